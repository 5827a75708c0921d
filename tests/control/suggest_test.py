# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-limits: first limits from a URDF, from episodes and from a bundle's statistics."""

import math

import numpy as np
import pytest
from loop_test import SPEC

from vla_cpp import BundleInfo
from vla_cpp.control import Action, Column, EpisodeWriter, Limiter, Limits, suggest
from vla_cpp.control.suggest import N_STD, main

SHIPPED = "models/metaworld-tiny.gguf"
URDF = """<?xml version="1.0"?><robot name="arm">
  <joint name="pan" type="revolute"><limit lower="-1.9" upper="2.1" velocity="3.0" effort="10"/></joint>
  <joint name="slide" type="prismatic"><limit lower="0" upper="0.04" velocity="0.1" effort="1"/></joint>
  <joint name="wheel" type="continuous"><limit velocity="6" effort="1"/></joint>
  <joint name="mirror" type="revolute"><limit lower="-1" upper="1" velocity="1" effort="1"/><mimic joint="pan"/></joint>
  <joint name="fixed" type="fixed"/>
</robot>"""


@pytest.fixture
def spec(monkeypatch):
    """What the runtime says of a bundle, in its place."""

    def of(names, units=(), stats=None):
        told = type(SPEC)(**{**vars(SPEC), "action_names": names, "action_units": units or ("",) * len(names), "d_action": len(names), "bundle": BundleInfo("b", "", "", "")})
        monkeypatch.setattr(suggest, "bundle_of", lambda path: (told, stats or {}))
        return told

    return of


def run(tmp_path, *arguments):
    code = main(["suggest", "b.gguf", "--refuse-above", "0.3", "-o", str(tmp_path / "out.json"), *map(str, arguments)])
    return code, Limits.read(tmp_path / "out.json") if code == 0 else None


def urdf(tmp_path, text=URDF):
    (tmp_path / "arm.urdf").write_text(text)
    return ["--urdf", tmp_path / "arm.urdf"]


def test_a_urdf_gives_ranges_and_velocities_in_the_bundles_units(spec, tmp_path):
    spec(("pan.pos", "slide", "roll"), ("degrees", "m", ""))
    code, limits = run(tmp_path, "--kind", "position", "--joint", "roll=wheel", *urdf(tmp_path))
    pan, slide, roll = limits.columns
    assert code == 0 and limits.refuse_above == 0.3
    assert (pan.low, pan.high, pan.velocity) == pytest.approx((math.degrees(-1.9), math.degrees(2.1), math.degrees(3)))
    assert (slide.low, slide.high, slide.velocity) == (0, 0.04, 0.1) and pan.acceleration is None
    assert (roll.low, roll.high, roll.velocity) == (None, None, 6)


def test_velocities_of_a_urdf_bound_differences(spec, tmp_path):
    spec(("pan",), ("radians",))
    _, limits = run(tmp_path, "--kind", "difference", *urdf(tmp_path))
    assert (limits.columns[0].low, limits.columns[0].velocity) == (None, 3)


@pytest.mark.parametrize(
    "names, units, options, words",
    [
        (("elbow",), (), [], "a joint elbow, one of pan, slide, wheel"),
        (("mirror",), (), [], "a joint mirror"),
        (("pan",), ("mm",), [], "in mm, as the bundle says"),
        (("slide",), ("radians",), [], "in metres"),
        (("pan",), (), ["--joint", "pan"], "ACTION=JOINT"),
        (("pan",), (), ["--joint", "tilt=pan"], "actions of b: pan"),
        (("pan",), (), ["--margin", "1.2"], "--margin"),
    ],
)
def test_what_does_not_fit_a_urdf_is_refused(spec, tmp_path, capsys, names, units, options, words):
    spec(names, units)
    assert run(tmp_path, "--kind", "position", *options, *urdf(tmp_path))[0] == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    "text",
    [
        "", "<robot>", "<html/>", '<!DOCTYPE a [<!ENTITY x "y">]><robot/>', URDF.replace('name="pan" ', ""), URDF.replace("-1.9", "nan"), URDF.replace("-1.9", "low"),
        "<a>" * 100000,
    ],
)  # fmt: skip
def test_what_is_no_urdf_is_refused(spec, tmp_path, capsys, text):
    spec(("pan",))
    assert run(tmp_path, "--kind", "position", *urdf(tmp_path, text))[0] == 9
    assert "a URDF: an element robot with joints" in capsys.readouterr().err


def test_a_joint_without_a_limit_is_refused(spec, tmp_path, capsys):
    spec(("pan",))
    for part in ('lower="-1.9" ', 'velocity="3.0" '):
        assert run(tmp_path, "--kind", "position", *urdf(tmp_path, URDF.replace(part, "")))[0] == 2
        assert "a limit with lower, upper and velocity" in capsys.readouterr().err


def test_episodes_give_the_largest_of_what_was_commanded(spec, tmp_path):
    told = spec(("x", "y"))
    rows = [np.stack([np.sin(np.arange(50) / 10), k * np.cos(np.arange(50) / 20)], 1).astype(np.float32) for k in (0.5, 0.1)]
    with EpisodeWriter(tmp_path / "episodes", told, 20) as episodes:
        for values in rows:
            episodes.begin("go")
            for i, row in enumerate(values):
                episodes.add({"images": {}, "state": {}}, Action(row, i + 10 * (i >= 20), False))  # ten periods are missed
            episodes.end(None)
    code, limits = run(tmp_path, "--kind", "position", "--margin", "1.1", "--episodes", tmp_path / "episodes")
    assert code == 0
    x, y = limits.columns
    assert x.velocity == pytest.approx(1.1 * 2, rel=0.01) and y.high == pytest.approx(0.5, rel=0.1)
    for values in rows:
        limiter = Limiter(limits, 20)
        assert not limiter.breaks(values[:20]).any() and not limiter.breaks(values[20:]).any()


def test_a_gripper_gets_no_velocity_from_episodes(spec, tmp_path, capsys):
    told = spec(("x", "grip"))
    with EpisodeWriter(tmp_path / "episodes", told, 20) as episodes:
        episodes.begin("go")
        for i in range(60):
            episodes.add({"images": {}, "state": {}}, Action(np.array([np.sin(i / 10), -1 if i % 30 < 15 else 1], np.float32), i, False))
        episodes.end(None)
    arguments = ["--margin", "1.5", "--episodes", tmp_path / "episodes"]
    assert run(tmp_path, "--kind", "position", *arguments)[0] == 2
    assert "-1, 1 alone in 60 commands; --kind grip=gripper for one that opens and closes" in capsys.readouterr().err
    code, limits = run(tmp_path, "--kind", "position", "--kind", "grip=gripper", *arguments)
    assert code == 0 and limits.columns[1] == Column("grip", "gripper", "", -1, 1)


def test_a_gripper_needs_no_joint_of_a_urdf(spec, tmp_path):
    spec(("pan", "grip"), ("radians", "m"))
    kinds = ["--kind", "position", "--kind", "grip=gripper"]
    assert run(tmp_path, *kinds, *urdf(tmp_path))[1].columns[1] == Column("grip", "gripper", "m")
    _, limits = run(tmp_path, *kinds, "--joint", "grip=slide", *urdf(tmp_path))
    assert limits.columns[1] == Column("grip", "gripper", "m", 0, 0.04)


def test_statistics_of_a_gripper_are_its_ends(spec, tmp_path):
    spec(("x", "grip"), (), {"stats.action.min": [-2.0, 0.0], "stats.action.max": [4.0, 1.0]})
    _, limits = run(tmp_path, "--kind", "position", "--kind", "grip=gripper", "--statistics", "--margin", "2")
    assert limits.columns[1] == Column("grip", "gripper", "", 0, 1)


@pytest.mark.parametrize(
    "stats, expected",
    [
        ({"min": [-2.0], "max": [4.0], "mean": [0.0], "std": [9.0]}, (-5, 7)),
        ({"q01": [-1.0], "q99": [1.0]}, (-2, 2)),
        ({"mean": [1.0], "std": [0.5]}, (1 - 2 * N_STD * 0.5, 1 + 2 * N_STD * 0.5)),
    ],
)
def test_statistics_give_ranges(spec, tmp_path, stats, expected):
    spec(("x",), (), {f"stats.action.{key}": values for key, values in stats.items()})
    code, limits = run(tmp_path, "--kind", "position", "--statistics", "--margin", "2")
    assert code == 0 and (limits.columns[0].low, limits.columns[0].high) == pytest.approx(expected)


def test_what_is_not_said_is_asked_for(spec, tmp_path, capsys):
    spec(("x", "y"), (), {"stats.action.mean": [0.0]})
    for kinds in (["--kind", "x=position"], ["--kind", "place"], ["--kind", "z=position"], ["--kind", "position", "--kind", "velocity"]):
        assert run(tmp_path, *kinds, "--statistics", "--margin", "1")[0] == 2
    assert run(tmp_path, "--kind", "position", "--statistics")[0] == 2 and run(tmp_path, "--kind", "position", "--statistics", "--margin", "0.5")[0] == 2
    assert run(tmp_path, "--kind", "position", "--statistics", "--margin", "1")[0] == 2  # statistics of another width
    assert "statistics of the 2 actions" in capsys.readouterr().err


def test_the_shipped_policy_gets_a_file_that_its_loop_takes(tmp_path, capsys):
    if not any(path.is_file() for path in suggest.candidates()):
        pytest.skip("vla is not built")
    root = suggest.candidates()[-1].parents[3]
    out = tmp_path / "limits.json"
    arguments = ["--kind", "difference", "--kind", "gripper=position", "--statistics", "--margin", "1", "--refuse-above", "0.5", "-o", str(out)]
    assert main(["suggest", str(root / SHIPPED), *arguments]) == 0
    assert main(["check", str(out), str(root / SHIPPED)]) == 0
    assert [line.split()[:2] for line in capsys.readouterr().out.splitlines()[-4:]] == [["dx", "difference"], ["dy", "difference"], ["dz", "difference"], ["gripper", "position"]]
    assert main(["check", str(out), "nothing.gguf"]) == 2
