# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random configurations, by the reference and by the runtime: what the golden cases do not happen to contain.

    python tools/parity_random.py ARCH FIRST LAST [--bf16 | --stored] [--vla build/cpu/bin/vla] [--keep DIR]

A seed draws everything: depths, heads, widths, patches, grid and table, views, frames, absent views, text, normalization, solver,
attention mode (of smolvla), relative actions (of pi0, pi05 and GR00T), poses and moments (of GR00T).  Its checkpoint is run by LeRobot's class, converted by vla-convert and run by vla; every block must agree.
A configuration that the reference cannot run must be refused, with a reason, by vla-convert or by vla.  Ends with exit
code 1 if a block differs by more than 1e-4 of its largest magnitude, or if only one side answers.

bitvla: a code that rounding moves changes all that follows, so that each part is run on the reference's own input (vla run --inject).
Products must agree within 1e-6, other parts within 1e-5; whole blocks, inside of which a code may move, by their root mean square.

With --bf16 the weights are float32 numbers that bfloat16 rounds and the bundle is in bf16: its actions, or the logits of its first token, must not lie further from
the reference's in float32 than those of the reference in the dtypes of a published file.  With --stored the checkpoint has the dtypes
of a published file, so has the bundle (vla-convert --dtype stored), and the runtime chooses its kernels: the same must hold.

With --leftover the chunk goes on from rows of a previous one (real-time chunking), whose number, delay and guidance the seed draws too;
the runtime is the engine in this process (VLA_LIBRARY).
"""
import argparse
import contextlib
import functools
import io
import json
import random
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from goldens import (
    act, bitvla, cases, diffusion, evo1, gr00t, gr00t_n1_5, gr00t_n1_6, gr00t_n1_7, groot, openvla, openvla_oft, pi, pi0_fast, recorder, rtc, smolvla, turbovla,
    turbovla_authors, vla_adapter, vla_jepa, xvla)
from parity_full import ROOT, distance, run_vla

TOLERANCE = 1e-4  # of the largest magnitude of a block, as the golden tests
MODES = ("MEAN_STD", "MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10", "IDENTITY")
TEXTS = ("a", "pick up the red cube\n", "  two  spaces ", "don't 12345 stop!", "naïve café 漢字 🙂 ok", "word " * 40, "\n\n",
         "<image> <|im_end|> hi", "tab\tand\r\nline")


def draw_views(r, n_empty):
    """({view: declared size}, {view: frame or None}) with at most as many absent as the reference fills in."""
    frames = {f"cam{i}": (r.randint(12, 90), r.randint(12, 90), r.choice(("png", "png", "jpg"))) for i in range(r.randint(1, 3))}
    views = {view: frame[:2] for view, frame in frames.items()}
    if n_empty and len(frames) > 1 and r.random() < 0.7:
        frames[r.choice(list(frames))] = None
    return views, frames | {f"empty_camera_{i}": None for i in range(n_empty)}


def draw(seed):
    """A case whose every size comes from the seed."""
    r = random.Random(seed)
    factor, patch = r.choice((1, 2, 2, 3)), r.choice((4, 5, 6, 8, 14))
    grid = factor * r.choice((1, 2, 2, 3))
    table = grid if r.random() < 0.7 else grid + r.choice((1, 2))
    vision_heads, kv = r.choice((1, 2, 3, 5)), r.choice((1, 2, 3))
    heads = kv * r.choice((1, 2, 3))
    d_model = heads * r.choice((8, 12, 16) if heads % 2 == 0 else (8, 16, 24))
    n_layer, n_cut = r.choice((1, 2, 3, 4, 6)), r.choice((0, 0, 1))
    n_expert, every = -1, r.choice((2, 2, 2, 3, 4, 1, 0, -1))
    if n_layer % 2 == 0 and r.random() < 0.3:
        n_expert, every = n_layer // 2, n_layer if r.random() < 0.5 else 2
    width = r.choice((0.5, 0.75, 1.0, 0.25))
    n_empty, d_state, d_action = r.choice((0, 0, 1)), r.randint(1, 14), r.randint(1, 14)
    views, frames = draw_views(r, n_empty)
    policy = smolvla.policy(
        r.randint(1, 12), r.choice((1, 2, 5, 10)), (grid * patch, grid * patch), width if d_model * width % 2 == 0 else 1.0,
        num_vlm_layers=n_layer, num_expert_layers=n_expert, self_attn_every_n_layers=every, empty_cameras=n_empty,
        max_state_dim=max(d_state, r.choice((8, 16, 32))), max_action_dim=max(d_action, r.choice((8, 16, 32))),
        tokenizer_max_length=r.choice((8, 24, 48)), pad_language_to=r.choice(("longest", "max_length")),
        prefix_length=r.choice((-1, 0, 90)), attention_mode=r.choice(("cross_attn",) * 5 + ("self_attn",)),
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)},
        min_period=r.choice((4e-3, 1e-3)), max_period=r.choice((4.0, 2.0)))
    vision = smolvla.vision(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)), table * patch, patch)
    text = smolvla.text(d_model, n_layer + n_cut, heads, kv, r.choice((4, 6, 8, 16, 32)), r.choice((32, 50)))
    checkpoint = smolvla.Checkpoint(vision, text, factor, policy, views, d_state, d_action)
    return cases.Case(seed, frames, r.choice(TEXTS), checkpoint)


def draw_pi(arch, seed):
    """The same for pi0 and pi05; the patches of their tower have 14 pixels."""
    r = random.Random(seed)
    kv, vision_heads, depth, d_head = r.choice((1, 1, 2, 3)), r.choice((1, 2, 3, 5)), r.randint(1, 4), r.choice((4, 8, 12, 16, 32))
    heads = kv * r.choice((1, 2, 4, 8))
    n_empty, d_state, d_action = r.choice((0, 0, 1)), r.randint(1, 14), r.randint(1, 14)
    views, frames = draw_views(r, n_empty)
    modes = {"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)}
    policy = pi.policy(
        r.randint(1, 12), r.choice((1, 2, 5, 10)), 14 * r.choice((1, 2, 2, 3, 4)),
        (max(d_state, r.choice((8, 16, 32))), max(d_action, r.choice((8, 16, 32)))), r.choice((8, 24, 48, 200)),
        empty_cameras=n_empty, normalization_mapping=modes, min_period=r.choice((4e-3, 1e-3)), max_period=r.choice((4.0, 2.0)),
        use_relative_actions=d_state >= d_action and r.random() < 0.3)
    lm, expert = (pi.gemma(r.choice((16, 24, 36, 40)), depth, heads, kv, d_head, r.choice((32, 50))) for _ in range(2))
    vision = pi.tower(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)))
    checkpoint = pi.Checkpoint(arch, policy, vision, lm, expert, views, d_state, d_action)
    return cases.Case(seed, frames, r.choice(TEXTS), checkpoint)


def draw_pi0_fast(seed):
    """The same for π0-FAST, whose random answers begin with no prefix: where one is required both refuse."""
    r = random.Random(f"pi0_fast {seed}")
    kv, vision_heads, d_head = r.choice((1, 1, 2, 3)), r.choice((1, 2, 3, 5)), r.choice((4, 8, 12, 16, 32))
    n_empty, d_state, d_action, n_row = r.choice((0, 0, 1)), r.randint(1, 14), r.randint(1, 14), r.randint(1, 12)
    views, frames = draw_views(r, n_empty)
    policy = pi0_fast.policy(
        (n_row + r.choice((0, 0, 3)), n_row), r.choice((1, 2, 5, 20, 40)), 14 * r.choice((1, 2, 2, 3, 4)), r.choice((8, 24, 48, 200)), empty_cameras=n_empty,
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)}, fast_skip_tokens=r.choice((0, 1, 9)),
        validate_action_token_prefix=r.random() < 0.1, use_kv_cache=r.random() < 0.7, use_relative_actions=d_state >= d_action and r.random() < 0.3)
    lm = pi.gemma(r.choice((16, 24, 36, 40)), r.randint(1, 4), kv * r.choice((1, 2, 4, 8)), kv, d_head, r.choice((32, 50)))
    vision = pi.tower(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)))
    low = r.choice((-80, -40, -150))
    fast = pi0_fast.Fast(-2 * low, low, r.choice((10, 5, 12.5)))
    return cases.Case(seed, frames, r.choice(TEXTS), pi0_fast.Checkpoint(policy, vision, lm, views, d_state, d_action, fast))


def draw_evo1(seed):
    """The same for Evo-1, in either published layout: three slots for views, rows of absent ones and of pads masked or not."""
    r = random.Random(f"evo1 {seed}")
    grid, kv, vision_heads = 2 * r.choice((1, 2, 2, 3)), r.choice((1, 2, 3)), r.choice((1, 2, 3, 5))
    heads = kv * r.choice((1, 2, 3))
    d_model = heads * r.choice((8, 12, 16))
    kept, d_state, d_action = r.randint(1, 4), r.randint(1, 24), r.randint(1, 24)
    vision = evo1.tower(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)), layer_norm_eps=r.choice((1e-6, 1e-5)))
    text = evo1.decoder(d_model, kept + r.choice((0, 0, 2)), heads, kv, r.choice((32, 50)), rope_theta=r.choice((1e4, 1e6)), rms_norm_eps=r.choice((1e-6, 1e-5)))
    head = evo1.head(r.randint(1, 3), r.choice([n for n in (1, 2, 3, 4, 6) if d_model % n == 0]), r.choice((20, 44)), r.choice((24, 36)))
    n_token = 3 * (grid // 2) ** 2 + r.choice((24, 40, 64))
    views = {f"cam{i}": (r.randint(12, 90), r.randint(12, 90)) for i in range(r.randint(1, 3))}
    frames = {view: (*size, r.choice(("png", "png", "jpg"))) for view, size in views.items()}
    if len(frames) > 1 and r.random() < 0.5:
        frames[r.choice(list(frames))] = None
    sizes, rest = (14 * grid, vision, text, kept, head), {"d_state": d_state, "d_action": d_action}
    words = r.choice(("go", "Pick up the red_cube!", "naïve café 漢字 n° 5", "word " * 20))
    if r.random() < 0.5:
        n_empty, width = sum(frame is None for frame in frames.values()), r.choice((0, 3))
        policy = evo1.policy(r.randint(1, 12), n_token, d_state + width, d_action + width, num_inference_timesteps=r.choice((1, 4, 10)),
                             vlm_dtype=r.choice(("float32", "bfloat16")), max_views=3, empty_cameras=n_empty,
                             normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)})
        frames |= {f"empty_camera_{i}": None for i in range(n_empty)}
        return cases.Case(seed, frames, words, evo1.Checkpoint("lerobot", *sizes, policy, views, **rest))
    keys, revision = r.choice((("sawyer",), ("aloha_joint", "robotwin_stack"))), r.choice(("r1", "r2"))
    normalization = r.choice(("bounds", "bounds_q99", "normal")) if len(keys) > 1 and revision == "r2" else "bounds"
    options = evo1.said(revision, r.choice(("zero_attention", "causal_attention")), views)
    checkpoint = evo1.Checkpoint("authors", *sizes, evo1.policy(r.randint(1, 12), n_token), views, **rest, normalization=normalization, keys=keys)
    return cases.Case(seed, frames, words, checkpoint, options=options)


def draw_bitvla(seed):
    """(case, spelling of the model's type): micro and tiny sizes, one view or two, files of one process and of several."""
    r = random.Random(seed)

    def tower(n_head, d_head, **others):
        return bitvla.sizes(n_head * d_head, 4 * r.choice((6, 7, 12, 17, 68, 92)), r.randint(1, 3), n_head, **others)

    vision = tower(r.choice((1, 2, 3, 6)), r.choice((4, 8, 12, 24)), image_size=14 * r.choice((1, 2, 3, 4)))
    kv = r.choice((1, 2, 3))
    text = tower(kv * r.choice((1, 2, 4)), r.choice((4, 8, 16)), num_key_value_heads=kv)
    prefixes = tuple(r.choice(("", "module.")) for _ in range(2))
    checkpoint = bitvla.Checkpoint(vision, text, n_shard=r.choice((1, 2, 3)), prefixes=prefixes)
    cameras = r.choice((("image", "image2"), ("wrist",)))
    options = {} if len(cameras) == 2 else {"views": list(cameras)}
    words = r.choice(("open the drawer", "Put the WHITE mug on the plate", "don't 12345 stop!", "naïve café 漢字", "a", "word " * 20))
    return bitvla.case(seed, cameras, words, checkpoint, **options), r.choice(("bitvla", "openvla"))


def draw_act(seed):
    """The same for ACT: towers have one width, everything else is drawn; in one of ten a width that positions cannot be told in."""
    r = random.Random(f"act {seed}")
    heads = r.choice((1, 2, 3, 4, 5))
    d_model = 4 * heads * r.choice((1, 2, 3, 5)) if r.random() < 0.9 else 2 * heads * r.choice((3, 5, 7))
    height, width = r.randint(12, 80), r.randint(12, 80)
    frames = {f"cam{i}": (height, width, r.choice(("png", "png", "jpg"))) for i in range(r.randint(1, 3))}
    old, n_environment = r.random() < 0.2, r.choice((0, 0, 0, 1, 9))
    pixels = ("MEAN_STD",) if old else ("MEAN_STD", "MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10", "IDENTITY")
    states = ("MEAN_STD", "IDENTITY") if old else MODES
    modes = {"VISUAL": r.choice(pixels), "STATE": r.choice(states), "ACTION": r.choice(states)}
    if r.random() < 0.5:
        modes["ENV"] = r.choice(states)
    policy = act.policy(
        r.randint(1, 14), d_model, heads, r.choice((20, 50, 72)), (r.randint(1, 4), r.choice((1, 1, 2, 3)), r.randint(1, 2)),
        vision_backbone=r.choice(("resnet18", "resnet18", "resnet34")), pre_norm=r.random() < 0.4, use_vae=r.random() < 0.7,
        feedforward_activation=r.choice(("relu", "relu", "gelu")), latent_dim=r.choice((8, 32)), normalization_mapping=modes)
    checkpoint = act.Checkpoint(policy, {view: frame[:2] for view, frame in frames.items()}, r.randint(1, 20), r.randint(1, 20), n_environment,
                                exact=False, imagenet=r.random() < 0.5, dtype=r.choice(("F32", "F32", "BF16")), old=old)
    return act.case(seed, frames, checkpoint)


def draw_diffusion(seed):
    """The same for Diffusion Policy: scheduler, moments, cameras or none, norms, sizes of the U-Net; in one of ten a config that the reference
    refuses or cannot run."""
    r = random.Random(f"diffusion {seed}")
    levels, groups = r.randint(1, 4), r.choice((1, 2, 4, 8))
    widths = [8 * r.randint(1, 4) if i == 0 or groups == 8 else groups * r.randint(1, 10) for i in range(levels)]
    horizon = max(4, 2**levels * r.randint(1, 3))  # a norm of two values is their order
    moments = min(r.choice((1, 2, 2, 3, 4)), horizon)
    height, width = r.randint(20, 80), r.randint(20, 80)
    cameras, n_environment = {f"cam{i}": (height, width) for i in range(r.choice((0, 1, 1, 2, 3)))}, r.choice((0, 0, 1, 9))
    n_environment = n_environment or (0 if cameras else 5)
    n_train = r.choice((5, 20, 50, 100))
    scheduler = r.choice(("DDPM", "DDPM", "DDIM"))
    sized = {}
    if cameras and r.random() < 0.4:
        sized = {"resize_shape": [r.randint(20, 70), r.randint(20, 70)], "crop_ratio": r.choice((1.0, 0.9, 0.76, 0.5))}
    elif r.random() < 0.5:
        sized = {"crop_shape": [r.randint(12, height), r.randint(12, width)]}
    old = bool(cameras) and not n_environment and r.random() < 0.2
    states = ("MEAN_STD", "MIN_MAX") if old else MODES
    modes = {"VISUAL": r.choice(("MEAN_STD",) if old else ("MEAN_STD", "MEAN_STD", "MIN_MAX", "QUANTILES", "IDENTITY")),
             "STATE": r.choice(states), "ACTION": r.choice(states)}
    if n_environment:
        modes["ENV"] = r.choice(MODES)
    policy = diffusion.sizes(
        horizon, r.randint(1, horizon - moments + 1), widths, 2 * r.randint(2, 9), groups, r.randint(1, 9), n_obs_steps=moments,
        kernel_size=r.choice((1, 3, 5, 5, 7)), use_film_scale_modulation=r.random() < 0.6, use_group_norm=r.random() < 0.5,
        use_separate_rgb_encoder_per_camera=r.random() < 0.5, vision_backbone=r.choice(("resnet18", "resnet18", "resnet34")),
        noise_scheduler_type=scheduler, num_train_timesteps=n_train, num_inference_steps=r.choice((None, r.randint(1, n_train))),
        beta_schedule=r.choice(("squaredcos_cap_v2", "squaredcos_cap_v2", "linear", "scaled_linear", "sigmoid")),
        beta_start=r.choice((0.0001, 0.001)), beta_end=r.choice((0.02, 0.05)), prediction_type=r.choice(("epsilon", "epsilon", "sample")),
        clip_sample=r.random() < 0.7, clip_sample_range=r.choice((1.0, 0.5, 3.0)), normalization_mapping=modes, **sized)
    checkpoint = diffusion.Checkpoint(policy, cameras, r.randint(1, 12), r.randint(1, 12), n_environment, exact=False,
                                      dtype=r.choice(("F32", "F32", "BF16")), old=old)
    return diffusion.case(seed, (r.choice(("png", "png", "jpg")),), checkpoint)


def draw_turbovla(seed):
    """The same for TurboVLA, whose instruction may have letters of every kind; in one of ten an image that patches do not fill."""
    r = random.Random(f"turbovla {seed}")
    vision_heads, text_heads, heads, patch = r.choice((1, 2, 3)), r.choice((1, 2, 3, 5)), r.choice((1, 2, 3, 5)), r.choice((4, 5, 8, 14))
    side, n_position = patch * r.randint(1, 5) + (r.random() < 0.1), r.choice((12, 20, 40))
    frames = {f"cam{i}": (r.randint(12, 90), r.randint(12, 90), r.choice(("png", "png", "jpg"))) for i in range(r.randint(1, 4))}
    if r.random() < 0.2:
        frames = {view: (side, side, "png") for view in frames}
    vision = turbovla.vision(4 * vision_heads * r.choice((2, 3, 5)), r.randint(1, 4), vision_heads, r.choice((20, 36, 50)), patch, r.choice((0, 1, 4, 4)),
                             layer_norm_eps=r.choice((1e-5, 1e-6)), rope_theta=r.choice((100.0, 100.0, 37.5, 1e4)))
    text = turbovla.text(4 * text_heads * r.choice((1, 2, 3)), r.randint(1, 4), text_heads, r.choice((20, 36, 50)), n_position)
    policy = turbovla.policy(
        r.randint(1, 14), 4 * heads * r.choice((1, 2, 3)), heads, r.choice((20, 50, 72)), (r.randint(1, 4), r.randint(1, 4)), side,
        max_language_tokens=r.randint(3, n_position), feedforward_activation=r.choice(("relu", "relu", "gelu")),
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)})
    checkpoint = turbovla.Checkpoint(vision, text, policy, {view: frame[:2] for view, frame in frames.items()}, r.choice((0, 1, 7, 20)), r.randint(1, 20),
                                     dtype=r.choice(("F32", "F32", "BF16")))
    return cases.Case(seed, frames, r.choice((*TEXTS, "Ouvre le TIROIR à côté de l'évier, 한국어 Ⅷ ﬁn", "[SEP]a[MASK] [cls]")), checkpoint)


SENTENCES = ("open the drawer", "open the drawer. put the bowl inside", "close it? now. ", "put the bowl on the plate.", ". ? .", "[SEP] a [PAD] b [CLS]",
             "word " * 40)


def draw_turbovla_authors(seed):
    """The same for TurboVLA of its authors: sentences, rows of padding, residuals, places."""
    r = random.Random(f"turbovla_authors {seed}")
    vision_heads, text_heads, heads, patch = r.choice((1, 2, 3)), r.choice((1, 2, 3, 5)), r.choice((1, 2, 3, 4, 6)), r.choice((4, 5, 8, 14))
    side, n_position, n_view = patch * r.randint(1, 4), r.choice((20, 40)), r.randint(1, 3)
    views = [f"cam{i}" for i in range(n_view)]
    vision = turbovla.vision(4 * vision_heads * r.choice((2, 3, 5)), r.randint(1, 3), vision_heads, r.choice((20, 36, 50)), patch, r.choice((0, 1, 4, 4)),
                             layer_norm_eps=r.choice((1e-5, 1e-6)), rope_theta=r.choice((100.0, 37.5)))
    text = turbovla.text(4 * text_heads * r.choice((1, 2, 3)), r.randint(1, 3), text_heads, r.choice((20, 36, 50)), n_position)
    words = r.choice((*TEXTS, *SENTENCES, *SENTENCES))
    n_row = r.choice((None, r.randint(3, n_position), r.randint(10, n_position), n_position))
    own = {words: r.randint(3, n_row), "another one": 3} if n_row and r.random() < 0.5 else {}
    texts = {"max_length": n_row or r.randint(3, n_position), "padding_length": n_row, "padding_length_by_instruction": own,
             "sub_sentence_present": r.random() < 0.8, "zero_padded_tokens": r.random() < 0.3}
    style = {"padding_strategy": r.choice(("key_padding_mask", "zero_fill")), "residual_style": r.choice(("normalized", "pre_norm")),
             "attention_backend": r.choice(("manual", "sdpa"))}
    inner = 4 * max(1, heads // 2) * r.choice((1, 2, 5))
    fusion = (4 * heads * max(1, heads // 2) * r.choice((1, 2)), heads, r.randint(1, 3), r.choice((20, 50)), inner, style)
    action = (r.randint(1, 14), r.randint(1, 4), r.randint(1, 3), r.choice((16, 44)), r.choice((20, 36)))
    parts = turbovla_authors.parts(side, fusion, action, texts, position_embedding=r.choice(("view", "learned_patch")),
                                   encode_views_separately=r.random() < 0.5)
    checkpoint = turbovla_authors.Checkpoint(vision, text, parts, tuple(views))
    options = {"vision_tokens": turbovla_authors.tokens_read(), "views": views}
    return cases.Case(seed, {view: (side, side, "png") for view in views}, words, checkpoint, options=options)


def draw_openvla(seed):
    """The same for OpenVLA: widths of both towers, sides, heads that share keys, bins, numbers of an action, statistics, shards."""
    r, openvla.MARGIN = random.Random(f"openvla {seed}"), 0.0  # tokens that rounding changes would show
    kv, d_head = r.choice((1, 2, 3)), r.choice((4, 6, 8, 16))
    heads = kv * r.choice((1, 2, 3))
    towers = [openvla.Tower(16 * r.choice((1, 2, 3, 4)), r.randint(2, 5), r.randint(10, 70)) for _ in range(2)]
    text = openvla.decoder(heads * d_head, r.randint(1, 4), heads, kv, r.choice((20, 36, 50)), rms_norm_eps=r.choice((1e-6, 1e-5)),
                           rope_theta=r.choice((10000.0, 500.0)))
    d_action = r.randint(1, 9)
    unmasked = r.choice((None, (), (d_action - 1,), tuple(i for i in range(d_action) if r.random() < 0.4)))
    others = r.choice(((), ("fractal20220817_data", "taco_play")))
    checkpoint = openvla.Checkpoint(*towers, text, 14 * r.choice((1, 2, 2, 3)), d_action, r.choice((256, 256, 17, 100)), r.choice((1, 1, 3)),
                                    r.random() < 0.3, others, unmasked)
    frame = r.randint(10, 90), r.randint(10, 90), r.choice(("png", "png", "jpg"))
    return openvla.case(seed, frame, r.choice((*TEXTS, "", "Pick UP the <s> cube</s> \u2581", "<PAD>")), checkpoint, **({"stats": "bridge_orig"} if others else {}))


def draw_openvla_oft(seed):
    """The same for OpenVLA-OFT: OpenVLA's sizes, cameras, platforms and others, states, FiLM with LoRA, diffusion, files of one process and of several."""
    r = random.Random(f"openvla_oft {seed}")
    kv, d_head = r.choice((1, 2, 3)), r.choice((4, 6, 8, 16))
    heads = kv * r.choice((1, 2, 3))
    towers = [openvla.Tower(16 * r.choice((1, 2, 3, 4)), r.randint(2, 4), r.randint(10, 70)) for _ in range(2)]
    text = openvla.decoder(heads * d_head, r.randint(1, 4), heads, kv, r.choice((20, 36, 50)), rms_norm_eps=r.choice((1e-6, 1e-5)),
                           rope_theta=r.choice((10000.0, 500.0)))
    platform = r.choice((*openvla_oft.PLATFORMS, *(f"{r.randint(1, 12)},{norm}" for norm in ("bounds", "bounds_q99"))))
    known = {"libero": (7, 8), "aloha": (14, 14), "bridge": (7, 7)}
    d_action, d_state = known.get(platform, (r.randint(1, 9), r.randint(1, 9)))
    side, views, plain = 14 * r.choice((1, 2, 2, 3)), [f"cam{i}" for i in range(r.randint(1, 3))], platform != "aloha" and r.random() < 0.3
    train = r.choice((50, 50, 7, 100))
    checkpoint = openvla_oft.Checkpoint(
        *towers, text, side, d_action, n_shard=r.choice((1, 3)), other_stats=r.choice(((), ("other",))),
        unmasked=r.choice((None, (), (d_action - 1,), tuple(i for i in range(d_action) if r.random() < 0.4))), d_state=r.choice((d_state, d_state, 0)),
        platform=platform, rank=r.choice((0, 0, 4, 20, 32)), steps=r.choice(((), (), (train, r.randint(1, min(train, 5))))), prefix=r.choice(("", "module.")))
    frames = {view: (side, side, "png") if plain else (r.randint(10, 90), r.randint(10, 90), r.choice(("png", "png", "jpg"))) for view in views}
    options = {"plain_images": True} if plain else {}
    return openvla_oft.case(seed, frames, r.choice((*TEXTS, "", "Pick UP the <s> cube</s> \u2581", "<PAD>")), checkpoint,
                            **options, **({"stats": openvla_oft.STATISTICS} if checkpoint.other_stats else {}))


def draw_vla_adapter(seed):
    """The same for VLA-Adapter: both heads, up to three cameras, so many patches that the rows of the task end before, at or behind the image's."""
    r = random.Random(f"vla_adapter {seed}")
    is_pro, kv = r.random() < 0.5, r.choice((1, 1, 2, 3))
    heads = kv * r.choice((1, 2, 4))
    d_model = next(heads * d_head for d_head in (8, 16, 24, 2, 4) if heads * d_head % (16 if is_pro else 8) == 0) if r.random() < 0.9 else 12 * heads
    towers = [vla_adapter.Tower(16 * r.choice((1, 2, 3)), r.randint(2, 4), r.randint(10, 60)) for _ in range(2)]
    text = vla_adapter.decoder(d_model, r.randint(1, 4), heads, kv, r.choice((20, 36, 50)), rms_norm_eps=r.choice((1e-6, 1e-5)),
                               rope_theta=r.choice((1e6, 1e4)))
    n_view = r.choice((1, 2, 2, 3))
    side = 14 * r.choice((1, 2, 3, 4, {1: 22, 2: 16, 3: 13}[n_view], {1: 24, 2: 17, 3: 14}[n_view]))
    others = r.choice(((), ("libero_goal_no_noops",)))
    checkpoint = vla_adapter.Checkpoint(
        *towers, text, side, is_pro=is_pro, platform=r.choice(("libero", "calvin")), n_shard=r.choice((1, 1, 3)), step=r.choice(("", "150000_", "latest_")),
        prefixes=tuple(r.choice(("", "module.")) for _ in range(2)), has_language_head=r.random() < 0.5, other_stats=others)
    views = ("third_person", "wrist", "left_wrist")[:n_view] if n_view != 2 or r.random() < 0.5 else ()
    frame = (r.randint(12, 90), r.randint(12, 90), r.choice(("png", "png", "jpg"))) if r.random() < 0.6 else ()
    return vla_adapter.case(seed, r.choice((*TEXTS, "", "Pick UP the <tool_call> cube<|im_start|>")), checkpoint, views, frame,
                            **({"stats": vla_adapter.STATISTICS[checkpoint.platform]} if others else {}))


def draw_vla_jepa(seed):
    """The same for VLA-JEPA: prompts, tokens, cameras, steps of the pipeline; in one of ten an instruction that the backbone takes an image for."""
    r = random.Random(f"vla_jepa {seed}")
    heads, kv, d_head = r.choice(((4, 2, 8), (3, 1, 12), (6, 3, 8), (5, 5, 8), (2, 2, 16), (1, 1, 12)))
    vision_heads, depth, side, n_view = r.choice((1, 2, 3)), r.randint(3, 5), 8 * r.choice((2, 3, 4)), r.randint(1, 3)
    deepstack = sorted(r.sample(range(depth), r.choice((1, 2, 3))))
    sizes = (gr00t_n1_7.vision(vision_heads * 4 * r.choice((2, 3, 4)), depth, vision_heads, 2 * r.randint(8, 20), r.randint(3, 7), deepstack),
             gr00t_n1_7.text(2 * r.randint(6, 18), r.randint(4, 6), heads, kv, d_head, r.choice((32, 50)), {8: (2, 1, 1), 12: (2, 2, 2), 16: (4, 2, 2)}[d_head])
             | r.choice(({}, {"vocab_size": gr00t_n1_7.N_VOCAB + 60})))
    frames = {f"cam{i}": (r.randint(12, 60), r.randint(12, 60), r.choice(("png", "png", "jpg"))) for i in range(n_view)}
    area = [r.randint(10, 40), r.randint(10, 40)] if r.random() < 0.6 else None
    if area is None:
        frames = {view: (*frames["cam0"][:2], frame[2]) for view, frame in frames.items()}
    world_model, video = r.random() < 0.5, r.choice((4, 6, 8))
    modes = {"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)}
    flags = {key: r.random() < 0.6 for key in ("clip_normalized_actions", "pre_snap_gripper_action", "binarize_gripper_action")}
    policy = vla_jepa.policy(
        r.randint(1, 12), r.choice((1, 2, 4, 7)), r.choice(((2, 6), (3, 4), (1, 10), (None, None))), r.randint(1, 5), r.randint(6, 30), r.randint(1, 12),
        action_model_type="DiT-test", resize_images_to=area, enable_world_model=world_model, num_video_frames=video, torch_dtype=r.choice(("float32", "bfloat16")),
        num_action_tokens_per_timestep=r.randint(1, 8), normalization_mapping=modes, action_num_timestep_buckets=r.choice((1000, 1000, 100)),
        prompt_template=r.choice((vla_jepa.PROMPT, vla_jepa.SHORT, "{instruction}{e_actions}", "{actions} {instruction}\n{e_actions}!")), **flags)
    checkpoint = vla_jepa.Checkpoint(*sizes, policy, {view: frame[:2] for view, frame in frames.items()}, r.choice((0, 1, 7, 20)), r.randint(1, 12), side,
                                     tubelet=r.choice((1, 2)), dtype=r.choice(("BF16", "BF16", "F32")), prunes=r.choice(("embed_tokens", "lm_head", "")))
    text = r.choice((*TEXTS, "{actions} of %s {0}")) if r.random() < 0.9 else "go<|placeholder|>"
    return cases.Case(seed, frames, text, checkpoint)


def draw_xvla(seed):
    """The same for X-VLA: stages, windows and groups of every size, all action spaces, both spellings of the backbone; in one of ten more
    tokens than positions."""
    r = random.Random(f"xvla {seed}")
    n_stage = r.randint(1, 4)
    heads = [r.choice((1, 2, 3)) for _ in range(n_stage)]
    widths = [h * g for h, g in zip(heads, [2 * r.choice((2, 3, 4, 5)) for _ in range(n_stage)])]
    groups = [r.choice([g for g in (1, 2, 3, 4, 6, 8) if w % g == 0]) for w in widths]
    patch = [r.choice((3, 5, 7)), *(r.choice((1, 3, 3)) for _ in range(3))]
    stride, prenorm = [r.choice((2, 3, 4)), *(r.choice((1, 2, 2)) for _ in range(3))], [r.random() < 0.5 for _ in range(4)]
    lm_heads = r.choice((1, 2, 3))
    d_lm = 4 * lm_heads * r.choice((1, 2, 3))
    vision = xvla.vision(widths, [r.randint(1, 2) for _ in widths], heads, groups, r.choice((2, 3, 4, 12)), d_lm, patch, stride[:n_stage], prenorm,
                         mlp_ratio=r.choice((2.0, 4.0, 1.3)))
    mode, frames = r.choice(("ee6d", "ee6d", "auto", "joint", "agibot_ee6d", "franka_joint7", "so101_bimanual")), {}
    for i in range(r.randint(1, 4)):
        frames[f"cam{i}"] = (r.randint(12, 50), r.randint(12, 50), r.choice(("png", "png", "jpg"))) if i == 0 or r.random() < 0.8 else None
    size = (r.randint(12, 36), r.randint(12, 36))
    resizes = r.random() < 0.8
    if not resizes:
        frames = {view: frame and (*size, "png") for view, frame in frames.items()}
    reads_state = mode in ("ee6d", "joint", "so101_bimanual") or r.random() < 0.6
    d_action = r.randint(1, 9) if mode == "auto" else xvla.OUTPUTS[mode]
    columns = {"auto": d_action + r.randint(0, 3), "joint": 14}.get(mode, 20)
    d_state = r.choice((7, 12, 20)) if reads_state else 0
    max_state = 20 if mode == "so101_bimanual" else max(20, d_state) + r.randint(0, 4)
    head = r.choice((1, 2, 4))
    more = {"resize_imgs_with_padding": size if resizes else None, "action_mode": mode, "max_action_dim": columns, "use_proprio": reads_state,
            "max_state_dim": max_state, "num_image_views": r.choice((None, None, 1, 4)), "empty_cameras": r.choice((0, 0, 1)) if resizes else 0,
            "use_hetero_proj": r.random() < 0.3, "len_soft_prompts": r.choice((0, 1, 5)), "dim_time": r.choice((4, 7, 32)), "mlp_ratio": r.choice((4.0, 1.7)),
            "tokenizer_max_length": r.randint(4, 40), "pad_language_to": r.choice(("max_length", "max_length", "longest")),
            "max_len_seq": r.choice((1500, 1500, 1500, 60)),
            "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": r.choice(("IDENTITY", *MODES)), "ACTION": r.choice(("IDENTITY", *MODES))}}
    policy = xvla.policy(r.randint(1, 9), r.choice((1, 2, 5, 10)), 4 * head * r.choice((1, 2, 3)), r.randint(1, 4), head, **more)
    views = {view: frame[:2] if frame else size for view, frame in frames.items()}
    text = xvla.text(d_lm, r.randint(1, 3), lm_heads, r.choice((12, 30, 50)), r.choice((900, 900, 900, 40)))
    checkpoint = xvla.Checkpoint(vision, text, policy, views, d_state, d_action, r.randint(0, 2), dtype=r.choice(("F32", "F32", "BF16")),
                                 vendored=r.random() < 0.4)
    return cases.Case(seed, frames, r.choice((*TEXTS, "Ouvre le TIROIR à côté de l'évier, 한국어 Ⅷ ﬁn", "</s>a<mask>  <pad>it's")), checkpoint)


# Of what a part of BitVLA reads: names of values that the reference records. A whole block starts from the one before.
INPUTS = [(r"(.*)\.attn_[qkv]", r"\1.attn_norm"), (r"(lm\..*)\.attn_out", r"\1.attn_sub_norm"), (r"(.*)\.ffn_(up|gate)", r"\1.ffn_norm"),
          (r"(lm\..*)\.ffn_down", r"\1.ffn_sub_norm"), (r"lm\.blk\.0(\.attn_norm)?", "prefix"), (r"vision\.patch_embed", "pixels"),
          (r"state_out", "state"), (r"step\.0\.head\.in", "step.0.head.in_norm"), (r"step\.0\.head\.blk\.0", "step.0.head.in"),
          (r"step\.0\.head\.out", "step.0.head.out_norm")]
PRODUCT = re.compile(r"(vision|lm)\.blk\.0\.(attn_[qkv]|ffn_(up|gate|down))|lm\.blk\.0\.attn_out")
BLOCK = re.compile(r"(vision|lm)\.blk\.\d+")


def input_of(name, taps):
    before = re.fullmatch(r"(.*\.blk\.)(\d+)", name)
    if before and before[2] != "0":
        return before[1] + str(int(before[2]) - 1)
    last = {"connector_down": "vision.blk.", "lm.norm": "lm.blk.", "step.0.head.out_norm": "step.0.head.blk."}.get(name)
    if last:
        return max((n for n in taps if re.fullmatch(re.escape(last) + r"\d+", n)), key=lambda n: int(n.rpartition(".")[2]))
    return next((re.sub(pattern, found, name) for pattern, found in INPUTS if re.fullmatch(pattern, name)), None)


def compare_bitvla(seed, vla, folder):
    case, spelling = draw_bitvla(seed)
    bitvla.MARGIN = -1.0  # parts are compared, each on its own input
    expected, stopped = run_reference(case, folder)
    config = folder / "checkpoint" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "model_type": spelling}))
    got, refused = run_runtime(vla, folder, "bf16")
    if expected is None or got is None:
        return expected is None and got is None, f"reference: {stopped or 'runs'}; {refused or 'the runtime runs'}"
    parts = {}
    for name in expected:
        if found := input_of(name, expected):
            parts.setdefault(found, []).append(name)
    far = {"product": (0.0, "none"), "part": (0.0, "none"), "block": (0.0, "none")}
    for given, names in parts.items():
        recorder.write_taps(folder / "inject.gguf", {given: expected[given]}, "vla-taps")
        taps = run_vla(vla, folder, folder / "bundle.gguf", ",".join(names), folder / "taps.gguf", 1, folder / "inject.gguf")[0]
        for name in names:
            kind = "product" if PRODUCT.fullmatch(name) else "block" if BLOCK.fullmatch(name) else "part"
            ours, theirs = taps[name].ravel().astype(float), expected[name].ravel().astype(float)
            off = np.sqrt(((ours - theirs) ** 2).mean() / (theirs**2).mean()) if kind == "block" else distance(ours, theirs)[1]
            far[kind] = max(far[kind], (float(off), name))
    agree = far["product"][0] <= 1e-6 and far["part"][0] <= 1e-5 and far["block"][0] <= 2e-2
    end = distance(got["chunk"].ravel(), expected["chunk"].ravel())[1]
    text = ", ".join(f"{kind} {off:.1e} at {name}" for kind, (off, name) in far.items())
    return agree, f"{sum(map(len, parts.values()))} parts, worst {text}; chunk end to end {end:.1e} ({spelling}, {case.checkpoint.prefixes})"


def draw_gr00t_robot(arch, r, n_view):
    widths = {f"k{i}": r.choice((1, 2, 3, 4)) for i in range(r.randint(1, 4))}
    actions, relative, poses = dict(widths), {}, {}
    if arch != "gr00t_n1_5":
        relative = {key: None for key in widths if r.random() < 0.5}
        if r.random() < 0.4:
            kind = "XYZ_ROTVEC" if arch == "gr00t_n1_6" else "XYZ_ROT6D"
            widths["pose"] = actions["pose"] = 6 if kind == "XYZ_ROTVEC" else 9
            relative["pose"], poses["pose"] = None, kind
    mixed = arch == "gr00t_n1_6"  # LeRobot's N1.7 does not read these lists, and takes one moment of the state
    moments = r.choice(((0,), (0,), (-2, 0))) if mixed else (0,)
    mean_std = tuple(k for k in widths if mixed and k not in poses and r.random() < 0.3)
    return gr00t.Robot(tuple(f"cam{i}" for i in range(n_view)), widths, dict(r.sample(sorted(actions.items()), len(actions))), r.randint(1, 6), relative,
                       poses=poses, mean_std=mean_std, sin_cos=tuple(k for k in widths if mixed and r.random() < 0.2), per_step=r.random() < 0.5,
                       state_moments=moments)


def draw_gr00t(arch, seed):
    """The same for GR00T: square cameras, since an instruction's letters are cleaned and an aspect is checked elsewhere."""
    r = random.Random(f"{arch} {seed}")
    heads, kv, d_head = r.choice(((4, 2, 8), (3, 1, 12), (6, 3, 8), (5, 5, 8), (2, 2, 16)))
    vl_heads = r.choice((2, 3, 4))
    d_model, n_view = vl_heads * 2 * r.choice((4, 5, 6)), r.randint(1, 3)
    robot = draw_gr00t_robot(arch, r, n_view)
    every, steps = r.choice((1, 2, 2, 3)), r.choice((1, 2, 4, 5))
    vl = None if arch == "gr00t_n1_6" else (r.choice((1, 2, 3)), vl_heads, d_model // vl_heads)
    more = {} if arch == "gr00t_n1_5" else {"attend_text_every_n_blocks": every}
    kept, vision_heads = r.choice((4, 5)), r.choice((1, 2, 3))
    sizes = gr00t.head(kept, (r.randint(2, 7), r.choice((2, 3, 4)), 2 * r.choice((3, 4, 5))), vl, 2 * r.randint(4, 12),
                       2 * sum(robot.states.values()) + r.randint(0, 3), sum(robot.actions.values()) + r.randint(0, 3), robot.rows + r.randint(0, 3),
                       num_inference_timesteps=steps, **more)
    side, crop, camera = 8 * r.choice((2, 3, 4)), r.choice((0.8, 0.9, 0.95)), r.randint(12, 70)
    tower = vision_heads * 4 * r.choice((2, 3, 4)), r.randint(3, 5), vision_heads, 2 * r.randint(8, 20)
    text_sizes = d_model, kept + r.randint(0, 2), heads, kv, d_head, r.choice((32, 50))
    options = {}
    if arch == "gr00t_n1_7":
        sections = {8: (2, 1, 1), 12: (2, 2, 2), 16: (4, 2, 2)}[d_head]
        deepstack = sorted(r.sample(range(tower[1]), 3))
        parts = gr00t_n1_7.vision(*tower, r.randint(3, 7), deepstack), gr00t_n1_7.text(*text_sizes, sections)
        image = {"image_target_size": [side] * 2, "shortest_image_edge": side, "crop_fraction": crop}
        checkpoint = gr00t_n1_7.Checkpoint("robot", 1, robot, *parts, sizes, image, side, percentiles=r.random() < 0.5)
    elif arch == "gr00t_n1_6":
        parts = gr00t_n1_6.vision(*tower, r.randint(3, 9)), gr00t_n1_6.text(*text_sizes)
        image = {"shortest_image_edge": side + r.randint(-3, 3), "crop_fraction": crop}
        checkpoint = gr00t_n1_6.Checkpoint("robot", 1, robot, *parts, sizes, image, percentiles=r.random() < 0.5)
    else:
        parts = gr00t_n1_5.vision(*tower, 14 * r.choice((1, 2, 3)), r.choice((7, 14))), gr00t_n1_5.text(*text_sizes)
        modes = {key: r.choice(("min_max", "q99", "mean_std", None)) for key in robot.states}
        checkpoint = gr00t_n1_5.Checkpoint("robot", 1, robot, *parts, sizes, gr00t_n1_5.camera(camera, camera, modes, modes, crop), n_future=r.randint(1, 6))
        options = {"variant": "data_config.json"}
    frames = {view: (camera, camera, r.choice(("png", "png", "jpg"))) for view in robot.views}
    return gr00t.case(seed, frames, r.choice(("go", "Pick up the red cube!", "naïve café 漢字 n° 5", "word " * 20)), checkpoint, options=options)


def draw_groot(release, seed):
    """The same for GR00T as LeRobot saves it, by the statistics of a data set; frames are squeezed, and texts printed as a list."""
    r = random.Random(f"groot {release} {seed}")
    heads, kv, d_head = r.choice(((4, 2, 8), (3, 1, 12), (6, 3, 8), (5, 5, 8), (2, 2, 16)))
    vl_heads = r.choice((2, 3, 4))
    d_model, kept, vision_heads = vl_heads * 2 * r.choice((4, 5, 6)), r.choice((4, 5)), r.choice((1, 2, 3))
    d_state, d_action, size = r.randint(1, 14), r.randint(1, 14), (r.randint(12, 90), r.randint(12, 90))
    sizes = {view: size for view in r.sample(("front", "wrist", "cam_high", "Top", "hand", "left_wrist"), r.randint(1, 3))}
    vl = r.choice((1, 2, 3)), vl_heads, d_model // vl_heads
    head = gr00t.head(kept, (r.randint(2, 7), r.choice((2, 3, 4)), 2 * r.choice((3, 4, 5))), vl, 2 * r.randint(4, 12), d_state + r.randint(0, 4),
                      d_action + r.randint(0, 4), r.randint(1, 9), num_inference_timesteps=r.choice((1, 2, 4, 5)))
    tower = vision_heads * 4 * r.choice((2, 3, 4)), r.randint(3, 5), vision_heads, 2 * r.randint(8, 20)
    text = d_model, kept + r.randint(0, 2), heads, kv, d_head, r.choice((32, 50))
    more = {"zero_spread": (0,) if r.random() < 0.3 else (), "stored_head": r.random() < 0.5}
    drawn = groot.DRAWN[release](r, sizes, d_state, d_action, tower, text, head, more)
    words = r.choice((*TEXTS, "the robot's \"cup\" \\ here", 'a "cup"', "a\u200bb\x7f\u00ad", "", "word " * 20))
    return cases.Case(seed, groot.frames(drawn.sizes, r.choice(("png", "png", "jpg"))), words, drawn, options=groot.OPTIONS)


def add_low_bits(file, seed):
    """Moves every weight by up to half a percent, to float32 numbers such as training leaves."""
    import torch
    from safetensors.torch import load_file, save_file

    generator = torch.Generator().manual_seed(seed)
    tensors = {n: t.float() * (1 + 0.01 * (torch.rand(t.shape, generator=generator) - 0.5)) for n, t in load_file(file).items()}
    save_file(tensors, file, metadata={"format": "pt"})


def run_reference(case, folder, low_bits=False):
    """(taps, None), or (None, why the reference stops)."""
    cases.write_checkpoint(case, folder)
    cases.write_observation(case, folder)
    if low_bits:
        add_low_bits(folder / "checkpoint" / "model.safetensors", case.seed)
    try:
        return recorder.run_case(folder), None
    except (RuntimeError, ValueError, AssertionError, IndexError) as error:
        return None, f"{type(error).__name__} {error}".splitlines()[0][:90]


def run_runtime(vla, folder, dtype="f32", kernels="float32"):
    """(taps, None), or (None, who refuses and why)."""
    message = io.StringIO()
    try:
        with contextlib.redirect_stderr(message):
            cases.write_bundle(folder, dtype=dtype)
    except SystemExit as stopped:
        return None, f"vla-convert ({stopped.code}): {message.getvalue().strip()[:200]}"
    try:
        return run_vla(vla, folder, folder / "bundle.gguf", "*", folder / "taps.gguf", threads=1, kernels=kernels)[0], None
    except subprocess.CalledProcessError as error:
        if error.returncode < 0:  # a signal is a crash, not a refusal
            raise
        return None, f"vla ({error.returncode})"


def judge(expected, got):
    """(whether they agree, worst block and its distance)."""
    shared = [n for n, x in expected.items() if n in got and np.abs(x).max() > 0]
    misshapen = [n for n in shared if got[n].size != expected[n].size]
    if misshapen or not {"actions", "prefix"} <= set(shared):
        return False, f"shapes differ at {', '.join(misshapen) or 'too few blocks'}"
    far = {n: distance(got[n].ravel(), expected[n].ravel())[1] for n in shared}
    worst = max(far, key=far.get)
    return far[worst] <= TOLERANCE, f"actions {far['actions']:.1e}, worst of {len(far)} blocks {far[worst]:.1e} at {worst}"


def judge_rounding(expected, got, published):
    """By the actions, or by the logits of the first token: a token is another one or the same, and one that is another changes those behind it."""
    what = "logits" if "logits" in expected else "actions"
    ours, theirs = (distance(run[what].ravel(), expected[what].ravel())[1] for run in (got, published))
    return ours <= theirs, f"{what} {ours:.1e}, of the reference in published dtypes {theirs:.1e}"


DRAWN = {"act": draw_act, "diffusion": draw_diffusion, "openvla": draw_openvla, "openvla_oft": draw_openvla_oft, "pi0_fast": draw_pi0_fast, "turbovla": draw_turbovla, "turbovla_authors": draw_turbovla_authors, "vla_adapter": draw_vla_adapter, "vla_jepa": draw_vla_jepa, "xvla": draw_xvla, "smolvla": draw, "evo1": draw_evo1} | {
    arch: functools.partial(draw_family, arch)
    for draw_family, archs in ((draw_pi, ("pi0", "pi05")), (draw_gr00t, ("gr00t_n1_5", "gr00t_n1_6", "gr00t_n1_7"))) for arch in archs} | {
    f"groot_{release}": functools.partial(draw_groot, release) for release in groot.DRAWN}


def compare(arch, seed, vla, folder, dtype):
    """`dtype` of the bundle: f32, or bf16 or stored to compare what rounding costs."""
    if arch == "bitvla":
        return compare_bitvla(seed, vla, folder)
    with contextlib.redirect_stdout(io.StringIO()):  # the reference tells how many layers it keeps
        drawn = DRAWN[arch](seed)
        expected, stopped = run_reference(drawn, folder, low_bits=dtype == "bf16")
        published = recorder.run_case(folder, "published") if dtype != "f32" and expected else None
    got, refused = run_runtime(vla, folder, dtype, kernels="" if dtype == "stored" else "float32")
    if expected is None or got is None:
        return expected is None and got is None, f"reference: {stopped or 'runs'}; {refused or 'the runtime runs'}"
    return judge_rounding(expected, got, published) if published else judge(expected, got)


def compare_leftover(arch, seed, folder):
    """The chunk of a guided policy."""
    import vla_cpp

    with contextlib.redirect_stdout(io.StringIO()):
        expected, stopped = run_reference(DRAWN[arch](seed), folder)
    if expected is None:
        return True, f"reference: {stopped}"
    cases.write_bundle(folder, dtype="f32")
    horizon, d_action = expected["chunk"].shape
    r, draw_rows = random.Random(seed), np.random.default_rng(seed)
    n_row = r.randint(1, horizon)
    delay, schedule, guidance = r.randint(0, n_row), r.choice(rtc.SCHEDULES), r.choice((0.5, 1.0, 5.0, 10.0))
    rows = draw_rows.normal(0, 0.5, (n_row, d_action)).astype(np.float32)
    if (folder / "checkpoint/norm_stats.json").is_file():
        return True, "the authors' server of Evo-1 has no real-time chunking"
    with contextlib.redirect_stdout(io.StringIO()):
        wanted = rtc.chunk_of(folder, rows, schedule, delay, guidance)
    seen = json.loads((folder / "observation.json").read_text())
    images = {view: file and (folder / file).read_bytes() for view, file in seen["images"].items()}
    with vla_cpp.Policy(folder / "bundle.gguf", kernels="float32", threads=1) as policy:
        if not policy.spec.real_time_chunking:
            return True, "relative actions: the runtime refuses real-time chunking"
        named = {state.name.removeprefix("observation."): seen["state"] for state in policy.spec.states}
        state = seen["state"] if isinstance(seen["state"], dict) else named
        chunk = policy.act(images=images, state=state, text=seen["text"], noise=np.load(folder / "noise.npy"),
                           leftover=vla_cpp.Leftover(rows, delay, schedule, guidance)).normalized
    far, moved = (np.abs(x - wanted).max() / np.abs(wanted).max() for x in (chunk, expected["chunk"]))
    return far <= TOLERANCE, f"{n_row} of {horizon} rows, delay {delay}, {schedule}, at most {guidance}: {far:.1e}; moved by {moved:.1e}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arch", choices=(*DRAWN, "bitvla"))
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    costs = parser.add_mutually_exclusive_group()
    costs.add_argument("--bf16", action="store_const", const="bf16", dest="dtype", default="f32", help="what rounding the weights costs, instead of every block")
    costs.add_argument("--stored", action="store_const", const="stored", dest="dtype", help="what rounding activations costs, with weights as published")
    costs.add_argument("--leftover", action="store_true", help="real-time chunking (smolvla, pi0, pi05, evo1)")
    parser.add_argument("--keep", type=Path, help="folder for the cases, instead of one that is removed")
    args = parser.parse_args()
    if args.arch != "bitvla":
        recorder.open_reference()
    warnings.filterwarnings("ignore")
    n_wrong = 0
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(args.first, args.last + 1):
            folder = (args.keep or Path(scratch)) / str(seed)
            folder.mkdir(parents=True)
            agree, what = compare_leftover(args.arch, seed, folder) if args.leftover else compare(args.arch, seed, args.vla, folder, args.dtype)
            n_wrong += not agree
            print(f"seed {seed}: {'agree' if agree else 'DIFFER'}; {what}", flush=True)
    print(f"{args.last - args.first + 1 - n_wrong} of {args.last - args.first + 1} seeds agree")
    sys.exit(1 if n_wrong else 0)


if __name__ == "__main__":
    main()
