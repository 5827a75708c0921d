# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla serve` as a process, a robot that asks it, and what `vla run` says to the same observation."""

import os
import re
import shlex
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

import vla_cpp

ROOT = Path(__file__).resolve().parents[2]
VLA = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
SECONDS = 20  # for what takes milliseconds on a machine with nothing else to do


class Server:
    """`told` are the fields of its ready line; `before` is called in its process before the program."""

    def __init__(self, case, *options, address="tcp://127.0.0.1:0", before=None):
        assert VLA.is_file(), f"{VLA} is not built: run `make build`, or set VLA_BINARY"
        command = [VLA, "serve", case.bundle, "--bind", address, "--threads", "1", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, preexec_fn=before)
        line = self.process.stdout.readline()
        assert line.startswith("ready "), line
        self.told = dict(field.split("=", 1) for field in shlex.split(line)[1:])
        self.address = re.match(r"tcp://127\.0\.0\.1:\d+", self.told["address"])[0]

    def stop(self, how=signal.SIGTERM):
        self.process.send_signal(how)
        self.process.wait(SECONDS)
        self.process.stdout.close()
        return self.process.returncode


class Robot:
    """A client that behaves, and checks what it gets."""

    def __init__(self, address, case):
        self._client = vla_cpp.Client(address, timeout=SECONDS)
        self._observation = {"images": frames(case), "state": case.state, "text": case.text}
        self._expected = {seed: self._act(seed).actions.tobytes() for seed in range(4)}

    def _act(self, seed):
        return self._client.act(**self._observation, seed=seed)

    def acts(self, n=40):
        """Median seconds of an act. None may be lost or wrong."""
        seconds = []
        for i in range(n):
            start = time.perf_counter()
            assert self._act(i % 4).actions.tobytes() == self._expected[i % 4]
            seconds.append(time.perf_counter() - start)
        return statistics.median(seconds)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._client.close()


def first_in_line():
    """The option by which scripts that time go before all other work of the machine, where that is allowed."""
    may = subprocess.run([sys.executable, "-c", "import os; os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))"], capture_output=True)
    return [] if may.returncode else ["--real-time"]


def frames(case):
    return {
        view: None if file is None else np.asarray(Image.open(file).convert("RGB"))
        for view, file in case.images.items()
    }


def ran(case, folder, *start, text=None):
    """The chunk of `vla run`, which reads the same observation from files."""
    arguments = case.arguments(text=text, options=("--out", folder / "run.npy"))
    at = arguments.index("--noise")
    arguments[at : at + 2] = start
    subprocess.run([VLA, *map(str, arguments)], check=True, capture_output=True)
    return np.load(folder / "run.npy")
