#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""lerobot-eval with torch seeded again at the start of every rollout.

lerobot-eval seeds before it makes the policy, and making LeRobot's SmolVLA draws its weights at random before they are loaded: the
plug-in, which draws none, would start from other noise. Take this in its place to compare the two on the same checkpoint:

paired_eval.py --policy.path=CHECKPOINT --env.type=metaworld --env.task=drawer-close-v3 --seed=1000 ...
paired_eval.py --policy.type=vla_cpp --policy.bundle=policy.gguf --policy.n_action_steps=8 ...
"""

from vla_cpp.eval import lerobot_reference  # noqa: F401, I001  (before lerobot: for Python 3.11, and offline)

import lerobot.scripts.lerobot_eval as program
import torch

SEED = 7


def main():
    rollout = program.rollout

    def seeded(*arguments, **options):
        torch.manual_seed(SEED)
        return rollout(*arguments, **options)

    program.rollout = seeded
    program.main()


if __name__ == "__main__":
    main()
