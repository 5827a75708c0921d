# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of cameras of any size, the same on every machine: for tests/cli/camera_sizes_test.py and tools/camera_sizes.py."""

import numpy as np

CAMERAS = [(640, 480), (1280, 720), (320, 240), (224, 224), (256, 256), (320, 180), (848, 480), (480, 640), (752, 480)]


def frame(width, height, number):
    """uint8 (height, width, 3): soft in some places, sharp in others."""
    y, x, c = np.mgrid[0:height, 0:width, 0:3]
    soft = 90 + 60 * np.sin(0.07 * x + 0.3 * number + c) + 60 * np.cos(0.05 * y - c)
    sharp = (x // 7 + y // 5 + number) % 2 * 35
    return np.clip(np.rint(soft + sharp), 0, 255).astype(np.uint8)


def drawn_sizes(random, n_view, stated):
    """(width, height) of each view: a usual camera, the case's own, near it, or anything small."""

    def size():
        kind = random.random()
        if kind < 0.25:
            return CAMERAS[random.integers(len(CAMERAS))]
        width, height = stated[random.integers(len(stated))]
        if kind < 0.45:
            return width, height
        if kind < 0.6:
            scale = int(random.integers(1, 5))
            return width * scale, height * scale
        if kind < 0.8:
            return width + int(random.integers(-4, 5)), height + int(random.integers(-4, 5))
        return int(random.integers(8, 200)), int(random.integers(8, 200))

    first = size()
    sizes = [first if random.random() < 0.5 else size() for _ in range(n_view)] if n_view > 1 and random.random() < 0.5 else [first] * n_view
    return [(max(2, int(width)), max(2, int(height))) for width, height in sizes]
