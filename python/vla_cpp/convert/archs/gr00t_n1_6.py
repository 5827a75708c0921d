# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.6: Eagle 3 as the prefix, and a diffusion transformer whose layers attend alternately to text and images.

The layout is the authors' (Isaac-GR00T), as for N1.7. An absent key of config.json has the default of the authors' own class.
"""

from __future__ import annotations

from functools import partial

from ..checkpoint import Layout
from .gr00t.eagle import EAGLE_3
from .gr00t.plan import DIT, Release, described, make_plan
from .gr00t.robot import ROBOT_OPTIONS

LAYOUT = Layout("GR00T N1.6", ROBOT_OPTIONS, model_types=("Gr00tN1d6",))
RELEASE = Release(
    "Gr00tN1d6",
    "eagle",
    EAGLE_3,
    config={  # gr00t/configs/model/gr00t_n1d6.py of Isaac-GR00T
        "select_layer": 16,
        "max_state_dim": 29,
        "max_action_dim": 29,
        "action_horizon": 16,
        "diffusion_model_cfg": {**DIT, "num_layers": 32},
        "model_name": "nvidia/Eagle-Block2A-2B-v2",
    },
    fixed={"vl_self_attention_cfg": (None, None)},
    ignored={"eagle_collator", "collator_overwrite_image_inputs", "state_additive_noise_scale"},
    embodiments={  # gr00t/model/gr00t_n1d6/processing_gr00t_n1d6.py
        "oxe_google": 0,
        "oxe_widowx": 1,
        "libero_panda": 2,
        "unitree_g1": 8,
        "new_embodiment": 10,
        "robocasa_panda_omron": 13,
        "oxe_droid": 16,
        "gr1": 20,
        "behavior_r1_pro": 24,
    },
    state_rows=True,
    cuts_rows=False,
)
plan = partial(make_plan, RELEASE)
embodiments = partial(described, RELEASE)
