# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Trains LeRobot's own ACT class, of small width, on the demonstrations of collect.py.

    python train.py --data data --out checkpoint --minutes 30

Nothing is pretrained. LeRobot's ResNet has normalizations whose statistics never change, which suits pretrained weights; here they
are learned as usual and become those statistics in what is written. Beside the actions the tower is asked where the cube is, through
a linear map that is no part of the checkpoint. What is written every few minutes can be evaluated while the training goes on.
"""

import argparse
import json
import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import small_smolvla as small  # noqa: E402  (before torch and lerobot)
import numpy as np  # noqa: E402
import torch  # noqa: E402
from torch import nn  # noqa: E402
from torch.nn import functional as F  # noqa: E402
from vla_cpp.eval.environments.aloha import CAMERA, HEIGHT, NAMES, RATE_HZ, WIDTH  # noqa: E402

HORIZON, EXECUTE = 50, 25
VIEW = f"observation.images.{CAMERA}"


class Demonstrations:
    """frames (n, 96, 128, 3) uint8, state (n, 14), cube (n, 2) metres, and of each look the next 50 actions, with the last one again
    where the episode ends."""

    def __init__(self, folder):
        parts = [np.load(path) for path in sorted(folder.glob("*.npz"))]
        join = lambda key: torch.from_numpy(np.concatenate([part[key] for part in parts]))  # noqa: E731
        self.frames, self.state, self.step, self.cube = join("frames"), join("states"), join("step").long(), join("cubes")[:, :2]
        first = np.cumsum([0] + [len(part["actions"]) for part in parts])
        self.episode = torch.from_numpy(np.concatenate([part["episode"] + at for part, at in zip(parts, first)])).long()
        self.actions = join("actions")

    def chunk(self, pick):
        at = self.step[pick, None] + torch.arange(HORIZON)
        pad = at >= self.actions.shape[1]
        return self.actions[self.episode[pick, None], at.clamp_max(self.actions.shape[1] - 1)], pad


def make_policy(statistics):
    """The policy with random weights, its pre- and its post-processor."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.act.processor_act import make_act_pre_post_processors

    config = ACTConfig(
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (14,)), VIEW: PolicyFeature(FeatureType.VISUAL, (3, HEIGHT, WIDTH))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (14,))},
        chunk_size=HORIZON, n_action_steps=EXECUTE, vision_backbone="resnet18", pretrained_backbone_weights=None, dim_model=160, n_heads=5,
        dim_feedforward=640, n_encoder_layers=3, n_decoder_layers=1, use_vae=False, dropout=0.05, device="cpu", push_to_hub=False)  # fmt: skip
    return (ACTPolicy(config).float(), *make_act_pre_post_processors(config, statistics))


def let_norms_learn(tower):
    for name, child in tower.named_children():
        if type(child).__name__ == "FrozenBatchNorm2d":
            setattr(tower, name, nn.BatchNorm2d(len(child.weight), momentum=0.03))
        let_norms_learn(child)


def export(policy, before, after, statistics, out):
    """Writes the published layout. Numbers are bf16's, stored as float32: the tower's normalizations still become part of its
    products where a bundle is made."""
    fresh, *_ = make_policy(statistics)
    fresh.load_state_dict({key: value for key, value in policy.state_dict().items() if not key.endswith("num_batches_tracked")})
    with torch.no_grad():
        for tensor in (*fresh.parameters(), *fresh.buffers()):
            tensor.copy_(tensor.bfloat16().float())
    for part in (fresh, before, after):
        part.save_pretrained(out)
    small.describe(out, RATE_HZ, list(NAMES), list(NAMES))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--batch", type=int, default=48)
    parser.add_argument("--rate", type=float, default=5e-4)
    parser.add_argument("--export", type=float, default=5, help="minutes from one written checkpoint to the next")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    data = Demonstrations(options.data)
    everything = torch.arange(len(data.step))
    actions, pad = data.chunk(everything)
    statistics = small.measure(data.state, actions, pad)
    pixels = data.frames[::37].float() / 255
    statistics[VIEW] = {"mean": pixels.mean((0, 1, 2))[:, None, None], "std": pixels.std((0, 1, 2))[:, None, None]}
    policy, before, after = make_policy(statistics)
    let_norms_learn(policy.model.backbone)
    policy.model.backbone.to(memory_format=torch.channels_last)
    policy.train()
    asked = nn.Linear(512 * math.ceil(HEIGHT / 32) * math.ceil(WIDTH / 32), 2)
    features = []
    policy.model.backbone.register_forward_hook(lambda module, given, found: features.append(found["feature_map"]))
    trained = [*policy.parameters(), *asked.parameters()]
    optimizer = torch.optim.AdamW(trained, lr=options.rate, weight_decay=1e-4)
    middle, spread = data.cube.mean(0), data.cube.std(0)
    random = torch.Generator().manual_seed(0)
    print(f"{len(data.actions)} demonstrations, {len(everything):,} looks, {sum(p.numel() for p in policy.parameters()):,} parameters", flush=True)

    begun = exported = time.monotonic()
    recent, step = [], 0
    while (share := (time.monotonic() - begun) / (60 * options.minutes)) < 1:
        for group in optimizer.param_groups:
            group["lr"] = options.rate * min(1, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * share))
        pick = torch.randint(len(everything), (options.batch,), generator=random)
        chunk, pad = data.chunk(pick)
        frames = small.light(data.frames[pick].permute(0, 3, 1, 2).float() / 255, random)
        batch = before({VIEW: frames, "observation.state": data.state[pick], "action": chunk})
        batch[VIEW] = batch[VIEW].to(memory_format=torch.channels_last)
        batch["action_is_pad"] = pad
        with torch.autocast("cpu", torch.bfloat16):
            loss, _ = policy.forward(batch)
            where = F.mse_loss(asked(features.pop().float().flatten(1)), (data.cube[pick] - middle) / spread)
        optimizer.zero_grad(set_to_none=True)
        (loss + 0.1 * where).backward()
        nn.utils.clip_grad_norm_(trained, 5.0)
        optimizer.step()
        step += 1
        recent.append((loss.item(), where.item()))
        if step % 50 == 0:
            print(f"step {step}: actions {np.mean(recent, 0)[0]:.4f}, cube {np.mean(recent, 0)[1]:.4f}, {(time.monotonic() - begun) / 60:.1f} min", flush=True)
            recent.clear()
        if time.monotonic() - exported > 60 * options.export:
            export(policy, before, after, statistics, options.out)
            exported = time.monotonic()
    export(policy, before, after, statistics, options.out)
    (options.out / "training.json").write_text(json.dumps({"steps": step, "minutes": options.minutes, "batch": options.batch, "episodes": len(data.actions)}) + "\n")


if __name__ == "__main__":
    main()
