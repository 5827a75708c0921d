# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla serve` as a process, and what `vla run` says to the same observation."""

import os
import re
import signal
import subprocess
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
VLA = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
SECONDS = 20  # for what takes milliseconds on a machine with nothing else to do


class Server:
    def __init__(self, case, *options, address="tcp://127.0.0.1:0"):
        assert VLA.is_file(), f"{VLA} is not built: run `make build`, or set VLA_BINARY"
        command = [VLA, "serve", case.bundle, "--bind", address, "--threads", "1", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        line = self.process.stdout.readline()
        assert line.startswith("ready "), line
        self.address = re.search(r"address=(tcp://127\.0\.0\.1:\d+)", line)[1]

    def stop(self, how=signal.SIGTERM):
        self.process.send_signal(how)
        self.process.wait(SECONDS)
        self.process.stdout.close()
        return self.process.returncode


def frames(case):
    return {
        view: None if file is None else np.asarray(Image.open(file).convert("RGB"))
        for view, file in case.images.items()
    }


def ran(case, folder, *start):
    """The chunk of `vla run`, which reads the same observation from files."""
    arguments = case.arguments(options=("--out", folder / "run.npy"))
    at = arguments.index("--noise")
    arguments[at : at + 2] = start
    subprocess.run([VLA, *map(str, arguments)], check=True, capture_output=True)
    return np.load(folder / "run.npy")
