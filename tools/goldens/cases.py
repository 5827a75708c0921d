# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A golden case: a checkpoint that a seed describes, an observation, the solver's noise."""

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .draw import Generator, f32
from .files import write_json
from .parameters import statistics

ROOT = Path(__file__).resolve().parents[2]
RECORDED = ROOT / "tests/golden"  # what is kept: observations, noise and the reference's taps
# An observation of LIBERO, for cases of the published size.
LIBERO_FRAMES = {view: (256, 256, "png") for view in ("image", "wrist_image")}
LIBERO_INSTRUCTION = "pick up the black bowl between the plate and the ramekin and place it on the plate"
# Of random configurations: what a feature is normalized by, instructions.
MODES = ("MEAN_STD", "MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10", "IDENTITY")
TEXTS = ("a", "pick up the red cube\n", "  two  spaces ", "don't 12345 stop!", "naïve café 漢字 🙂 ok", "word " * 40, "\n\n",
         "<image> <|im_end|> hi", "tab\tand\r\nline")


@dataclass(frozen=True)
class Case:
    seed: int
    frames: dict  # view -> (height, width, suffix), or None: the view is absent
    text: str
    checkpoint: object  # the Checkpoint of a family
    state: tuple = ()  # instead of a random one
    options: dict = field(default_factory=dict)  # of vla-convert, for what the checkpoint does not say


def copy_tokenizer(family, folder):
    """The family's tokenizer files: a small vocabulary in the published form, trained on robot sentences."""
    shutil.copytree(RECORDED / "tokenizers" / family, folder, dirs_exist_ok=True, copy_function=shutil.copyfile)


def smooth_frame(height, width, generator):
    """Coarse colours with a little grain: resizing matters and is not noise.  (height, width, 3) uint8."""
    from PIL import Image

    coarse = Image.fromarray((generator.uniform(7, 9, 3) * 255).astype(np.uint8))
    smooth = np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC), f32) / 255
    return np.rint(np.clip(smooth + 0.05 * generator.uniform(height, width, 3), 0, 1) * 255).astype(np.uint8)


def write_observation(case, folder):
    """Frames, observation.json and noise.npy of a new case."""
    from PIL import Image

    generator, images, checkpoint = Generator(case.seed + 99), {}, case.checkpoint
    folder.mkdir(parents=True, exist_ok=True)
    for view, frame in case.frames.items():
        images[view] = frame and f"{view}.{frame[2]}"
        if frame:
            image = Image.fromarray(smooth_frame(frame[0], frame[1], generator))
            image.save(folder / images[view], **({"quality": 92} if frame[2] == "jpg" else {"optimize": True}))
    widths = getattr(checkpoint, "states", None if checkpoint.d_state else {})  # feature -> width; None: all are of one feature
    state = generator.normal(checkpoint.d_state if widths is None else sum(widths.values())) * f32(0.4)
    for i in checkpoint.zero_spread:  # what never moved in the data does not move here; otherwise eps would rule the chunk
        state[i] = statistics(checkpoint.d_state, checkpoint.d_action, case.seed)["observation.state"]["mean"][i]
    state = list(case.state) or state.tolist()
    if widths is not None:
        numbers = iter(state)
        state = {name: [next(numbers) for _ in range(n)] for name, n in widths.items()}
    observation = {"images": images, "state": state, "text": case.text}
    (folder / "observation.json").write_text(json.dumps(observation, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    shape = getattr(checkpoint, "noise_shape", None) or (checkpoint.policy["chunk_size"], checkpoint.policy.get("max_action_dim", checkpoint.d_action))
    if getattr(checkpoint, "noise", "normal") == "uniform":  # multiples of 2^-20: they survive what a reference makes of a draw
        noise = np.rint((2 * generator.uniform(*shape) - 1) * 2**20) / f32(2**20)
    else:
        noise = generator.normal(*shape)
    np.save(folder / "noise.npy", noise.astype(f32))


def conversion_options(folder):
    """The options of vla-convert that a case's convert.json names."""
    file = folder / "convert.json"
    return arguments(json.loads(file.read_text()) if file.is_file() else {}, folder)


def arguments(said, folder):
    """Options of vla-convert by their names. `folder`: the case's, in which a base lies."""
    for name, value in said.items():
        yield "--" + name.replace("_", "-")
        if value is not True:  # a flag
            yield ",".join(value) if isinstance(value, list) else str(folder / value if name == "base" else value)


def backbone_folder(checkpoint):
    """What the hub keeps in another repository: the backbone of SmolVLA, the tokenizer of pi0; None where everything is in one."""
    return next((p for p in (Path(checkpoint) / "vlm", Path(checkpoint) / "tokenizer") if p.is_dir()), None)


def write_bundle(folder, out=None, dtype="bf16"):
    """The bundle as vla-convert makes it.  bfloat16 changes nothing: every stored value has one."""
    from vla_cpp.convert import cli

    checkpoint = folder / "checkpoint"
    backbone = backbone_folder(checkpoint)
    code = cli.main([str(checkpoint), *(["--backbone", str(backbone)] if backbone else []), "-o", str(out or folder / "bundle.gguf"),
                     "--dtype", dtype, "--force", "--quiet", "--vla", "none", *conversion_options(folder)])
    if code:
        raise SystemExit(code)


def write_checkpoint(case, folder):
    """checkpoint/ and convert.json.  Returns the parameter count."""
    folder.mkdir(parents=True, exist_ok=True)
    if case.options:
        write_json(folder / "convert.json", case.options)
    return case.checkpoint.write(case.seed, folder / "checkpoint")


def draw_views(r, n_empty):
    """({view: declared size}, {view: frame or None}) with at most as many absent as the reference fills in."""
    frames = {f"cam{i}": (r.randint(12, 90), r.randint(12, 90), r.choice(("png", "png", "jpg"))) for i in range(r.randint(1, 3))}
    views = {view: frame[:2] for view, frame in frames.items()}
    if n_empty and len(frames) > 1 and r.random() < 0.7:
        frames[r.choice(list(frames))] = None
    return views, frames | {f"empty_camera_{i}": None for i in range(n_empty)}
