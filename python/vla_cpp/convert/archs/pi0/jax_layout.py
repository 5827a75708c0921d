# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5 in the layout of openpi's JAX code: under params/, each array stacks all layers; LoRA arrays are beside the arrays that they adapt.

Reference: openpi examples/convert_jax_model_to_pytorch.py (names and axes), models/gemma.py (get_config), models/lora.py. Attention adds
scale (x A) B with A and B per head, except in the last product, where B is summed over the heads; feed-forward layers add (x A) B. The scale
is alpha / rank, which is 1 in both configurations. Sums are computed in float64 and rounded once.
"""

from __future__ import annotations

import math
import os
from typing import Callable, Dict, List, NamedTuple, Tuple

import numpy as np

from ...errors import Problems
from ...orbax import Computed, Stored, is_orbax, read_orbax
from .mapping import EXPERT, LM, PROJECTOR, ROOT, VISION

PARAMS = "params"
Shape = Tuple[int, ...]


def is_jax(folder: str) -> bool:
    return is_orbax(os.path.join(folder, PARAMS))


class Axes(NamedTuple):
    """The conversion of one layer's array to a tensor: of the values (`turn`) and of the shape."""

    turn: Callable[[np.ndarray], np.ndarray]
    shape: Callable[[Shape], Shape]


SAME = Axes(lambda x: x, lambda s: s)
TURNED = Axes(np.transpose, lambda s: s[::-1])
FLAT = Axes(np.ravel, lambda s: (math.prod(s),))
FROM_HEADS = Axes(lambda x: x.reshape(-1, x.shape[-1]).T, lambda s: (s[-1], math.prod(s[:-1])))  # (head, d_head, d) -> (d, all heads)
TO_HEADS = Axes(lambda x: x.reshape(len(x), -1).T, lambda s: (math.prod(s[1:]), s[0]))  # (d, head, d_head) -> (all heads, d)
BY_HEAD = Axes(lambda x: x.transpose(0, 2, 1).reshape(-1, x.shape[1]), lambda s: (s[0] * s[2], s[1]))  # (head, d, d_head) -> (all heads, d)
PATCH = Axes(lambda x: x.transpose(3, 2, 0, 1), lambda s: (s[3], s[2], s[0], s[1]))
FIRST = Axes(lambda x: x[0], lambda s: s[1:])  # (1, patch, d)

# Array -> tensor of a layer. `{}`: the layer's number.
TOWER = "PaliGemma/img/Transformer/encoderblock/"
ATTENTION = TOWER + "MultiHeadDotProductAttention_0/"
TOWER_LAYERS = [
    *(("{}LayerNorm_{}/{}".format(TOWER, i, a), "layer_norm{}.{}".format(i + 1, b), SAME) for i in (0, 1) for a, b in (("scale", "weight"), ("bias", "bias"))),
    *(("{}MlpBlock_0/Dense_{}/kernel".format(TOWER, i), "mlp.fc{}.weight".format(i + 1), TURNED) for i in (0, 1)),
    *(("{}MlpBlock_0/Dense_{}/bias".format(TOWER, i), "mlp.fc{}.bias".format(i + 1), SAME) for i in (0, 1)),
    *(("{}{}/kernel".format(ATTENTION, a), "self_attn.{}_proj.weight".format(a[0]), TO_HEADS) for a in ("query", "key", "value")),
    *(("{}{}/bias".format(ATTENTION, a), "self_attn.{}_proj.bias".format(a[0]), FLAT) for a in ("query", "key", "value")),
    (ATTENTION + "out/kernel", "self_attn.out_proj.weight", FROM_HEADS),
    (ATTENTION + "out/bias", "self_attn.out_proj.bias", SAME),
]
SINGLE = [
    ("PaliGemma/img/embedding/kernel", VISION + "embeddings.patch_embedding.weight", PATCH),
    ("PaliGemma/img/embedding/bias", VISION + "embeddings.patch_embedding.bias", SAME),
    ("PaliGemma/img/pos_embedding", VISION + "embeddings.position_embedding.weight", FIRST),
    ("PaliGemma/img/Transformer/encoder_norm/scale", VISION + "post_layernorm.weight", SAME),
    ("PaliGemma/img/Transformer/encoder_norm/bias", VISION + "post_layernorm.bias", SAME),
    ("PaliGemma/img/head/kernel", PROJECTOR + ".weight", TURNED),
    ("PaliGemma/img/head/bias", PROJECTOR + ".bias", SAME),
    ("PaliGemma/llm/embedder/input_embedding", LM + "embed_tokens.weight", SAME),
]
# LoRA's rank in the configurations gemma_2b_lora and gemma_300m_lora; it implies alpha, which no file states.
RANKS = {"": 16, "_1": 32}


class Reader:
    """Takes arrays by name, so that unread arrays are known in the end."""

    def __init__(self, folder: str, problems: Problems) -> None:
        self.path, self.problems = os.path.join(folder, PARAMS), problems
        self.arrays = _plain(read_orbax(self.path))
        self.tensors: Dict[str, Computed] = {}

    def take(self, name: str) -> Stored:
        if name in self.arrays:
            return self.arrays.pop(name)
        self.problems.add("array " + name, "the array in " + PARAMS, "none")
        return Stored((1,) * 5, "F32", lambda part=slice(None): np.zeros((1,) * 5, np.float32)[part])

    def put(self, name: str, shape: Shape, stored: str, load: Callable[[], np.ndarray], has_adapter: bool = False) -> None:
        def make(first: int, count: int) -> np.ndarray:
            return load()[first : first + count]

        self.tensors[name] = Computed(name, self.path, shape, stored, make, has_adapter=has_adapter)


def _plain(arrays: Dict[str, Stored]) -> Dict[str, Stored]:
    """The arrays without the prefix `params` and the suffix `value`, which flax adds when it saves a State."""
    names = {name: name.split("/") for name in arrays}
    first = 1 if all(parts[0] == "params" for parts in names.values()) else 0
    last = -1 if all(parts[-1] == "value" for parts in names.values()) else None
    return {"/".join(parts[first:last]): arrays[name] for name, parts in names.items()}


def read_jax(folder: str, problems: Problems):
    """The tensors under LeRobot's names, and no aliases. Errors: io, bad_bundle, unsupported."""
    reader = Reader(folder, problems)
    for name, tensor, axes in SINGLE:
        array = reader.take(name)
        if axes is SAME and len(array.shape) == 2:  # the token table, which is read by rows, since it is large
            read = lambda first, count, array=array: array.read(slice(first, first + count))  # noqa: E731
            reader.tensors[tensor] = Computed(tensor, reader.path, array.shape, array.dtype, read, by_rows=True)
        else:
            reader.put(tensor, axes.shape(array.shape), array.dtype, lambda array=array, axes=axes: axes.turn(array.read()))
    for name, tensor, axes in TOWER_LAYERS:
        array = reader.take(name)
        for i in range(array.shape[0]):
            load = lambda array=array, i=i, axes=axes: axes.turn(array.read(i))  # noqa: E731
            reader.put("{}encoder.layers.{}.{}".format(VISION, i, tensor), axes.shape(array.shape[1:]), array.dtype, load)
    _decoder(reader, "", LM)
    _decoder(reader, "_1", EXPERT)
    _heads(reader)
    for name in sorted(reader.arrays):
        problems.unsupported("array " + name, "an array of openpi's π0 or π0.5", "another one, {}".format(reader.arrays[name].shape))
    return reader.tensors, {}


def _heads(reader: Reader) -> None:
    """The linear layers outside the towers, which differ between π0 and π0.5."""
    for name in sorted(reader.arrays):
        layer, _, part = name.rpartition("/")
        if "/" in layer or part not in ("kernel", "bias"):
            continue
        array, axes = reader.take(name), TURNED if part == "kernel" else SAME
        tensor = ROOT + layer + (".weight" if part == "kernel" else ".bias")
        reader.put(tensor, axes.shape(array.shape), array.dtype, lambda array=array, axes=axes: axes.turn(array.read()))


def _decoder(reader: Reader, which: str, to: str) -> None:
    """The layers of a decoder. `which`: suffix of the module names, "" for the language model and "_1" for the expert."""
    layers = "PaliGemma/llm/layers/"
    for module, tensor in (("q", "q"), ("attn_vec", "o")):
        _attention(reader, "{}attn/{}_einsum{}".format(layers, module, which), which, to, "self_attn.{}_proj.weight".format(tensor))
    _keys_and_values(reader, "{}attn/kv_einsum{}".format(layers, which), which, to)
    mlp = "{}mlp{}/".format(layers, which)
    gating, linear = reader.take(mlp + "gating_einsum"), reader.take(mlp + "linear")
    factors = _factors(reader, mlp + "gating_einsum_", which)
    for k, tensor in enumerate(("gate", "up")):
        for i in range(gating.shape[0]):
            _product(reader, "{}layers.{}.mlp.{}_proj.weight".format(to, i, tensor), gating, factors, (i, k), TURNED)
    factors = _factors(reader, mlp + "linear_", which)
    for i in range(linear.shape[0]):
        _product(reader, "{}layers.{}.mlp.down_proj.weight".format(to, i), linear, factors, (i,), TURNED)
    for module, tensor in (("pre_attention_norm", "input_layernorm"), ("pre_ffw_norm", "post_attention_layernorm")):
        _norm(reader, "{}{}{}".format(layers, module, which), lambda i, tensor=tensor: "{}layers.{}.{}".format(to, i, tensor))
    _norm(reader, "PaliGemma/llm/final_norm" + which, None, to + "norm")


def _norm(reader: Reader, name: str, layer, single: str = "") -> None:
    """A norm's weights, or in π0.5's expert the dense layer that computes them from the time."""
    parts = [("scale", "weight", SAME)]
    if name + "/Dense_0/kernel" in reader.arrays:
        parts = [("Dense_0/kernel", "dense.weight", TURNED), ("Dense_0/bias", "dense.bias", SAME)]
    for stored, tensor, axes in parts:
        array = reader.take("{}/{}".format(name, stored))
        if single:
            reader.put("{}.{}".format(single, tensor), axes.shape(array.shape), array.dtype, lambda array=array, axes=axes: axes.turn(array.read()))
            continue
        for i in range(array.shape[0]):
            load = lambda array=array, axes=axes, i=i: axes.turn(array.read(i))  # noqa: E731
            reader.put("{}.{}".format(layer(i), tensor), axes.shape(array.shape[1:]), array.dtype, load)


def _factors(reader: Reader, name: str, which: str) -> List[Stored]:
    """LoRA's two arrays; empty if there are none."""
    if name + "lora_a" not in reader.arrays and name + "lora_b" not in reader.arrays:
        return []
    left, right = reader.take(name + "lora_a"), reader.take(name + "lora_b")
    if left.shape[-1] != RANKS[which]:
        hint = "the scale of the sum follows from alpha, which only the configuration states: merge it and save the policy"
        wanted = "rank {}, as gemma_{}_lora has".format(RANKS[which], "300m" if which else "2b")
        reader.problems.unsupported("array {}lora_a".format(name), wanted, str(left.shape[-1]), hint)
    if right.shape[-2] != left.shape[-1] or left.shape[:-2] != right.shape[:-2]:
        reader.problems.add("array {}lora_b".format(name), "(..., {}, ...) beside {}".format(left.shape[-1], left.shape), str(right.shape))
    return [left, right]


def _product(reader: Reader, name: str, array: Stored, factors: List[Stored], place: Tuple[int, ...], axes: Axes, sum_heads: bool = False) -> None:
    def load() -> np.ndarray:
        x = array.read(place)
        if factors:
            left, right = (factor.read(place).astype(np.float64) for factor in factors)
            x = (x + left @ (right.sum(axis=0) if sum_heads else right)).astype(np.float32)
        return axes.turn(x)

    fits = not factors or (factors[0].shape[:-1], factors[1].shape[-1]) == (array.shape[:-1], array.shape[-1])
    if not fits:
        reader.problems.add("LoRA of " + name, "factors of {}".format(array.shape), "{} and {}".format(*(f.shape for f in factors)))
    reader.put(name, axes.shape(array.shape[len(place) :]), array.dtype, load, bool(factors))


def _attention(reader: Reader, name: str, which: str, to: str, tensor: str) -> None:
    array, factors = reader.take(name + "/w"), _factors(reader, name + "/", which)
    is_last = tensor.startswith("self_attn.o_")
    for i in range(array.shape[0]):
        _product(reader, "{}layers.{}.{}".format(to, i, tensor), array, factors, (i,), FROM_HEADS if is_last else BY_HEAD, is_last)


def _keys_and_values(reader: Reader, name: str, which: str, to: str) -> None:
    array, factors = reader.take(name + "/w"), _factors(reader, name + "/", which)
    for i in range(array.shape[0]):
        for k, tensor in enumerate("kv"):
            _product(reader, "{}layers.{}.self_attn.{}_proj.weight".format(to, i, tensor), array, factors, (i, k), BY_HEAD)
