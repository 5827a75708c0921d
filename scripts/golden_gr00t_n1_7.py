# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the golden cases under tests/golden/gr00t_n1_7, as golden_smolvla does for SmolVLA.

    python scripts/golden_gr00t_n1_7.py [ARCH/NAME ...] [--out DIR]
    python scripts/golden_gr00t_n1_7.py --bundles [ARCH/NAME ...]       only convert the checkpoints again
"""
from golden_smolvla import Case, main
from random_gr00t_n1_7 import Description, Robot, write_checkpoint


def vision(d, layers, heads, ff, side, deepstack, patch=4):
    """side: of the square table of positions."""
    return {"hidden_size": d, "depth": layers, "num_heads": heads, "intermediate_size": ff, "num_position_embeddings": side * side,
            "deepstack_visual_indexes": list(deepstack), "patch_size": patch}


def text(d, layers, heads, kv, d_head, ff, sections):
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "num_key_value_heads": kv,
            "head_dim": d_head, "intermediate_size": ff,
            "rope_scaling": {"mrope_interleaved": True, "mrope_section": list(sections), "rope_type": "default"}}


def head(layers, dit, vl, d_hidden, d_state, d_action, horizon, **more):
    """layers: of the language model, which the policy keeps; dit, vl: (layers, heads, width of a head)."""
    same = {"positional_embeddings": None, "dropout": 0.2, "final_dropout": True}
    sizes = ("num_layers", "num_attention_heads", "attention_head_dim")
    return {"select_layer": layers, "input_embedding_dim": dit[1] * dit[2], "hidden_size": d_hidden, "max_state_dim": d_state,
            "max_action_dim": d_action, "action_horizon": horizon, "max_seq_len": horizon + 4, "max_num_embodiments": 3,
            "diffusion_model_cfg": same | dict(zip(sizes, dit)) | {
                "norm_type": "ada_norm", "output_dim": d_hidden, "interleave_self_attention": True},
            "vl_self_attention_cfg": same | dict(zip(sizes, vl)), **more}


def case(seed, frames, instruction, description, **more):
    options = {"embodiment": description.tag} | more.pop("options", {})
    return Case(seed, frames, instruction, description, options=options, **more)


POSE = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 1)

CASES = {
    # Two square cameras, shrunk by a fraction, cropped and enlarged again; ranges instead of percentiles; a robot that gets
    # five of eight rows; its state and its actions are of different widths.
    "gr00t_n1_7/libero": case(41, {"image": (45, 45, "png"), "wrist_image": (45, 45, "png")}, "open the middle drawer", Description(
        "libero_sim", 2, Robot(("image", "wrist_image"), POSE | {"gripper": 2}, POSE | {"gripper": 1}, 5),
        vision(24, 5, 3, 44, 5, (0, 2, 3)), text(40, 6, 6, 2, 12, 56, (2, 2, 2)),
        head(4, (6, 4, 9), (2, 5, 8), 20, 14, 11, 8),
        {"image_target_size": [32, 32], "shortest_image_edge": 32, "crop_fraction": 0.95}, 32)),
    # Percentiles, with numbers beyond them and one that never moved; one camera, padded to a square and halved; the last vision
    # layer feeds DeepStack as well as the connector; one key-value head; eight DiT blocks; the whole horizon.
    "gr00t_n1_7/percentiles": case(42, {"front": (40, 64, "png")}, "push the plate slowly", Description(
        "simpler_env_widowx", 1, Robot(("front",), {"pose": 4, "pad": 1, "gripper": 1}, {"gripper": 1, "pose": 4}, 6, zero_spread=(2,)),
        vision(24, 4, 2, 36, 6, (0, 1, 3)), text(36, 7, 4, 1, 16, 48, (4, 2, 2)),
        head(5, (8, 3, 8), (1, 3, 12), 18, 9, 7, 6),
        {"image_target_size": [32, 32], "image_crop_size": [28, 28], "letter_box_transform": True}, 32, percentiles=True),
        state=(0.5, -2.25, 0.1, 4.0, 0.03125, -3.5)),
    # Joints that are predicted relative to the state, by statistics of their own, beside a gripper that is not; one part is
    # relative to a state of another name. Three cameras whose aspect is kept: six by eight patches.
    "gr00t_n1_7/relative": case(43, {"ego_view": (36, 48, "png"), "left": (36, 48, "png"), "right": (36, 48, "jpg")},
        "stack the green block on the yellow block", Description(
        "real_arms_relative_joints", 1, Robot(
            ("ego_view", "left", "right"), {"gripper": 1, "right_arm_joints": 4, "left_arm": 3, "waist": 2},
            {"gripper": 1, "right_arm": 4, "left_arm": 3}, 7, {"right_arm": "right_arm_joints", "left_arm": None}),
        vision(32, 4, 2, 40, 7, (0, 1, 2)), text(40, 5, 5, 5, 8, 52, (2, 1, 1)),
        head(4, (6, 5, 6), (2, 4, 10), 22, 12, 10, 9),
        {"image_target_size": [24, 24], "image_crop_size": [22, 22]}, 24, percentiles=True),
        options={"camera_size": "48x36"}),
    # An instruction that has to be cleaned: capitals, punctuation, what looks like a special token, letters in two parts and in other
    # scripts, digits of several kinds; five steps; frames shrunk to a third; no crop; text blocks every third time; four
    # language layers that the policy cuts off.
    "gr00t_n1_7/clean_text": case(44, {"top": (48, 48, "png"), "wrist": (48, 48, "png")},
        "  \u00d6ffne die \"Schublade_12\" -- don't stop!\nPla\u0308tze \u5f00\u62bd\u5c49\uff0c THEN put the black-bowl (n\u00b0 3\u00bd) on top"
        " of the stove<|im_end|>; it\u2019s \u0645\u0646\u0636\u062f\u0629 #42. Close the bottom drawer, and stack the GREEN block ", Description(
        "my_robot.v2", 2, Robot(("top", "wrist"), {"joints": 6}, {"joints": 5, "hand": 2}, 4),
        vision(28, 4, 7, 32, 4, (0, 1, 2), 2), text(36, 8, 3, 1, 20, 40, (4, 3, 3)),
        head(4, (7, 2, 16), (3, 2, 18), 26, 8, 8, 5, num_inference_timesteps=5, attend_text_every_n_blocks=3),
        {"image_target_size": [16, 16], "image_crop_size": [16, 16]}, 16)),
    # Numbers so small that every eps shows; a frame that is enlarged; two words.
    "gr00t_n1_7/faint": case(45, {"camera": (12, 12, "png")}, "Go on", Description(
        "simpler_env_google", 1, Robot(("camera",), {"x": 1, "hand": 3}, {"x": 1, "hand": 2}, 3),
        vision(16, 3, 2, 24, 3, (0, 1, 2)), text(24, 5, 3, 1, 8, 32, (2, 1, 1)),
        head(4, (6, 2, 10), (1, 3, 8), 14, 6, 5, 4),
        {"image_target_size": [16, 16], "shortest_image_edge": 16, "crop_fraction": 0.9}, 16, faint=True)),
}

if __name__ == "__main__":
    main(__doc__, CASES, write_checkpoint, "tests/golden")
