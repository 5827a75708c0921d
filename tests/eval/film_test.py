# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a chunk in a film names every action."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("PIL.Image")
from vla_cpp.eval import film  # noqa: E402


class Drawing:
    """Notes where texts begin."""

    def __init__(self):
        self.texts = []

    def text(self, at, text, **_):
        self.texts.append((*at, text))

    def line(self, *_, **__):
        pass

    rectangle = line


@pytest.mark.parametrize("names", [["dx", "dy", "dz", "gripper"], ["dx", "dy", "dz", "drx", "dry", "drz", "gripper"], ["a rather long one"] * 8])
def test_every_action_is_named_within_the_picture(names):
    look = SimpleNamespace(answer=SimpleNamespace(actions=np.zeros((16, len(names)))), step=0, executed=8)
    draw = Drawing()
    film._curves(draw, (20, 6, 472, 206), look, 0, names, 8)
    told = [(x, text) for x, y, text in draw.texts if y > 206]
    assert [text for _, text in told] == [name[: len(text)] for name, (_, text) in zip(names, told)] and len(told) == len(names)
    assert all(x + 7 * len(text) <= end for (x, text), end in zip(told, [*[x for x, _ in told[1:]], 472]))
