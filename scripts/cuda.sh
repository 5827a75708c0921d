#!/usr/bin/env bash
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# scripts/cuda.sh FOLDER: a CUDA toolkit in FOLDER/nvidia/cu13, from the wheels that cmake/cuda-requirements.txt pins.
set -euo pipefail
folder=$1 wheels=$(dirname "$0")/../cmake/cuda-requirements.txt
cmp -s "$wheels" "$folder/.complete" && exit 0

echo "cuda: downloading NVIDIA's compiler and cuBLAS (525 MB, once)"
python=$(dirname "$0")/../.venv/bin/python
[ -x "$python" ] || python=python3
rm -rf "$folder"
"$python" -m pip install --quiet --disable-pip-version-check --no-deps --only-binary :all: \
  --require-hashes -r "$wheels" --target "$folder"

# Names under which CMake and the linker look for what lies there under others.
cd "$folder/nvidia/cu13"
ln -s lib lib64
for library in cudart cublas cublasLt; do ln -s "lib$library.so.13" "lib/lib$library.so"; done
cd - >/dev/null
cp "$wheels" "$folder/.complete"
