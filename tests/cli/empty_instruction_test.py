# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An empty instruction is answered as the references answer it (recorded by tools/empty_instructions.py); one that is not given is refused."""

import json

import numpy as np
import pytest
from conftest import ROOT
from golden_cases import FLOAT32, Golden
from program import every_third_if_sanitized

RECORDED = json.loads((ROOT / "tests/golden/empty_instructions.json").read_text())
CLOSE = 1e-5  # of the largest action, or of 1: sums in another order
READ_NO_TEXT = ("act/", "diffusion/")


@pytest.mark.parametrize("name", every_third_if_sanitized(RECORDED))
def test_an_empty_instruction_gives_the_references_chunk(vla, tmp_path, name):
    done = vla(*Golden(name).arguments(text="", options=["--out", tmp_path / "out.npy", *FLOAT32]))
    assert done.code == 0, done.err
    found, expected = np.load(tmp_path / "out.npy")[[0, -1]], np.array(RECORDED[name])
    assert np.abs(found - expected).max() < CLOSE * max(1, np.abs(expected).max())
    assert ("instruction: empty" in done.err) == (not name.startswith(READ_NO_TEXT))


@pytest.mark.parametrize("name", every_third_if_sanitized(RECORDED))
def test_an_instruction_that_is_not_given_is_refused_where_the_policy_reads_one(vla, name):
    arguments = Golden(name).arguments()
    at = arguments.index("--text")
    done = vla(*arguments[:at], *arguments[at + 2 :])
    if name.startswith(READ_NO_TEXT):
        assert done.code == 0, done.err
    else:
        done.refused("bad_observation", "instruction: expected a text, found none; give an empty one if that is meant")


def test_every_family_is_compared():
    """But for BitVLA, whose reference needs a transformers of its own: it answers."""
    families = {name.split("/")[0] for name in RECORDED}
    assert families == {path.name for path in (ROOT / "tests/golden").iterdir() if path.is_dir()} - {"tokenizers", "bitvla"}


def test_bitvla_answers_an_empty_instruction(vla):
    done = vla(*Golden("bitvla/micro").arguments(text=""))
    assert done.code == 0 and "instruction: empty" in done.err
