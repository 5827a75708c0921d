# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the golden cases under tests/golden/smolvla: tiny checkpoints, observations, noise, and what the reference says.

    python scripts/golden_smolvla.py [NAME ...] [--out DIR]
    python scripts/golden_smolvla.py --bundles [NAME ...]       only convert the checkpoints again

Needs torch, lerobot and gguf (see vla_cpp.convert.golden); --bundles needs vla_cpp's [convert] extra alone.  The same
versions write the same bytes.
"""
import argparse
import json
import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "scripts")]
import random_smolvla  # noqa: E402
from random_smolvla import Description  # noqa: E402
from vla_cpp.convert import golden  # noqa: E402


@dataclass(frozen=True)
class Case:
    seed: int
    frames: dict  # view -> (height, width, suffix), or None: the view is absent
    text: str
    checkpoint: object  # the Description of random_smolvla, random_pi, random_evo1 or random_gr00t_n1_7
    state: tuple = ()  # instead of a random one
    options: dict = field(default_factory=dict)  # what the checkpoint does not say: kept as convert.json beside it


def vision(d, layers, heads, ff, image, patch, eps=1e-6):
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "intermediate_size": ff,
            "image_size": image, "patch_size": patch, "layer_norm_eps": eps}


def text(d, layers, heads, kv, d_head, ff, eps=1e-5):
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "num_key_value_heads": kv,
            "head_dim": d_head, "intermediate_size": ff, "rms_norm_eps": eps}


def policy(horizon, steps, size, width, **more):
    """size: (width, height) of the pictures that the network sees; width: of the expert, relative to the backbone."""
    return {"chunk_size": horizon, "n_action_steps": horizon, "num_steps": steps, "resize_imgs_with_padding": size,
            "expert_width_multiplier": width, **more}


CASES = {
    # Two views, both shrunk; one language layer cut off; attention wider than the model (6 x 12 against 48).
    "two_views": Case(1, {"camera1": (40, 90, "png"), "camera2": (75, 52, "png")}, "open the middle drawer", Description(
        vision(36, 2, 3, 60, 32, 8), text(48, 4, 6, 2, 12, 56), 2,
        policy(5, 4, (32, 32), 0.75, num_vlm_layers=3, max_state_dim=8, max_action_dim=8, tokenizer_max_length=24,
               pad_language_to="max_length"), {"camera1": (40, 90), "camera2": (75, 52)})),
    # Three views of three aspects, one a JPEG file; an instruction beyond the bucket; self attention every third layer;
    # one key-value head; patch columns (3 * 7 * 7) that no vector width divides.
    "long_text": Case(2, {"top": (20, 27, "png"), "wrist": (53, 53, "jpg"), "side": (64, 37, "png")},
                      "put the black bowl on top of the stove, then close the bottom drawer of the cabinet", Description(
        vision(40, 3, 5, 56, 28, 7), text(40, 4, 5, 1, 8, 48), 2,
        policy(7, 3, (28, 28), 0.6, num_vlm_layers=4, self_attn_every_n_layers=3, max_state_dim=16, max_action_dim=16,
               tokenizer_max_length=12, pad_language_to="longest"),
        {"top": (20, 27), "wrist": (53, 53), "side": (64, 37)}, d_state=14, d_action=14)),
    # The second of three views is absent, and so is the one that empty_cameras adds; order of features is not alphabetical; ranges and quantiles instead of means;
    # a prefix padded at its end; an expert as wide as the backbone; other periods of the time embedding.
    "absent_view": Case(3, {"wrist": (31, 60, "png"), "front": None, "base": (45, 45, "png"), "empty_camera_0": None},
                        "push the plate", Description(
        vision(32, 1, 2, 64, 32, 8), text(32, 3, 4, 2, 8, 48, 1e-6), 2,
        policy(9, 6, (32, 32), 1.0, num_vlm_layers=2, empty_cameras=1, prefix_length=60, max_state_dim=4,
               max_action_dim=4, tokenizer_max_length=16, pad_language_to="max_length", min_period=2e-3, max_period=8.0,
               normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MIN_MAX", "ACTION": "QUANTILES"}),
        {"wrist": (31, 60), "front": (31, 60), "base": (45, 45)}, d_state=3, d_action=4,
        rename={"observation.images.left": "observation.images.base"})),
    # Half as many expert layers as language layers, three query heads per key-value head; a 4 x 4 grid of patches read
    # from a 6 x 6 table of positions.
    "sparse_expert": Case(4, {"camera": (44, 26, "png")}, "close drawer 42!", Description(
        vision(30, 2, 5, 60, 48, 8, 1e-5), text(36, 4, 9, 3, 4, 72), 2,
        policy(6, 5, (32, 32), 0.5, num_vlm_layers=4, num_expert_layers=2, self_attn_every_n_layers=4, max_state_dim=10,
               max_action_dim=6, tokenizer_max_length=20, pad_language_to="max_length"), {"camera": (44, 26)}, d_state=10,
        d_action=6)),
    # One view that needs no resizing, a 6 x 6 grid, pixel shuffle by 3, ten steps; a state number that never moved in the
    # data; an instruction that already ends its line and is not plain English.
    "one_view": Case(5, {"camera1": (48, 48, "png")}, "Öffne die Schublade 12, bitte: 开抽屉\n", Description(
        vision(36, 2, 4, 44, 48, 8), text(48, 3, 3, 3, 16, 36), 3,
        policy(8, 10, (48, 48), 0.5, num_vlm_layers=3, max_state_dim=8, max_action_dim=8, tokenizer_max_length=64,
               pad_language_to="max_length"), {"camera1": (48, 48)}, d_state=5, d_action=3, zero_spread=(2,))),
}


def smooth_frame(height, width, generator):
    """A picture of coarse colours with a little grain: resizing matters and is not noise.  (height, width, 3) uint8."""
    import torch

    coarse = torch.rand(1, 3, 7, 9, generator=generator)
    image = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bicubic", align_corners=False)[0]
    image = image.clamp(0, 1) + 0.05 * torch.rand(3, height, width, generator=generator)
    return (image.clamp(0, 1).permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()


def write_observation(case, folder):
    """Frames, observation.json, noise.npy and convert.json of a case."""
    import torch
    from PIL import Image

    generator, images = torch.Generator().manual_seed(case.seed + 99), {}
    for view, frame in case.frames.items():
        images[view] = frame and f"{view}.{frame[2]}"
        if frame:
            picture = Image.fromarray(smooth_frame(frame[0], frame[1], generator))
            picture.save(folder / images[view], **({"quality": 92} if frame[2] == "jpg" else {"optimize": True}))
    d = case.checkpoint
    state = torch.randn(d.d_state, generator=generator) * 0.4
    for i in d.zero_spread:  # what never moved in the data does not move here; otherwise eps would rule the chunk
        state[i] = random_smolvla.statistics(d, case.seed)["observation.state"]["mean"][i]
    state = torch.tensor(case.state) if case.state else state
    state = state.tolist()
    if hasattr(d, "states"):  # feature -> width
        numbers = iter(state)
        state = {name: [next(numbers) for _ in range(n)] for name, n in d.states.items()}
    observation = {"images": images, "state": state, "text": case.text}
    (folder / "observation.json").write_text(json.dumps(observation, indent=1, ensure_ascii=False) + "\n")
    shape = d.policy["chunk_size"], d.policy["max_action_dim"]
    if getattr(d, "noise", "normal") == "uniform":  # multiples of 2^-20: they survive what a reference makes of a draw
        noise = torch.randint(-(2**20), 2**20, shape, generator=generator) / 2**20
    else:
        noise = torch.randn(shape, generator=generator)
    np.save(folder / "noise.npy", noise.numpy())
    if case.options:
        (folder / "convert.json").write_text(json.dumps(case.options) + "\n")


def conversion_options(folder):
    """The options of vla-convert that a case's convert.json names."""
    file = folder / "convert.json"
    for name, value in (json.loads(file.read_text()) if file.is_file() else {}).items():
        yield "--" + name.replace("_", "-")
        yield ",".join(value) if isinstance(value, list) else str(value)


def write_bundle(folder):
    """bundle.gguf as vla-convert makes it, in bfloat16: every stored value has one, so no number changes."""
    from vla_cpp.convert import cli

    checkpoint = folder / "checkpoint"
    code = cli.main([str(checkpoint), "--backbone", str(golden.backbone_folder(checkpoint)), "-o", str(folder / "bundle.gguf"),
                     "--dtype", "bf16", "--force", "--quiet", *conversion_options(folder)])
    if code:
        raise SystemExit(code)


def write_case(name, case, folder, write_checkpoint):
    n = write_checkpoint(case.checkpoint, case.seed, folder / "checkpoint")
    write_observation(case, folder)
    taps = golden.write_expected(folder, case.seed)
    largest = np.abs(taps["chunk"]).max()
    print(f"{name}: {n:,} parameters, {len(taps)} taps, chunk up to {largest:.2f}, published dtypes "
          f"{np.abs(taps['chunk.bf16'] - taps['chunk']).max() / largest:.1e} away")


def main(doc, cases, write_checkpoint, out):
    """The command line of the scripts that write golden cases."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="*", choices=[[], *cases])
    parser.add_argument("--out", type=Path, default=ROOT / out)
    parser.add_argument("--bundles", action="store_true", help="only convert the checkpoints that are there")
    args = parser.parse_args()
    if not args.bundles:
        golden.open_reference()
        warnings.filterwarnings("ignore")
    for name in args.name or cases:
        if not args.bundles:
            write_case(name, cases[name], args.out / name, write_checkpoint)
        write_bundle(args.out / name)


if __name__ == "__main__":
    main(__doc__, CASES, random_smolvla.write_checkpoint, "tests/golden/smolvla")
