# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Records one look of LIBERO with PyTorch's answer, for `vla run` and the tests.

    python record.py --checkpoint checkpoint --out look --task libero_object/4

OUT/ then holds what a policy is given, and what LeRobot's class in float32 makes of it:
    image.png, image2.png  what the cameras saw, 256 x 256
    noise.npy              (16, 8) float32: the noise that the chunk is made from
    expected.npy           (16, 7) float32: PyTorch's chunk in the robot's units
    look.json              task, seed, sentence, state
"""

import argparse
import json
import os
import sys
from pathlib import Path

from vla_cpp.eval import lerobot_reference as reference  # before lerobot
import numpy as np
from PIL import Image
from vla_cpp.eval.environments.libero import Libero
from vla_cpp.eval.episode import noise_of

SEED = 910030  # vla-eval counts on others


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", required=True, metavar="DIR", help="of train.py")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="0.2 MB")
    parser.add_argument("--task", required=True, metavar="NAME", help="e.g. libero_object/4")
    args = parser.parse_args()
    policy, before, after = reference.load(args.checkpoint)
    environment = Libero(args.task)
    environment.reset(SEED)
    seen, sentence = environment.observe(), environment.instruction()
    noise = noise_of(SEED, 0, policy.config.chunk_size, policy.config.max_action_dim)
    chunk = reference.predict(policy, before, after, seen.frames, seen.state, sentence, noise)
    args.out.mkdir(parents=True, exist_ok=True)
    for view, frame in seen.frames.items():
        Image.fromarray(frame).save(args.out / f"{view}.png", optimize=True)
    np.save(args.out / "noise.npy", noise)
    np.save(args.out / "expected.npy", chunk)
    state = [float(format(float(x), ".9g")) for x in seen.state["observation.state"]]
    (args.out / "look.json").write_text(json.dumps({"task": args.task, "seed": SEED, "sentence": sentence, "state": state}, indent=1) + "\n")
    sys.stdout.flush()
    os._exit(0)  # the renderer's destructors print errors at a normal exit


if __name__ == "__main__":
    main()
