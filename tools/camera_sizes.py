# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of cameras of any size, through every family and through its reference: the chunks are equal, or the runtime refuses.

    python tools/camera_sizes.py check [--count 500] [--only FAMILY]    random cameras; exit code 1 where an answer is wrong
    python tools/camera_sizes.py record [--count 10] [--only FAMILY]    what the references answer, into tests/golden/camera_sizes.json

The policies are those of the golden cases (`python tools/goldens make`), the references theirs: an environment with torch and lerobot, and
for the runtime a build whose libvla.so VLA_LIBRARY names. Cameras of one observation have one size half of the time, and each its own
otherwise. A reference that fails has refused: then the runtime has to refuse as well. `turbovla_authors`, `openvla`, `openvla_oft` and
`vla_adapter` need environments of their own (their modules in tools/goldens), and --only.
"""

import argparse
import contextlib
import io
import json
import os
import sys
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tools"), str(ROOT / "python"), str(ROOT / "tests/support")]
from camera_frames import drawn_sizes, frame  # noqa: E402
from goldens import all_cases  # noqa: E402
from goldens.build import FOLDER  # noqa: E402

RECORDED = ROOT / "tests/golden/camera_sizes.json"
CLOSE = 1e-5  # of the largest action, or of 1 where that is smaller


class Pair:
    """A golden case's policy, in the reference and in the runtime."""

    def __init__(self, name, runtime=True):
        import torch
        from goldens import recorder

        self.case, self.recorder = FOLDER / name, recorder
        self.observation = json.loads((self.case / "observation.json").read_text())
        self.views = [view for view, file in self.observation["images"].items() if file is not None]
        self.policy, self.before, self.after = recorder.load(self.case / "checkpoint")
        self.noise = torch.from_numpy(np.load(self.case / "noise.npy"))[None]
        self.batch = recorder.read_observation(self.case)
        if runtime:
            import vla_cpp

            self.engine = vla_cpp.Policy(str(self.case / "bundle.gguf"), kernels="float32", threads=1)

    def reference(self, frames):
        """The actions, None where it refuses."""
        import torch

        batch = dict(self.batch)
        if self.case.parent.name == "gr00t_n1_7" and len({pixels.shape for pixels in frames.values()}) > 1:
            return self.stacked_late(frames)
        if self.case.parent.name == "groot" and len({pixels.shape for pixels in frames.values()}) > 1:
            frames = {view: self.squeezed(pixels) for view, pixels in frames.items()}
        for view, pixels in frames.items():
            batch[f"observation.images.{view}"] = torch.from_numpy(pixels).permute(2, 0, 1).float().div(255)
        try:
            with torch.inference_mode(), contextlib.redirect_stdout(io.StringIO()):
                reset = getattr(self.policy, "reset", None)
                if reset:
                    reset()
                chunk = self.policy.predict_action_chunk(self.before(batch), noise=self.noise.clone())
                return self.after(chunk).float().numpy()[0]
        except Exception as error:  # noqa: BLE001 - whatever stops it is a refusal
            self.refused = repr(error)[:200]
            return None

    def runtime(self, frames):
        import vla_cpp

        images = {view: None for view in self.observation["images"]} | frames
        try:
            return np.asarray(self.engine.act(images=images, state=self.observation["state"], text=self.observation["text"], noise=self.noise[0].numpy()))
        except vla_cpp.BadObservation:
            return None


    def squeezed(self, pixels):
        """LeRobot stacks the cameras of its own GR00T before it makes squares of them, each by itself: here the squares are stacked."""
        import torch
        from torchvision.transforms.v2 import InterpolationMode, functional

        side = {"n1_5": 28, "n1_7": 32}[self.case.name]
        image = torch.from_numpy(pixels).permute(2, 0, 1)
        return functional.resize(image, [side, side], interpolation=InterpolationMode.BICUBIC, antialias=True).permute(1, 2, 0).numpy()

    def stacked_late(self, frames):
        """LeRobot stacks the cameras of N1.7 before it transforms them, and so takes frames of one size alone; its authors stack them
        after that (Isaac-GR00T gr00t/model/gr00t_n1d7/processing_gr00t_n1d7.py)."""
        from unittest import mock

        from goldens.gr00t_n1_6 import RobotNumbers
        from lerobot.policies.groot import processor_groot

        robot = RobotNumbers(self.case / "checkpoint")
        frames = {view: robot.transform(pixels) for view, pixels in frames.items()}
        if len({pixels.shape for pixels in frames.values()}) > 1:
            self.refused = "images of several sizes"
            return None
        with mock.patch.object(processor_groot, "_transform_n1_7_image_for_vlm_albumentations", lambda image, **_: image):
            return self.reference(frames)


def stated_sizes(case):
    """Of the frames of the golden case, so that the cameras that a policy is for are among those that are drawn."""
    from PIL import Image

    files = [file for file in json.loads((case / "observation.json").read_text())["images"].values() if file]
    return sorted({Image.open(case / file).size for file in files})


def cases(only):
    """One of each family and of each way in which its pipeline may go: those of GR00T keep aspects or pad."""
    chosen = [name for name in all_cases() if name.split("/")[1] in
              ("two_views", "pre_norm", "lerobot", "modes", "libero", "aspect", "relative", "four_by_three", "camera", "small", "no_state", "ddpm", "ddim", "environment", "bridge", "aloha", "calvin",
               "n1_5", "n1_7")]
    return [name for name in chosen if wanted(name, only)]


def wanted(name, only):
    """Without --only all families that run in this environment."""
    family = name.split("/")[0]
    return only in (family, name) if only else family not in ("turbovla_authors", "openvla", "openvla_oft", "vla_adapter") and name != "groot/n1_5"


def check(name, count, seed):
    pair, random = Pair(name), np.random.default_rng([seed, len(name)])
    told = dict.fromkeys(("equal", "refused by both", "refused by the runtime alone"), 0)
    worst, wrong = 0.0, []
    for i in range(count):
        sizes = drawn_sizes(random, len(pair.views), stated_sizes(pair.case))
        frames = {view: frame(*size, i + k) for k, (view, size) in enumerate(zip(pair.views, sizes))}
        expected, found = pair.reference(frames), pair.runtime(frames)
        if found is None:
            told["refused by both" if expected is None else "refused by the runtime alone"] += 1
            continue
        off = np.inf if expected is None else np.abs(found - expected).max() / max(1, np.abs(expected).max())
        worst = max(worst, off if np.isfinite(off) else 0)
        if off > CLOSE:
            wrong.append((sizes, "the reference refuses: " + pair.refused if expected is None else f"{off:.1e}"))
        else:
            told["equal"] += 1
    print(f"{name}: " + ", ".join(f"{n} {what}" for what, n in told.items()) + f", {len(wrong)} wrong; largest difference {worst:.1e}", flush=True)
    for sizes, why in wrong[:5]:
        print(f"    {sizes}: {why}")
    return not wrong


def record(only, count, seed):
    """What is not asked for stays as it is recorded."""
    out = json.loads(RECORDED.read_text())
    for name in cases(only):
        pair = Pair(name, runtime=False)
        random, rows = np.random.default_rng([seed, len(name)]), []
        for i in range(count):
            sizes = drawn_sizes(random, len(pair.views), stated_sizes(pair.case))
            actions = pair.reference({view: frame(*size, i + k) for k, (view, size) in enumerate(zip(pair.views, sizes))})
            rows.append({"sizes": sizes, "frames": i, "actions": None if actions is None else [[float(f"{x:.8g}") for x in actions[j]] for j in (0, -1)]})
        out[name] = rows
        print(f"{name}: {sum(row['actions'] is not None for row in rows)} of {count} are answered", flush=True)
    lines = ",\n".join(f"  {json.dumps(name)}: [\n" + ",\n".join("   " + json.dumps(row) for row in rows) + "\n  ]" for name, rows in out.items())
    RECORDED.write_text("{\n" + lines + "\n}\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for command, count in (("check", 500), ("record", 10)):
        sub = commands.add_parser(command)
        sub.add_argument("--count", type=int, default=count)
        sub.add_argument("--seed", type=int, default=0)
        sub.add_argument("--only", help="a family or a case, as smolvla or groot/n1_5")
    args = parser.parse_args()
    from goldens.recorder import open_reference

    open_reference()
    warnings.filterwarnings("ignore")
    import torch

    torch.set_num_threads(1)
    if args.command == "record":
        record(args.only, args.count, args.seed)
        return
    good = True
    for name in cases(args.only):
        good &= check(name, args.count, args.seed)
    sys.exit(not good)


if __name__ == "__main__":
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    main()
