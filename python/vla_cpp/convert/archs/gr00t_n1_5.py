# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.5: Eagle 2.5 as the prefix, self-attention over its features, a diffusion transformer with future tokens.

The layout is the authors' (Isaac-GR00T, last in November 2025): config.json, weights, and experiment_cfg/metadata.json with the statistics of
every robot. A class in the authors' code, chosen when a server starts, defines a robot's keys, their order and their normalization; --variant
names this class, or a JSON file with the same content.
"""

from __future__ import annotations

import os
from types import MappingProxyType
from typing import Dict, List, Mapping, NamedTuple, Optional, Tuple

import numpy as np

from ..bundle import Key
from ..checkpoint import Checkpoint, Layout, find_backbone
from ..errors import Code, Problems, refuse
from ..files import member, read_json
from ..layers import Rows, table
from ..networks import MAX_LAYERS
from ..options import variant
from ..section import Fixed, Section
from . import Options, Plan
from .gr00t import head, lerobot_n1_5
from .gr00t.eagle import EAGLE_2_5
from .gr00t.images import STANDARDIZE, Images
from .gr00t.plan import Parts, assemble, network_keys_of
from .gr00t.robot import BINARY, ROBOT_OPTIONS, SIN_COS, Group, Robot, check_widths, choose
from .gr00t.sizes import Sizes

LAYOUT = Layout("GR00T N1.5", (*ROBOT_OPTIONS, variant("the data config, by name or as a JSON file")), model_types=("gr00t_n1_5",))
POLICY, METADATA = "config.json", os.path.join("experiment_cfg", "metadata.json")
TOP_FIXED: Fixed = {"model_type": (None, "gr00t_n1_5")}
TOP_IGNORED = set(
    """action_dim action_horizon hidden_size compute_dtype architectures dtype torch_dtype transformers_version _name_or_path model_dtype
    attn_implementation""".split()
)
BACKBONE_FIXED: Fixed = {"project_to_dim": (1536, None), "reproject_vision": (False, False)}
BACKBONE_IGNORED = {"tune_llm", "tune_visual", "eagle_path", "use_flash_attention", "load_bf16"}
# Keys of FlowmatchingActionHeadConfig. Its default sizes differ from the published checkpoint's, so the sizes must be stated.
HEAD = dict.fromkeys(
    """max_state_dim action_dim action_horizon hidden_size input_embedding_dim backbone_embedding_dim num_inference_timesteps\n    num_target_vision_tokens diffusion_model_cfg vl_self_attention_cfg""".split()
)
HEAD = {**HEAD, "max_seq_len": 1024, "num_timestep_buckets": 1000, "max_num_embodiments": 32}
HEAD_FIXED: Fixed = {"add_pos_embed": (True, True), "use_vlln": (True, True)}
HEAD_IGNORED = set(
    """noise_beta_alpha noise_beta_beta noise_s tune_projector tune_diffusion_model model_dtype load_pretrained_det_decode_layer_path
    detection_coeff freeze_decode_layer expand_batch vl_self_attention_dtype model_type""".split()
)
EMBODIMENTS = {"new_embodiment": 31, "oxe_droid": 17, "agibot_genie1": 26, "gr1": 24}
# Mode of a key -> the recipe's kind and the statistics that it reads; a key without a mode is not normalized.
MODES = {
    "min_max": ("groot_n1_5_min_max", ("min", "max")),
    "q99": ("groot_n1_5_quantiles", ("q01", "q99")),
    "mean_std": ("groot_n1_5_mean_std", ("mean", "std")),
    "binary": (BINARY, ("min", "max")),
    "sin_cos": (SIN_COS, ("min", "max")),
    None: ("", ("min", "max")),
}
EULER = tuple("euler_angles_" + order for order in "rpy ryp pry pyr yrp ypr".split())
ROTATIONS = {"quaternion": 4, **dict.fromkeys(("axis_angle", *EULER), 3)}  # representations -> number of numbers
EDGE, CROP, HORIZON = 224, 0.95, 16


class DataConfig(NamedTuple):
    """A robot's cameras, states and actions, and their normalization."""

    video: Tuple[str, ...]
    state: Dict[str, Optional[str]]  # key -> mode
    action: Dict[str, Optional[str]]
    horizon: int = HORIZON
    crop: float = CROP
    index: int = -1  # the robot's index in the weights; -1: its tag determines it
    rotations: Mapping[str, str] = MappingProxyType({})  # state.KEY or action.KEY -> the network's representation of the rotation


def _modes(keys: str) -> Dict[str, Optional[str]]:
    """Modes by key, from KEY or KEY:MODE, separated by blanks."""
    return {key: mode or None for key, _, mode in (entry.partition(":") for entry in keys.split())}


def _all(keys: str, mode: str = "min_max") -> Dict[str, Optional[str]]:
    return dict.fromkeys(keys.split(), mode)


ARMS = "left_arm right_arm left_hand right_hand"
XYZ = "x y z roll pitch yaw"
AGIBOT = "left_arm_joint_position right_arm_joint_position left_effector_position right_effector_position head_position waist_position"
TWO_ARMS = dict.fromkeys(("state.right_arm_eef_quat", "state.left_arm_eef_quat"), "rotation_6d")
# The data configs in Isaac-GR00T's gr00t/experiment/data_config.py and examples/Libero/custom_data_config.py.
CONFIGS = {
    "fourier_gr1_arms_only": DataConfig(("ego_view",), _all(ARMS, "sin_cos"), _all(ARMS)),
    "fourier_gr1_arms_waist": DataConfig(("ego_view",), _all(ARMS + " waist", "sin_cos"), _all(ARMS + " waist")),
    "fourier_gr1_full_upper_body": DataConfig(("front_view",), _all(ARMS + " waist neck"), _all(ARMS + " waist neck")),
    "so100": DataConfig(("webcam",), _all("single_arm gripper"), _all("single_arm gripper")),
    "so100_dualcam": DataConfig(("front", "wrist"), _all("single_arm gripper"), _all("single_arm gripper")),
    "unitree_g1": DataConfig(("rs_view",), _all(ARMS), _all(ARMS)),
    "unitree_g1_full_body": DataConfig(("rs_view",), _all("left_leg right_leg waist " + ARMS), _all(ARMS)),
    "agibot_genie1": DataConfig(("top_head", "hand_left", "hand_right"), _all(AGIBOT), _all(AGIBOT + " robot_velocity")),
    "bimanual_panda_gripper": DataConfig(
        ("right_wrist_view", "left_wrist_view", "front_view"),
        _modes(
            "right_arm_eef_pos:min_max right_arm_eef_quat right_gripper_qpos:min_max"
            " left_arm_eef_pos:min_max left_arm_eef_quat left_gripper_qpos:min_max"
        ),
        _modes(
            "right_arm_eef_pos right_arm_eef_rot right_gripper_close:binary left_arm_eef_pos left_arm_eef_rot left_gripper_close:binary"
        ),
        rotations=TWO_ARMS,
    ),
    "bimanual_panda_hand": DataConfig(
        ("right_wrist_view", "left_wrist_view", "ego_view"),
        _modes(
            "right_arm_eef_pos:min_max right_arm_eef_quat right_hand:min_max left_arm_eef_pos:min_max left_arm_eef_quat left_hand:min_max"
        ),
        _modes("right_arm_eef_pos right_arm_eef_rot right_hand:min_max left_arm_eef_pos left_arm_eef_rot left_hand:min_max"),
        rotations=TWO_ARMS,
    ),
    "single_panda_gripper": DataConfig(
        ("left_view", "right_view", "wrist_view"),
        _all("end_effector_position_relative end_effector_rotation_relative gripper_qpos base_position base_rotation"),
        _modes("end_effector_position:min_max end_effector_rotation:min_max gripper_close:binary base_motion:min_max control_mode:binary"),
        rotations=dict.fromkeys(("state.end_effector_rotation_relative", "state.base_rotation"), "rotation_6d"),
    ),
    "oxe_droid": DataConfig(
        ("exterior_image_1", "exterior_image_2", "wrist_image"),
        _modes("eef_position:min_max eef_rotation gripper_position:min_max"),
        _modes("eef_position_delta eef_rotation_delta gripper_position:binary"),
        rotations={"state.eef_rotation": "rotation_6d", "action.eef_rotation_delta": "axis_angle"},
    ),
    "libero": DataConfig(("image", "wrist_image"), _all(XYZ + " gripper"), _all(XYZ + " gripper")),
}


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    if checkpoint.vectors:
        return _plan_of_lerobot(checkpoint, options, problems)
    config = _data_config(checkpoint, options.variant)
    robots = read_json(checkpoint.path(METADATA))
    metadata = choose(robots, options.embodiment)
    folder = find_backbone(checkpoint, options.backbone, None, "backbone")
    s, n_future = read_sizes(checkpoint.config, folder, problems)
    s.max_views = len(config.video)
    s.embodiment = config.index if config.index >= 0 else EMBODIMENTS.get(options.embodiment, -1)
    if not 0 <= s.embodiment < s.n_embodiment:
        expected = "one of {}, or a projector_index below {} in --variant".format(", ".join(EMBODIMENTS), s.n_embodiment)
        problems.add("--embodiment " + options.embodiment, expected, str(s.embodiment), code=Code.USAGE)
    _read_horizon(config, s, problems)
    robot = _robot(config, metadata, s.horizon, problems)
    images = _images(config, metadata, s, problems)
    problems.raise_any()
    parts = Parts(EAGLE_2_5, folder, robot, images, [])
    return assemble(parts, network_keys(s, n_future), weights(s, n_future), checkpoint, options, s, problems)


def _plan_of_lerobot(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    vectors = checkpoint.vectors
    folder = find_backbone(checkpoint, options.backbone, vectors.config.get("tokenizer_assets_repo"), "tokenizer_assets_repo")
    s, n_future = read_sizes(checkpoint.config, folder, problems)
    s.max_views, s.embodiment = len(vectors.views), vectors.index
    if not 0 <= s.embodiment < s.n_embodiment:
        where = "{}: embodiment_mapping: {}".format(lerobot_n1_5.PACK, options.embodiment)
        problems.add(where, "an index below max_num_embodiments {}".format(s.n_embodiment), str(s.embodiment))
    images = lerobot_n1_5.read_images(folder, s, problems)
    problems.raise_any()
    parts = Parts(EAGLE_2_5, folder, vectors.robot(s.horizon), images, lerobot_n1_5.text_ops())
    return assemble(parts, network_keys(s, n_future), weights(s, n_future), checkpoint, options, s, problems)


def embodiments(checkpoint: Checkpoint) -> List[str]:
    """Tags of the robots in the authors' checkpoint."""
    return list(read_json(checkpoint.path(METADATA)))


def _read_horizon(config: DataConfig, s: Sizes, problems: Problems) -> None:
    """Sets the horizon from the data config, not from the head's config: the authors' Gr00tPolicy._load_model rebuilds the head with as many
    rows as the data config has delta_indices, and every row of a chunk attends to all others."""
    s.horizon = config.horizon
    if s.horizon > s.n_position:
        expected = "at most max_seq_len {}, the rows of the head's position table".format(s.n_position)
        problems.add("--variant: horizon", expected, str(s.horizon))


def network_keys(s: Sizes, n_future: int) -> List[Key]:
    return network_keys_of(EAGLE_2_5, s, {"policy": dict(n_future=n_future)})


def weights(s: Sizes, n_future: int) -> Rows:
    return [*EAGLE_2_5.weights(s), *head.weights(s), *table("future", head.HEAD + "future_tokens.weight", n_future, s.d_dit)]


def _data_config(checkpoint: Checkpoint, name: str) -> DataConfig:
    """The data config of that name, or in a JSON file: a path, or a file name in the checkpoint."""
    if name in CONFIGS:
        return CONFIGS[name]
    if not name.endswith(".json"):
        expected = "one of {}, or a JSON file with video, state and action".format(", ".join(CONFIGS))
        hint = "the data config that the server is started with: a checkpoint does not state it"
        raise refuse("--variant", expected, name or "none", hint, Code.USAGE)
    problems = Problems(name)
    section = Section(
        name,
        read_json(name if os.path.exists(name) else checkpoint.path(name)),
        {"horizon": HORIZON, "crop": CROP, "projector_index": 0, "rotations": {}},
        problems,
    )
    section.refuse_unknown({"video", "state", "action", "horizon", "crop", "projector_index", "rotations"})
    video = [view for view in member(section.values, "video", list, name) if isinstance(view, str)]
    modes = [member(section.values, part, dict, name) for part in ("state", "action")]
    for part, keys in zip(("state", "action"), modes):
        allowed = [mode for mode in MODES if part == "state" or mode != "sin_cos"]
        if not keys or not all(mode in allowed for mode in keys.values()):
            expected = "keys with one of " + ", ".join(mode or "null" for mode in allowed)
            section.bad(part, expected, str(keys)[:80], unsupported=True)
    rotations = member(section.values, "rotations", dict, name)
    keys = {"{}.{}".format(part, key) for part, known in zip(("state", "action"), modes) for key in known}
    if not all(key in keys and isinstance(target, str) for key, target in rotations.items()):
        section.bad("rotations", "state.KEY or action.KEY with a representation", str(rotations)[:80])
    crop = section.number("crop")
    if not video or crop > 1:
        section.bad("video", "names of cameras, and a crop of at most 1", str(video))
    horizon, index = section.count("horizon", maximum=4096), section.count("projector_index", minimum=0)
    problems.raise_any()
    return DataConfig(tuple(video), modes[0], modes[1], horizon, crop, index if "projector_index" in section.values else -1, rotations)


def read_sizes(config: dict, folder: str, problems: Problems) -> Tuple[Sizes, int]:
    s, top = Sizes(), Section(POLICY, config, {}, problems)
    top.refuse_unknown({*TOP_FIXED, *TOP_IGNORED, "backbone_cfg", "action_head_cfg"})
    top.check_fixed(TOP_FIXED)
    backbone = Section(POLICY + ": backbone_cfg", member(config, "backbone_cfg", dict, POLICY), {}, problems)
    backbone.refuse_unknown({*BACKBONE_FIXED, *BACKBONE_IGNORED, "select_layer"})
    backbone.check_fixed(BACKBONE_FIXED)
    policy = Section(POLICY + ": action_head_cfg", member(config, "action_head_cfg", dict, POLICY), HEAD, problems)
    policy.refuse_unknown({*HEAD, *HEAD_FIXED, *HEAD_IGNORED})
    policy.check_fixed(HEAD_FIXED)
    EAGLE_2_5.read(folder, backbone.count("select_layer", maximum=MAX_LAYERS), s, problems)
    s.d_action = policy.count("action_dim")
    head.read(policy, s)
    return s, policy.count("num_target_vision_tokens", maximum=4096)


def _robot(config: DataConfig, metadata: dict, n_row: int, problems: Problems) -> Robot:
    groups = []
    for part, modes in (("state", config.state), ("action", config.action)):
        groups.append([_group(part, key, mode, metadata, config.rotations, problems) for key, mode in modes.items()])
    if any(group.rotation for group in groups[0]) and any(group.kind == SIN_COS for group in groups[0]):
        problems.unsupported("--variant", "rotations of states, or sines of states", "both")
    return Robot(list(config.video), groups[0], groups[1], n_row)


def _group(part: str, key: str, mode: Optional[str], metadata: dict, rotations: Mapping[str, str], problems: Problems) -> Group:
    where = "{}: statistics.{}.{}".format(METADATA, part, key)
    table = member(member(metadata, "statistics", dict, METADATA), part, dict, METADATA)
    kind, names = MODES[mode]
    columns = []
    for name in names:
        values = member(table, key, dict, where).get(name)
        numbers = isinstance(values, list) and values and all(type(v) in (int, float) for v in values)
        columns.append(np.asarray(values if numbers else [0.0], np.float32))
        if not numbers or not np.isfinite(columns[-1]).all():
            problems.add("{}.{}".format(where, name), "finite numbers", str(values)[:80])
    low, high = columns
    if low.size != high.size:
        problems.add(where, "statistics of one width", "{} and {}".format(low.size, high.size))
        high = low
    check_widths(where, member(table, key, dict, where), names, low.size, problems)
    group = Group(key, low.size, kind, low, high, part == "state" and mode == "q99")
    modalities = member(member(metadata, "modalities", dict, METADATA), part, dict, METADATA)
    described, place = member(modalities, key, dict, METADATA), "{}: modalities.{}.{}".format(METADATA, part, key)
    target = rotations.get("{}.{}".format(part, key))
    if target is not None and target != described.get("rotation_type"):
        return _converted(group, part, mode, target, described, place, problems)
    if described.get("continuous") is False and mode not in ("binary", None):
        problems.add(place, "mode binary for numbers that are not continuous", str(mode))
    return group


def _converted(group: Group, part: str, mode: Optional[str], target: str, described: dict, place: str, problems: Problems) -> Group:
    """The group of a rotation that the network has in another representation than the robot. Statistics describe the robot's representation,
    so only an absolute rotation can be normalized, by the bounds of the network's representation. The reference fails on most other pairs of
    representations, since it uses the robot's width; it would accept further pairs of Euler angles and axis_angle, but no data config has
    them."""
    source = described.get("rotation_type")
    pairs = {("state", name, "rotation_6d"): width for name, width in ROTATIONS.items()}
    pairs.update({("action", name, "axis_angle"): 3 for name in EULER})
    width = pairs.get((part, source, target))
    if width is None:
        expected = "states: {} as rotation_6d; actions: {} as axis_angle".format(", ".join(ROTATIONS), ", ".join(EULER))
        problems.unsupported(place + ".rotation_type", expected, "{} as {}".format(source, target))
    elif group.width != width:
        problems.add(place, "{} numbers of a {}".format(width, source), str(group.width))
    if mode is not None and (mode != "min_max" or described.get("absolute") is not True):
        found = "{}, absolute: {}".format(mode, described.get("absolute"))
        problems.add(place, "min_max for an absolute rotation that is converted, no mode for another", found)
    if part == "action":
        turn, bound = {"from": target, "to": str(source)}, np.full(3, np.pi, np.float32)
        return group._replace(low=-bound, high=bound, rotation=turn)
    turn = {"from": str(source), "to": target, "normalize": MODES["min_max"][0] if mode else "identity"}
    return group._replace(kind="", rotation=turn)


def _images(config: DataConfig, metadata: dict, s: Sizes, problems: Problems) -> Images:
    video = member(member(metadata, "modalities", dict, METADATA), "video", dict, METADATA)
    sizes: List[object] = [member(video, view, dict, METADATA).get("resolution") for view in config.video]
    size = sizes[0]
    sound = isinstance(size, list) and len(size) == 2 and all(type(n) is int and 2 <= n <= 8192 for n in size)
    if not sound or any(other != size for other in sizes):
        problems.add(METADATA + ": modalities.video", "one resolution for the cameras " + ", ".join(config.video), str(sizes))
        size = [EDGE, EDGE]
    width, height = size
    crop = {"op": "center_crop", "width": max(1, int(width * config.crop)), "height": max(1, int(height * config.crop))}
    side = s.image_width
    resize = {"op": "resize", "width": side, "height": side, "filter": "torch_bilinear_cut"}
    ops = [{"op": "camera_size", "width": width, "height": height}, crop, resize, {"op": "size", "width": side, "height": side}]
    return Images(side, side, [*ops, STANDARDIZE])
