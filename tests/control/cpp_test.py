# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The loop, the limiter and the interpolator of include/vla/control.h give what Python's give: the same bytes for the same scenario."""

import json
import os
import subprocess

import numpy as np
import pytest
from limits_test import GOOD

from vla_cpp import BadAction, Noted, UsageError
from vla_cpp.control import ChunkLoop, Interpolator, Limiter, Limits, RealTimeChunking
from vla_cpp.errors import Late, error_of
from vla_cpp.spec import BundleInfo, Spec

TOOL = os.environ.get("VLA_CONTROL_TOOL", "")
pytestmark = pytest.mark.skipif(not TOOL, reason="VLA_CONTROL_TOOL names no control_tool")
N_SCENARIO = int(os.environ.get("VLA_EXAMPLES", 300))
PASSING = ("busy", "timeout", "disconnected", "superseded", "late")
KINDS = ("position", "velocity", "difference", "gripper")


def in_cpp(scenarios):
    text = "".join(json.dumps(scenario) + "\n" for scenario in scenarios)
    done = subprocess.run([TOOL], input=text, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def bits(values):
    return np.asarray(values, np.float32).ravel().view(np.uint32).tolist()


# --- the loop -------------------------------------------------------------------------------------------------------------------


class Chunk(np.ndarray):
    """Rows with what a loop reads of an answer beside them."""


def chunk_of(script):
    chunk = np.array(script["rows"], np.float32).view(Chunk)
    chunk.notes, chunk.normalized = ("a note",) * script["notes"], np.array(script["normalized"], np.float32)
    return chunk


class Pending:
    def __init__(self, policy, script):
        self.policy, self.script, self.due = policy, script, policy.now + script["seconds"]

    def done(self):
        return self.policy.now >= self.due

    def result(self):
        self.policy.now = max(self.policy.now, self.due)
        if self.script["error"]:
            raise error_of(self.script["error"], "scripted")
        return chunk_of(self.script)


class ScriptedPolicy:
    def __init__(self, scenario):
        given = scenario["spec"]
        self.answers, self.asked, self.now = scenario["answers"], [], 0.0
        self.spec = Spec(
            views=(), min_views=0, states=(), action_names=tuple(given["names"]), action_units=tuple(given["units"]),
            horizon=given["horizon"], d_action=given["d_action"], d_noise=0, noise_rows=0, noise="normal", rate_hz=given["rate_hz"],
            bundle=BundleInfo("scripted", "", "", ""), precision="", kernels="", device="", real_time_chunking=given["rtc"],
            n_action_steps=given["n_action_steps"],
        )  # fmt: skip

    features = ("loop",)

    def submit(self, loop, leftover=None):
        script = self.answers[len(self.asked) % len(self.answers)]
        told = leftover and {"rows": bits(leftover.rows), "delay": leftover.delay, "schedule": leftover.schedule}
        self.asked.append({"loop": loop, "leftover": told})
        return Pending(self, script)


def shown(action):
    state = "none" if action.values is None else "held" if action.held else "command"
    values = [] if action.values is None else bits(action.values)
    age = -1 if action.age is None else action.age
    return {
        "state": state, "values": values, "tick": action.tick, "age": age, "limited": action.limited, "clamped": list(action.clamped),
        "human": action.human, "policy": [] if action.policy is None else bits(action.policy),
    }  # fmt: skip


def in_python(scenario):
    policy, given = ScriptedPolicy(scenario), scenario["options"]
    limits = None if given["limits"] is None else Limits.parse(given["limits"])
    loop = ChunkLoop(
        policy, rate_hz=given["rate_hz"], replan_every=given["replan_every"], mode=given["mode"], blend=given["blend"], on_late=given["late"],
        on_note=given["on_note"], fade_steps=given["fade_steps"], decay=given["decay"], max_age=given["max_age"],
        rtc=RealTimeChunking(given["overlap"], "exp", 5.0) if given["mode"] == "rtc" else None,
        max_jump=None if given["max_jump"] is None else np.array(given["max_jump"], np.float32), limits=limits, clock=lambda: policy.now,
    )  # fmt: skip
    actions = []
    if limits:
        loop.start_at(scenario["start"])
    for time in scenario["times"]:
        if time is None:
            loop.reset()
            if limits:
                loop.start_at(scenario["start"])
            continue
        if isinstance(time, str):
            loop.take_over("operator") if time == "take over" else loop.give_back("operator")
            continue
        policy.now = max(policy.now, time["at"])
        try:
            actions.append(shown(loop.step({}, human=time["human"] or None)))
        except Late as error:
            actions.append({"state": "stopped", "code": error.code})
        except (BadAction, Noted) as error:
            actions.append({"state": "failed", "code": error.code})
        except Exception as error:
            assert getattr(error, "code", "") == "bad_observation", error
            actions.append({"state": "failed", "code": error.code})
    stats = loop.stats
    names = ("actions", "held", "chunks", "stale", "failed", "limited", "refused", "missed", "notes", "human")
    delay = -1 if stats["delay"] is None else stats["delay"]
    return {"actions": actions, "asked": policy.asked, "stats": [stats[name] for name in names] + [delay]}


def limits_of(rng, names, refuse_above):
    def column():
        entry = {"kind": str(rng.choice(KINDS)), "unit": ""}
        if entry["kind"] == "gripper" and rng.random() < 0.5:
            entry["range"] = [float(rng.uniform(0.1, 0.4)), float(rng.uniform(0.5, 1.5))]
        elif rng.random() < 0.5:
            entry["range"] = [-float(rng.uniform(0.1, 3)), float(rng.uniform(0.1, 3))]
        for field, low, high in (("velocity", 0.1, 20), ("acceleration", 0.5, 100), ("jerk", 5, 2000)):
            if rng.random() < 0.6 and entry["kind"] != "gripper":
                entry[field] = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        return entry

    return {"format": "vla-limits 1", "columns": {name: column() for name in names}, "refuse_above": refuse_above}


def scenario_of(seed):
    rng = np.random.default_rng(seed)
    horizon, d = int(rng.integers(1, 13)), int(rng.integers(1, 4))
    names, rate = [f"a{i}" for i in range(d)], float(rng.choice((5, 20, 50)))
    mode = str(rng.choice(("sync", "async", "async", "rtc")))
    blend = "linear" if mode == "rtc" else str(rng.choice(("linear", "ensemble")))
    wild = rng.random() < 0.5

    def answer():
        rows = rng.uniform(-2, 2, (horizon, d)) if wild else np.cumsum(0.03 * rng.standard_normal((horizon, d)), 0)
        rows = rows.astype(np.float32).astype(float).tolist()
        code = str(rng.choice(PASSING + ("bad_observation",))) if rng.random() < 0.15 else ""
        seconds = float(rng.choice((0.2, 1.4, 3.0, horizon + 1.0)) / rate)
        return {"seconds": seconds, "rows": rows, "normalized": rows, "notes": int(rng.random() < 0.1), "error": code}

    times, now, is_driven = [], 100.0, False
    for _ in range(int(rng.integers(10, 60))):
        now += float(rng.choice((1.0, 1.0, 1.0, 0.7, 2.3)) / rate)
        if rng.random() < 0.02:
            times.append(None)
            is_driven = False
        elif rng.random() < 0.07:
            times.append("give back" if is_driven else "take over")
            is_driven = not is_driven
        is_commanded = is_driven and rng.random() < 0.9
        times.append({"at": now, "human": rng.uniform(-2, 2, d).astype(np.float32).astype(float).tolist() if is_commanded else []})
    options = {
        "rate_hz": rate, "replan_every": int(rng.integers(1, horizon + 1)), "mode": mode, "blend": blend,
        "fade_steps": int(rng.integers(0, 6)), "decay": float(rng.uniform(0, 1)), "late": str(rng.choice(("hold", "zero", "stop"))),
        "on_note": str(rng.choice(("ignore", "raise"))), "overlap": int(rng.integers(1, horizon + 1)),
        "max_age": None if rng.random() < 0.7 else float(rng.uniform(0, 8) / rate), "max_jump": None, "limits": None,
    }  # fmt: skip
    if rng.random() < 0.5:
        options["limits"] = limits_of(rng, names, float(rng.choice((0.0, 0.5, 1.0))))
    elif rng.random() < 0.4:
        options["max_jump"] = rng.uniform(0.05, 1, d).astype(np.float32).astype(float).tolist()
    spec = {"names": names, "units": [""] * d, "horizon": horizon, "d_action": d, "rate_hz": rate, "n_action_steps": 0, "rtc": "guided"}
    return {
        "kind": "loop", "spec": spec, "options": options, "answers": [answer() for _ in range(7)], "times": times, "start": [0.0] * d
    }  # fmt: skip


def test_both_loops_give_the_same_bytes():
    scenarios = [scenario_of(seed) for seed in range(N_SCENARIO)]
    seen = set()
    for seed, (scenario, found) in enumerate(zip(scenarios, in_cpp(scenarios))):
        expected = in_python(scenario)
        for i, (one, other) in enumerate(zip(expected["actions"], found["actions"])):
            assert one == other, f"scenario {seed}, step {i}"
        assert expected == found, f"scenario {seed}"
        seen |= {action["state"] for action in found["actions"]} | {"clamped" for action in found["actions"] if action.get("clamped")}
        seen |= {"human" for action in found["actions"] if action.get("human") and action["policy"]}
        seen |= {"leftover" for asked in found["asked"] if asked["leftover"]}
    assert seen == {"command", "held", "none", "stopped", "failed", "clamped", "leftover", "human"}  # the scenarios reach every state


# --- its parts ------------------------------------------------------------------------------------------------------------------


def test_both_limiters_give_the_same_bytes():
    rng = np.random.default_rng(1)
    scenarios = []
    for _ in range(N_SCENARIO // 3):
        names = [f"a{i}" for i in range(int(rng.integers(1, 4)))]
        steps = rng.uniform(-2, 2, (40, len(names))) if rng.random() < 0.5 else np.cumsum(0.05 * rng.standard_normal((40, len(names))), 0)
        wanted = steps.astype(np.float32).astype(float).tolist()
        limits = limits_of(rng, names, 1.0)
        scenarios.append({"kind": "limiter", "limits": limits, "rate_hz": float(rng.choice((5, 30, 200, 1000))), "wanted": wanted, "start": [0.0] * len(names)})
    for scenario, found in zip(scenarios, in_cpp(scenarios)):
        limiter = Limiter(Limits.parse(scenario["limits"]), scenario["rate_hz"])
        limiter.rest_at(scenario["start"])
        assert found["commands"] == [bits(limiter.step(row)[0]) for row in scenario["wanted"]]
        broken = limiter.breaks(np.array(scenario["wanted"]))
        assert found["broken"] == [int(broken.sum()), int(np.argmax(broken)) if broken.any() else -1]


@pytest.mark.parametrize("method", ("linear", "cubic", "minimum_jerk"))
def test_both_interpolators_agree(method):
    rng = np.random.default_rng(2)
    scenario = {
        "kind": "interpolator", "kinds": KINDS, "method": method, "start": rng.uniform(-1, 1, 4).tolist(),
        "rows": rng.uniform(-1, 1, (20, 4)).astype(np.float32).astype(float).tolist(), "shares": [0.1, 0.35, 0.5, 0.99, 1.0],
    }  # fmt: skip
    between = Interpolator(KINDS, method=method, rate_hz=20)
    between.start_at(scenario["start"])
    expected = []
    for row in scenario["rows"]:
        between.to(row)
        expected += [between.at(share) for share in scenario["shares"]]
    (found,) = in_cpp([scenario])
    assert np.array(found) == pytest.approx(np.array(expected), abs=1e-6)


def texts():
    """Files of limits, right and wrong: each field of a good one changed."""
    yield json.dumps(GOOD)
    values = (None, 0, 1, -1, 1e300, 0.5, True, "", "position", "velocity", "gripper", [], [0, 1], [1, 0], [None, None], [0.5, 1], {}, "radians")
    for value in values:
        for field in GOOD:
            yield json.dumps({**GOOD, field: value})
        for name, column in GOOD["columns"].items():
            for field in ("kind", "unit", "range", "velocity", "acceleration", "jerk", "more"):
                yield json.dumps({**GOOD, "columns": {**GOOD["columns"], name: {**column, field: value}}})
    for field in GOOD:
        yield json.dumps({key: value for key, value in GOOD.items() if key != field})
    yield from ("", "[]", "{", "{}", "nul", json.dumps(GOOD)[:-1], json.dumps(GOOD) + "x", "[" * 5000, json.dumps(GOOD).replace("0.25", "NaN"))
    yield json.dumps(GOOD).replace('"unit": "radians"', '"unit": "radians", "unit": "radians"')


def test_both_read_and_refuse_the_same_files(tmp_path):
    given = list(dict.fromkeys(texts()))
    accepted = 0
    for text, found in zip(given, in_cpp([{"kind": "limits", "text": text} for text in given])):
        (tmp_path / "limits.json").write_text(text)
        try:
            Limits.read(tmp_path / "limits.json")
            expected = "read"
        except UsageError:
            expected = "usage"
        assert (found if found == "read" else found["code"]) == expected, text
        accepted += expected == "read"
    assert 20 < accepted < len(given) - 100
