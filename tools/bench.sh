#!/bin/sh
# SPDX-License-Identifier: MIT
# bench.sh BUILD: run every Google Benchmark program of the build.
set -eu
found=no
for program in "$1"/cpp/bench/bench_*; do
  [ -x "$program" ] && [ -f "$program" ] || continue
  found=yes
  echo "== $(basename "$program")"
  "$program"
done
[ $found = yes ] || { echo "tools/bench.sh: no benchmark programs in $1/cpp/bench; build with -DAJNA_BUILD_BENCH=ON" >&2; exit 1; }
