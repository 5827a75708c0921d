#!/bin/sh
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# Makes checkpoints and bundles of the golden cases in build/goldens, where they are not there yet. Test programs call it when they
# start; VLA_PYTHON is an interpreter with numpy, gguf and xxhash, by default that of the tests.
cd "$(dirname "$0")/.." || exit 1
python=${VLA_PYTHON:-.venv/bin/python}
if [ ! -x "$python" ]; then
  echo "error: $PWD/$python: expected the environment of the tests, found nothing; make test prepares it" >&2
  exit 1
fi
PYTHONDONTWRITEBYTECODE=1 exec "$python" tools/goldens make
