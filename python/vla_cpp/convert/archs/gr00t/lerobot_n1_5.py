# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.5 in the layout of LeRobot up to 0.5.1: robot, images and instruction as its pipelines state them.

Reference: lerobot policies/groot/processor_groot.py of 0.4.0 to 0.5.1, which differ only in names of constants, and policies/factory.py,
which normalizes even if the steps say otherwise.
"""

from __future__ import annotations

import os
from typing import Dict, List

from ... import chat_template
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...files import read_json
from ...section import Fixed, Section
from .. import Options
from . import lerobot_files as files
from .eagle import EAGLE_2_5, FILE, IMAGE, IMAGE_FIXED
from .images import STANDARDIZE, Images
from .lerobot_files import BATCH, CONFIG, DEVICE, RENAME, Step, Vectors
from .prompt import LEROBOT_EMPTY
from .sizes import Sizes

ARCH = "gr00t_n1_5"
PACK, ENCODE, COLLATE, UNPACK = "groot_pack_inputs_v3", "groot_eagle_encode_v3", "groot_eagle_collate_v3", "groot_action_unpack_unnormalize_v1"
BEFORE, AFTER = [RENAME, BATCH, PACK, ENCODE, COLLATE, DEVICE], [UNPACK, DEVICE]
PACK_FIXED: Fixed = {"state_horizon": (1, 1), "language_key": ("task", "task"), "normalize_min_max": (True, True), "formalize_language": (False, False)}
# Only masks in training use max_action_dim and action_horizon.
PACK_READ = {"max_state_dim", "max_action_dim", "action_horizon", "embodiment_tag", "embodiment_mapping"}
UNPACK_FIXED: Fixed = {"normalize_min_max": (True, True)}
# Settings of Eagle25VLProcessor and its image processor. LeRobot requests one tile, so settings of tiles and thumbnails have no effect.
TILE_FIXED: Fixed = {**IMAGE_FIXED, "crop_size": (None, None), "do_center_crop": (None, None), "pad_during_tiling": (False, False), "resample": (3, 3)}
TOKENS_FIXED: Fixed = {"image_token": (IMAGE, IMAGE), "image_start_token": ("<img>", "<img>"), "image_end_token": ("</img>", "</img>"),
                       "image_placeholder": ("image", "image"), "video_placeholder": ("video", "video")}  # fmt: skip
PROCESSOR = "processor_config.json"
PLACES = ("<image-", "<video-")  # Eagle's processor replaces these anywhere in a text


def is_n1_5(checkpoint: Checkpoint) -> bool:
    if checkpoint.processors is None:
        return "n1.5" in str(checkpoint.config.get("base_model_path")).lower()
    return any(name.startswith("groot_pack_inputs") for name in files.names_of(checkpoint, 0))


def as_published(checkpoint: Checkpoint, options: Options) -> Options:
    """Changes LeRobot's checkpoint to the authors' layout, with one vector each for states and actions. Returns the options with its robot."""
    problems, own = Problems(checkpoint.name), checkpoint.config
    instead = "LeRobot's files state it"
    files.refuse_options(options, dict.fromkeys(("variant", "camera_size", "letterbox", "gripper_sign"), instead))
    steps = files.read_steps(checkpoint, BEFORE, [AFTER], problems)
    pack, unpack = files.section(steps[PACK], problems), files.section(steps[UNPACK], problems)
    policy = Section(CONFIG, own, {"chunk_size": 50, "n_action_steps": 50, "max_state_dim": 64, "max_action_dim": 32}, problems)
    _check(policy, steps, pack, unpack, problems)
    state = files.state_group(checkpoint, own, steps[PACK], False, problems)
    width = files.action_width(own, unpack)
    action = files.action_group(checkpoint, steps[UNPACK], width, False, problems)
    if width > policy.count("max_action_dim"):
        policy.bad("max_action_dim", "at least the {} numbers of an action".format(width))
    views, index = files.cameras(own, checkpoint.notes, problems), files.robot_index(pack)
    base = files.base_config(checkpoint)
    _check_base(base, pack, state.width, problems)
    problems.raise_any()
    checkpoint.vectors = Vectors(own, views, state, action, index, base["action_horizon"])
    files.take_over(checkpoint, ARCH, base)
    _tell_queue(own, base["action_horizon"], checkpoint.notes)
    return files.check_robot(options, str(pack.get("embodiment_tag")))


def _check(policy: Section, steps: Dict[str, Step], pack: Section, unpack: Section, problems: Problems) -> None:
    policy.refuse_unknown({*files.CONFIG_FIXED, *files.CONFIG_IGNORED})
    policy.check_fixed(files.CONFIG_FIXED)
    if policy.count("n_action_steps") > policy.count("chunk_size"):
        policy.bad("n_action_steps", "at most chunk_size", hint="LeRobot refuses it too")
    pack.refuse_unknown({*PACK_FIXED, *PACK_READ})
    pack.check_fixed(PACK_FIXED)
    unpack.refuse_unknown({*UNPACK_FIXED, "env_action_dim"})
    unpack.check_fixed(UNPACK_FIXED)
    repos = [section.get("tokenizer_assets_repo") for section in (files.section(steps[name], problems) for name in (ENCODE, COLLATE))]
    for name in (ENCODE, COLLATE):
        files.section(steps[name], problems).refuse_unknown({"tokenizer_assets_repo"})
    if repos[0] != repos[1]:
        problems.add(steps[COLLATE].where + ": tokenizer_assets_repo", "{} as of {}".format(repos[0], ENCODE), str(repos[1]))


def _check_base(base: dict, pack: Section, width: int, problems: Problems) -> None:
    """Checks that the base's config agrees with its action_head_cfg, since LeRobot compares the network's output with the former."""
    head = base.get("action_head_cfg")
    for key in ("action_horizon", "action_dim"):
        if type(base.get(key)) is not int or not isinstance(head, dict) or base[key] != head.get(key):
            problems.add("base config.json: " + key, "a number, as in action_head_cfg", str(base.get(key)))
    limit = pack.count("max_state_dim")
    if isinstance(head, dict) and head.get("max_state_dim") != limit:
        pack.bad("max_state_dim", "{} as in action_head_cfg of the base".format(head.get("max_state_dim")))
    if width > limit:
        pack.bad("max_state_dim", "at least the {} numbers of the statistics".format(width))


def _tell_queue(config: dict, n_row: int, notes: List[str]) -> None:
    steps = config.get("n_action_steps")
    if type(steps) is int and steps < n_row:
        text = "n_action_steps: LeRobot's select_action executes the last {} of the {} rows of a chunk, since its queue drops the first ones; a client of this bundle the first"
        notes.append(text.format(steps, n_row))


def text_ops() -> List[dict]:
    """The text ops. The authors pass the instruction as a list with one member, and the template prints this list."""
    return [*({"op": "refuse", "text": place} for place in PLACES), LEROBOT_EMPTY, {"op": "python_list"}]


def read_images(folder: str, s: Sizes, problems: Problems) -> Images:
    """The image ops of Eagle's processor: one tile of the tower's size, for frames of any aspect ratio. `folder`: the backbone's."""
    tile, tokens = (Section("backbone " + name, read_json(os.path.join(folder, name)), {}, problems) for name in (FILE, PROCESSOR))
    tile.check_fixed(TILE_FIXED, EAGLE_2_5.folder)
    side = s.image_width
    if tile.get("size") != {"height": side, "width": side}:
        tile.bad("size", "height and width {}, image_size of the tower".format(side), unsupported=True)
    tokens.check_fixed({**TOKENS_FIXED, "tokens_per_tile": (256, s.n_view_token)}, EAGLE_2_5.folder)
    _check_template(folder, problems)
    return Images(side, side, [{"op": "resize", "width": side, "height": side, "filter": "torch_bicubic_16bit"}, STANDARDIZE])


def _check_template(folder: str, problems: Problems) -> None:
    """Checks that the chat template renders a user turn to the bundle's prompt."""
    where, template = chat_template.find(folder)
    before, after = EAGLE_2_5.TEMPLATE.before, EAGLE_2_5.TEMPLATE.after
    for n_view, text in ((1, "['go']"), (3, "[\" Pick {{ x }} up,\\n the robot's <|im_end|> \"]")) if template is not None else ():
        wanted = before + "".join("<image-{}>".format(i + 1) for i in range(n_view)) + text + after
        found = chat_template.user_turn(template, where, n_view, text, True)
        if found != wanted:
            problems.unsupported(where, "Eagle's, which makes {!r} of a user's turn".format(wanted), repr(found)[:200])
            return
