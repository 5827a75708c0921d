#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# arm64_depends.sh SYSROOT FILE ...: what a Debian package with programs and libraries for 64-bit ARM depends on, as the packages that
# SYSROOT was laid from say it of each library that the files load (Debian Policy, 8.6.4: shlibs files).
set -euo pipefail
shlibs=$1/.shlibs
shift
depends=()
for name in $(readelf --dynamic --wide "$@" | sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p' | sort -u); do
  case $name in
    libvla.so*) continue ;;
    *.so.*) library=${name%%.so.*} version=${name#*.so.} ;;
    *) library=${name%-*} version=${name##*-} version=${version%.so} ;;
  esac
  found=$(awk -v library="$library" -v version="$version" '$1 == library && $2 == version {$1 = $2 = ""; print; exit}' "$shlibs")
  if [ -z "$found" ]; then
    echo "arm64_depends: $shlibs: expected a line for $name, found none" >&2
    exit 1
  fi
  depends+=("${found#"${found%%[! ]*}"}")
done
printf '%s\n' "${depends[@]}" | sort -u | paste -sd, | sed 's/,/, /g'
