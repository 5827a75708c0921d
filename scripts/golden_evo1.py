# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the golden cases under tests/golden/evo1, as golden_smolvla does for SmolVLA.

    python scripts/golden_evo1.py [ARCH/NAME ...] [--out DIR]
    python scripts/golden_evo1.py --bundles [ARCH/NAME ...]       only convert the checkpoints again

The cases in the authors' layout also need opencv-python-headless, which resizes their frames.
"""
from golden_smolvla import Case, main
from random_evo1 import Description, write_checkpoint


def vision(d, layers, heads, ff, **more):
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "intermediate_size": ff, **more}


def text(d, layers, heads, kv, ff, **more):
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "num_key_value_heads": kv,
            "intermediate_size": ff, **more}


def head(layers, heads, d_hidden, d_state_hidden):
    return {"num_layers": layers, "num_heads": heads, "hidden_dim": d_hidden, "state_hidden_dim": d_state_hidden}


def policy(horizon, n_token, d_state=24, d_action=24, **more):
    return {"chunk_size": horizon, "max_text_length": n_token, "max_state_dim": d_state, "max_action_dim": d_action, **more}


def said(variant, dead_rows, views, **more):
    """What whoever converts the authors' files has to know."""
    return {"variant": variant, "dead_rows": dead_rows, "views": list(views), "view_slots": 3, **more}


CASES = {
    # The authors' layout: two views for three slots; one frame of the network's size, one not; pads; numbers of the state
    # beyond their range.
    "evo1/two_views": Case(31, {"agentview": (56, 56, "png"), "wrist": (45, 71, "png")}, "open the middle drawer", Description(
        "authors", 56, vision(36, 2, 3, 52), text(48, 3, 6, 2, 64), 2, head(2, 4, 40, 28), policy(5, 64),
        {"agentview": (56, 56), "wrist": (45, 71)}),
        state=(0.5, -1.25, 0.25, 2.0, -0.125, -3.0, 0.0625, 0.75),
        options=said("r2", "zero_attention", ("agentview", "wrist"))),
    # The first revision: 32 steps, another scale of time, pixels normalised in float32, -1 where the state is filled up. The
    # slot in the middle is empty; 6 x 6 patches; many pads; a state number that never moved in the data.
    "evo1/first_revision": Case(32, {"front": (70, 52, "png"), "left": None, "wrist": (84, 84, "png")}, "push the plate slowly",
        Description(
        "authors", 84, vision(30, 3, 5, 44, layer_norm_eps=1e-5), text(32, 3, 4, 1, 56, rope_theta=1e5, rms_norm_eps=1e-5), 2,
        head(3, 2, 24, 36), policy(7, 104), {"front": (70, 52), "left": (84, 84), "wrist": (84, 84)}, d_state=9, keys=("sawyer",),
        zero_spread=(2,)),
        options=said("r1", "zero_attention", ("front", "left", "wrist"))),
    # Rows that carry nothing take part: the first slot is empty and there are pads. Means instead of ranges, of one of two
    # data sets; as many heads of keys as of queries.
    "evo1/causal_rows": Case(33, {"high": None, "left": (40, 64, "png"), "right": (56, 56, "png")},
        "stack the green block on the yellow block", Description(
        "authors", 56, vision(32, 2, 4, 40), text(40, 3, 5, 5, 48), 2, head(2, 5, 44, 20), policy(6, 60),
        {"high": (56, 56), "left": (40, 64), "right": (56, 56)}, d_state=14, d_action=14, normalization="normal",
        keys=("aloha_joint", "robotwin_stack"), other_keys=("robotwin_push",)),
        options=said("r2", "causal_attention", ("high", "left", "right"), stats="aloha_joint/robotwin_stack")),
    # Two slots are empty, the first among them, and share their rows; one pad; numbers so small that every eps shows.
    "evo1/one_view": Case(36, {"left": None, "front": (33, 49, "png"), "right": None}, "go", Description(
        "authors", 56, vision(32, 1, 4, 48), text(32, 2, 4, 2, 40), 1, head(2, 2, 36, 44), policy(3, 39),
        {"left": (56, 56), "front": (33, 49), "right": (56, 56)}, d_state=5, d_action=4, faint=True),
        options=said("r2", "zero_attention", ("left", "front", "right"))),
    # Nothing is dead: every view present and an instruction beyond the limit, with capitals, digits, a letter in two parts
    # and lines around it; quantiles; a robot with as many numbers as the network.
    "evo1/long_text": Case(35, {"top": (56, 56, "png"), "left": (38, 50, "png"), "right": (90, 60, "png")},
        "\n O\u0308ffne die Schublade 12: 开抽屉, THEN put the black bowl on top of the stove, and close the bottom drawer\n", Description(
        "authors", 56, vision(28, 2, 2, 44), text(32, 2, 4, 2, 72, rope_theta=1e4), 2, head(1, 4, 52, 40), policy(4, 72),
        {"top": (56, 56), "left": (38, 50), "right": (90, 60)}, d_state=24, d_action=24, normalization="bounds_q99"),
        options=said("r2", "zero_attention", ("top", "left", "right"))),
    # LeRobot's layout: the first of three cameras absent, so that the others move up; a JPEG file; the gripper made one of two
    # numbers. Absent may be as many as are declared as empty ones: one such is there instead.
    "evo1/lerobot": Case(34, {"front": None, "wrist": (61, 97, "jpg"), "empty_camera_0": (90, 84, "png")},
        "Put the black_bowl on top of the stove!", Description(
        "lerobot", 84, vision(40, 2, 5, 36), text(36, 4, 3, 1, 64), 3, head(2, 3, 30, 26),
        policy(6, 80, 10, 9, num_inference_timesteps=8, vlm_dtype="float32", max_views=3, binarize_gripper=True, empty_cameras=1),
        {"front": (52, 90), "wrist": (61, 97)})),
    # As published files say: pixels normalised in bfloat16. One frame of the network's size; means and quantiles; a state number
    # that never moved in the data; an instruction beyond the limit.
    "evo1/lerobot_bfloat16": Case(37, {"wrist": (56, 56, "png"), "base": (80, 43, "png"), "empty_camera_0": None},
        "close the bottom drawer, and then stack the green block on the yellow block", Description(
        "lerobot", 56, vision(24, 2, 3, 40), text(32, 3, 4, 2, 48), 2, head(2, 4, 20, 24),
        policy(4, 56, 12, 7, num_inference_timesteps=5, vlm_dtype="bfloat16", max_views=3, empty_cameras=1,
               normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "QUANTILES"}),
        {"wrist": (56, 56), "base": (80, 43)}, d_state=6, zero_spread=(1,))),
}

if __name__ == "__main__":
    main(__doc__, CASES, write_checkpoint, "tests/golden")
