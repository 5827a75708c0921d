# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Records one closed-loop episode of every task for the demo, driven by the PyTorch policy.

    python record.py --checkpoint checkpoint --out episodes

Of every task it takes the first layout, from seed 910000 on, that the policy solves (training never used these seeds; the
seeds that it tried and did not solve are listed in episode.json).  OUT/<task>/ then holds, for each look at the scene,
    step_00.png            what the camera saw, 128 x 128
    step_00_noise.npy      (16, 8) float32: the noise that the chunk was made from
and for all n looks together
    expected.npy           (n, 16, 4) float32: PyTorch's chunks in float32, in the robot's units
    expert.npy             (n, 16, 4) float32: the 16 actions of the scripted expert, had it taken over at that moment.  It knows
                           the true position of the object; the policy has only the picture.
    episode.json           sentence, states (hand position in metres, gripper opening), seed, names, how it ended
"""
import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any, Dict, List

from vla_cpp.eval import lerobot_reference as reference  # before lerobot
import numpy as np
from PIL import Image

from sim import ACTION_NAMES, CAMERA, EXECUTE, HORIZON, LIMIT, RATE_HZ, STATE_NAMES, TASKS, UNSEEN, Scene, noise

FIRST = UNSEEN + 10000  # vla-eval counts on the seeds below


def drive(scene: Scene, predict: Any, seed: int) -> Dict[str, Any]:
    """One closed-loop episode: what was seen, predicted and executed."""
    scene.reset(seed)
    looks: List[Dict[str, Any]] = []
    executed: List[np.ndarray] = []
    solved = False
    while len(executed) < LIMIT and not solved:
        look = {"step": len(executed), "frame": scene.frame(), "state": scene.state(), "noise": noise(seed, len(looks))}
        look["chunk"] = predict(look["frame"], look["state"], TASKS[scene.task], look["noise"])
        looks.append(look)
        for action in look["chunk"][:EXECUTE]:
            solved = scene.step(action)
            executed.append(action)
            if solved or len(executed) == LIMIT:
                break
    return {"looks": looks, "executed": executed, "solved": solved}


def take_over(scene: Scene, seed: int, executed: List[np.ndarray]) -> np.ndarray:
    """(16, 4) float32: the scripted expert's next actions after these executed ones."""
    scene.reset(seed)
    for action in executed:
        scene.step(action)
    actions = []
    for _ in range(HORIZON):
        actions.append(scene.expert())
        scene.step(actions[-1])
    return np.stack(actions)


def main() -> int:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--checkpoint", required=True, metavar="DIR", help="a checkpoint of train.py")
    ap.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the episodes go; under 1 MB in all")
    ap.add_argument("--tries", type=int, default=20, help="layouts to try for each task (default 20)")
    a = ap.parse_args()
    from rich.progress import track

    policy, before, after = reference.load(a.checkpoint)

    def predict(frame: np.ndarray, state: np.ndarray, text: str, draw: np.ndarray) -> np.ndarray:
        return reference.predict(policy, before, after, {CAMERA: frame}, {"observation.state": state}, text, draw)

    for task in track(TASKS, description="recording"):
        scene, missed = Scene(task), []
        for seed in range(FIRST, FIRST + a.tries):
            run = drive(scene, predict, seed)
            if run["solved"]:
                break
            missed.append(seed)
        else:
            raise SystemExit(f"{task}: none of {a.tries} layouts was solved. Train longer, or raise --tries.")
        folder = a.out / task
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.iterdir():
            old.unlink()
        for i, look in enumerate(run["looks"]):
            Image.fromarray(look["frame"]).save(folder / f"step_{i:02d}.png", optimize=True)
            np.save(folder / f"step_{i:02d}_noise.npy", look["noise"])
        np.save(folder / "expected.npy", np.stack([look["chunk"] for look in run["looks"]]))
        np.save(folder / "expert.npy", np.stack([take_over(scene, seed, run["executed"][: look["step"]]) for look in run["looks"]]))
        (folder / "episode.json").write_text(json.dumps({
            "task": task, "sentence": TASKS[task], "camera": CAMERA, "seed": seed, "seeds_not_solved": missed,
            "solved_after_steps": len(run["executed"]), "execute": EXECUTE, "horizon": HORIZON, "ms_per_step": 1e3 / RATE_HZ,
            "state_names": STATE_NAMES, "action_names": ACTION_NAMES,
            "looks": [{"step": look["step"], "frame": f"step_{i:02d}.png", "noise": f"step_{i:02d}_noise.npy",
                       "state": [float(format(float(x), ".9g")) for x in look["state"]]} for i, look in enumerate(run["looks"])],
        }, indent=1) + "\n")
        print(f"{task}: seed {seed}, {len(run['looks'])} chunks, solved after {len(run['executed'])} steps, not solved before: {missed}")
    sys.stdout.flush()
    os._exit(0)  # the renderer's destructors print errors at a normal exit


if __name__ == "__main__":
    main()
