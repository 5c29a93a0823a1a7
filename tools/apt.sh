#!/bin/sh
# SPDX-License-Identifier: MIT
# apt.sh PACKAGE...: install the Debian packages that are missing, as root or through sudo; nothing where all are there.
# The word `python` stands for what a virtual environment and an extension need, unless $PYTHON has it already.
set -eu

wanted=""
for package in "$@"; do
  if [ "$package" = python ]; then
    if ! "${PYTHON:-python3}" -c 'import ensurepip, os, sysconfig
assert os.path.exists(sysconfig.get_path("include") + "/Python.h")' >/dev/null 2>&1; then
      wanted="$wanted python3 python3-venv python3-dev"
    fi
  else
    wanted="$wanted $package"
  fi
done

missing=""
if command -v dpkg-query >/dev/null 2>&1; then
  for package in $wanted; do
    case "$(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null || true)" in
      installed) ;;
      *) missing="$missing $package" ;;
    esac
  done
else
  echo "tools/apt.sh: no dpkg here, so this is not Debian or Ubuntu; assuming that you have installed:$wanted" >&2
  exit 0
fi
[ -n "$missing" ] || exit 0

if [ "$(id -u)" -eq 0 ]; then
  as_root=""
elif command -v sudo >/dev/null 2>&1; then
  as_root="sudo"
else
  echo "tools/apt.sh: neither root nor sudo; ask an administrator for: apt-get install$missing" >&2
  exit 1
fi
echo "Installing Debian packages:$missing"
export DEBIAN_FRONTEND=noninteractive
# The package lists are fetched only where the known ones do not do: they may be empty (a fresh container) or old.
if ! $as_root apt-get install -y -q --no-install-recommends $missing >/dev/null 2>&1; then
  $as_root apt-get update -q
  $as_root apt-get install -y -q --no-install-recommends $missing
fi
