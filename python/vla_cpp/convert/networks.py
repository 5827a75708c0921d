# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Vision towers and language models that several architectures share: sizes from a config, keys, tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, List, Mapping, Sequence, Tuple, Union

from .archs import Dropped
from .bundle import Key, keys_by_type
from .layers import LLAMA, SIGLIP, Decoder, Rows, blocks, gated_block, linear, norm, patch_embed, rms_norm, table
from .section import Section

MAX_LAYERS = 1024
NORM_EPS = 1e-5  # default eps of torch.nn.LayerNorm


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
    def heads(self) -> Tuple[int, int, int]:
        """Widths of queries, of keys and of a head."""
        return self.n_head * self.d_head, self.n_head_kv * self.d_head, self.d_head


@dataclass
class TextEncoder:
    """Keys `lm.*` for BERT and BART."""

    d_model: int = 0
    n_layer: int = 0
    n_head: int = 0
    d_ff: int = 0
    n_vocab: int = 0
    n_position: int = 0
    norm_eps: float = 0.0


DOUBLES = {"policy.time_scale", "policy.rtc_ramp_rate", "time.min_period", "time.max_period"}
DOUBLES |= {"solver." + name for name in ("t_start", "t_end", "beta_start", "beta_end", "clip")}
KINDS = {int: "u32", float: "f32", str: "string"}
Fields = Union[Vision, Language, TextEncoder, Mapping[str, object]]


def kind_of(key: str, value: object) -> str:
    if isinstance(value, (list, tuple)):
        return "string[]" if value and isinstance(value[0], str) else "u32[]"
    return "f64" if key in DOUBLES else KINDS[type(value)]


def keys_of(*parts: Mapping[str, Fields]) -> List[Key]:
    """Keys "module.field" with the type of each value. `parts`: fields by module."""
    groups: Dict[str, Dict[str, object]] = {kind: {} for kind in ("u32", "f32", "f64", "string", "u32[]", "string[]")}
    for module, fields in (item for part in parts for item in part.items()):
        for name, value in (fields if isinstance(fields, Mapping) else vars(fields)).items():
            key = "{}.{}".format(module, name)
            groups[kind_of(key, value)][key] = list(value) if isinstance(value, tuple) else value
    return keys_by_type(groups)


def pick(sizes: object, names: str) -> Dict[str, object]:
    """The attributes with these names, separated by blanks, as a dict."""
    return {name: getattr(sizes, name) for name in names.split()}


SIZES = ("hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads")


def defaults(*sizes: int, **others: object) -> Dict[str, object]:
    """The defaults of a config class of transformers. `sizes`: values of the fields in SIZES."""
    return {**dict(zip(SIZES, sizes)), **others}


def read_vision(section: Section, image_size: int, patch_size: int) -> Vision:
    """Reads a config with the field names of transformers' vision configs."""
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
    """Reads a config with the field names of transformers' text configs; the caller sets `rope_base`. A null num_key_value_heads means
    num_attention_heads."""
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
    """Checks that the heads divide the width, and that a head's width is even, as the rotary embedding needs."""
    if lm.d_model % lm.n_head or lm.n_head % lm.n_head_kv or lm.d_model // lm.n_head % 2:
        expected = "heads of an even width that divide hidden_size {}, in whole groups".format(lm.d_model)
        section.bad("num_attention_heads", expected)


def pooling_head(tower: str, vision: Vision, reason: str) -> List[Dropped]:
    """The pooling head of a SigLIP tower, which no policy reads. `tower`: the tower's prefix, up to the dot."""
    d = vision.d_model
    shapes = {"probe": (1, 1, d), "attention.in_proj_weight": (3 * d, d), "attention.in_proj_bias": (3 * d,)}
    for name, d_out, d_in in (("attention.out_proj", d, d), ("mlp.fc1", vision.d_ff, d), ("mlp.fc2", d, vision.d_ff)):
        shapes.update({name + ".weight": (d_out, d_in), name + ".bias": (d_out,)})
    shapes.update({"layernorm.weight": (d,), "layernorm.bias": (d,)})
    return [Dropped("{}head.{}".format(tower, name), shape, reason) for name, shape in shapes.items()]


def siglip(source: str, v: Vision, n_position: int = 0, product=linear, post_norm: bool = True) -> Rows:
    """The tower with the prefix `source`, which ends in a dot, as `vision.*`. `product`: function for the matrices of the blocks."""
    return [
        *patch_embed(source + "embeddings.patch_embedding", v.d_model, v.patch_size),
        *table("vision.position", source + "embeddings.position_embedding.weight", n_position or v.n_patch, v.d_model),
        *blocks("vision.", source + "encoder.layers.{}.", SIGLIP, v.n_layer, v.d_model, v.d_ff, product),
        *(norm("vision.post_norm", source + "post_layernorm", v.d_model) if post_norm else []),
    ]


# Tensors of the last layer that are read if only its keys and values are used, as in a prefix.
KEPT_OF_LAST = ("attn_norm.weight", "attn_k.weight", "attn_v.weight")


def decoder(lm: Language, source: str, kind: Decoder = LLAMA, end: str = "norm", tokens: str = "") -> Rows:
    """The language model with the prefix `source`, which ends in a dot, as `lm.*`. `end`: "norm"; "layers", without the final norm; "cache",
    for a prefix: the last layer has only its keys and values. `tokens`: full name of the embedding, if it has another prefix."""
    rows = table("lm.token_embd", tokens or source + "embed_tokens.weight", lm.n_vocab, lm.d_model)
    for i in range(lm.n_layer):
        own = _layer(lm, source, i, kind)
        rows += own if end != "cache" or i < lm.n_layer - 1 else [row for row in own if row.target.endswith(KEPT_OF_LAST)]
    return rows + (kind.norm("lm.norm", source + "norm", lm.d_model) if end == "norm" else [])


def _layer(lm: Language, source: str, i: int, kind: Decoder = LLAMA) -> Rows:
    return gated_block("lm.blk.{}.".format(i), "{}layers.{}.".format(source, i), lm.d_model, lm.d_ff, lm.heads, kind)


def dropped_of_last(lm: Language, source: str) -> List[Dropped]:
    """The tensors that `decoder` leaves out with end="cache"."""
    reason = "the last language layer leaves only keys and values"
    rest = [row for row in _layer(lm, source, lm.n_layer - 1) if not row.target.endswith(KEPT_OF_LAST)]
    return [
        Dropped(source + "norm.weight", (lm.d_model,), "the prefix leaves only keys and values"),
        *(Dropped(row.source, row.stored, reason) for row in rest),
    ]


def expert(source: str, d: int, d_ff: int, lm: Language, kind: Decoder = LLAMA, d_in: Sequence[int] = ()) -> Rows:
    """The action expert with the prefix `source`, which ends in a dot, as `expert.*`; its layers attend jointly with those of the language
    model `lm`. `d_in`: per layer the width of the input of keys and values, by default d."""
    rows: Rows = []
    for i, width in enumerate(d_in or [d] * lm.n_layer):
        rows += gated_block("expert.blk.{}.".format(i), "{}layers.{}.".format(source, i), d, d_ff, lm.heads, kind, width)
    return rows + kind.norm("expert.norm", source + "norm", d)
