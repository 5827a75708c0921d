# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The reference of a case in PyTorch on a GPU: one JSON object with the milliseconds of each inference.  Run by scripts/measure_gpu.sh.

    python tools/peers/gpu.py --case DIR --mode eager|compiled|graphs [--rounds 20] [--device cuda]

DIR is what tools/parity_full.py --only write leaves: checkpoint/, frames, an observation, noise.npy.  compiled is torch.compile as it
comes, graphs the same with CUDA graphs (mode reduce-overhead).  The processor's work is not part of an inference here, but of BitVLA's,
whose reference has no door behind it.
"""
import argparse
import json
import time
import warnings
from pathlib import Path

from peer import ROOT  # noqa: F401  which makes the goldens importable

MODES = {"eager": None, "compiled": "default", "graphs": "reduce-overhead"}


def to_device(value, device):
    """A batch of tensors, or of dictionaries and lists of them."""
    if isinstance(value, dict):
        return {key: to_device(part, device) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(to_device(part, device) for part in value)
    return value.to(device) if hasattr(value, "to") else value


def move(policy, device):
    """LeRobot's policies are modules. References of authors hold some, and make tensors where torch does by default."""
    import torch

    modules = [policy] if isinstance(policy, torch.nn.Module) else [part for part in vars(policy).values() if isinstance(part, torch.nn.Module)]
    for module in modules:
        module.to(device)
    if modules != [policy]:
        torch.set_default_device(device)
        torch.inference_mode = lambda *_: torch.no_grad()  # they ask for it inside of what is compiled, where torch has none


def main():
    import numpy as np
    import torch
    from goldens import recorder

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, required=True)
    parser.add_argument("--mode", choices=MODES, required=True)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--dtype", default="published", choices=("float32", "published"))
    args = parser.parse_args()
    recorder.open_reference()
    warnings.filterwarnings("ignore")
    policy, before, _ = recorder.load(args.case / "checkpoint", args.dtype)
    batch = to_device(dict(before(recorder.read_observation(args.case))), args.device)
    noise = torch.from_numpy(np.load(args.case / "noise.npy"))[None].to(args.device)
    move(policy, args.device)
    act = getattr(policy, "predict_action_chunk", None) or (lambda batch, noise: policy.run(batch))
    if MODES[args.mode]:
        act = torch.compile(act, mode=MODES[args.mode])
    wait = torch.cuda.synchronize if args.device.startswith("cuda") else lambda: None
    times = []
    with torch.inference_mode():
        for _ in range(args.rounds + 3):
            wait()
            start = time.perf_counter()
            act(dict(batch), noise=noise.clone())
            wait()
            times.append(1e3 * (time.perf_counter() - start))
    print(json.dumps({"name": f"PyTorch {torch.__version__} {args.mode}", "ms": times[3:]}))


if __name__ == "__main__":
    main()
