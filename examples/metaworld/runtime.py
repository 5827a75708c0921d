# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Asks the C++ runtime for a chunk: one call of `vla run`, as anybody would make it from a shell."""
import json
import shlex
import subprocess
from pathlib import Path
from typing import Any, Dict, List, Union

import numpy as np

Name = Union[str, Path]


def command(vla: Name, bundle: Name, frame: Name, state: np.ndarray, text: str, noise: Name, threads: int = 0) -> List[str]:
    """The command line.  frame: a PNG file; state (4,) in metres and gripper opening; noise: a .npy file (16, 8) float32;
    threads: 0 takes every core.  In float32, as PyTorch computed what the chunks are compared with."""
    values = ",".join(format(float(x), ".9g") for x in state)  # 9 digits bring a float32 back exactly
    return [str(vla), "run", str(bundle), "--image", f"corner4={frame}", "--state", values, "--text", text,
            "--noise", str(noise), "--threads", str(threads), "--kernels", "float32", "--json"]


def run(vla: Name, bundle: Name, frame: Name, state: np.ndarray, text: str, noise: Name, threads: int = 0) -> Dict[str, Any]:
    """The runtime's answer: `actions` as an array (16, 4) float32, `timing_ms`, `bundle` and what else it says."""
    line = command(vla, bundle, frame, state, text, noise, threads)
    try:
        done = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True, timeout=300)
    except (FileNotFoundError, PermissionError) as e:
        raise SystemExit(f"cannot start {vla}: {e.strerror}. Build it first:  cmake --preset cpu && cmake --build --preset cpu")
    except subprocess.TimeoutExpired:
        raise SystemExit(f"{vla} gave no answer within 5 minutes")
    if done.returncode:
        raise SystemExit(f"{vla} run failed ({done.returncode}):\n{done.stderr.strip()}\nThe call was:\n{' '.join(shlex.quote(x) for x in line)}")
    try:
        answer = json.loads(done.stdout.strip().splitlines()[-1])
        answer["actions"] = np.asarray(answer["actions"], np.float32)
    except (IndexError, KeyError, ValueError) as e:
        raise SystemExit(f"the last line of `{vla} run --json` is not the expected JSON object ({e!r}):\n{done.stdout[-500:]}")
    return answer
