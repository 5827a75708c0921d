# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random parameters and statistics, and the shapes of the layers that families share.

A parameter depends on its name and the seed alone.  Norm weights are not 1 and biases are not 0, so that a missing multiply or
add shows; every value is exact in bfloat16, so that every storage type holds the same numbers.
"""

import math
import zlib

import numpy as np

from .draw import Generator, bfloat16, f32

STATISTICS = {"min": -2.9, "max": 3.1, "q01": -2.3, "q99": 2.2, "q10": -1.3, "q90": 1.2}  # mean + factor * std


def parameter(name, shape, seed):
    """float32, at a scale that keeps every path alive."""
    x = Generator(zlib.crc32(name.encode()) + 1_000_003 * seed).normal(*shape)
    if len(shape) == 1:
        x = f32(0.1) * x + f32("norm" in name and name.endswith("weight"))
    elif "position_embedding" in name:
        x = f32(0.5) * x
    else:
        x = x / f32(math.sqrt(math.prod(shape[1:])))
    return bfloat16(x)


def statistics(d_state, d_action, seed, zero_spread=()):
    """Of a data set, with every field that a normalization reads.  zero_spread: state numbers that never moved."""
    generator, out = Generator(seed + 77), {}
    for feature, n in (("observation.state", d_state), ("action", d_action)):
        mean, std = generator.normal(n) * f32(0.3), generator.uniform(n) * f32(0.5) + f32(0.1)
        if feature == "observation.state":
            std[list(zero_spread)] = 0.0
        out[feature] = {"mean": mean, "std": std} | {k: mean + f32(abs(c)) * std if c > 0 else mean - f32(abs(c)) * std
                                                     for k, c in STATISTICS.items()}
    return out


def sines(shape):
    """(1, n, d): the table of positions of "Attention is all you need", in bfloat16."""
    _, n, d = shape
    exponent = np.arange(0, d, 2, dtype=f32) * f32(-math.log(10000.0) / d)
    angle = (np.arange(n, dtype=f32)[:, None] * np.exp(exponent.astype(np.float64)).astype(f32)).astype(np.float64)
    out = np.zeros((n, d), f32)
    out[:, 0::2], out[:, 1::2] = np.sin(angle), np.cos(angle[:, : d // 2])
    return bfloat16(out)[None]


# --- sizes, by the field names of transformers' configs --------------------------------------------------------------


def tower(d, layers, heads, ff, **more):
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "intermediate_size": ff, **more}


def decoder(d, layers, heads, kv, ff, d_head=None, **more):
    width = {"head_dim": d_head} if d_head else {}
    return {"hidden_size": d, "num_hidden_layers": layers, "num_attention_heads": heads, "num_key_value_heads": kv, **width,
            "intermediate_size": ff, **more}


# --- name -> shape ---------------------------------------------------------------------------------------------------


def linear(name, d_out, d_in, bias=True):
    return {f"{name}.weight": (d_out, d_in)} | ({f"{name}.bias": (d_out,)} if bias else {})


def norm(name, d):
    return {f"{name}.weight": (d,), f"{name}.bias": (d,)}


def rms_norm(name, d):
    return {f"{name}.weight": (d,)}


def decoder_layer(at, d, d_ff, n_head, n_kv, d_head, d_kv_in=None, qkv_bias=False, norms=rms_norm):
    """A layer of the Llama kind.  d_kv_in: what keys and values are projected from, where it is not the layer's input."""
    out = {}
    for part, d_out, d_in, bias in (("q", n_head * d_head, d, qkv_bias), ("k", n_kv * d_head, d_kv_in or d, qkv_bias),
                                    ("v", n_kv * d_head, d_kv_in or d, qkv_bias), ("o", d, n_head * d_head, False)):
        out |= linear(f"{at}self_attn.{part}_proj", d_out, d_in, bias)
    for part, d_out, d_in in (("gate", d_ff, d), ("up", d_ff, d), ("down", d, d_ff)):
        out |= linear(f"{at}mlp.{part}_proj", d_out, d_in, False)
    return out | norms(f"{at}input_layernorm", d) | norms(f"{at}post_attention_layernorm", d)


def mlp_resnet(at, d_in, d, d_out):
    """openvla-oft's head of an action; its norms in blocks are called 0."""
    out = norm(f"{at}layer_norm1", d_in) | linear(f"{at}fc1", d, d_in)
    for i in range(2):
        out |= norm(f"{at}mlp_resnet_blocks.{i}.ffn.0", d) | linear(f"{at}mlp_resnet_blocks.{i}.ffn.1", d, d)
    return out | norm(f"{at}layer_norm2", d) | linear(f"{at}fc2", d_out, d)


def siglip(at, d, d_ff, n_layer, patch, n_position):
    """A vision tower of the SigLIP family."""
    out = {f"{at}embeddings.patch_embedding.weight": (d, 3, patch, patch), f"{at}embeddings.patch_embedding.bias": (d,),
           f"{at}embeddings.position_embedding.weight": (n_position, d)}
    for i in range(n_layer):
        layer = f"{at}encoder.layers.{i}."
        for part in ("q_proj", "k_proj", "v_proj", "out_proj"):
            out |= linear(f"{layer}self_attn.{part}", d, d)
        out |= linear(f"{layer}mlp.fc1", d_ff, d) | linear(f"{layer}mlp.fc2", d, d_ff)
        out |= norm(f"{layer}layer_norm1", d) | norm(f"{layer}layer_norm2", d)
    return out | norm(f"{at}post_layernorm", d)
