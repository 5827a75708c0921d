#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# sysroot.sh FOLDER: lays Debian's arm64 libraries in a folder, without root and without a change to this machine's packages. apt keeps
# lists and state of its own there, and packages are unpacked, not installed. (As a second architecture of the machine they would
# replace some of its own.) A folder with all of these packages stays as it is.
set -euo pipefail
folder=$(mkdir -p "$1" && cd "$1" && pwd)
state=$folder/.apt
packages=(libfmt-dev libpng-dev libjpeg62-turbo-dev libxxhash-dev libutf8proc-dev nlohmann-json3-dev libcli11-dev doctest-dev
          libzmq3-dev cppzmq-dev libsodium-dev libprotobuf-dev prometheus-cpp-dev libmsgpack-cxx-dev libboost-dev libnghttp2-dev
          libc6-dev libstdc++-12-dev)
content="${packages[*]}, and .shlibs"
[ "$(cat "$folder/.complete" 2>/dev/null)" = "$content" ] && exit 0
rm -rf "$state" && mkdir -p "$state"/{lists/partial,cache/archives/partial,state}
: > "$state/status"  # nothing is installed: all that is needed is downloaded
cat > "$state/apt.conf" <<CONF
Dir::State "$state/state";
Dir::State::status "$state/status";
Dir::State::lists "$state/lists";
Dir::Cache "$state/cache";
APT::Architecture "arm64";
APT::Architectures { "arm64"; };
Debug::NoLocking "true";
APT::Sandbox::User "$(id -un)";
CONF
export APT_CONFIG=$state/apt.conf
echo "sysroot: downloading arm64 libraries into $folder (90 MB, once)"
apt-get update -qq
apt-get install -qq -y --no-install-recommends --download-only "${packages[@]}" >/dev/null
# .shlibs: which package a program that needs a library depends on.
: > "$folder/.shlibs"
for package in "$state"/cache/archives/*.deb; do
  dpkg-deb -x "$package" "$folder"
  dpkg-deb -I "$package" shlibs 2>/dev/null >> "$folder/.shlibs" || true
done
# Links that name a file from the root of the machine would leave the folder.
find "$folder/usr/lib" "$folder/lib" -type l -lname '/*' 2>/dev/null | while read -r link; do
  ln -sfn "$(realpath -m --relative-to="$(dirname "$link")" "$folder$(readlink "$link")")" "$link"
done
rm -rf "$state"
echo "$content" > "$folder/.complete"
