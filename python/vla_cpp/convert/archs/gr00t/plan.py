# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Plans the bundle of one robot of a checkpoint with processor_config.json, that is, of N1.6 and N1.7.

A `Release` holds the differences between the two: the backbone and the permitted configs.
"""

from __future__ import annotations

from typing import Any, Collection, Dict, List, NamedTuple, Sequence

from ... import recipe
from ...bundle import Key
from ...checkpoint import Checkpoint, find_backbone
from ...errors import Problems
from ...files import member
from ...layers import Rows
from ...networks import MAX_LAYERS, keys_of
from ...section import Fixed, Section
from ...tokenizer import read_tokenizer
from .. import Options, Plan
from . import head
from .images import Images, read_images, read_square_images
from .prompt import FORMALIZE, LEROBOT_EMPTY, text_ops
from .robot import END, PROCESSOR, STATISTICS, Robot, choose, embodiment_index, processor_file, read_robot
from .sizes import Sizes
from .vectors import action_ops, feature_description, gripper_ops, state_ops, statistics_of

POLICY = "config.json"
# Defaults of Isaac-GR00T's Gr00tN1d7Processor. LeRobot has other defaults for image sizes, so these must be stated, possibly as null.
KWARGS = {
    "modality_configs": None,
    "use_percentiles": False,
    "clip_outliers": True,
    "formalize_language": True,
    "max_state_dim": 29,
    "apply_sincos_state_encoding": False,
    "use_relative_action": False,
    "letter_box_transform": False,
}
STATED = ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction")
FLAGS = [key for key, value in KWARGS.items() if isinstance(value, bool)]
KWARGS_FIXED: Fixed = {
    "use_albumentations": (False, True),
    "exclude_state": (False, False),
    "use_mean_std": (False, False),
    "use_tactile": (False, False),
    "statistics": (None, None),
    "embodiment_id_mapping": (None, None),
}
KWARGS_IGNORED = set(
    """random_rotation_angle color_jitter_params model_name max_action_dim max_action_horizon extra_augmentation_config
    state_dropout_prob transformers_loading_kwargs tactile_state_keys tactile_input_shape tactile_embed_dim""".split()
)
# Keys of config.json with the defaults of the authors' classes of both releases.
CONFIG = {
    "backbone_embedding_dim": 2048,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_seq_len": 1024,
    "attend_text_every_n_blocks": 2,
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "max_num_embodiments": 32,
}
DIT = {
    "positional_embeddings": None,
    "num_attention_heads": 32,
    "attention_head_dim": 48,
    "norm_type": "ada_norm",
    "output_dim": 1024,
    "interleave_self_attention": True,
}
FIXED: Fixed = {
    "reproject_vision": (False, False),
    "add_pos_embed": (True, True),
    "use_vlln": (True, True),
    "use_alternate_vl_dit": (True, True),
}
# Keys of training, of precision and of transformers; and keys of images, text and statistics, which the reference reads from
# processor_config.json instead.
IGNORED = set(
    """
    architectures model_dtype dtype torch_dtype transformers_version _name_or_path model_revision tune_top_llm_layers tune_llm
    tune_visual tune_projector tune_diffusion_model tune_vlln use_flash_attention load_bf16 backbone_trainable_params_fp32
    attn_dropout noise_beta_alpha noise_beta_beta noise_s state_dropout_prob rtc_ramp_rate image_crop_size image_target_size
    shortest_image_edge crop_fraction random_rotation_angle color_jitter_params use_albumentations_transforms letter_box_transform
    extra_augmentation_config formalize_language apply_sincos_state_encoding use_percentiles use_relative_action use_mean_std
    tactile_state_keys tactile_input_shape tactile_embed_dim return_dict output_hidden_states id2label label2id problem_type
    chunk_size_feed_forward is_encoder_decoder output_attentions
    """.split()
)


class Release(NamedTuple):
    """The differences of one release."""

    model_type: str
    backbone_type: str  # backbone_model_type of config.json, model_type of the processor
    backbone: Any  # has read, read_area, read_prompt, weights, keys, dropped, LM, TEMPLATE
    config: Dict[str, object]  # keys of config.json with their defaults, beside CONFIG
    fixed: Fixed  # keys with one supported value, beside FIXED
    ignored: Collection[str]
    embodiments: Dict[str, int]  # indices of tags that are missing in embodiment_id.json
    state_rows: bool = False  # True: each moment of the state is a token; False: all moments together are one token
    cuts_rows: bool = True  # True: a robot with more steps than the head's rows gets only these rows; False: the reference refuses it


def make_plan(release: Release, checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    processor = _processor(release, checkpoint, problems)
    robot_config = choose(member(processor.values, "modality_configs", dict, PROCESSOR), options.embodiment)
    backbone = release.backbone
    folder = find_backbone(checkpoint, options.backbone, checkpoint.config.get("model_name"), "model_name")
    s = read_sizes(release, checkpoint.config, folder, problems)
    s.embodiment = embodiment_index(checkpoint, options.embodiment, release.embodiments, s.n_embodiment, problems)
    statistics = processor_file(checkpoint, STATISTICS)
    robot = (
        checkpoint.vectors.robot(s.horizon)
        if checkpoint.vectors
        else read_robot(options.embodiment, robot_config, statistics, processor, s.horizon, problems)
    )
    if not release.cuts_rows:
        _check_horizon(robot_config, s, options, problems)
    problems.raise_any()
    s.max_views = len(robot.cameras)
    if release.state_rows:
        s.n_state_row = robot.n_moment
    elif robot.n_moment != s.state_history:
        where = "{}: {}.state: delta_indices".format(PROCESSOR, options.embodiment)
        problems.add(where, "state_history_length {} moments".format(s.state_history), str(robot.n_moment))
    area = backbone.read_area(folder, s, problems)
    images = (read_images if processor.get("use_albumentations") else read_square_images)(processor, area, options, checkpoint.notes, problems)
    if processor.count("max_state_dim") * s.state_history != s.d_state:
        processor.bad("max_state_dim", "{} as in config.json".format(s.d_state // s.state_history))
    s.image_width, s.image_height = images.width, images.height
    clean = [*([LEROBOT_EMPTY] if checkpoint.documents else []), *(FORMALIZE if processor.get("formalize_language") else [])]
    parts = Parts(backbone, folder, robot, images, clean, checkpoint.documents.get(END, {}).get("ops", ()))
    return assemble(parts, network_keys(release, s), weights(release, s), checkpoint, options, s, problems)


def _check_horizon(robot: dict, s: Sizes, options: Options, problems: Problems) -> None:
    steps = member(robot, "action", dict, PROCESSOR).get("delta_indices")
    if isinstance(steps, list) and len(steps) > s.horizon:
        where = "{}: {}.action: delta_indices".format(PROCESSOR, options.embodiment)
        problems.add(where, "at most action_horizon {} of config.json".format(s.horizon), "{} steps".format(len(steps)))


def described(release: Release, checkpoint: Checkpoint) -> List[str]:
    """Tags of the robots that the checkpoint was trained for: those with statistics."""
    problems = Problems(checkpoint.name)
    configs = member(_processor(release, checkpoint, problems).values, "modality_configs", dict, PROCESSOR)
    problems.raise_any()
    statistics = processor_file(checkpoint, STATISTICS)
    checkpoint.notes += ["{}: left out, {} has no statistics".format(tag, STATISTICS) for tag in configs if tag not in statistics]
    return [tag for tag in configs if tag in statistics]


class Parts(NamedTuple):
    """The parts of a bundle beside the network."""

    backbone: Any
    folder: str  # folder of the backbone
    robot: Robot
    images: Images
    clean: List[dict]  # ops on the instruction
    end: Sequence[dict] = ()  # ops after those of the actions


def assemble(parts: Parts, keys: List[Key], rows: Rows, checkpoint: Checkpoint, options: Options, s: Sizes, problems: Problems) -> Plan:
    """The plan of a bundle. `keys`, `rows`: those of the network."""
    robot, backbone = parts.robot, parts.backbone
    tokenizer = read_tokenizer(parts.folder, s.lm.n_vocab, problems, checkpoint.notes)
    problems.raise_any()  # the prompt needs a valid tokenizer
    prompt = backbone.read_prompt(tokenizer, parts.folder, s, problems)
    document = {
        "image": parts.images.ops,
        "text": text_ops(backbone.TEMPLATE, parts.clean, prompt, s),
        "state": state_ops(robot, s, problems),
        "action": [*action_ops(robot, s, problems), *parts.end],
    }
    if options.gripper_sign:
        document["action"] += gripper_ops(robot, options.gripper_sign, problems)
    described = checkpoint.vectors.keys(checkpoint, robot.n_row, options, problems) if checkpoint.vectors else None
    all_keys = [
        *keys,
        *prompt.keys(),
        *(described or feature_description(robot, options, checkpoint.notes, problems)),
        *tokenizer.keys,
        recipe.recipe_key(document),
    ]
    problems.raise_any()
    tensors = {**statistics_of(recipe.STATE, robot.states), **statistics_of(recipe.ACTION, robot.actions)}
    return Plan(all_keys, rows, backbone.dropped(s), tensors, _hints(backbone, s))


def _processor(release: Release, checkpoint: Checkpoint, problems: Problems) -> Section:
    config = processor_file(checkpoint, PROCESSOR)
    name = release.model_type + "Processor"
    if config.get("processor_class") != name:
        problems.unsupported(PROCESSOR + ": processor_class", repr(name), repr(config.get("processor_class")))
    section = Section(PROCESSOR, member(config, "processor_kwargs", dict, PROCESSOR), KWARGS, problems)
    fixed = {**KWARGS_FIXED, "model_type": (release.backbone_type,) * 2}
    if checkpoint.documents:  # a LeRobot checkpoint: LeRobot has its own pipeline for false
        del fixed["use_albumentations"]
        section.defaults["use_albumentations"] = False
    section.refuse_unknown({*KWARGS, *STATED, *KWARGS_FIXED, *fixed, *KWARGS_IGNORED})
    section.check_fixed(fixed)
    for key in STATED:
        if key not in section.values:
            section.bad(key, "a value, or null", "no such key", "the reference and LeRobot take different defaults for it")
    for key in FLAGS:
        if not isinstance(section.get(key), bool):
            section.bad(key, "true or false")
    return section


def read_sizes(release: Release, config: dict, folder: str, problems: Problems) -> Sizes:
    """Reads all sizes. `folder`: the backbone's."""
    defaults = {**CONFIG, **release.config}
    fixed: Fixed = {"model_type": (None, release.model_type), "backbone_model_type": (release.backbone_type,) * 2, **FIXED, **release.fixed}
    s, policy = Sizes(), Section(POLICY, config, defaults, problems, nullable=("diffusion_model_cfg",))
    policy.refuse_unknown({*defaults, *fixed, *IGNORED, *release.ignored})
    policy.check_fixed(fixed)
    release.backbone.read(folder, policy.count("select_layer", maximum=MAX_LAYERS), s, problems)
    s.d_action, s.attend_text_every_n_blocks = policy.count("max_action_dim"), policy.count("attend_text_every_n_blocks")
    head.read(policy, s)
    return s


def network_keys(release: Release, s: Sizes) -> List[Key]:
    own: Dict[str, Dict[str, object]] = {"dit": dict(attend_text_every_n_blocks=s.attend_text_every_n_blocks)}
    if release.state_rows:
        own["policy"] = dict(n_state_row=s.n_state_row)
    keys = network_keys_of(release.backbone, s, own)
    return (
        keys
        if "vl_self_attention_cfg" in release.config
        else [key for key in keys if key.name not in ("vl.n_layer", "vl.n_head", "vl.d_ff")]
    )


def network_keys_of(backbone: Any, s: Sizes, own: Dict[str, Dict[str, object]]) -> List[Key]:
    """Keys of the network. `own`: further values of a release, by module."""
    chunking = {} if s.rtc_ramp_rate is None else {"policy": dict(rtc_ramp_rate=s.rtc_ramp_rate)}
    return keys_of(own, head.keys(s), chunking, backbone.keys(s), {"lm": s.lm})


def weights(release: Release, s: Sizes) -> Rows:
    return [*release.backbone.weights(s), *head.weights(s)]


def _hints(backbone: Any, s: Sizes) -> Dict[str, str]:
    return {
        backbone.LM + "layers.": "select_layer keeps {} language layers, 0 to {}".format(s.lm.n_layer, s.lm.n_layer - 1),
        "action_head.vl_self_attention.": "vl_self_attention_cfg of config.json has {} layers".format(s.n_vl_layer),
    }
