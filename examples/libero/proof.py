# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Draws one task of LIBERO as a policy sees it, both cameras side by side, to show that the installation works.

    python proof.py out/libero.png
"""

import os
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from vla_cpp.eval.environment import Guard
from vla_cpp.eval.environments import MissingSimulator, make

TASK = "libero_object/0"


def main() -> int:
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "libero.png")
    begin = time.perf_counter()
    print(f"making {TASK}: a minute, most of it the compiler of numba", flush=True)
    try:
        guard = Guard(make("libero", TASK))
    except MissingSimulator as error:
        print(f"proof: {error}", file=sys.stderr)
        return 9
    guard.reset(0)
    seen = guard.observe()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(list(seen.frames.values()), axis=1)).save(str(path))
    print(f"{path}: \"{guard.instruction()}\", both cameras, after {time.perf_counter() - begin:.0f} s")
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # MuJoCo's destructors print errors at a normal exit
