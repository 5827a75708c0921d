#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# scripts/measure_gpu.sh OUT [OPTION ...]: what `make gpu-kit` packed runs on this machine's GPU into OUT, and the result becomes data and
# tables of docs/gpu. Needs NVIDIA's driver, Python and out/vla-gpu-kit.tar.xz, nothing that is built here. Options are those of
# scripts/gpu_kit/try_gpu.py: stages, --families, --torch, ...
set -euo pipefail
out=${1:?where to write}
shift
root=$(cd "$(dirname "$0")/.." && pwd)
kit=$root/out/vla-gpu-kit.tar.xz
[ -f "$kit" ] || { echo "error: $kit: expected what make gpu-kit packs, found nothing" >&2; exit 1; }
unpacked=$(mktemp -d)
trap 'rm -rf "$unpacked"' EXIT
python3 -m tarfile -e "$kit" "$unpacked"  # a bare system has no xz
status=0
python3 "$unpacked/vla-gpu-kit/try_gpu.py" "$out" "$@" || status=$?
python3 "$root/scripts/gpu_table.py" --keep "$out/result.json"
exit $status
