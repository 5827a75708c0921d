# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the Python peers share: the checkpoint, one observation, and the protocol of a child that waits for its turn."""
import json
import sys
import time
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tools")]
STAGES = ("vision", "prefix", "steps")


def load(checkpoint, dtype, threads):
    """LeRobot's network of a folder in the hub layout with the backbone's files under vlm/."""
    import torch
    from goldens import recorder

    recorder.open_reference()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(threads)
    return recorder.load(checkpoint, dtype)[0].model.requires_grad_(False)  # constants, to whoever traces it


def observation(config, n_view, n_text, seed=0):
    """What the network reads, as float32 or int64 arrays: images (view, 3, side, side), tokens, state, noise."""
    draw = np.random.default_rng(seed)
    side = config.resize_imgs_with_padding[0]
    return {
        "images": draw.uniform(-1, 1, (n_view, 3, side, side)).astype(np.float32),
        "tokens": draw.integers(3, 400, (1, n_text)),
        "state": draw.standard_normal((1, config.max_state_dim)).astype(np.float32),
        "noise": draw.standard_normal((1, config.chunk_size, config.max_action_dim)).astype(np.float32),
    }


class Laps:
    """Milliseconds by stage."""

    def __init__(self):
        self.last, self.stages = time.perf_counter(), {}

    def lap(self, stage):
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + 1e3 * (now - self.last)
        self.last = now


def serve(run, **about):
    """Says that it is ready, then answers every line of standard input with one timed run: {stage: ms}."""
    print(json.dumps(about), flush=True)
    for _ in sys.stdin:
        print(json.dumps(run()), flush=True)
