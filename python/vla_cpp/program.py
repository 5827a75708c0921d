# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla`, as pip puts it on the PATH: the program that a wheel carries takes this process over."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import List

from .installed import PACKAGE, source_tree


def candidates() -> List[Path]:
    """Where the program may be, best first."""
    root = source_tree()
    return [PACKAGE / "bin/vla", *([root / "build/cpu/bin/vla"] if root else [])]


def main() -> int:
    for path in candidates():
        if path.is_file():
            os.execv(path, ["vla", *sys.argv[1:]])
    print(f"vla: expected {' or '.join(map(str, candidates()))}, found no such file", file=sys.stderr)
    return 9


if __name__ == "__main__":
    sys.exit(main())
