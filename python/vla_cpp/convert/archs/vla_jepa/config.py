# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes and prompt of a VLA-JEPA policy from its config.json and that of its backbone. Refuses everything that the runtime does not support.

An absent key has the default of the reference's own class, listed here with the key. A checkpoint has the weights of
Qwen3-VL but neither its config nor its tokenizer; --backbone names the folder with both.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from typing import Dict, Sequence, Tuple

from ...checkpoint import Checkpoint, find_backbone
from ...errors import Problems
from ...files import read_json
from ...lerobot import action_width, check_keys, check_widths, no_position_rule, read_views, state_width
from ...networks import MAX_LAYERS
from ...recipe import STATE
from ...section import Section
from .. import Options
from ..gr00t import qwen3_vl, sizes
from ..gr00t.images import MAX_SIDE, held_size

# VLAJEPAConfig keys with effect on numbers, with the class's defaults.
POLICY = {
    "chunk_size": 7,
    "n_action_steps": 7,
    "qwen_model_name": "Qwen/Qwen3-VL-2B-Instruct",
    "freeze_qwen": False,
    "enable_world_model": True,
    "prompt_template": "Your task is {instruction}. Infer the temporal dynamics from frames {actions} and produce the corresponding "
    "policy actions {e_actions}.",
    "special_action_token": "<|action_{}|>",
    "embodied_action_token": "<|embodied_action|>",
    "action_dim": 7,
    "state_dim": 8,
    "num_action_tokens_per_timestep": 8,
    "num_embodied_action_tokens_per_instruction": 32,
    "num_inference_timesteps": 4,
    "action_hidden_size": 1024,
    "action_model_type": "DiT-B",
    "action_num_layers": 16,
    "action_num_heads": None,
    "action_attention_head_dim": None,
    "action_num_timestep_buckets": 1000,
    "num_video_frames": 8,
    "jepa_tubelet_size": 2,
    "resize_images_to": None,
    "use_relative_actions": False,
    "torch_dtype": "bfloat16",
}
# Keys without effect on the numbers of an action chunk, beside those of every LeRobot policy: keys of training, of the world model, and
# keys from which LeRobot built the saved pipelines, which are read instead.
IGNORED = set(
    """jepa_encoder_name reinit_modules tokenizer_padding_side action_dropout action_noise_beta_alpha action_noise_beta_beta
    action_noise_s num_target_vision_tokens action_max_seq_len predictor_depth predictor_num_heads predictor_mlp_ratio
    predictor_dropout world_model_loss_weight repeated_diffusion_steps binarize_gripper_action pre_snap_gripper_action
    clip_normalized_actions gripper_dim gripper_threshold optimizer_grad_clip_norm relative_exclude_joints action_feature_names
    gripper_joint_names""".split()
)
# Keys of later releases, with the only value that the runtime supports and the reason.
FIXED = {
    "causal_world_model_context": (False, "the prompt would have other moments"),
    "world_model_num_views": (None, "the world model would see other views"),
}
PRESETS = {"DiT-B": (12, 64), "DiT-L": (32, 48), "DiT-test": (2, 8)}  # number of heads and width of a head (action_head.py DIT_PRESETS)
PLACES = ("{instruction}", "{actions}", "{e_actions}")
FOLDER = "--backbone needs the folder of Qwen/Qwen3-VL-2B-Instruct, or of the model that qwen_model_name names"
ENCODER = "model.video_encoder.encoder.embeddings.patch_embeddings.proj.weight"
MAX_TEMPLATE = 1 << 12  # bytes, the runtime's limit
EMBEDDING = "model.qwen.model.model.language_model.embed_tokens.weight"
# Tokens that the backbone's processor replaces by images; no text may contain them.
PLACEHOLDERS = (qwen3_vl.IMAGE, "<|video_pad|>", "<|placeholder|>")


@dataclass
class Sizes(sizes.Sizes):
    views: Sequence[str] = ()
    frame: Tuple[int, int] = (0, 0)  # width and height that all frames must have, if the images' size is computed from them
    area: Tuple[int, int] = (0, 0)  # width and height to which frames are resized first, if the policy states it
    n_embodied: int = 0
    action_tokens: Sequence[str] = ()  # tokens that the policy adds to the tokenizer
    embodied_token: str = ""
    prompt: str = ""  # contains {instruction}
    folder: str = ""  # folder of the backbone
    in_bf16: bool = False  # the reference holds the backbone in bfloat16
    world_model: Dict[str, Tuple[int, ...]] = field(default_factory=dict)  # shapes of its tensors by name


def read_sizes(checkpoint: Checkpoint, options: Options, problems: Problems) -> Sizes:
    # The reference's class has no empty_cameras.
    policy = Section("config.json", checkpoint.config, {**POLICY, "empty_cameras": 0}, problems)
    no_position_rule(policy, options, problems)
    check_keys(policy, "VLAJEPAConfig", set(POLICY) | IGNORED, FIXED)
    check_widths(policy, {})
    s = Sizes()
    s.folder = find_backbone(checkpoint, options.backbone, policy.get("qwen_model_name"), "qwen_model_name")
    qwen3_vl.read(s.folder, MAX_LAYERS, s, problems, FOLDER)
    _check_tie(checkpoint, s.folder, problems)
    s.views, _ = read_views(policy, checkpoint)
    s.max_views = len(s.views)
    _read_images(policy, s, problems)
    _read_head(policy, checkpoint, options, s)
    _read_prompt(policy, checkpoint, s)
    dtype = policy.get("torch_dtype")
    if dtype not in ("bfloat16", "float32"):
        policy.bad("torch_dtype", "'bfloat16' or 'float32'", unsupported=True)
    s.in_bf16 = dtype == "bfloat16"
    return s


def _check_tie(checkpoint: Checkpoint, folder: str, problems: Problems) -> None:
    """Checks that the config ties embedding and language head if only the head is stored: otherwise the reference initializes the embedding
    randomly."""
    config = read_json(os.path.join(folder, "config.json"))
    tied = config.get("tie_word_embeddings")
    if EMBEDDING in checkpoint.aliases and EMBEDDING not in checkpoint.tensors and tied is not True:
        found = "nothing" if tied is None else str(tied)
        problems.add("backbone config.json: tie_word_embeddings", "true, since the checkpoint has no {}".format(EMBEDDING), found)


def _read_images(policy: Section, s: Sizes, problems: Problems) -> None:
    """Reads the size of the images. If the policy states none, the backbone's processor computes it from the size of the cameras' frames."""
    size, where = policy.get("resize_images_to"), "config.json: resize_images_to"
    if size is not None:
        if not isinstance(size, list) or len(size) != 2 or any(type(side) is not int or not 2 <= side <= MAX_SIDE for side in size):
            policy.bad("resize_images_to", "[height, width] or null")
            size = [s.vision.patch_size, s.vision.patch_size]
        s.area = width, height = size[1], size[0]
    else:
        frames = {_frame(policy, view) for view in s.views}
        if len(frames) > 1:
            found = ", ".join("{}x{}".format(*frame) for frame in sorted(frames))
            policy.bad("input_features", "cameras of one size, since resize_images_to is null", found, unsupported=True)
        s.frame = width, height = max(frames, default=(2, 2))
        where = "config.json: input_features"
    s.image_width, s.image_height = held_size(width, height, qwen3_vl.read_area(s.folder, s, problems), where, problems)


def _frame(policy: Section, view: str) -> Tuple[int, int]:
    shape = policy.get("input_features")[view].get("shape")
    sides = shape[1:] if isinstance(shape, list) else []
    if len(sides) != 2 or any(type(side) is not int or not 2 <= side <= MAX_SIDE for side in sides):
        policy.bad("input_features." + view, "the camera's shape, since resize_images_to is null", str(shape))
        return 2, 2
    return sides[1], sides[0]


def _read_head(policy: Section, checkpoint: Checkpoint, options: Options, s: Sizes) -> None:
    preset = policy.get("action_model_type")
    if preset not in PRESETS:
        policy.bad("action_model_type", " or ".join(PRESETS), unsupported=True)
    heads, width = PRESETS.get(str(preset), PRESETS["DiT-B"])
    # The reference treats 0 like an absent number.
    s.n_dit_head = policy.count("action_num_heads") if policy.get("action_num_heads") else heads
    s.d_dit = s.n_dit_head * (policy.count("action_attention_head_dim") if policy.get("action_attention_head_dim") else width)
    s.n_dit_layer, s.d_hidden = policy.count("action_num_layers", maximum=MAX_LAYERS), policy.count("action_hidden_size")
    s.d_out = s.d_hidden
    if s.d_dit % 2:
        policy.bad("action_num_heads", "heads of an even width together")
    s.d_action = action_width(policy, checkpoint, options)
    s.d_state = _read_state(policy, checkpoint, options)
    s.horizon, s.n_step = policy.count("chunk_size", maximum=4096), policy.count("num_inference_timesteps")
    s.n_bucket = policy.count("action_num_timestep_buckets")
    s.n_embodied = policy.count("num_embodied_action_tokens_per_instruction", maximum=4096)
    s.n_position = max(1024, s.horizon + policy.count("num_action_tokens_per_timestep") + 4)  # rows of the table as in the reference


def _read_state(policy: Section, checkpoint: Checkpoint, options: Options) -> int:
    """Width of the state; 0 if the policy reads none. Refuses a network with a state whose feature is missing: nothing would normalize it."""
    features = policy.get("input_features")
    if isinstance(features, dict) and STATE in features:
        return state_width(policy, checkpoint, options, padded=False)
    if policy.get("state_dim") != 0:
        hint = "without the feature nothing normalizes the state that the network expects"
        policy.bad("state_dim", "0, since input_features has no " + STATE, hint=hint, unsupported=True)
    return 0


def _read_prompt(policy: Section, checkpoint: Checkpoint, s: Sizes) -> None:
    """Reads the prompt (VLAJEPAModel.__init__, Qwen3VLInterface.expand_tokenizer, build_inputs). The prompt is cut after its last embodied
    token, since no used token attends to later ones."""
    template, embodied, action = (policy.get(key) for key in ("prompt_template", "embodied_action_token", "special_action_token"))
    if not isinstance(action, str) or action.count("{}") != 1 or action.count("{") + action.count("}") != 2:
        policy.bad("special_action_token", "text with {} once and no other braces")
        action = POLICY["special_action_token"]
    if not isinstance(embodied, str) or not embodied or "{" in embodied or "}" in embodied:
        policy.bad("embodied_action_token", "the text of a token, without braces")
        embodied = POLICY["embodied_action_token"]
    s.embodied_token, s.action_tokens = embodied, [action.format(i) for i in range(4 * s.horizon)]
    if not isinstance(template, str) or not _is_template(template):
        expected = "text with {instruction} and behind it {e_actions}, {actions} once at most, and no other braces"
        policy.bad("prompt_template", expected, unsupported=True)
        template = POLICY["prompt_template"]
    words = [*re.split("|".join(map(re.escape, PLACES)), template), *s.action_tokens]
    if any(text in word for text in (embodied, *PLACEHOLDERS) for word in words):
        policy.bad("prompt_template", "no token of images, and no embodied one but in {e_actions}", unsupported=True)
    n_frame = _n_moment(policy, checkpoint, s)
    frames = "".join(token * policy.count("num_action_tokens_per_timestep") for token in s.action_tokens[:n_frame])
    text = template[: template.index(PLACES[2])].replace(PLACES[1], frames)
    s.prompt = text + embodied * s.n_embodied
    if len(s.prompt.encode()) > MAX_TEMPLATE:
        policy.bad(
            "prompt_template", "a prompt of at most {} bytes".format(MAX_TEMPLATE), "{}".format(len(s.prompt.encode())), unsupported=True
        )


def _is_template(text: str) -> bool:
    counts = [text.count(place) for place in PLACES]
    n_brace = sum(counts)
    return (
        counts[0] == counts[2] == 1
        and counts[1] <= 1
        and text.count("{") == text.count("}") == n_brace
        and text.index(PLACES[0]) < text.index(PLACES[2])
    )


def _n_moment(policy: Section, checkpoint: Checkpoint, s: Sizes) -> int:
    """Number of moments for which the prompt has action tokens: one less than the moments that the world model's encoder makes of a video."""
    n_frame, tubelet = policy.count("num_video_frames"), policy.count("jepa_tubelet_size")
    if policy.get("enable_world_model") and not policy.get("freeze_qwen"):
        s.world_model = {name: entry.shape for name, entry in checkpoint.tensors.items() if name.startswith("model.video_")}
        shape = s.world_model.get(ENCODER, ())
        if len(shape) != 5 or shape[2] < 1:
            policy.problems.add(
                "tensor " + ENCODER, "(width, 3, frames, 16, 16), which tells the frames that become one", str(shape or "none")
            )
        else:
            tubelet = shape[2]
    if n_frame // tubelet < 2:
        policy.bad("num_video_frames", "at least {}, for two moments".format(2 * tubelet))
    return n_frame // tubelet - 1
