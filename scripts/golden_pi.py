# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the golden cases under tests/golden/pi0 and tests/golden/pi05, as golden_smolvla does for SmolVLA.

    python scripts/golden_pi.py [ARCH/NAME ...] [--out DIR]
    python scripts/golden_pi.py --bundles [ARCH/NAME ...]       only convert the checkpoints again
"""
from golden_smolvla import Case, main
from random_pi import Description, write_checkpoint


def vision(d, layers, heads, ff):
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "intermediate_size": ff}


def gemma(width, depth, heads, kv, d_head, ff):
    return {"width": width, "depth": depth, "mlp_dim": ff, "num_heads": heads, "num_kv_heads": kv, "head_dim": d_head}


def policy(horizon, steps, side, d_max, n_token, **more):
    return {"chunk_size": horizon, "n_action_steps": horizon, "num_inference_steps": steps, "image_resolution": (side, side),
            "max_state_dim": d_max[0], "max_action_dim": d_max[1], "tokenizer_max_length": n_token, **more}


CASES = {
    # Two views, one wide and one square; a third is declared and never sent. One key-value head, as published, with heads
    # wider in all than the models.
    "pi0/two_views": Case(11, {"base": (20, 28, "png"), "wrist": (36, 36, "png"), "absent": None}, "open the middle drawer", Description(
        "pi0", policy(5, 4, 28, (10, 9), 20), vision(36, 2, 3, 52), gemma(40, 3, 8, 1, 8, 72), gemma(32, 3, 8, 1, 8, 48),
        {"base": (20, 28), "wrist": (36, 36), "absent": (20, 28)}, d_state=8)),
    # Three views of three aspects, one a JPEG file; an instruction beyond the limit; grouped heads; a 3 x 3 grid; quantiles;
    # other periods of the time embedding.
    "pi0/long_text": Case(12, {"top": (60, 31, "png"), "wrist": (53, 53, "jpg"), "side": (37, 64, "png")},
                          " put the black_bowl on top of the stove, then close the bottom drawer of the cabinet", Description(
        "pi0", policy(7, 3, 42, (14, 16), 12, min_period=2e-3, max_period=8.0,
                      normalization_mapping={"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILES"}),
        vision(30, 1, 5, 64), gemma(36, 2, 6, 2, 12, 80), gemma(28, 2, 6, 2, 12, 56),
        {"top": (60, 31), "wrist": (53, 53), "side": (37, 64)}, d_state=14, d_action=14)),
    # One of three views absent in the middle, and one that empty_cameras adds; ten steps; ranges; a state number that never
    # moved in the data; an expert as wide as the language model.
    "pi0/absent_view": Case(13, {"wrist": (31, 60, "png"), "front": None, "base": (28, 28, "png"), "empty_camera_0": None},
                            "Öffne die Schublade 12: 开抽屉\n", Description(
        "pi0", policy(9, 10, 28, (6, 6), 40, empty_cameras=1,
                      normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MIN_MAX", "ACTION": "MIN_MAX"}),
        vision(32, 3, 4, 40), gemma(32, 4, 4, 1, 8, 56), gemma(32, 4, 4, 1, 8, 40),
        {"wrist": (31, 60), "front": (31, 60), "base": (28, 28)}, d_state=5, d_action=3, zero_spread=(2,))),
    # The same towers as pi0/two_views; quantiles, as published; an added empty camera.
    "pi05/two_views": Case(21, {"base": (20, 28, "png"), "wrist": (36, 36, "png"), "empty_camera_0": None}, "open the middle drawer",
                           Description(
        "pi05", policy(5, 4, 28, (10, 9), 80, empty_cameras=1), vision(36, 2, 3, 52), gemma(40, 3, 8, 1, 8, 72),
        gemma(32, 3, 8, 1, 8, 48), {"base": (20, 28), "wrist": (36, 36)}, d_state=8)),
    # States below and above the range of the bins; means instead of quantiles; blanks, underscores and a line break around
    # the instruction; grouped heads; ten steps.
    "pi05/wide_state": Case(22, {"front": (48, 27, "png")}, "  close_the\ndrawer 42! ", Description(
        "pi05", policy(6, 10, 42, (8, 8), 100, max_period=2.0,
                       normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}),
        vision(30, 1, 5, 64), gemma(36, 2, 6, 2, 12, 80), gemma(28, 2, 6, 2, 12, 56), {"front": (48, 27)}, d_state=6, d_action=6),
        state=(-3.0, 3.0, 0.0, 0.25, -0.5, 1.5)),
    # A prompt beyond the limit, so that the state is cut off; three views, one absent, one a JPEG file.
    "pi05/long_text": Case(23, {"top": (40, 60, "jpg"), "left": (28, 28, "png"), "right": None},
                           "put the black bowl on top of the stove, then close the bottom drawer of the cabinet", Description(
        "pi05", policy(8, 5, 28, (14, 14), 24), vision(32, 3, 4, 40), gemma(32, 4, 4, 1, 8, 56), gemma(32, 4, 4, 1, 8, 40),
        {"top": (40, 60), "left": (28, 28), "right": (28, 28)}, d_state=14, d_action=14)),
}

if __name__ == "__main__":
    main(__doc__, CASES, write_checkpoint, "tests/golden")
