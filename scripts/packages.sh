#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# Installs the Debian or Ubuntu packages that the build needs, or says which are missing where that takes a password.
# `packages.sh demo` adds what the simulator draws with, `packages.sh fuzz` the compiler that has libFuzzer, `packages.sh vulkan` what
# libvla-vulkan.so is built with and Mesa's software driver for its tests, `packages.sh deb` what CPack tells with which libraries a
# program needs, `packages.sh test` an emulator of processors, `packages.sh arm64` the same and a compiler for 64-bit ARM.
set -euo pipefail

packages=(build-essential cmake ninja-build pkg-config python3 python3-pip python3-venv
          libcli11-dev nlohmann-json3-dev libfmt-dev libpng-dev libjpeg-dev libxxhash-dev libutf8proc-dev doctest-dev
          libzmq3-dev cppzmq-dev libsodium-dev libprotobuf-dev protobuf-compiler prometheus-cpp-dev libboost-dev libnghttp2-dev)
if apt-cache show libmsgpack-cxx-dev >/dev/null 2>&1 || ! apt-cache show libmsgpack-dev >/dev/null 2>&1; then
  packages+=(libmsgpack-cxx-dev)
else
  packages+=(libmsgpack-dev)  # its name before Ubuntu 22.10
fi
if [ "${1:-}" = demo ]; then
  if apt-cache show libegl1 >/dev/null 2>&1 && ! apt-cache show libosmesa6 >/dev/null 2>&1; then
    packages+=(libegl1 libgl1-mesa-dri)  # newer releases have no OSMesa any more
  else
    packages+=(libosmesa6)
  fi
fi
if [ "${1:-}" = fuzz ]; then
  packages+=(clang)
  # Newer releases only recommend the libraries behind -fsanitize, libFuzzer's too.
  version=$(apt-cache depends clang 2>/dev/null | sed -n 's/^ *Depends: clang-\([0-9]*\)$/\1/p')
  if apt-cache show "libclang-rt-$version-dev" >/dev/null 2>&1; then packages+=("libclang-rt-$version-dev"); fi
fi
if [ "${1:-}" = test ]; then packages+=(qemu-user); fi
if [ "${1:-}" = deb ]; then packages+=(dpkg-dev file); fi
if [ "${1:-}" = arm64 ]; then packages+=(qemu-user g++-aarch64-linux-gnu); fi
if [ "${1:-}" = vulkan ]; then packages+=(glslc libvulkan-dev spirv-headers mesa-vulkan-drivers); fi

if ! command -v dpkg-query >/dev/null; then
  echo "packages: this is not Debian or Ubuntu; install what corresponds to: ${packages[*]}" >&2
  exit 0
fi
missing=()
for package in "${packages[@]}"; do
  status=$(dpkg-query -W -f '${Status}' "$package" 2>/dev/null || true)
  [ "$status" = "install ok installed" ] || missing+=("$package")
done
[ ${#missing[@]} -eq 0 ] && exit 0

as_root=()
if [ "$(id -u)" -ne 0 ]; then
  if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root=(sudo)
  else
    echo "packages: missing ${missing[*]}" >&2
    echo "packages: please run:  sudo apt-get install ${missing[*]}" >&2
    exit 1
  fi
fi
echo "packages: installing ${missing[*]}"
"${as_root[@]}" apt-get update -qq
DEBIAN_FRONTEND=noninteractive "${as_root[@]}" apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
