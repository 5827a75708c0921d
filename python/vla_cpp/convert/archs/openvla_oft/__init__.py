# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""OpenVLA-OFT: OpenVLA's towers and Llama 2 with several cameras and a state, which compute a whole chunk in one pass or in diffusion steps.

A checkpoint is a folder of OpenVLA with merged weights, and beside them a torch.save file of the action head and, if the policy has them, of
the projectors of state and noisy actions and of towers with FiLM. A robot is a set of constants in the authors' code, chosen by a word in the
command line of a training run; the numbers of cameras and diffusion steps are arguments of their evaluation. No file states any of these.

Reference: moojink/openvla-oft (prismatic/extern/hf/modeling_prismatic.py, prismatic/vla/constants.py, experiments/robot/openvla_utils.py,
experiments/robot/libero/run_libero_eval.py, experiments/robot/aloha/aloha_utils.py).
"""

from __future__ import annotations

import re
from typing import Dict, List, NamedTuple, Tuple

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint, Layout, Tensors, read_stored
from ...errors import Code, Problems
from ...features import robot_keys, view_name, views_of
from ...options import Option, stats, views
from ...tokenizer import read_tokenizer
from .. import Options, Plan, oft
from ..openvla import LAYOUT as OPENVLA
from ..openvla import MAX_TOKENS, check_prompt, chosen_statistics, read_pixels, text_ops
from .mapping import DIFFUSION, NOISY, Sizes, dropped, head_of, network_keys, put_film, read_sizes, weights

PARTS = ("action_head",)
OPTIONAL_PARTS = ("proprio_projector", "noisy_action_projector", "vision_backbone")


class Norm(NamedTuple):
    """A normalization to [-1, 1]: the recipe's kind, and the statistics that it reads."""

    kind: str
    names: Tuple[str, str]


NORMS = {"bounds_q99": Norm("openpi_quantiles", ("q01", "q99")), "bounds": Norm("openvla_bounds", ("min", "max"))}


class Platform(NamedTuple):
    horizon: int
    norm: str
    d_action: int = 0  # 0: the checkpoint's width
    d_state: int = 0


PLATFORMS = {
    "libero": Platform(8, "bounds_q99", 7, 8),
    "aloha": Platform(25, "bounds", 14, 14),
    "bridge": Platform(5, "bounds_q99", 7, 7),
}
OTHER = r"(\d{1,4}),(bounds_q99|bounds)"  # rows of a chunk and normalization: the values of constants.py that no file states
MAX_ROWS = 4096  # rows of a chunk
ALOHA_SIDE = 256  # ALOHA's client first resizes frames to squares of this side
VIEWS = {
    "libero": dict(zip(oft.VIEWS, oft.ALIASES)),
    "aloha": {"cam_high": "full_image", "cam_left_wrist": "left_wrist_image", "cam_right_wrist": "right_wrist_image"},
}
FILE = "action_head--STEP_checkpoint.pt"


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    s = read_sizes(checkpoint, problems)
    platform = _platform(options.platform, s, problems)
    _read_steps(checkpoint, options.diffusion_steps, s, problems)
    entry, where = chosen_statistics(checkpoint, options.stats)
    norm = NORMS[platform.norm]
    statistics, mask = oft.ranges(entry, where, {recipe.STATE: s.d_state, recipe.ACTION: s.d_action}, norm.names, problems)
    pixels = read_pixels(checkpoint, s.dino.image_size, problems)
    tokenizer = read_tokenizer(checkpoint.folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()
    empty = check_prompt(checkpoint, tokenizer, s, problems)
    shown = _views(list(options.views), options.platform, problems)
    widths = {**({recipe.STATE: s.d_state} if s.d_state else {}), recipe.ACTION: s.d_action}
    document = {
        "image": _image_ops(s.dino.image_size, options),
        "text": text_ops(),
        "state": oft.state_ops(norm.kind, s.d_state) if s.d_state else [],
        "action": oft.action_ops(norm.kind, mask, options.platform == "libero"),
    }
    keys = [
        *network_keys(s),
        *robot_keys(shown, widths, options.dataset_info, checkpoint.notes, problems, MAX_TOKENS),
        *tokenizer.keys,
        Key("tokenizer.suffix_ids", "u32[]", [empty]),
        recipe.recipe_key(document),
    ]
    problems.raise_any()
    return Plan(keys, weights(s, pixels), dropped(s), statistics)


def _image_ops(side: int, options: Options) -> List[dict]:
    """The image ops. The crop of the whole image is there so that a second resize may follow."""
    square = {"op": "resize", "width": ALOHA_SIDE, "height": ALOHA_SIDE, "filter": "pillow_bicubic"}
    client = [{"op": "crop_fraction", "fraction": 1.0}, square] if options.platform == "aloha" else []
    return [*client, *oft.image_ops(side, options.plain_images)]


def _platform(name: str, s: Sizes, problems: Problems) -> Platform:
    """The constants of prismatic/vla/constants.py for a robot."""
    found, own = PLATFORMS.get(name), re.fullmatch(OTHER, name)
    if found is None and own and 0 < int(own[1]) <= MAX_ROWS:
        found = Platform(int(own[1]), own[2])
    if found is None:
        expected = ", ".join(PLATFORMS) + ", or rows of a chunk and a normalization, as in 10,bounds_q99 or 10,bounds"
        hint = "--platform NAME, the constants of prismatic/vla/constants.py that the policy was trained with: no file states them"
        problems.add("--platform", expected, name or "none", hint, Code.USAGE)
        return PLATFORMS["libero"]
    for part, width, wanted in (("action", s.d_action, found.d_action), ("state", s.d_state, found.d_state)):
        if wanted and width and width != wanted:
            problems.add("--platform " + name, "{} numbers of a{} {}".format(width, "n" * (part[0] == "a"), part), str(wanted))
    s.horizon = found.horizon
    return found


def _read_steps(checkpoint: Checkpoint, stated: str, s: Sizes, problems: Problems) -> None:
    """Reads the numbers of steps of a diffusion head."""
    noisy = any(name.startswith(NOISY) for name in checkpoint.tensors)
    if head_of(checkpoint) != DIFFUSION:
        if noisy:
            problems.add(FILE, "a head that takes noise away, as noisy_action_projector has it", "one of L1 regression")
        if stated:
            problems.add("--diffusion-steps", "a diffusion head", "one of L1 regression", "leave the option out", Code.USAGE)
        return
    if not noisy:
        problems.add("noisy_action_projector--STEP_checkpoint.pt", "one such file, since the head takes noise away", "none")
    found = re.fullmatch(r"(\d{1,4}),(\d{1,4})", stated)
    train, run = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 0 < run <= train <= 1000:
        expected = "TRAIN,INFERENCE with at most 1000 steps of training and as many of inference"
        hint = "num_diffusion_steps_train and num_diffusion_steps_inference, which no file states; the authors' are 50,50"
        problems.add("--diffusion-steps", expected, stated or "none", hint, Code.USAGE)
    s.n_train_step, s.n_step = max(train, 1), max(run, 1)


def _views(names: List[str], platform: str, problems: Problems) -> List[Key]:
    """Keys of the views: all are required, in the order of the training."""
    known: Dict[str, str] = VIEWS.get(platform, {})
    if not names:
        hint = "--views {}: as many as num_images_in_input, which no file states".format(",".join(known) or "A,B")
        problems.add("--views", "names of the cameras, the first one the scene's and then those of wrists", "none", hint, Code.USAGE)
        return []
    return views_of([view_name(name) for name in names], [view_name(known[name]) if name in known else "" for name in names], [0] * len(names), len(names))


def _read_tensors(folder: str, problems: Problems) -> Tensors:
    tensors = read_stored(folder, problems)
    oft.read_parts(folder, tensors, PARTS, OPTIONAL_PARTS, problems)
    put_film(tensors, problems)
    return tensors


LAYOUT = Layout(
    "OpenVLA-OFT's authors",
    (
        stats("the data set whose statistics normalize states and actions (their unnorm_key), where there are several"),
        views("names of the cameras, as many as the policy was trained with: image,image2 of LIBERO, cam_high,cam_left_wrist,cam_right_wrist of ALOHA"),
        Option(
            "--platform",
            "the robot whose constants the policy was trained with (prismatic/vla/constants.py): libero, aloha or bridge, or rows of a chunk and"
            " bounds or bounds_q99, as in 10,bounds",
            "NAME",
        ),
        Option("--diffusion-steps", "of a diffusion head: steps of training and of inference, as in 50,50", "TRAIN,INFERENCE"),
        oft.PLAIN_IMAGES,
    ),
    model_types=OPENVLA.model_types,
    keys=OPENVLA.keys,
    files=tuple("{}--*_checkpoint.pt".format(part) for part in (*PARTS, *OPTIONAL_PARTS)),
    read=_read_tensors,
)
