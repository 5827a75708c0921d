# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Vision towers and language models that several architectures share: sizes from a config, keys, tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, List, Mapping, Union

from .archs import TABLE, Dropped, Weight
from .bundle import Key, keys_by_type
from .layers import KEPT_OF_LAST, gated_block, vector
from .section import Section

MAX_LAYERS = 1024


@dataclass
class Vision:
    """Keys `vision.*`."""

    d_model: int = 0
    n_layer: int = 0
    n_head: int = 0
    d_ff: int = 0
    image_size: int = 0
    patch_size: int = 0
    norm_eps: float = 0.0

    @property
    def n_patch(self) -> int:
        return (self.image_size // self.patch_size) ** 2


@dataclass
class Language:
    """Keys `lm.*`."""

    d_model: int = 0
    n_layer: int = 0
    n_head: int = 0
    n_head_kv: int = 0
    d_head: int = 0
    d_ff: int = 0
    n_vocab: int = 0
    norm_eps: float = 0.0
    rope_base: float = 0.0

    @property
    def d_q(self) -> int:
        return self.n_head * self.d_head

    @property
    def d_kv(self) -> int:
        return self.n_head_kv * self.d_head


DOUBLES = ("policy.time_scale", "time.min_period", "time.max_period", "solver.t_start", "solver.t_end")
KINDS = {int: "u32", float: "f32", str: "string"}


Modules = Mapping[str, Union[Vision, Language, Mapping[str, object]]]


def typed(modules: Modules) -> Dict[str, Dict[str, object]]:
    """Numbers and names of modules, by type."""
    groups: Dict[str, Dict[str, object]] = {"u32": {}, "f32": {}, "f64": {}, "string": {}}
    for module, fields in modules.items():
        for name, value in (fields if isinstance(fields, Mapping) else vars(fields)).items():
            key = "{}.{}".format(module, name)
            groups["f64" if key in DOUBLES else KINDS[type(value)]][key] = value
    return groups


def keys_of(modules: Modules) -> List[Key]:
    return keys_by_type(typed(modules))


def read_vision(section: Section, image_size: int, patch_size: int) -> Vision:
    """Field names of transformers' vision configs."""
    vision = Vision(
        d_model=section.count("hidden_size"),
        n_layer=section.count("num_hidden_layers", maximum=MAX_LAYERS),
        n_head=section.count("num_attention_heads"),
        d_ff=section.count("intermediate_size"),
        image_size=image_size,
        patch_size=patch_size,
        norm_eps=section.number("layer_norm_eps") if "layer_norm_eps" in section.defaults else 0.0,
    )
    if vision.d_model % vision.n_head:
        section.bad("num_attention_heads", "a divisor of hidden_size {}".format(vision.d_model))
    return vision


def read_language(section: Section) -> Language:
    """Field names of transformers' text configs; `rope_base` is the caller's. A null num_key_value_heads means num_attention_heads."""
    n_head, d_model = section.count("num_attention_heads"), section.count("hidden_size")
    section.defaults.setdefault("num_key_value_heads", n_head)
    if "num_key_value_heads" in section.values:
        section.defaults["num_key_value_heads"] = n_head
    section.defaults.setdefault("head_dim", d_model // n_head)
    return Language(
        d_model=d_model,
        n_layer=section.count("num_hidden_layers", maximum=MAX_LAYERS),
        n_head=n_head,
        n_head_kv=section.count("num_key_value_heads"),
        d_head=section.count("head_dim"),
        d_ff=section.count("intermediate_size"),
        n_vocab=section.count("vocab_size"),
        norm_eps=section.number("rms_norm_eps"),
    )


def check_heads(section: Section, lm: Language) -> None:
    """Heads must share the width evenly, and be pairs for the rotary embedding."""
    if lm.d_model % lm.n_head or lm.n_head % lm.n_head_kv or lm.d_model // lm.n_head % 2:
        expected = "heads of an even width that divide hidden_size {}, in whole groups".format(lm.d_model)
        section.bad("num_attention_heads", expected)


def pooling_head(tower: str, vision: Vision, reason: str) -> List[Dropped]:
    """Of a SigLIP tower, which no policy reads. `tower`: where it stands, up to the dot."""
    d = vision.d_model
    shapes = {"probe": (1, 1, d), "attention.in_proj_weight": (3 * d, d), "attention.in_proj_bias": (3 * d,)}
    for name, d_out, d_in in (("attention.out_proj", d, d), ("mlp.fc1", vision.d_ff, d), ("mlp.fc2", d, vision.d_ff)):
        shapes.update({name + ".weight": (d_out, d_in), name + ".bias": (d_out,)})
    shapes.update({"layernorm.weight": (d,), "layernorm.bias": (d,)})
    return [Dropped("{}head.{}".format(tower, name), shape, reason) for name, shape in shapes.items()]


def plus_one(weights: List[Weight]) -> List[Weight]:
    """Norms of Gemma."""
    return [weight._replace(plus_one=True) for weight in weights]


def embedding(lm: Language, source: str) -> Weight:
    return Weight("lm.token_embd.weight", source, TABLE, (lm.n_vocab, lm.d_model), (lm.n_vocab, lm.d_model))


def language_block(lm: Language, source: str, i: int, qkv_bias: bool = False, gemma: bool = False) -> Dict[str, List[Weight]]:
    """Layer i by part. `source`: where the layers are, up to the dot."""
    target = "lm.blk.{}.".format(i)
    block = gated_block(target, "{}layers.{}.".format(source, i), lm.d_model, lm.d_q, lm.d_kv, lm.d_model, lm.d_ff)
    for part in ("attn_q", "attn_k", "attn_v") if qkv_bias else ():
        weight = block[part][0]
        block[part] += vector(target + part + ".bias", weight.source[: -len("weight")] + "bias", weight.shape[0])
    for part in ("attn_norm", "ffn_norm") if gemma else ():
        block[part] = plus_one(block[part])
    return block


def keys_and_values(lm: Language, source: str, gemma: bool = False) -> List[Weight]:
    """The layers of a language model of which only keys and values are read, so that the last one needs no more."""
    return [
        weight
        for i in range(lm.n_layer)
        for part, weights in language_block(lm, source, i, gemma=gemma).items()
        if i < lm.n_layer - 1 or part in KEPT_OF_LAST
        for weight in weights
    ]


def dropped_of_last(lm: Language, source: str) -> List[Dropped]:
    """What `keys_and_values` leaves out."""
    block = language_block(lm, source, lm.n_layer - 1)
    rest = [weight for part, weights in block.items() if part not in KEPT_OF_LAST for weight in weights]
    reason = "the last language layer leaves only keys and values"
    return [
        Dropped(source + "norm.weight", (lm.d_model,), "the prefix leaves only keys and values"),
        *(Dropped(weight.source, weight.stored, reason) for weight in rest),
    ]
