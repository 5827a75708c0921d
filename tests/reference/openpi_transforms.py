# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What openpi does in front of its network and behind it, in numpy and Pillow.

Reference: openpi src/openpi/transforms.py, policies/aloha_policy.py, models/tokenizer.py, packages/openpi-client image_tools.py.
"""

import json

import contracts
import numpy as np
from PIL import Image

SIDE, EPS, SLOTS = 224, 1e-6, 3
FLIPS = np.array([1, -1, -1, 1, 1, 1, 1] * 2, np.float64)
GRIPPERS = [6, 13]
ARMS = [*range(6), *range(7, 13)]
# DeltaActions of the named configurations.
RELATIVE = {"pi0_aloha_sim": [], "pi0_libero": range(6), "pi0_libero_low_mem_finetune": range(6), "pi05_libero": [], "pi05_full_droid_finetune": range(7)}


class Transforms:
    def __init__(self, row, folder):
        self.model, self.states, self.n_action, _ = contracts.openpi_robot(row)
        variant = row["variant"]
        named = isinstance(variant, str)
        self.is_aloha = "aloha" in (variant if named else variant.get("robot", ""))
        self.relative = list(RELATIVE.get(variant, ARMS if self.is_aloha else []) if named else variant.get("relative", []))
        self.state_in_prompt = self.model == "pi05" and (variant != "pi05_libero" if named else variant.get("discrete_state", True))
        self.views = list(row["views"])
        self.stats = json.loads(next((folder / "assets").rglob("norm_stats.json")).read_text())["norm_stats"]

    def images(self, raw):
        """(3, 224, 224) in [-1, 1] for each slot of the network, and whether it has a camera."""
        out = []
        for view in self.views:
            frame = raw.get(f"observation.images.{view}")
            pixels = None if frame is None else np.rint(frame.numpy().transpose(1, 2, 0) * 255).astype(np.uint8)
            out.append(None if pixels is None else resized_with_pad(pixels))
        out += [None] * (SLOTS - len(out))
        black = np.full((3, SIDE, SIDE), -1, np.float32)
        return [black if image is None else image for image in out], [image is not None for image in out]

    def decoded(self, state):
        """AlohaInputs with adapt_to_pi."""
        if not self.is_aloha:
            return state
        state = FLIPS * state
        opening = state[GRIPPERS] * (0.05800 - 0.01844) + 0.01844
        angle = np.arcsin(np.clip((0.022**2 + opening**2 - 0.036**2) / (2 * 0.022 * opening), -1, 1))
        state[GRIPPERS] = (angle - 0.5476) / (1.6296 - 0.5476)
        return state

    def state(self, state):
        stats, x = {k: np.asarray(v) for k, v in self.stats["state"].items()}, self.decoded(state)
        if self.model == "pi0":
            return (x - stats["mean"]) / (stats["std"] + EPS)
        return (x - stats["q01"]) / (stats["q99"] - stats["q01"] + EPS) * 2 - 1

    def prompt(self, text, state):
        text = text.strip().replace("_", " ").replace("\n", " ")
        if not self.state_in_prompt:
            return text + "\n"
        bins = np.digitize(state, bins=np.linspace(-1, 1, 256 + 1)[:-1]) - 1
        return f"Task: {text}, State: {' '.join(map(str, bins))};\nAction: "

    def actions(self, chunk, state):
        stats = {k: np.asarray(v) for k, v in self.stats["actions"].items()}
        x = chunk[:, : self.n_action]
        if self.model == "pi0":
            x = x * (stats["std"] + EPS) + stats["mean"]
        else:
            x = (x + 1) / 2 * (stats["q99"] - stats["q01"] + EPS) + stats["q01"]
        x[:, self.relative] += self.decoded(state)[self.relative]
        if self.is_aloha:
            x = x * FLIPS
            x[:, GRIPPERS] = (x[:, GRIPPERS] + 0.5476 + 0.6213) / (1.4910 + 0.6213)
        return x


def resized_with_pad(pixels):
    image = Image.fromarray(pixels)
    ratio = max(image.width / SIDE, image.height / SIDE)
    width, height = int(image.width / ratio), int(image.height / ratio)
    # Columns first and then rows, as Pillow did in one call before release 12.
    small = image.resize((width, image.height), Image.BILINEAR).resize((width, height), Image.BILINEAR)
    padded = Image.new("RGB", (SIDE, SIDE), 0)
    padded.paste(small, (max(0, (SIDE - width) // 2), max(0, (SIDE - height) // 2)))
    return (np.asarray(padded, np.float32) / np.float32(255) * 2 - 1).transpose(2, 0, 1)
