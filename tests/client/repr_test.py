# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A spec and a chunk as a person meets them at the prompt of Python."""

import numpy as np

from vla_cpp import BundleInfo, Chunk, Spec, StateSpec, ViewSpec

BUNDLE = BundleInfo("arm.gguf", "smolvla", "xxh3:1", "someone/arm")
SPEC = Spec(
    views=(ViewSpec("top", False, 512, 512), ViewSpec("wrist", True, 512, 512)), min_views=1, states=(StateSpec("joints", 2, ("deg", ""), ("a", "b")),),
    action_names=("a", "b"), action_units=("deg", "deg"), horizon=50, d_action=2, d_noise=32, noise_rows=50, noise="normal",
    rate_hz=30.0, bundle=BUNDLE, precision="bf16", kernels="avx2", device="cpu", real_time_chunking="guided",
)  # fmt: skip


def test_a_spec_tells_in_lines_what_goes_in_and_out():
    assert repr(SPEC).splitlines() == [
        "arm.gguf (smolvla), bf16 on cpu",
        "  image   top, seen as 512 x 512",
        "  image   wrist, seen as 512 x 512, optional",
        "  state   joints, 2 values: a [deg], b",
        "  action  50 rows at 30 Hz of 2 values: a [deg], b [deg]",
        "  noise   normal, 50 x 32",
        "  real-time chunking: guided",
    ]


def test_a_chunk_tells_the_range_of_each_column_and_its_notes():
    rows = np.array([[0, 1], [0.5, -1]], np.float32)
    chunk = Chunk(rows, ("a", "b\x1b[2J"), 30.0, BUNDLE, {"vision": 20.0, "steps": 9.0}, seed=5, notes=("cut",))
    assert str(chunk).splitlines() == [
        "2 actions at 30 Hz of arm.gguf, in 29.0 ms, seed 5",
        "  a  0 first, 0 to 0.5",
        "  b\\x1b[2J  1 first, -1 to 1",
        "  note  cut",
    ]
