#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# scripts/cuda.sh FOLDER [nvcc]: a CUDA toolkit in FOLDER/nvidia/cu13, from the wheels that cmake/cuda-requirements.txt
# pins; with nvcc, those of cmake/nvcc-requirements.txt alone: the compiler, without cuBLAS.
set -euo pipefail
folder=$1 what=${2:-cuda} lists=$(dirname "$0")/../cmake
pinned=$(cat "$lists/nvcc-requirements.txt" "$lists/$what-requirements.txt")
[ "$(cat "$folder/.complete" 2>/dev/null)" = "$pinned" ] && exit 0

if [ "$what" = nvcc ]; then size="compiler (100 MB, once)"; else size="compiler and cuBLAS (525 MB, once)"; fi
echo "cuda: downloading NVIDIA's $size"
python=$(dirname "$0")/../.venv/bin/python
[ -x "$python" ] || python=python3
rm -rf "$folder"
"$python" -m pip install --quiet --disable-pip-version-check --no-deps --only-binary :all: \
  --require-hashes -r "$lists/$what-requirements.txt" --target "$folder"

if [ "$what" = cuda ]; then  # names under which CMake and the linker look for what lies there under others
  (
    cd "$folder/nvidia/cu13"
    ln -s lib lib64
    for library in cudart cublas cublasLt; do ln -s "lib$library.so.13" "lib/lib$library.so"; done
  )
fi
echo "$pinned" > "$folder/.complete"
