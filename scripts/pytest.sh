#!/bin/sh
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# scripts/pytest.sh FOLDER ...: pytest with the environment of the tests. ctest calls it; that environment is looked for
# only now, because a build may well be configured before the environment exists.
cd "$(dirname "$0")/.." || exit 1
python=.venv/bin/python
if [ ! -x "$python" ]; then
  echo "error: $PWD/$python: expected the environment of the tests, found nothing; make test prepares it" >&2
  exit 1
fi
# Byte code and caches stay out of the tree: the lint looks at what lies in it.
PYTHONPYCACHEPREFIX="$PWD/.cache/pycache" exec "$python" -m pytest -q -rsfE -p no:cacheprovider "$@"
