# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Closed loop in LIBERO without a trained checkpoint: each family with random weights, beside its PyTorch reference.

    python tools/libero_parity.py [FAMILY ...] [--tasks libero_object/0,libero_goal/3] [--steps 40] [--vla build/cpu/bin/vla] [--keep DIR]

A family's golden case in LIBERO's shapes (two frames of 256 x 256, 8 numbers of state, 7 of action) is converted and served. The
runtime drives an episode while the reference predicts from the same observations: the largest difference of two chunks. Then the
reference drives the same episode itself: the largest difference of the actions that were executed, and of the simulator's state
(positions in metres, angles in radians, speeds) at the end. Ends with exit code 1 where a chunk differs by more than 1e-4.

Needs what LIBERO (examples/libero/requirements.txt) and the reference (goldens) need. BitVLA: see goldens/bitvla.py.
"""

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
import traceback
from dataclasses import replace
from pathlib import Path

import numpy as np
from goldens import all_cases, bitvla, cases, recorder
from goldens.gr00t_n1_5 import camera

sys.path.insert(0, str(cases.ROOT / "python"))
from vla_cpp.eval.environment import Guard  # noqa: E402
from vla_cpp.eval.environments import MissingSimulator, make  # noqa: E402
from vla_cpp.eval.episode import Job, run_episode  # noqa: E402
from vla_cpp.eval.policies import Answer, EvalPolicy, ServedPolicy  # noqa: E402
from vla_cpp.eval.serving import Server  # noqa: E402

BAR = 1e-4
SIZE = (256, 256)
SEED = 1000
VIEWS = {"image": SIZE, "image2": SIZE}
SHAPE = {"d_state": 8, "d_action": 7, "views": VIEWS}


def family_case(arch):
    """The family's golden case with LIBERO's cameras, state and action."""
    case = all_cases()[{"evo1": "evo1/two_views", "bitvla": "bitvla/micro"}.get(arch, f"{arch}/{'libero' if 'gr00t' in arch else 'two_views'}")]
    views, given = VIEWS, case.checkpoint
    if arch in ("smolvla", "pi0", "pi05"):
        names = ("camera1", "camera2") if arch == "smolvla" else ("base", "wrist")
        given = replace(given, **SHAPE, rename={}, policy={k: v for k, v in given.policy.items() if k != "empty_cameras"})
        assert set(names) <= set(case.frames)
    elif arch in ("act", "turbovla"):
        views = dict.fromkeys(given.views, SIZE)
        given = replace(given, views=views, d_state=8, d_action=7)
    elif arch == "evo1":
        given = replace(given, views=VIEWS)
        case = replace(case, options=case.options | {"views": list(VIEWS)})
    elif arch == "bitvla":
        case = replace(case, options={})  # images go through a JPEG, as the authors' evaluation sends them
        bitvla.MARGIN = -1.0  # the simulator's observations may lie near the border of two codes; those of a golden case may not
    elif "gr00t" in arch:
        views = dict.fromkeys(given.robot.views, SIZE)
        if arch == "gr00t_n1_5":
            given = replace(given, image=camera(*SIZE))
    return replace(case, frames={view: (*size, "png") for view, size in views.items()}, checkpoint=given, state=())


class Runtime(ServedPolicy):
    """The server, given LIBERO's frames and state under the names of its policy."""

    def act(self, observation, text, noise):
        return super().act(renamed(observation, self.spec), text, noise)


def renamed(observation, spec):
    """The observation with its frames and numbers under the names that a policy has for them, in order."""
    values, states = next(iter(observation.state.values())), {}
    for part in spec.states:
        states[part.name], values = values[: part.width], values[part.width :]
    assert not len(values)
    return replace(observation, frames=dict(zip((view.name for view in spec.views), observation.frames.values())), state=states)


class Reference(EvalPolicy):
    """The family's reference, run on the folder of a golden case that is rewritten at every look."""

    def __init__(self, folder, spec):
        self.folder, self.spec, self.noise_shape = folder, spec, (spec.noise_rows, spec.d_noise)

    def act(self, observation, text, noise):
        from PIL import Image

        seen, images = renamed(observation, self.spec), {}
        for name, frame in seen.frames.items():
            view = name.removeprefix("observation.images.").removeprefix("video.")
            images[view] = f"{view}.png"
            Image.fromarray(frame).save(self.folder / images[view], compress_level=1)
        numbers = np.concatenate(list(seen.state.values())).tolist()
        (self.folder / "observation.json").write_text(json.dumps({"images": images, "state": numbers, "text": text}))
        np.save(self.folder / "noise.npy", noise)
        with contextlib.redirect_stdout(io.StringIO()):
            return Answer(recorder.run_case(self.folder)["actions"], 0.0, {})


def episode(environment, driver, shadow, steps):
    """(largest difference of chunks, executed actions, the simulator's state at the end)"""
    guard = Guard(environment)
    guard.declaration = replace(environment.declaration, limit=steps)
    outcome = run_episode(guard, driver, Job(environment.task, SEED), 8, shadow)
    return max(outcome.difference, default=0.0), np.array(guard.executed), environment._env.get_sim_state(), outcome


def measure(arch, environments, vla, folder, steps):
    case = family_case(arch)
    n_parameter = cases.write_checkpoint(case, folder)
    cases.write_bundle(folder, dtype="f32")
    row = {"family": arch, "parameters": n_parameter, "looks": 0, "chunks": 0.0, "actions": 0.0, "state": 0.0, "clipped": 0, "steps": 0, "size": 0.0}
    with Server(vla, folder / "bundle.gguf", 1, "float32") as server:
        runtime = Runtime(server.address, 60.0)
        reference = Reference(folder, runtime.spec)
        for environment in environments:
            far, ours, our_state, outcome = episode(environment, runtime, reference, steps)
            _, theirs, their_state, _ = episode(environment, reference, None, steps)
            row["looks"] += len(outcome.difference)
            row["chunks"] = max(row["chunks"], far)
            n = min(len(ours), len(theirs))
            row["actions"] = max(row["actions"], float(np.abs(ours[:n] - theirs[:n]).max()))
            row["state"] = max(row["state"], float(np.abs(our_state - their_state).max()))
            row["clipped"] += outcome.clipped
            row["steps"] += outcome.steps
            row["size"] = max(row["size"], float(np.sqrt((ours**2).mean())))
        runtime.close()
    return row


def main():
    archs = sorted({name.split("/")[0] for name in all_cases()})
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family", nargs="*", help=f"of {', '.join(archs)} (default: all but bitvla, whose reference needs other packages: run it alone)")
    parser.add_argument("--tasks", default="libero_object/0,libero_goal/3")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--vla", default=str(cases.ROOT / "build/cpu/bin/vla"))
    parser.add_argument("--keep", type=Path, metavar="DIR", help="checkpoints and bundles, for a look afterwards")
    a = parser.parse_args()
    wanted = a.family or [arch for arch in archs if arch != "bitvla"]
    try:
        if wanted != ["bitvla"]:
            recorder.open_reference()
        environments = [make("libero", task) for task in a.tasks.split(",")]
    except (MissingSimulator, ImportError) as error:
        raise SystemExit(f"libero_parity: skipped, {error}") from error
    print("| family | parameters | looks | chunks | executed actions | simulator's state | actions' rms | clipped steps |\n|---|---:|---:|---:|---:|---:|---:|---:|", flush=True)
    bad = 0
    for arch in wanted:
        with tempfile.TemporaryDirectory() as temporary:
            folder = (a.keep or Path(temporary)) / arch
            try:
                row = measure(arch, environments, a.vla, folder, a.steps)
            except Exception as error:  # one family that does not run does not keep the others from being told
                traceback.print_exc()
                print(f"| {arch} | not run: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''} |", flush=True)
                bad += 1
                continue
        print(f"| {arch} | {row['parameters']:,} | {row['looks']} | {row['chunks']:.1e} | {row['actions']:.1e} | {row['state']:.1e} "
              f"| {row['size']:.2f} | {row['clipped']}/{row['steps']} |", flush=True)  # fmt: skip
        bad += row["chunks"] > BAR
    return 1 if bad else 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # MuJoCo's destructors print errors at a normal exit
