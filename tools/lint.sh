#!/bin/sh
# SPDX-License-Identifier: MIT
# lint.sh BUILD BIN: every linter, all of them even where one fails; BIN is the virtual environment's bin folder.
set -u
build=$1
bin=$2
failed=""
step() {
  name=$1
  shift
  echo "== $name"
  "$@" || failed="$failed, $name"
}

step clang-format sh -c 'find cpp tests -name "*.[ch]pp" -print0 | xargs -0 clang-format --dry-run -Werror'
step ruff "$bin/ruff" check .
step "ruff format" "$bin/ruff" format --check .
step mypy "$bin/mypy"
step clang-tidy "$bin/python" tools/tidy.py "$build/compile_commands.json"

if [ -n "$failed" ]; then
  echo "lint: FAILED: ${failed#, }"
  exit 1
fi
echo "lint: passed"
