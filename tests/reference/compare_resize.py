# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Compares the resize op with OpenCV and torch on random images of many sizes, up and down.

    cmake --build --preset cpu --target reference_tool
    python tests/reference/compare_resize.py build/cpu/bin/reference_tool [--count 500] [--seed 0] [--only opencv_bilinear]

Run in an environment with OpenCV and torch.  Noise and black and white alternate, because ties and overshoots are rare in
photographs.  Exit code 1 at the first OpenCV image, or the first torch byte off by more than one, that differs; torch
kernels for other machines sum in another order, so that differing bytes are counted there.
"""

import argparse
import io
import struct
import subprocess

import cv2
import numpy as np
from resize_references import REFERENCES


def runtime(tool: str, frame: np.ndarray, width: int, height: int, how: str) -> np.ndarray:
    file = io.BytesIO()
    np.save(file, frame)
    data = file.getvalue()
    done = subprocess.run([tool, "image", str(width), str(height), how], input=struct.pack("<I", len(data)) + data, stdout=subprocess.PIPE, check=True)
    return np.frombuffer(done.stdout[4:], "<f4").reshape(3, height, width)


def sizes(rng: np.random.Generator) -> tuple[int, ...]:
    largest = rng.choice([12, 60, 300, 900])
    width, height = rng.integers(1, largest + 1, 2)
    to_width, to_height = rng.integers(2, rng.choice([12, 60, 300, 500]) + 1, 2)
    kind = rng.random()
    if kind < 0.05:
        to_width = to_height = 448
    elif kind < 0.15:
        width, height = to_width * 2, to_height * (2 if kind < 0.1 else 1)
    elif kind < 0.25:
        width, height = to_width * rng.integers(1, 6), to_height * rng.integers(1, 6)
    return tuple(int(n) for n in (width, height, to_width, to_height))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("tool")
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=REFERENCES)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(args.seed)
    for how in [args.only] if args.only else REFERENCES:
        equal = n_byte = n_off = 0
        for i in range(args.count):
            width, height, to_width, to_height = sizes(rng)
            frame = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
            frame = frame if i % 2 else frame // 128 * 255
            expected = REFERENCES[how](frame, to_width, to_height)
            found = np.rint(runtime(args.tool, frame, to_width, to_height, how) * 255).astype(np.uint8).transpose(1, 2, 0)
            off = np.abs(found.astype(int) - expected)
            if off.max() > (0 if how == "opencv_bilinear" else 1):
                raise SystemExit(f"{how}: {width} x {height} to {to_width} x {to_height} differs by {off.max()}")
            equal, n_byte, n_off = equal + (off.max() == 0), n_byte + off.size, n_off + np.count_nonzero(off)
        print(f"{how}: {equal} of {args.count} images equal, {n_off} of {n_byte} bytes differ")


main()
