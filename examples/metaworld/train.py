# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Trains LeRobot's own SmolVLA class, at 4.7 million parameters, on the demonstrations of collect.py.

    python train.py --data data --out checkpoint --minutes 60
    python train.py --data data --out smoke --steps 60            # a quick look

Nothing is pretrained: the weights start random and the tokenizer is trained on the four sentences.  The learning rate
warms up, then follows a cosine to 0, which it reaches when the steps or the minutes are used up, whichever is first.
An interrupted training continues where it stopped (its state is in OUT/state.pt) when the same command is run again.

OUT holds what a published checkpoint holds (config.json, model.safetensors, the two processors), vlm/ what a hub keeps in
the repository of the backbone (its config and tokenizer), meta/ the names of state and action numbers.  Every parameter is rounded to a value that
bfloat16 can represent and stored as float32: a bfloat16 copy of the file then holds exactly the same numbers, and
differences between runtimes come from their arithmetic alone.
"""
import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, Dict, List, Tuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from vla_cpp.eval import lerobot_reference as reference  # before lerobot
import numpy as np
import torch

import small_smolvla as small
from sim import ACTION_NAMES, CAMERA, EXECUTE, HORIZON, RATE_HZ, SIZE, STATE_NAMES, TASKS

CAMERA_KEY = f"observation.images.{CAMERA}"


def lines() -> List[str]:
    """What the tokenizer is trained on: the sentences, and others like them."""
    verbs, places = ["open", "close", "press", "push", "pull", "turn"], ["from above", "from the side", "to the left", "to the right"]
    things = ["faucet", "button", "drawer", "door", "window", "handle"]
    other = [f"{v} the {t} {p}" for v in verbs for t in things for p in places]
    return list(TASKS.values()) * len(other) + other


def save_backbone(folder: Path) -> None:
    small.save_backbone(folder, lines(), SIZE)


def make_policy(backbone: Path, statistics: Dict[str, Dict[str, torch.Tensor]]) -> Tuple[Any, Any, Any]:
    """The policy with random weights, its pre- and its post-processor."""
    return small.make_policy(backbone, {CAMERA_KEY: SIZE}, len(STATE_NAMES), len(ACTION_NAMES), (HORIZON, EXECUTE), 24, statistics)


def describe(out: Path) -> None:
    small.describe(out, RATE_HZ, STATE_NAMES, ACTION_NAMES)


def read_demonstrations(folder: Path) -> Tuple[Dict[str, torch.Tensor], List[str]]:
    """All kept steps of all files: frame (n, 3, 128, 128) uint8, state (n, 4), action (n, 16, 4), pad (n, 16); the sentences."""
    from rich.progress import track

    files = sorted(folder.glob("*.npz"))
    if not files:
        raise SystemExit(f"no demonstrations in {folder}: run  python collect.py --out {folder}")
    parts: Dict[str, List[np.ndarray]] = {"frame": [], "state": [], "action": [], "valid": []}
    sentences: List[str] = []
    for path in track(files, description="reading"):
        with np.load(path) as episode:
            for key in parts:
                parts[key].append(episode[key])
            sentences += [TASKS[str(episode["task"])]] * len(parts["state"][-1])
    data = {key: torch.from_numpy(np.concatenate(part)) for key, part in parts.items()}
    data["pad"] = ~data.pop("valid")
    data["frame"] = data["frame"].permute(0, 3, 1, 2)
    return data, sentences


def rate(progress: float, step: int) -> float:
    """Share of the peak learning rate: linear over the first 100 steps, then a cosine that is 0 at progress 1."""
    return min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def main() -> int:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--data", type=Path, required=True, metavar="DIR", help="the folder that collect.py filled")
    ap.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the checkpoint goes")
    ap.add_argument("--minutes", type=float, default=60, help="wall clock at most, over all runs (default 60)")
    ap.add_argument("--steps", type=int, default=6000, help="optimizer steps at most (default 6000)")
    ap.add_argument("--batch", type=int, default=40, help="default 40")
    ap.add_argument("--rate", type=float, default=8e-4, help="peak learning rate (default 8e-4)")
    ap.add_argument("--threads", type=int, default=2, help="default 2")
    ap.add_argument("--seed", type=int, default=0, help="of the weights and of the order of the data (default 0)")
    a = ap.parse_args()
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    torch.set_num_threads(a.threads)
    torch.manual_seed(a.seed)
    data, sentences = read_demonstrations(a.data)
    a.out.mkdir(parents=True, exist_ok=True)
    save_backbone(a.out / "vlm")
    policy, before, after = make_policy(a.out / "vlm", small.measure(data["state"], data["action"], data["pad"]))
    size = sum(p.numel() for p in policy.parameters())
    print(f"{len(sentences):,} frames, {size:,} parameters, camera {CAMERA}")

    trained = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=a.rate, betas=(0.9, 0.95), weight_decay=0.01)
    random = torch.Generator().manual_seed(a.seed)
    step, spent, losses, state_file = 0, 0.0, [], a.out / "state.pt"
    if state_file.exists():
        saved = torch.load(state_file, weights_only=True)
        policy.load_state_dict(saved["policy"])
        optimizer.load_state_dict(saved["optimizer"])
        step, spent, losses = saved["step"], saved["spent"], saved["losses"]
        random.manual_seed(a.seed + step)
        print(f"continuing at step {step}, {spent / 60:.1f} minutes in")

    def keep() -> None:
        parts = {"policy": policy.state_dict(), "optimizer": optimizer.state_dict()}
        small.keep({**parts, "step": step, "spent": spent, "losses": losses}, state_file)

    policy.train()
    order = torch.randperm(len(sentences), generator=random)
    at, clock = 0, time.monotonic()
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                  TextColumn("{task.fields[note]}")) as bar:
        row = bar.add_task("training", total=a.steps, completed=step, note="")
        while True:
            progress = max(step / a.steps, spent / (60 * a.minutes))
            if progress >= 1:
                break
            if at + a.batch > len(order):
                order, at = torch.randperm(len(sentences), generator=random), 0
            pick, at = order[at : at + a.batch], at + a.batch
            batch = before({
                CAMERA_KEY: small.light(data["frame"][pick].float() / 255, random), "observation.state": data["state"][pick],
                "action": data["action"][pick], "action_is_pad": data["pad"][pick], "task": [sentences[i] for i in pick]})
            for group in optimizer.param_groups:
                group["lr"] = a.rate * rate(progress, step)
            loss, _ = policy.forward(dict(batch))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(trained, 1.0)
            optimizer.step()
            now = time.monotonic()
            spent, clock, step = spent + now - clock, now, step + 1
            losses.append(loss.item())
            mean = sum(losses[-100:]) / len(losses[-100:])
            left = (1 - max(step / a.steps, spent / (60 * a.minutes))) * spent / max(step / a.steps, spent / (60 * a.minutes))
            bar.update(row, completed=step, note=f"loss {mean:.3f}, {spent / step:.2f} s a step, {left / 60:.0f} min left")
            if step % 100 == 0:
                print(f"step {step}: loss {mean:.4f}, {spent / 60:.1f} min, rate {group['lr']:.2e}", flush=True)
            if step % 250 == 0:
                keep()
    keep()
    small.save(policy, before, after, a.out)
    describe(a.out)
    curve = [sum(losses[i : i + 100]) / len(losses[i : i + 100]) for i in range(0, len(losses), 100)]
    summary = {"steps": step, "minutes": round(spent / 60, 2), "batch": a.batch, "frames": len(sentences), "parameters": size,
               "loss_per_100_steps": [round(x, 4) for x in curve]}
    (a.out / "training.json").write_text(json.dumps(summary, indent=1) + "\n")

    loaded, before, after = reference.load(a.out)  # what is on disk must be usable and hold the same numbers
    for (name, one), other in zip(policy.named_parameters(), loaded.parameters()):
        assert torch.equal(one, other), f"{name} changed on its way through {a.out}"
    frame, state = data["frame"][0].permute(1, 2, 0).contiguous().numpy(), data["state"][0].numpy()
    noise = torch.randn(HORIZON, 8, generator=random).numpy()
    chunk = reference.predict(loaded, before, after, {CAMERA: frame}, {"observation.state": state}, sentences[0], noise)
    print(f"{a.out}: {step} steps in {spent / 60:.1f} min, loss {curve[-1]:.3f}; '{sentences[0]}' -> {chunk[0].round(3).tolist()}, "
          f"the expert: {data['action'][0, 0].numpy().round(3).tolist()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
