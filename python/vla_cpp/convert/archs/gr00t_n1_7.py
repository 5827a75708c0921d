# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7: Qwen3-VL as the prefix, a diffusion transformer that reads its text and its images in turns.

A checkpoint holds several robots, a bundle those that --embodiment names. The layout is the authors' (Isaac-GR00T).

An absent key of config.json means the default of the authors' own class, which is stated here beside the key. LeRobot's copy of that
class has other defaults for `select_layer`, `diffusion_model_cfg` and `vl_self_attention_cfg`, those of the published checkpoint; where a
checkpoint leaves one of them out, its tensors fit the one or the other, and what does not fit is refused.
"""

from __future__ import annotations

from functools import partial

from ..checkpoint import Layout
from ..section import Fixed
from .gr00t import qwen3_vl
from .gr00t.plan import Release, described, make_plan
from .gr00t.robot import ROBOT_OPTIONS

LAYOUT = Layout("GR00T N1.7", ROBOT_OPTIONS, model_types=("Gr00tN1d7",))
# gr00t/configs/model/gr00t_n1d7.py of Isaac-GR00T.
DIT_DEFAULT = {
    "positional_embeddings": None,
    "num_layers": 16,
    "num_attention_heads": 32,
    "attention_head_dim": 48,
    "norm_type": "ada_norm",
    "output_dim": 1024,
    "interleave_self_attention": True,
}
CONFIG = {
    "select_layer": 12,
    "backbone_embedding_dim": 2048,
    "max_state_dim": 132,
    "state_history_length": 1,
    "max_action_dim": 132,
    "action_horizon": 40,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_seq_len": 1024,
    "attend_text_every_n_blocks": 2,
    "diffusion_model_cfg": DIT_DEFAULT,
    "vl_self_attention_cfg": None,
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "max_num_embodiments": 32,
    "rtc_ramp_rate": 6.0,  # of LeRobot's class; the authors' callers give it
    "model_name": "nvidia/Cosmos-Reason2-2B",
}
FIXED: Fixed = {
    "model_type": (None, "Gr00tN1d7"),
    "backbone_model_type": ("qwen", "qwen"),
    "reproject_vision": (False, False),
    "add_pos_embed": (True, True),
    "use_vlln": (True, True),
    "use_alternate_vl_dit": (True, True),
    "exclude_state": (False, False),
    "strict_action_padding_mask": (False, False),
    "use_tactile": (False, False),
}
IGNORED = {"use_mean_std", "tactile_state_keys", "tactile_input_shape", "tactile_embed_dim"}
KWARGS_FIXED: Fixed = {"model_type": ("qwen", "qwen")}
EMBODIMENTS = {
    "simpler_env_google": 0,
    "simpler_env_widowx": 1,
    "libero_sim": 2,
    "new_embodiment": 10,
    "robocasa_panda_omron": 10,
    "robocasa_gr1_tabletop": 10,
    "unitree_g1_sonic": 11,
    "oxe_droid_relative_eef_relative_joint": 24,
    "real_g1_relative_eef_relative_joints": 25,
    "unitree_g1_full_body_with_waist_height_nav_cmd": 25,
    "real_r1_pro_sharpa_relative_eef": 26,
    "real_r1_pro_sharpa_relative_eef_human": 26,
    "real_r1_pro_sharpa_relative_eef_maxinsights": 26,
    "real_r1_pro_sharpa_relative_eef_mecka": 26,
    "xdof_relative_eef_relative_joint": 27,
    "xdof_relative_eef_relative_joint_subtask": 27,
}
RELEASE = Release(CONFIG, FIXED, IGNORED, "Gr00tN1d7Processor", KWARGS_FIXED, EMBODIMENTS, False, qwen3_vl)
plan = partial(make_plan, RELEASE)
embodiments = partial(described, RELEASE)
