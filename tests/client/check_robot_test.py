# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla check --robot: which motor and camera goes where, and what is missing, before anything moves."""

import subprocess
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from bundle_keys import rewritten
from golden_cases import Golden
from server_process import SECONDS, VLA

import vla_cpp

SO101 = [f"{motor}.pos" for motor in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")]
ALOHA = [f"{arm}_{joint}" for arm in ("left", "right") for joint in ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")]
RATE = {"action.rate_hz": 30.0}


def named(names, units):
    return {**RATE, "action.names": names, "action.units": units, "observation.state_names": names, "observation.state_units": units}


def bundle_of(tmp_path, case, **keys):
    return rewritten(Golden(case).bundle, tmp_path / "policy.gguf", {**RATE, **keys})


def check(bundle, robot, *options):
    done = subprocess.run([VLA, "check", bundle, "--robot", robot, *map(str, options)], capture_output=True, text=True, timeout=SECONDS)
    problems = [line.removeprefix("problem: ") for line in done.stdout.splitlines() if line.startswith("problem: ")]
    return done, problems


@pytest.fixture
def so101(tmp_path):
    return bundle_of(tmp_path, "pi05/wide_state", **named(SO101, ["degrees"] * 5 + [""]))


def test_a_robot_that_fits(so101):
    done, problems = check(so101, "so101", "--camera", "front")
    assert (done.returncode, problems) == (0, []), done
    assert "camera front\n    feeds the view observation.images.front" in done.stdout
    rows = [line.split() for line in done.stdout.splitlines()[1:7]]
    assert [row[0] for row in rows] == [name.removesuffix(".pos") for name in SO101]
    assert rows[2][1:5] == ["degrees", "2", "elbow_flex.pos", "[degrees]"] and rows[2][-3:] == ["2", "elbow_flex.pos", "[degrees]"]
    assert "does not say all units" in done.stdout  # the gripper's


@pytest.mark.parametrize(
    "keys, options, words",
    [
        (named(SO101[::-1], [""] * 6), ["--camera", "front"], ["state 0: expected gripper.pos, as the policy has it, found shoulder_pan"]),
        (named(SO101, ["radians"] * 5 + [""]), ["--camera", "front"], ["state 1: the policy has radians, shoulder_lift of the robot degrees", "action 1"]),
        (named(SO101, ["degrees"] * 6), ["--camera", "top"], ["camera top feeds no view: --map observation.images.top=VIEW", "view observation.images.front: no camera"]),
        (named(SO101, ["degrees"] * 6), [], ["view observation.images.front: no camera feeds it"]),
        ({**named(SO101, ["degrees"] * 6), "action.rate_hz": 0.0}, ["--camera", "front"], ["does not say its control rate"]),
    ],
)
def test_what_does_not_fit_is_listed(tmp_path, keys, options, words):
    done, problems = check(bundle_of(tmp_path, "pi05/wide_state", **keys), "so101", *options)
    assert done.returncode == 2 and f"found {len(problems)} problem" in done.stderr
    for word in words:
        assert any(word in problem for problem in problems), (word, problems)


def test_what_a_person_says_makes_it_fit(tmp_path):
    bundle = bundle_of(tmp_path, "pi05/wide_state", **named(SO101[::-1], [""] * 6))
    lines = ["--map", "observation.state=state,in_order", "--map", "observation.images.top=front", "--map", "observation.images.side="]
    done, problems = check(bundle, "so101", "--camera", "top", "--camera", "side", *lines)
    assert (done.returncode, problems) == (0, []), done
    assert "camera top\n    feeds the view observation.images.front" in done.stdout and "camera side\n    is not looked at" in done.stdout
    turned = bundle_of(tmp_path, "pi05/wide_state", **named(SO101, ["radians"] * 5 + [""]))
    lines = ["--map", "observation.state=state,degrees", "--map", "actions=0:5,degrees"]
    assert check(turned, "so101", "--camera", "front", *lines)[1] == ["state 5: --map converts degrees, gripper of the robot has 0 to 100"]


def test_another_number_of_motors(tmp_path):
    _, problems = check(bundle_of(tmp_path, "act/two_views", **named(ALOHA, [""] * 14)), "so101", "--camera", "top", "--camera", "wrist")
    assert "state: no motor for column 6 left_gripper" in problems and "action: no motor for column 13 right_gripper" in problems


def test_aloha_has_its_cameras_and_fourteen_motors(tmp_path):
    bundle = bundle_of(tmp_path, "act/two_views", **named(ALOHA, (["radians"] * 6 + [""]) * 2))
    lines = ["--map", "observation.images.cam_high=top", "--map", "observation.images.cam_left_wrist=wrist", "--map", "observation.images.cam_low="]
    done, problems = check(bundle, "aloha", *lines)
    assert problems == ["camera cam_right_wrist feeds no view: --map observation.images.cam_right_wrist=VIEW, or --map observation.images.cam_right_wrist= for one that is not looked at"]
    done, problems = check(bundle, "aloha", *lines, "--map", "observation.images.cam_right_wrist=")
    assert (done.returncode, problems) == (0, []), done


def test_the_first_chunk_is_plotted(so101, tmp_path):
    case = Golden("pi05/wide_state")
    state = [round(float(value), 3) for value in case.state]
    (frame,) = case.images.values()
    options = ["--camera", "front", "--image", f"observation.images.front={frame}", "--save", tmp_path / "seen"]
    done, _ = check(so101, "so101", *options, "--state", ",".join(map(str, state)), "--text", case.text)
    assert done.returncode == 0, done.stderr
    with vla_cpp.Policy(so101, threads=1) as policy:
        chunk = policy.act(images={"observation.images.front": frame.read_bytes()}, state=state, text=case.text, seed=0).actions
    most = int(np.argmax(np.abs(chunk[0] - state)))
    name = SO101[most].removesuffix(".pos")
    assert f"moves {name} most: from {state[most]:.4g} to {chunk[0, most]:.4g}" in done.stdout
    assert (tmp_path / "seen" / "front.png").is_file()
    root = ElementTree.parse(tmp_path / "seen" / "chunk.svg").getroot()
    svg = "{http://www.w3.org/2000/svg}"
    assert len(root.findall(f"{svg}polyline")) == 6 and len(root.findall(f"{svg}circle")) == 6
    assert all(len(line.attrib["points"].split()) == len(chunk) for line in root.findall(f"{svg}polyline"))
    assert [text.text.split(":")[0] for text in root.findall(f"{svg}text")] == SO101


@pytest.mark.parametrize(
    "options, words",
    [
        (["--camera", "front", "--state", "1,2", "--text", "go"], "6 numbers, as so101 shows its motors"),
        (["--camera", "front", "--save", "seen"], "--image KEY=FILE and --save DIR together"),
        (["--door", "lerobot"], "--door PROTOCOL, or --robot MODEL"),
    ],
)
def test_options_that_do_not_go_together(so101, options, words):
    done, _ = check(so101, "so101", *options)
    assert done.returncode == 2 and words in done.stderr


def test_a_robot_that_is_not_known(so101):
    done, _ = check(so101, "pr2")
    assert done.returncode == 2 and "so101" in done.stderr
