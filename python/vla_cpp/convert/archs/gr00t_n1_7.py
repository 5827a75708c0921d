# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7: Qwen3-VL as the prefix, and a diffusion transformer whose layers attend alternately to text and images.

A checkpoint has several robots, and a bundle those that --embodiment names. The layout is the authors' (Isaac-GR00T).

An absent key of config.json has the default of the authors' own class, listed here with the key. LeRobot's copy of that class has other
defaults for `select_layer`, `diffusion_model_cfg` and `vl_self_attention_cfg`: those of the published checkpoint. If a checkpoint omits one
of them and its tensors do not fit the authors' default, it is refused.
"""

from __future__ import annotations

from functools import partial

from ..checkpoint import Layout
from .gr00t import qwen3_vl
from .gr00t.plan import DIT, Release, described, make_plan
from .gr00t.robot import ROBOT_OPTIONS

LAYOUT = Layout("GR00T N1.7", ROBOT_OPTIONS, model_types=("Gr00tN1d7",))
RELEASE = Release(
    "Gr00tN1d7",
    "qwen",
    qwen3_vl,
    config={  # gr00t/configs/model/gr00t_n1d7.py of Isaac-GR00T
        "select_layer": 12,
        "max_state_dim": 132,
        "state_history_length": 1,
        "max_action_dim": 132,
        "action_horizon": 40,
        "diffusion_model_cfg": {**DIT, "num_layers": 16},
        "vl_self_attention_cfg": None,
        "rtc_ramp_rate": 6.0,  # the default of LeRobot's class; in the authors' code the caller passes it
        "model_name": "nvidia/Cosmos-Reason2-2B",
    },
    fixed={"exclude_state": (False, False), "strict_action_padding_mask": (False, False), "use_tactile": (False, False)},
    ignored={"use_mean_std", "tactile_state_keys", "tactile_input_shape", "tactile_embed_dim"},
    embodiments={
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
    },
)
plan = partial(make_plan, RELEASE)
embodiments = partial(described, RELEASE)
