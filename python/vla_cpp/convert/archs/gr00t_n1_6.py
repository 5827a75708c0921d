# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.6: Eagle 3 as the prefix, a diffusion transformer that reads its text and its images in turns.

The layout is the authors' (Isaac-GR00T), as of N1.7. An absent key of config.json means the default of their own class.
"""

from __future__ import annotations

from functools import partial

from ..checkpoint import Layout
from ..section import Fixed
from .gr00t.eagle import EAGLE_3
from .gr00t.plan import Release, described, make_plan
from .gr00t.robot import ROBOT_OPTIONS

LAYOUT = Layout("GR00T N1.6", ROBOT_OPTIONS, model_types=("Gr00tN1d6",))
# gr00t/configs/model/gr00t_n1d6.py of Isaac-GR00T.
CONFIG = {
    "select_layer": 16,
    "backbone_embedding_dim": 2048,
    "max_state_dim": 29,
    "max_action_dim": 29,
    "action_horizon": 16,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_seq_len": 1024,
    "attend_text_every_n_blocks": 2,
    "diffusion_model_cfg": {
        "positional_embeddings": None,
        "num_layers": 32,
        "num_attention_heads": 32,
        "attention_head_dim": 48,
        "norm_type": "ada_norm",
        "output_dim": 1024,
        "interleave_self_attention": True,
    },
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "max_num_embodiments": 32,
    "model_name": "nvidia/Eagle-Block2A-2B-v2",
}
FIXED: Fixed = {
    "model_type": (None, "Gr00tN1d6"),
    "backbone_model_type": ("eagle", "eagle"),
    "reproject_vision": (False, False),
    "add_pos_embed": (True, True),
    "use_vlln": (True, True),
    "use_alternate_vl_dit": (True, True),
    "vl_self_attention_cfg": (None, None),
}
IGNORED = {"eagle_collator", "collator_overwrite_image_inputs", "state_additive_noise_scale"}
KWARGS_FIXED: Fixed = {"model_type": ("eagle", "eagle")}
# gr00t/model/gr00t_n1d6/processing_gr00t_n1d6.py
EMBODIMENTS = {
    "oxe_google": 0,
    "oxe_widowx": 1,
    "libero_panda": 2,
    "unitree_g1": 8,
    "new_embodiment": 10,
    "robocasa_panda_omron": 13,
    "oxe_droid": 16,
    "gr1": 20,
    "behavior_r1_pro": 24,
}
RELEASE = Release(CONFIG, FIXED, IGNORED, "Gr00tN1d6Processor", KWARGS_FIXED, EMBODIMENTS, True, EAGLE_3)
plan = partial(make_plan, RELEASE)
embodiments = partial(described, RELEASE)
