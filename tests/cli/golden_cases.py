# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The golden cases as command lines, and bundles of theirs that were changed and sealed again."""

import json
import struct
import sys
from pathlib import Path

import gguf
import numpy as np
import xxhash

FLOAT32 = ["--kernels", "float32"]  # for what is held to the reference's float32, on machines that multiply bf16 too

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))
from goldens.build import make  # noqa: E402
from goldens.cases import arguments  # noqa: E402

FOLDER = make()
NAMES = sorted(str(path.parent.relative_to(FOLDER)) for path in FOLDER.glob("*/*/observation.json"))


def tensors(path):
    """{name: float32 array} of a GGUF file; shapes as numpy has them, slowest first."""
    return {t.name: np.array(t.data) for t in gguf.GGUFReader(path).tensors}


def _states(state):
    """Arguments of --state: the numbers of the only feature, or those of each by name."""
    if not isinstance(state, dict):
        return [",".join(map(repr, state))]
    return [f"{name}={','.join(map(repr, numbers))}" for name, numbers in state.items()]


class Golden:
    """One case, `arch/name`, or the name alone of one of SmolVLA's.  `arguments` is a sound call of `vla run`, of which a
    test changes one thing."""

    def __init__(self, name):
        self.folder = FOLDER / (name if "/" in name else f"smolvla/{name}")
        self.bundle, self.noise, self.expected = (
            self.folder / f for f in ("bundle.gguf", "noise.npy", "expected.gguf")
        )
        observation = json.loads((self.folder / "observation.json").read_text(encoding="utf-8"))
        self.images = {view: file and self.folder / file for view, file in observation["images"].items()}
        self.state, self.text = observation["state"], observation["text"]
        said = self.folder / "convert.json"
        self.said = json.loads(said.read_text(encoding="utf-8")) if said.is_file() else {}

    @property
    def arch(self):
        return gguf.GGUFReader(self.bundle).fields["vla.arch"].contents()

    def conversion(self):
        """Options of vla-convert for what the checkpoint does not say."""
        return arguments(self.said, self.folder)

    def arguments(self, bundle=None, images=None, state=None, text=None, noise=None, options=("--json",)):
        images = self.images if images is None else images
        states = _states(self.state) if state is None else [state]
        return [
            "run",
            bundle or self.bundle,
            *(a for v, f in images.items() for a in ("--image", f"{v}={f or ''}")),
            *(a for s in states for a in ("--state", s)),
            "--text",
            self.text if text is None else text,
            "--noise",
            noise or self.noise,
            "--threads",
            "2",
            *options,
        ]

    def with_image(self, view, file):
        """The images with another file, or None, for one view."""
        return {**self.images, view: file}


def sealed(data):
    """The bytes of a changed bundle with the checksum that fits them, as docs/bundle.md defines it."""
    data = bytearray(data)
    digits = data.index(b"xxh3:", data.index(b"vla.checksum")) + 5
    data[digits : digits + 16] = b"0" * 16
    data[digits : digits + 16] = xxhash.xxh3_64(bytes(data)).hexdigest().encode()
    return bytes(data)


def replaced(data, old, new):
    """One place of the bytes changed to others of the same length."""
    assert data.count(old) == 1 and len(old) == len(new), (data.count(old), old, new)
    return data.replace(old, new)


def with_integer(data, key, value):
    """A bundle with another value for an unsigned 32-bit key."""
    head = struct.pack("<Q", len(key)) + key.encode() + struct.pack("<I", 4)
    at = data.index(head) + len(head)
    return data[:at] + struct.pack("<I", value) + data[at + 4 :]


def data_offset(path, tensor):
    """Where the data of a tensor starts in its file."""
    return next(int(t.data_offset) for t in gguf.GGUFReader(path).tensors if t.name == tensor)
