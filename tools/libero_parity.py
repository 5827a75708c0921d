# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Closed loop in LIBERO without a trained checkpoint: each family with random weights, beside its PyTorch reference.

    python tools/libero_parity.py [FAMILY ...] [--tasks libero_object/0,libero_goal/3] [--steps 40] [--vla build/cpu/bin/vla] [--keep DIR]

A family's golden case in LIBERO's shapes (two frames of 256 x 256, 8 numbers of state, 7 of action) is converted and served. The
runtime drives an episode while the reference predicts from the same observations: the largest difference of two chunks. Then the
reference drives the same episode itself: the largest difference of the actions that were executed, and of the simulator's state
(positions in metres, angles in radians, speeds) at the end. Ends with exit code 1 where a chunk differs by more than 1e-4.

A policy that reads several moments (Diffusion Policy) is asked at every step: the client's History and the rows of the last chunk on one
side, LeRobot's queues on the other; a chunk is then the one row that is executed.

Needs what LIBERO (examples/libero/requirements.txt) and the reference (goldens) need: BitVLA, OpenVLA, OpenVLA-OFT and VLA-Adapter each an
environment of its own, as goldens/FAMILY.py tells.  With MUJOCO_GL=osmesa that has no triton, whose LLVM crashes beside OSMesa's.
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
from goldens import all_cases, bitvla, cases, diffusion, openvla, recorder
from goldens.gr00t_n1_5 import camera

sys.path.insert(0, str(cases.ROOT / "python"))
from vla_cpp import History  # noqa: E402
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
NAMES = {"bitvla": "micro", "diffusion": "ddim", "openvla": "bridge", "openvla_oft": "libero", "vla_adapter": "spatial", "vla_jepa": "libero"}  # others: two_views, libero
ALONE = {"bitvla", "openvla", "openvla_oft", "vla_adapter"}  # whose references need packages that those of the others do not run with
UNFIT = {"groot", "pi0_fast", "turbovla_authors"}  # no case in LIBERO's shapes; random answers that are no actions; frames of the network's size alone


def family_case(arch):
    """The family's golden case with LIBERO's cameras, state and action."""
    case = all_cases()[f"{arch}/{NAMES.get(arch, 'libero' if 'gr00t' in arch else 'two_views')}"]
    views, given = VIEWS, case.checkpoint
    if arch in ("smolvla", "pi0", "pi05"):
        names = ("camera1", "camera2") if arch == "smolvla" else ("base", "wrist")
        given = replace(given, **SHAPE, rename={}, policy={k: v for k, v in given.policy.items() if k != "empty_cameras"})
        assert set(names) <= set(case.frames)
    elif arch in ("act", "turbovla", "vla_jepa"):
        views = dict.fromkeys(given.views, SIZE)
        given = replace(given, views=views, d_state=8, d_action=7)
    elif arch == "evo1":
        given = replace(given, views=VIEWS)
        case = replace(case, options=case.options | {"views": list(VIEWS)})
    elif arch == "bitvla":
        case = replace(case, options={})  # images go through a JPEG, as the authors' evaluation sends them
        bitvla.MARGIN = -1.0  # the simulator's observations may lie near the border of two codes; those of a golden case may not
    elif arch == "openvla":
        views, openvla.MARGIN = {"image": SIZE}, 0.0  # as of BitVLA's codes: two tokens may be about as likely
    elif arch == "vla_adapter":
        case = replace(case, options={"platform": "libero"})  # frames go through a JPEG
    elif arch == "xvla":
        given = replace(given, **SHAPE, policy=given.policy | {"action_mode": "auto", "max_action_dim": 7})
    elif arch == "diffusion":
        given = replace(given, cameras=VIEWS, d_state=8, d_action=7)
    elif "gr00t" in arch:
        views = dict.fromkeys(given.robot.views, SIZE)
        if arch == "gr00t_n1_5":
            given = replace(given, image=camera(*SIZE))
    return replace(case, frames={view: (*size, "png") for view, size in views.items()}, checkpoint=given, state=())


class Runtime(ServedPolicy):
    """The server, given LIBERO's frames and state under the names of its policy."""

    replan_every = 8

    def reset(self):
        """An episode begins."""

    def act(self, observation, text, noise):
        return super().act(renamed(observation, self.spec), text, noise)


class SteppedRuntime(Runtime):
    """Asked at every step: with the moments before, and for new rows where those of the last chunk are executed."""

    replan_every = 1

    def reset(self):
        self.history, self.rows = History(self.spec), []

    def act(self, observation, text, noise):
        seen = renamed(observation, self.spec)
        self.history.add(seen.frames, seen.state)
        self.rows = self.rows or list(np.asarray(self._robot.act(**self.history.observation, text=text, noise=noise)))
        return Answer(self.rows.pop(0)[None], 0.0, {})


def renamed(observation, spec):
    """The observation with its frames and numbers under the names that a policy has for them, in order."""
    values, states = next(iter(observation.state.values())), {}
    for part in now(spec.states):
        states[part.name], values = values[: part.width], values[part.width :]
    assert not (spec.states and len(values))
    return replace(observation, frames=dict(zip((view.name for view in now(spec.views)), observation.frames.values())), state=states)


def now(features):
    """Those of the last moment."""
    return [feature for feature in features if "@-" not in feature.name]


class Reference(EvalPolicy):
    """The family's reference, run on the folder of a golden case that is rewritten at every look."""

    replan_every = 8

    def __init__(self, folder, spec):
        self.folder, self.spec, self.noise_shape = folder, spec, (spec.noise_rows, spec.d_noise)

    def reset(self):
        """An episode begins."""

    def act(self, observation, text, noise):
        from PIL import Image

        seen, images = renamed(observation, self.spec), {}
        for name, frame in seen.frames.items():
            view = name.removeprefix("observation.images.").removeprefix("video.")
            images[view] = f"{view}.png"
            Image.fromarray(frame).save(self.folder / images[view], compress_level=1)
        numbers = [float(x) for part in seen.state.values() for x in part]
        (self.folder / "observation.json").write_text(json.dumps({"images": images, "state": numbers, "text": text}))
        np.save(self.folder / "noise.npy", noise)
        with contextlib.redirect_stdout(io.StringIO()):
            return Answer(recorder.run_case(self.folder)["actions"], 0.0, {})


class SteppedReference(Reference):
    """LeRobot's select_action, asked at every step: its queues keep moments and rows."""

    replan_every = 1

    def __init__(self, folder, spec):
        super().__init__(folder, spec)
        self.policy, self.before, self.after = diffusion.opened(folder / "checkpoint")

    def reset(self):
        self.policy.reset()

    def act(self, observation, text, noise):
        import torch

        seen = renamed(observation, self.spec)
        batch = {name: torch.from_numpy(frame.copy()).permute(2, 0, 1).float().div(255) for name, frame in seen.frames.items()}
        batch |= {name: torch.from_numpy(values) for name, values in seen.state.items()}
        row = self.policy.select_action(self.before(batch | {"task": text}), noise=torch.from_numpy(noise)[None])
        return Answer(self.after(row).numpy(), 0.0, {})


def episode(environment, driver, shadow, steps):
    """(largest difference of chunks, executed actions, the simulator's state at the end)"""
    guard = Guard(environment)
    guard.declaration = replace(environment.declaration, limit=steps)
    for policy in filter(None, (driver, shadow)):
        policy.reset()
    outcome = run_episode(guard, driver, Job(environment.task, SEED), driver.replan_every, shadow)
    return max(outcome.difference, default=0.0), np.array(guard.executed), environment._env.get_sim_state(), outcome


def measure(arch, environments, vla, folder, steps):
    case = family_case(arch)
    n_parameter = cases.write_checkpoint(case, folder)
    cases.write_bundle(folder, dtype="f32")
    row = {"family": arch, "parameters": n_parameter, "looks": 0, "chunks": 0.0, "actions": 0.0, "state": 0.0, "clipped": 0, "steps": 0, "size": 0.0}
    Ours, Theirs = (SteppedRuntime, SteppedReference) if arch == "diffusion" else (Runtime, Reference)
    with Server(vla, folder / "bundle.gguf", 1, "float32") as server:
        runtime = Ours(server.address, 60.0)
        reference = Theirs(folder, runtime.spec)
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
    archs = sorted({name.split("/")[0] for name in all_cases()} - UNFIT)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family", nargs="*", help=f"of {', '.join(archs)} (default: all but {', '.join(sorted(ALONE))}, of which each has an environment of its own)")
    parser.add_argument("--tasks", default="libero_object/0,libero_goal/3")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--vla", default=str(cases.ROOT / "build/cpu/bin/vla"))
    parser.add_argument("--keep", type=Path, metavar="DIR", help="checkpoints and bundles, for a look afterwards")
    a = parser.parse_args()
    wanted = a.family or [arch for arch in archs if arch not in ALONE]
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
