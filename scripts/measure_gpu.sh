#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# scripts/measure_gpu.sh OUT [FAMILY ...]: everything that is to be known of a GPU, in one go, into OUT and as the table OUT/table.md for
# docs/gpu.md: the golden cases in every precision; `vla bench` of all families, or of those that are named, at their published sizes beside
# the prediction and, where TORCH names a Python with torch and lerobot, PyTorch eager, compiled and with CUDA graphs; products in all shapes
# of blocks. It needs `make cuda` and the tests' build. What fails is told, and the rest goes on.
#
#   TORCH=/path/to/python   PyTorch's; without it its columns say "not measured"
#   MODEL=h100              the model whose prediction stands beside (vla bench --model)
#   ROUNDS=20  SIZES=all    inferences that are timed, and how many sizes of products
#   TRY=1                   on the driver of tests: golden cases in the place of published sizes. No figure means anything then
set -uo pipefail
out=${1:?where to write}
shift
root=$(cd "$(dirname "$0")/.." && pwd)
build=${VLA_BUILD_DIR:-$root/build/cpu}
vla=$build/bin/vla python=$root/.venv/bin/python
rounds=${ROUNDS:-20} try=${TRY:-} torch_device=cuda
families=("$@")
[ ${#families[@]} -gt 0 ] || families=(act bitvla evo1 gr00t_n1_5 gr00t_n1_6 gr00t_n1_7 pi0 pi05 smolvla turbovla vla_jepa xvla)
if [ -n "$try" ]; then
  export LD_LIBRARY_PATH=$build/fake_cuda
  torch_device=cpu
fi
mkdir -p "$out/cases"
out=$(cd "$out" && pwd)
say() { echo "measure_gpu: $*" >&2; }
# $1: file for the output; a command that fails leaves its error there instead
keep() {
  local file=$1
  shift
  "$@" > "$file" 2> "$file.err" && rm -f "$file.err" || { say "failed: $* ($(tail -n 1 "$file.err"))"; rm -f "$file"; }
}

nvidia-smi --query-gpu=name,driver_version,clocks.max.sm,power.limit --format=csv,noheader > "$out/machine.txt" 2>/dev/null ||
  "$vla" inspect --devices | grep '^cuda' > "$out/machine.txt" || { say "no device: $("$vla" inspect --devices | grep cuda)"; exit 1; }

say "golden cases"
ladder=()
if [ -n "$try" ]; then ladder=(-k "every_tap or nearer"); else export VLA_ALL_CASES=1; fi  # one case of each family
VLA_TEST_DEVICE=cuda VLA_BINARY=$vla VLA_LIBRARY=$build/lib/libvla.so.1 \
  "$root/scripts/pytest.sh" "$root/tests/gpu" "${ladder[@]}" > "$out/ladder.txt" 2>&1 || say "golden cases failed: $out/ladder.txt"

for family in "${families[@]}"; do
  say "$family"
  what=(--arch "$family" --size full) case=$out/cases/$family
  if [ -n "$try" ]; then
    case=$(ls -d "$root/build/goldens/$family"/*/ | head -n 1)
    what=("$case/bundle.gguf")
  fi
  keep "$out/$family.predicted.json" "$vla" bench "${what[@]}" --device cuda --model "${MODEL:-h100}" --json
  for kernels in stored int8; do
    option=()
    if [ $kernels = int8 ]; then
      [ "$family" != bitvla ] || continue               # its products are of int8 already
      [ -z "$try" ] || [ "$family" = act ] || continue  # other golden cases have no matrix that is large enough
      option=(--kernels int8)
    fi
    keep "$out/$family.$kernels.json" "$vla" bench "${what[@]}" --device cuda "${option[@]}" --runs "$rounds" --warmup 3 --json
  done
  [ -n "${TORCH:-}" ] || continue
  if [ -z "$try" ] && [ ! -d "$case/checkpoint" ]; then
    "$TORCH" "$root/tools/parity_full.py" --case "$case" --arch "$family" --only write > "$out/$family.case.txt" 2>&1 ||
      { say "$family: no checkpoint for PyTorch: $(tail -n 1 "$out/$family.case.txt")"; continue; }
  fi
  for mode in eager compiled graphs; do
    keep "$out/$family.torch_$mode.json" "$TORCH" "$root/tools/peers/gpu.py" --case "$case" --mode $mode --rounds "$rounds" \
      --device $torch_device
  done
  [ -n "$try" ] || rm -rf "$case"  # up to 14 GB
done

say "products"
sizes=()
[ "${SIZES:-all}" = all ] || sizes=("$SIZES")
[ -z "$try" ] || sizes=(1 1)
keep "$out/products.jsonl" "$build/bin/bench_products" "${sizes[@]}"
"$python" "$root/scripts/gpu_table.py" "$out" > "$out/table.md" && cat "$out/table.md"
