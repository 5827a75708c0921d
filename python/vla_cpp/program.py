# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The command `vla` that pip installs: it replaces this process by the program in the wheel."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import List

from .installed import PACKAGE, source_tree


def candidates() -> List[Path]:
    """Paths to look for the program, in order of preference."""
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
