# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The checkpoint that a bundle of a small SmolVLA was made from, for LeRobot to load; `checkpoint.py` of an example says which.

The bundle holds the statistics and all weights that an action depends on; tokenizer and configuration are the training's. What no action
depends on (the language head, half of the last language layer) is zeros. The checkpoint is converted again, and it ends with an error
unless every tensor and every key of the bundle comes out.
"""

import argparse
import contextlib
import io
import shutil
import tempfile
from pathlib import Path
from typing import Callable

import small_smolvla as small  # before torch and lerobot
import gguf
import numpy as np
import torch

from vla_cpp.convert import cli
from vla_cpp.convert.archs import Options, smolvla
from vla_cpp.convert.checkpoint import open_checkpoint
from vla_cpp.convert.errors import Problems

CONVERTED = "vla.source.", "GGUF.", "vla.checksum"  # keys that tell a file, not a policy


def read(bundle: Path) -> "tuple[dict, dict]":
    """Keys and tensors, float32."""
    reader = gguf.GGUFReader(str(bundle))
    keys = {name: field.contents() for name, field in reader.fields.items() if not name.startswith(CONVERTED)}
    return keys, {t.name: gguf.dequantize(t.data, t.tensor_type) for t in reader.tensors}


def fill(policy: "torch.nn.Module", tensors: "dict[str, np.ndarray]", folder: Path) -> None:
    """Puts the bundle's weights where the converter reads them in a checkpoint of the same sizes."""
    problems = Problems("checkpoint")
    plan = smolvla.plan(open_checkpoint(str(folder), {}), Options(), problems)
    state = {name: torch.zeros_like(value) for name, value in policy.state_dict().items()}
    for weight in plan.weights:
        state[weight.source] = torch.from_numpy(tensors[weight.target].reshape(weight.stored).copy())
    policy.load_state_dict(state, strict=True)


def main(description: str, save_backbone: Callable, make_policy: Callable, describe: Callable) -> int:
    """save_backbone(folder), make_policy(backbone, statistics) -> policy and processors, describe(folder): the training's own."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    args = parser.parse_args()
    keys, tensors = read(args.bundle)
    statistics = {
        name: {part: torch.from_numpy(tensors[f"stats.{name}.{part}"].copy()) for part in ("mean", "std")}
        for name in ("observation.state", "action")
    }
    args.out.mkdir(parents=True)
    save_backbone(args.out / "vlm")
    parts = make_policy(args.out / "vlm", statistics)
    small.save(*parts, args.out)
    describe(args.out)
    fill(parts[0], tensors, args.out)
    small.save(*parts, args.out)
    with tempfile.TemporaryDirectory() as scratch:
        again = Path(scratch) / "again.gguf"
        info = str(args.out / "meta/info.json")
        with contextlib.redirect_stdout(io.StringIO()):
            if cli.main([str(args.out), "-o", str(again), "--dtype", "bf16", "--dataset-info", info]):
                return 1
        keys_again, tensors_again = read(again)
    differ = [name for name in keys.keys() | keys_again.keys() if keys.get(name) != keys_again.get(name)]
    differ += [
        name
        for name in tensors.keys() | tensors_again.keys()
        if name not in tensors or name not in tensors_again or tensors[name].tobytes() != tensors_again[name].tobytes()
    ]
    if differ:
        shutil.rmtree(args.out)
        raise SystemExit(f"{args.bundle} is not of this training's policy; other in a bundle made anew: {', '.join(sorted(differ))}")
    print(f"{args.out}: converted again, all {len(keys)} keys and {len(tensors)} tensors of {args.bundle} come out")
    return 0
