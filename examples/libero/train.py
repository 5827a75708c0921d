# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Trains LeRobot's own SmolVLA class, at four million parameters, on the demonstrations of collect.py.

    python train.py --data data --out checkpoint --minutes 120

Nothing is pretrained: the weights start random and the tokenizer is trained on the ten sentences.  Two things spare time on few
cores.  A look passes the backbone once and the action expert for several draws of noise and time.  And beside the actions the
backbone is asked where the thing of the sentence and the basket are from the hand (`place` of the demonstrations), through a
linear map that is no part of the checkpoint: the policy itself sees frames, state and sentence alone.

An interrupted training continues where it stopped when the same command is run again, and later with more --minutes: its state
is in OUT/state.pt.  The learning rate warms up, stays, and falls to 0 over the last quarter of the minutes.  What is written is
the mean of the weights over about the last 200 steps, every --export minutes: it can be evaluated while the training goes on.
Demonstrations that were added meanwhile are read then.
"""

import argparse
import copy
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import small_smolvla as small  # noqa: E402  (before torch and lerobot)
import numpy as np  # noqa: E402
import torch  # noqa: E402
from torch.nn import functional as F  # noqa: E402
from collect import ACTION_NAMES, EXECUTE, HORIZON, RATE_HZ, STATE_NAMES, VIEWS  # noqa: E402
from vla_cpp.eval.environments.libero import SENTENCES  # noqa: E402
from vla_cpp.eval.environments.libero import SIZE as FRAME  # noqa: E402

SIZE = FRAME // 2  # pixels: what the policy sees of what LIBERO shows; collect.py halves it as well
VISION = 128  # width of the vision tower
N_TOKEN = 20  # of a sentence, padded
DISTANCE = 0.1  # metres that the question for places counts as 1
AVERAGE = 0.995  # of the weights that are written: what remains of the mean after a step


def save_backbone(folder):
    small.save_backbone(folder, list(SENTENCES.values()) * 20, SIZE, VISION)


def make_policy(backbone, statistics):
    """The policy with random weights, its pre- and its post-processor."""
    views = {f"observation.images.{view}": FRAME for view in VIEWS}
    return small.make_policy(backbone, views, len(STATE_NAMES), len(ACTION_NAMES), (HORIZON, EXECUTE), N_TOKEN, statistics)


def describe(out):
    small.describe(out, RATE_HZ, STATE_NAMES, ACTION_NAMES)


class Demonstrations:
    """All kept steps of all files of a folder; `read` adds those that are new.

    frames: of each view (n, 128, 128, 3) uint8; state (n, 8); action (n, 16, 7); pad (n, 16); place (n, 6); sentence: n strings
    """

    KEYS = (*VIEWS, "state", "action", "valid", "place")

    def __init__(self, folder):
        self.folder, self._known, self._kept, self.sentence = folder, set(), {}, []
        self.read()
        if not self.sentence:
            raise SystemExit(f"no demonstrations in {folder}: run  python collect.py --out {folder}")

    def read(self):
        new = [path for path in sorted(self.folder.glob("*.npz")) if path.name not in self._known]
        if not new:
            return
        parts = {key: [self._kept[key]] if self._kept else [] for key in self.KEYS}
        for path in new:
            with np.load(path) as episode:
                for key in self.KEYS:
                    parts[key].append(torch.from_numpy(episode[key]))
                self.sentence += [str(episode["sentence"])] * len(parts["state"][-1])
        self._known.update(path.name for path in new)
        self._kept = kept = {key: torch.cat(part) for key, part in parts.items()}
        self.state, self.action, self.place, self.pad = kept["state"], kept["action"], kept["place"], ~kept["valid"]
        self.frames = {view: kept[view] for view in VIEWS}

    def episodes(self):
        return len(self._known)

    def batch(self, pick, random):
        """What the policy's pre-processor takes."""
        frames = {f"observation.images.{view}": small.light(kept[pick].permute(0, 3, 1, 2).float() / 255, random) for view, kept in self.frames.items()}
        return {**frames, "observation.state": self.state[pick], "action": self.action[pick], "task": [self.sentence[i] for i in pick]}


def losses(policy, asked, batch, pad, place, draws):
    """(flow matching, places): mean squared errors. Each look passes the backbone once and the expert `draws` times."""
    from lerobot.policies.smolvla.modeling_smolvla import make_att_2d_masks
    from transformers import DynamicCache

    model = policy.model
    images, present = policy.prepare_images(batch)
    state, actions = policy.prepare_state(batch), policy.prepare_action(batch)
    embedded, mask, causal = model.embed_prefix(
        images, present, batch["observation.language.tokens"], batch["observation.language.attention_mask"], state=state
    )
    (prefix, _), cache = model.vlm_with_expert.forward(
        attention_mask=make_att_2d_masks(mask, causal), position_ids=torch.cumsum(mask, dim=1) - 1,
        past_key_values=None, inputs_embeds=[embedded, None], use_cache=True,
    )  # fmt: skip
    again, repeated = lambda x: x.repeat_interleave(draws, 0), DynamicCache()
    for i, layer in enumerate(cache.layers):
        repeated.update(again(layer.keys), again(layer.values), i)
    actions, pad, n = again(actions), again(pad), len(actions) * draws
    noise, t = model.sample_noise(actions.shape, actions.device), model.sample_time(n, actions.device)
    mixed = t[:, None, None] * noise + (1 - t[:, None, None]) * actions
    velocity = model.denoise_step(again(mask), repeated, mixed, t)
    error = (velocity - (noise - actions))[..., : len(ACTION_NAMES)] ** 2
    flow = (error * ~pad[..., None]).sum() / ((~pad).sum() * len(ACTION_NAMES))
    return flow, F.mse_loss(asked(prefix[:, -1]), place)  # the last row is the state's, which sees frames and sentence


class Training:
    """Policy, optimizer and the mean of the weights, with all that goes on after an interruption."""

    def __init__(self, a, data):
        self.a, self.data, self.state_file = a, data, a.out / "state.pt"
        torch.manual_seed(a.seed)
        saved = torch.load(self.state_file, weights_only=True) if self.state_file.exists() else None
        self.statistics = saved["statistics"] if saved else small.measure(data.state, data.action, data.pad)
        save_backbone(a.out / "vlm")
        self.policy, self.before, self.after = make_policy(a.out / "vlm", self.statistics)
        self.asked = torch.nn.Linear(self.policy.model.vlm_with_expert.config.text_config.hidden_size, 6)
        self.mean = copy.deepcopy(self.policy)
        self.trained = [p for p in (*self.policy.parameters(), *self.asked.parameters()) if p.requires_grad]
        self.optimizer = torch.optim.AdamW(self.trained, lr=a.rate, betas=(0.9, 0.95), weight_decay=0.01)
        self.step, self.spent, self.curve = 0, 0.0, []
        if saved:
            for name in ("policy", "asked", "mean", "optimizer"):
                getattr(self, name).load_state_dict(saved[name])
            self.step, self.spent, self.curve = saved["step"], saved["spent"], saved["curve"]
            print(f"continuing at step {self.step}, {self.spent / 60:.1f} minutes in")
        self.random = torch.Generator().manual_seed(a.seed + self.step)
        torch.manual_seed(a.seed + self.step)

    def keep(self):
        parts = {name: getattr(self, name).state_dict() for name in ("policy", "asked", "mean", "optimizer")}
        small.keep({**parts, "statistics": self.statistics, "step": self.step, "spent": self.spent, "curve": self.curve}, self.state_file)

    def export(self):
        small.save(copy.deepcopy(self.mean), self.before, self.after, self.a.out)
        describe(self.a.out)
        summary = {"steps": self.step, "minutes": round(self.spent / 60, 1), "batch": self.a.batch, "draws": self.a.draws,
                   "episodes": self.data.episodes(), "looks": len(self.data.sentence), "curve": self.curve}  # fmt: skip
        (self.a.out / "training.json").write_text(json.dumps(summary, indent=1) + "\n")

    def progress(self):
        """1 where the minutes or the steps are used up."""
        return max(self.spent / (60 * self.a.minutes), self.step / self.a.steps)

    def rate(self):
        """Share of the peak learning rate."""
        return min(1.0, (self.step + 1) / 100, max(0.0, 4 * (1 - self.progress())))

    def improve(self, pick):
        """One step on the looks of these numbers -> the two losses."""
        raw = self.data.batch(pick, self.random)
        place = (self.data.place[pick] - raw["observation.state"][:, :3].repeat(1, 2)) / DISTANCE
        for group in self.optimizer.param_groups:
            group["lr"] = self.a.rate * self.rate()
        with torch.autocast("cpu", torch.bfloat16, enabled=self.a.autocast):
            flow, where = losses(self.policy, self.asked, self.before(raw), self.data.pad[pick], place, self.a.draws)
        self.optimizer.zero_grad(set_to_none=True)
        (flow + self.a.place * where).backward()
        torch.nn.utils.clip_grad_norm_(self.trained, 1.0)
        self.optimizer.step()
        kept = min(AVERAGE, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mean, now in zip(self.mean.parameters(), self.policy.parameters()):
                mean.lerp_(now, 1 - kept)
        self.step += 1
        return flow.item(), where.item()

    def run(self):
        self.policy.train()
        at, order, recent, clock, exported = 0, [], [], time.monotonic(), self.spent
        while self.progress() < 1:
            if at + self.a.batch > len(order):
                order, at = torch.randperm(len(self.data.sentence), generator=self.random), 0
            recent.append(self.improve(order[at : at + self.a.batch]))
            at += self.a.batch
            now = time.monotonic()
            self.spent, clock = self.spent + now - clock, now
            if self.step % 50 == 0:
                flow, where = np.mean(recent, axis=0)
                self.curve.append([self.step, round(self.spent / 60, 2), round(float(flow), 4), round(float(where), 4)])
                recent.clear()
                print(f"step {self.step}: flow {flow:.4f}, place {where:.4f}, {self.spent / 60:.1f} min, {len(self.data.sentence)} looks", flush=True)
            if self.spent - exported > 60 * self.a.export:
                self.keep(), self.export(), self.data.read()
                exported, order = self.spent, []
        self.keep(), self.export()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the folder that collect.py filled")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the checkpoint goes")
    parser.add_argument("--minutes", type=float, default=120, help="wall clock at most, over all runs (default 120)")
    parser.add_argument("--steps", type=int, default=100000, help="optimizer steps at most (default 100000)")
    parser.add_argument("--batch", type=int, default=32, help="looks in a step (default 32)")
    parser.add_argument("--draws", type=int, default=4, help="draws of noise and time for each look (default 4)")
    parser.add_argument("--place", type=float, default=0.5, help="weight of the question for places (default 0.5)")
    parser.add_argument("--rate", type=float, default=8e-4, help="peak learning rate (default 8e-4)")
    parser.add_argument("--export", type=float, default=5, help="minutes from one written checkpoint to the next (default 5)")
    parser.add_argument("--autocast", action="store_true", help="products in bfloat16: a quarter quicker where the processor has AVX512_BF16")
    parser.add_argument("--threads", type=int, default=2, help="default 2")
    parser.add_argument("--seed", type=int, default=0, help="of the weights and of the order of the data (default 0)")
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    a.out.mkdir(parents=True, exist_ok=True)
    data = Demonstrations(a.data)
    training = Training(a, data)
    size = sum(p.numel() for p in training.policy.parameters())
    print(f"{data.episodes()} demonstrations, {len(data.sentence):,} looks, {size:,} parameters", flush=True)
    training.run()
    print(f"{a.out}: {training.step} steps in {training.spent / 60:.1f} min")
    return 0


if __name__ == "__main__":
    sys.exit(main())
