#!/bin/sh
# SPDX-License-Identifier: MIT
# test.sh BUILD PYTHON: run CTest, then pytest against the installed package; fail if either failed, show both results.
set -u
build=$1
python=$2

# The installed package, not the source tree: whatever a developer's shell has set.
unset PYTHONPATH
export AJNA_TEST_BUILD_DIR="$PWD/$build"

jobs=$(nproc)
ctest --test-dir "$build" --output-on-failure --no-tests=error -j "$jobs"
cpp=$?
"$python" -m pytest tests/python ${PYTEST_ARGS:-}
py=$?

verdict() { if [ "$1" -eq 0 ]; then echo passed; else echo "FAILED (exit code $1)"; fi; }
echo "C++ tests (CTest): $(verdict $cpp)"
echo "Python tests (pytest): $(verdict $py)"
[ $cpp -eq 0 ] && [ $py -eq 0 ]
