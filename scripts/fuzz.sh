#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# scripts/fuzz.sh SECONDS: runs every target of build/fuzz/bin for that long, one after the other, then the converter on
# damaged checkpoints, and fails when one crashes, hangs, leaks or takes too much memory. What it finds lies in build/fuzz/found/<target>/ and belongs into
# tests/fuzz/regressions/<target>/ once it is fixed; what it learns stays in build/fuzz/corpus/<target>/ for the next run.
set -euo pipefail
seconds=${1:?usage: scripts/fuzz.sh SECONDS}
cd "$(dirname "$0")/.."

failed=()
goldens=$(.venv/bin/python -c 'import sys; sys.path.insert(0, "tests/cli"); import golden_cases; print(golden_cases.FOLDER)')
for target in build/fuzz/bin/*_fuzz; do
  [ -x "$target" ] || { echo "no targets in build/fuzz/bin: make fuzz builds them" >&2; exit 1; }
  name=$(basename "$target" _fuzz)
  corpus=build/fuzz/corpus/$name found=build/fuzz/found/$name
  mkdir -p "$corpus" "$found"
  seeds=() longest=20000
  [ -d "tests/fuzz/regressions/$name" ] && seeds+=("tests/fuzz/regressions/$name")
  [ "$name" = image ] && seeds+=(tests/processor/data/images)
  if [ "$name" = recipe ]; then  # of each golden case
    .venv/bin/python - "$corpus" "$goldens" <<'EOF'
import pathlib, sys
import gguf
corpus, goldens = map(pathlib.Path, sys.argv[1:])
for bundle in goldens.glob("*/*/bundle.gguf"):
    (corpus / "-".join(bundle.parts[-3:-1])).write_text(gguf.GGUFReader(bundle).fields["processor.recipe"].contents())
EOF
  fi
  if [ "$name" = act ]; then  # a bundle of each architecture
    for arch in "$goldens"/*/; do
      bundle=$(find "$arch" -name bundle.gguf | sort | head -1)
      cp "$bundle" "$corpus/$(basename "$arch")"
    done
    two=$(mktemp -d)  # and one for two robots
    .venv/bin/python - "$two" <<'EOF'
import pathlib, sys
sys.path.insert(0, "tests/cli")
import embodiment_test
embodiment_test.joint("gr00t_n1_6/faint", pathlib.Path(sys.argv[1]))
EOF
    cp "$two"/*.gguf "$corpus/two_robots"
    rm -r "$two"
    longest=400000
  fi
  echo "== $name, $seconds s"
  "$target" -max_total_time="$seconds" -max_len="$longest" -timeout=20 -rss_limit_mb=2048 -print_final_stats=1 \
    -artifact_prefix="$found/" "$corpus" ${seeds[@]+"${seeds[@]}"} >"build/fuzz/$name.log" 2>&1 || failed+=("$name")
  grep -E "number_of_executed_units|peak_rss_mb" "build/fuzz/$name.log" || true
done
echo "== checkpoint, $seconds s"
.venv/bin/python tests/fuzz/checkpoint_fuzz.py "$seconds" "$RANDOM" | tee build/fuzz/checkpoint.log || failed+=(checkpoint)
[ ${#failed[@]} -eq 0 ] && exit 0
for name in "${failed[@]}"; do
  echo "FAILED $name: build/fuzz/$name.log ends with" >&2
  tail -30 "build/fuzz/$name.log" >&2
done
exit 1
