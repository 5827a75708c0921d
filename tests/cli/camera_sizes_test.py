# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras of any size: every family answers as its reference does, or refuses.

What the references answer is recorded by `tools/camera_sizes.py record`; `check` of it compares any number of further sizes."""

import json
import sys

import numpy as np
import pytest
from conftest import ROOT
from golden_cases import FLOAT32, Golden
from program import every_third_if_sanitized

sys.path.append(str(ROOT / "tests/support"))
from camera_frames import frame  # noqa: E402

RECORDED = json.loads((ROOT / "tests/golden/camera_sizes.json").read_text())
CLOSE = 2e-5  # of the largest action, or of 1: sums in another order. Farthest: OpenVLA-OFT with AVX2, 1.3e-5


@pytest.mark.parametrize("name", every_third_if_sanitized(RECORDED))
def test_a_camera_of_any_size_gives_the_references_chunk_or_a_refusal(vla, tmp_path, name):
    golden, answered = Golden(name), 0
    views = [view for view, file in golden.images.items() if file is not None]
    for row in RECORDED[name]:
        images = dict(golden.images)
        for k, (view, size) in enumerate(zip(views, row["sizes"])):
            images[view] = tmp_path / f"{k}.npy"
            np.save(images[view], frame(*size, row["frames"] + k))
        done = vla(*golden.arguments(images=images, options=["--out", tmp_path / "out.npy", *FLOAT32]))
        if done.code != 0:
            done.refused("bad_observation")
            continue
        assert row["actions"] is not None, f"the reference refuses {row['sizes']}"
        answered += 1
        found, expected = np.load(tmp_path / "out.npy")[[0, -1]], np.array(row["actions"])
        off = np.abs(found - expected).max() / max(1, np.abs(expected).max())
        assert off < CLOSE, f"{row['sizes']}: {off:.1e}"
    assert answered > 0


def test_every_family_is_compared():
    """But for BitVLA, whose reference needs a transformers of its own: its resizes are compared with TensorFlow's (bitvla_recipe_test.cpp)."""
    families = {name.split("/")[0] for name in RECORDED}
    assert families == {path.name for path in (ROOT / "tests/golden").iterdir() if path.is_dir()} - {"tokenizers", "bitvla"}
