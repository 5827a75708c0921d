#!/bin/sh
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# packaging/image.sh [FOLDER]: builds packaging/Containerfile with buildah where no registry of images is reached, and
# tries the image: its user, its size, and an act of the shipped policy, served in it and asked for from outside. FOLDER
# has a package of `make deb` on Debian 12, which stands in for the first stage and its quarter of an hour of compiling.
# IMAGE_ARGS goes to `buildah build`, MIRROR to debootstrap in the place of its own. Needs root, buildah, debootstrap,
# and a PYTHON with numpy, pyzmq and protobuf; takes two minutes and 1 GB of disk.
set -eu
package=${1:+$(cd "$1" && pwd)}
cd "$(dirname "$0")/.."
most_mb=120  # megabytes of all files of the image
work=$(mktemp -d)
export BUILDAH_ISOLATION=chroot
store="--root $work/images --runroot $work/run"
server=
finish() {
  [ -z "$server" ] || { kill "$server" && wait "$server"; } 2>/dev/null || true  # buildah ends what it runs
  buildah $store rm --all >/dev/null 2>&1 || true
  umount "$work/images/overlay" 2>/dev/null || true
  rm -rf --one-file-system "$work"
}
trap finish EXIT
trap 'exit 1' INT TERM
fail() {  # LOG: its end says why
  tail -n 40 "$1" >&2
  exit 1
}

image_of() {  # FOLDER NAME
  container=$(buildah $store from scratch)
  buildah $store add -q "$container" "$1" / >/dev/null
  buildah $store commit -q --rm "$container" "$2" >/dev/null
}

# Debian's published images are made of minbase too. The slim one is without what packages bring for people to read.
echo "image: a base by debootstrap"
base=$work/base
debootstrap --variant=minbase bookworm "$base" ${MIRROR:+"$MIRROR"} >"$work/log" || fail "$work/log"
rm -rf "$base"/var/cache/apt/* "$base"/var/lib/apt/lists/*
[ -n "$package" ] || image_of "$base" docker.io/library/debian:12
find "$base/usr/share/doc" -type f ! -name copyright -delete
for folder in man locale info lintian; do rm -rf "$base/usr/share/$folder"/*; done
{
  printf 'path-exclude /usr/share/%s\n' 'doc/*' 'man/*' 'locale/*' 'info/*' 'lintian/*'
  echo 'path-include /usr/share/doc/*/copyright'
} >"$base/etc/dpkg/dpkg.cfg.d/docker"
image_of "$base" docker.io/library/debian:12-slim
rm -rf "$base"

first_stage=
if [ -n "$package" ]; then
  mkdir -p "$work/build/src/out"
  cp "$package"/vla_*_"$(dpkg --print-architecture)".deb "$work/build/src/out"
  first_stage="--build-context build=$work/build"
fi
echo "image: packaging/Containerfile"
# shellcheck disable=SC2086  # several words each
buildah $store build --pull=never $first_stage ${IMAGE_ARGS:-} -f packaging/Containerfile -t vla . >"$work/log" 2>&1 ||
  fail "$work/log"

container=$(buildah $store from --pull=never vla)
inside="buildah $store run -v $PWD/models:/models:ro $container --"
echo "image: vla $($inside vla --version) as the user $($inside id -un)"
[ "$($inside id -un)" = nobody ]
$inside vla inspect /models/metaworld-tiny.gguf >/dev/null
$inside vla doctor /models/metaworld-tiny.gguf >"$work/log" 2>&1 || fail "$work/log"

$inside vla serve /models/metaworld-tiny.gguf --bind 'tcp://127.0.0.1:*' >"$work/ready" 2>"$work/log" &
server=$!
seconds=0
until [ -s "$work/ready" ]; do
  seconds=$((seconds + 1))
  [ "$seconds" -le 60 ] || fail "$work/log"  # a minute without a ready line
  sleep 1
done
PYTHONPATH=python "${PYTHON:-python3}" - "$(sed 's/^ready address=\([^ ]*\).*/\1/' "$work/ready")" <<'ACT'
import sys
from pathlib import Path
import vla_cpp
frame = Path("examples/metaworld/episodes/faucet-open/step_00.png").read_bytes()
with vla_cpp.Client(sys.argv[1], timeout=30) as policy:
    chunk = policy.act(images={"corner4": frame}, state=[0.0045, 0.4003, 0.1957, 1], text="open the faucet", seed=1)
    print("image: served an act,", *(f"{name} {value:.3f}" for name, value in zip(chunk.names, chunk[0])))
ACT

megabytes() { echo $(($(du -s --block-size=1 --apparent-size "$1" | cut -f1) / 1000000)); }
size=$(megabytes "$(buildah $store mount "$container")")
buildah $store push -q vla "oci:$work/packed" >/dev/null
echo "image: $size MB, at most $most_mb; compressed $(megabytes "$work/packed") MB"
[ "$size" -le "$most_mb" ]
