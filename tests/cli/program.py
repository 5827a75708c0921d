# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the binary as a script would, and looks at what a script can see: exit code, streams, time, memory."""

import json
import os
import re
import resource
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass

EXIT = {
    "internal": 1,
    "usage": 2,
    "bad_bundle": 3,
    "bad_observation": 4,
    "bad_action": 5,
    "unsupported": 6,
    "out_of_memory": 7,
    "device": 8,
    "io": 9,
    "mismatch": 10,
}


IS_SANITIZED = "asan" in os.environ.get("VLA_BINARY", "")


def every_third_if_sanitized(names, first=0):
    """Cases of whole families: a sanitizer watches the same code in each, and their numbers are for the plain build to test."""
    return list(names)[first::3] if IS_SANITIZED else list(names)


def _no_constant(name):
    raise ValueError(f"{name} is not JSON")


@dataclass(frozen=True)
class Answer:
    code: int  # as a shell sees it; negative: killed by that signal
    out: str
    err: str
    seconds: float
    peak: int  # bytes of memory at the most

    def json(self):
        """The object on the last line of output."""
        assert self.code == 0, self.err
        return json.loads(self.out.splitlines()[-1], parse_constant=_no_constant)

    def refused(self, code, *parts):
        """Whether this is one typed error: its exit code, one line on stderr that has `parts`, nothing on stdout."""
        assert self.code == EXIT[code], (self.code, self.err)
        assert self.out == ""
        call = r"arguments: [^\n]+; (did you mean \S+ )?see vla( \w+)? --help"  # of a call that cannot be read
        assert re.fullmatch(rf"error: {code}: ({call}|[^\n]+: expected [^\n]+, found [^\n]+)\n", self.err), self.err
        for part in parts:
            assert part in self.err, (part, self.err)
        return self


class Program:
    def __init__(self, path):
        self.path = str(path)
        # A sanitizer's allocator must answer an impossible request as malloc does, so that the program's answer is seen.
        self.environment = {**os.environ, "ASAN_OPTIONS": "allocator_may_return_null=1", "OMP_NUM_THREADS": "2"}

    def cpu(self):
        """What the program says of the processor: memory, precision of products, kernels."""
        return next(line for line in self("inspect", "--devices").out.splitlines() if line.startswith("cpu "))

    def __call__(self, *args, stdout=None, limit=60, memory=None):
        """memory: bytes of address space that the program may take."""
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            start = time.monotonic()
            process = subprocess.Popen(
                [self.path, *map(os.fsencode, map(os.fspath, map(_text, args)))],
                stdin=subprocess.DEVNULL,
                stdout=stdout or out,
                stderr=err,
                env=self.environment,
                preexec_fn=memory and (lambda: resource.setrlimit(resource.RLIMIT_AS, (memory, memory))),
            )
            killer = threading.Timer(limit, process.kill)
            killer.start()
            _, status, usage = os.wait4(process.pid, 0)
            killer.cancel()
            process.returncode = os.waitstatus_to_exitcode(status)
            seconds = time.monotonic() - start
            assert seconds < limit, f"no answer within {limit} s"
            out.seek(0), err.seek(0)
            return Answer(
                process.returncode,
                out.read().decode(),
                err.read().decode("utf-8", "replace"),
                seconds,
                usage.ru_maxrss * 1024,
            )


def _text(argument):
    return argument if isinstance(argument, (str, bytes, os.PathLike)) else str(argument)
