# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a chunk in a film names every action."""

from types import SimpleNamespace

import numpy as np
import pytest

Image = pytest.importorskip("PIL.Image")
from PIL import ImageDraw  # noqa: E402
from vla_cpp.eval import film  # noqa: E402


@pytest.mark.parametrize("names", [["dx", "dy", "dz", "gripper"], ["dx", "dy", "dz", "drx", "dry", "drz", "gripper"], ["x"] * 8])
def test_every_action_is_named_within_the_picture(names):
    look = SimpleNamespace(answer=SimpleNamespace(actions=np.zeros((16, len(names)))), step=0, executed=8)
    page = Image.new("RGB", (600, 260), (255, 255, 255))
    film._curves(ImageDraw.Draw(page), (20, 6, 472, 206), look, 0, names, 8)
    below = np.asarray(page)[208:]
    for colour in film.CURVES[: len(names)]:
        columns = np.flatnonzero((below == colour).all(axis=2).any(axis=0))
        assert len(columns) and columns.max() <= 472
