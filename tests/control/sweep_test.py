# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The simulation of examples/control says what docs/control.md reads from it."""

import importlib.util
from pathlib import Path
from xml.etree import ElementTree

import pytest

FILE = Path(__file__).resolve().parents[2] / "examples/control/latency_sweep.py"


@pytest.fixture(scope="module")
def toy():
    spec = importlib.util.spec_from_file_location("latency_sweep", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.SECONDS = 10.0
    return module


def test_with_latency_async_tracks_better_than_sync_which_stands_while_it_waits(toy):
    waiting, flowing = (toy.simulate(150, 4, mode, "replace", 0) for mode in ("sync", "async"))
    assert flowing.error_mm < 0.8 * waiting.error_mm
    assert waiting.held > 0.3 and flowing.held == 0


def test_async_starves_when_the_replan_interval_and_the_delay_exceed_the_horizon(toy):
    near, beyond = (toy.simulate(150, s, "async", "replace", 0) for s in (10, 16))
    assert near.held == 0 and beyond.held > 0.1 and beyond.error_mm > near.error_mm


def test_a_cross_fade_changes_the_command_less_than_replacing_does(toy):
    hard, soft = (toy.simulate(50, 6, "async", blend, 0) for blend in ("replace", "linear"))
    assert soft.jump_mm < 0.7 * hard.jump_mm


def test_a_run_repeats_exactly(toy):
    assert toy.simulate(50, 6, "async", "ensemble", 1) == toy.simulate(50, 6, "async", "ensemble", 1)


def test_the_picture_is_well_formed_and_has_a_line_for_each_mode_and_blend(toy):
    results = toy.sweep((50,), (4, 8), 1)
    picture = ElementTree.fromstring(toy.draw(results, (4, 8)))
    assert len(picture.findall(".//{http://www.w3.org/2000/svg}polyline")) == 2 * 6
