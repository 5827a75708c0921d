# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of OpenVLA and the names of its tensors. config.json gives timm's names of the vision towers, which determine heads, patches and norms;
widths and depths come from the tensors. An absent key of the language model has the default of the reference's LlamaConfig, listed here with
the key.

Reference: openvla prismatic/extern/hf (configuration_prismatic.py, modeling_prismatic.py); timm 0.9.16 vision_transformer.py; transformers
4.40.1 models/llama.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Dict, List, Set, Tuple

import numpy as np

from ...bundle import Key
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...files import member
from ...layers import Names, Rows, blocks, linear, norm, table, vector
from ...networks import Fields, Language, Vision, check_heads, decoder, defaults, keys_of, pick, read_language
from ...section import Fixed, Section
from ...standardized import Standardized
from .. import MATRIX, VECTOR, Dropped, Weight

WHERE = "config.json"
# timm's models of the towers. All have the same number of heads, side of a patch, and eps of norms.
DINO_ID, SIGLIP_IDS = "vit_large_patch14_reg4_dinov2.lvd142m", ("vit_so400m_patch14_siglip_224", "vit_so400m_patch14_siglip_384")
N_HEAD, PATCH, NORM_EPS = 16, 14, 1e-6
DINO, SIGLIP, PROJECTOR, LM, HEAD = (
    "vision_backbone.featurizer.",
    "vision_backbone.fused_featurizer.",
    "projector.",
    "language_model.model.",
    "language_model.lm_head",
)
DINO_BLOCK = Names("attn.qkv. attn.proj", "mlp.fc1 mlp.fc2", "norm1 norm2", scales="ls1.scale_factor ls2.scale_factor")
SIGLIP_BLOCK = DINO_BLOCK._replace(scales="")
BACKBONES = ("llama2-7b-pure", "llama2-13b-pure", "llama2-7b-chat", "llama2-13b-chat")
TOP_FIXED: Fixed = {"use_fused_vision_backbone": (True, True), "timm_override_act_layers": ([None, None], [None, None])}
TOP = {"n_action_bins": 256, "pad_to_multiple_of": 64, "eos_token_id": None}
TEXT = defaults(4096, 11008, 32, 32, vocab_size=32000, rms_norm_eps=1e-6, rope_theta=10000.0, eos_token_id=2)
TEXT_FIXED: Fixed = {
    "model_type": ("llama", "llama"),
    "hidden_act": ("silu", "silu"),
    "attention_bias": (False, False),
    "mlp_bias": (False, False),
    "pretraining_tp": (1, 1),
    "rope_scaling": (None, None),
    "tie_word_embeddings": (False, False),
}
# Keys of transformers and of training, and keys that no forward pass reads: preprocessor_config.json determines the image ops.
IGNORED = set(
    """
    _name_or_path arch_specifier architectures auto_map attention_dropout bos_token_id dtype hf_llm_id image_resize_strategy image_sizes
    initializer_range llm_backbone_id llm_max_length max_position_embeddings model_type norm_stats output_projector_states pad_token_id
    text_config timm_model_ids torch_dtype transformers_version use_cache vision_backbone_id vocab_size _attn_implementation_autoset
    """.split()
)


@dataclass
class Sizes:
    dino: Vision = field(default_factory=Vision)
    siglip: Vision = field(default_factory=Vision)
    lm: Language = field(default_factory=Language)
    n_register: int = 0
    d_action: int = 0
    n_bin: int = 0
    first_id: int = 0  # token id of bin 0; the ids of further bins decrease from here
    stop_token: int = 0
    horizon = 1
    d_state = 0


def read_sizes(checkpoint: Checkpoint, problems: Problems) -> Sizes:
    s = Sizes()
    top = Section(WHERE, checkpoint.config, TOP, problems)
    top.refuse_unknown({*TOP, *TOP_FIXED, *IGNORED})
    top.check_fixed(TOP_FIXED)
    _check_backbones(top)
    text = text_section(checkpoint, TEXT, TEXT_FIXED, IGNORED | {"num_key_value_heads"}, problems)
    s.lm = read_text(text)
    s.n_bin = top.count("n_action_bins", 2)
    s.first_id = s.lm.n_vocab - top.count("pad_to_multiple_of", 0) - 1
    if s.first_id < s.n_bin:
        expected = "fewer bins than the {} tokens of the vocabulary without its padding".format(s.first_id + 1)
        top.bad("n_action_bins", expected)
    section = text if top.get("eos_token_id") is None else top
    s.stop_token = section.count("eos_token_id", 0, s.lm.n_vocab - 1)
    read_towers(checkpoint, s, top)
    return s


def text_section(checkpoint: Checkpoint, keys: Dict, fixed: Fixed, ignored: Set[str], problems: Problems) -> Section:
    """The language model's part of config.json. `keys`: supported keys with the defaults of the reference's class."""
    text = member(checkpoint.config, "text_config", dict, WHERE)
    section = Section(WHERE + ": text_config", text, keys, problems, ("num_key_value_heads",))
    section.check_fixed(fixed)
    section.refuse_unknown({*keys, *fixed, *ignored, "head_dim"})
    return section


def read_text(text: Section) -> Language:
    lm = read_language(text)
    lm.rope_base, lm.d_head = text.number("rope_theta"), lm.d_model // lm.n_head
    text.fixed("head_dim", lm.d_head)
    check_heads(text, lm)
    return lm


def read_towers(checkpoint: Checkpoint, s, top: Section) -> None:
    """Sets dino, siglip and n_register of `s`."""
    ids, sides = top.get("timm_model_ids"), top.get("image_sizes")
    if not isinstance(ids, list) or len(ids) != 2 or ids[0] != DINO_ID or ids[1] not in SIGLIP_IDS:
        top.bad("timm_model_ids", "{}, and {}".format(DINO_ID, " or ".join(SIGLIP_IDS)), unsupported=True)
    if (
        not isinstance(sides, list)
        or len(sides) != 2
        or sides[0] != sides[1]
        or type(sides[0]) is not int
        or not 0 < sides[0] <= 4096
        or sides[0] % PATCH
    ):
        top.bad("image_sizes", "the same multiple of {} for both towers".format(PATCH), unsupported=True)
        return
    s.dino = _tower(checkpoint, DINO, sides[0], top.problems)
    s.siglip = _tower(checkpoint, SIGLIP, sides[0], top.problems)
    s.n_register = _dim(checkpoint, DINO + "reg_token", 3, 1, top.problems)


def _check_backbones(top: Section) -> None:
    language = top.get("llm_backbone_id")
    if isinstance(language, str) and language.startswith("vicuna"):
        hint = "openvla-v01 has another prompt and one tower; fine-tunes of openvla-7b are supported"
        top.bad("llm_backbone_id", " or ".join(BACKBONES), hint=hint, unsupported=True)
    elif language not in BACKBONES:
        top.bad("llm_backbone_id", " or ".join(BACKBONES), unsupported=True)


def _dim(checkpoint: Checkpoint, name: str, rank: int, axis: int, problems: Problems) -> int:
    entry = checkpoint.tensors.get(name)
    if entry is not None and len(entry.shape) == rank and entry.shape[axis] > 0:
        return entry.shape[axis]
    problems.add("tensor " + name, "one of {} dimensions".format(rank), "none" if entry is None else str(entry.shape))
    return 1


def _tower(checkpoint: Checkpoint, at: str, side: int, problems: Problems) -> Vision:
    """The sizes of a tower up to the block whose output is used, the last but one."""
    found = (re.match(re.escape(at) + r"blocks\.(\d{1,4})\.", name) for name in checkpoint.tensors)
    depth = 1 + max((int(match[1]) for match in found if match), default=-1)
    d, d_ff = _dim(checkpoint, at + "pos_embed", 3, 2, problems), _dim(checkpoint, at + "blocks.0.mlp.fc1.weight", 2, 0, problems)
    if depth < 2:
        problems.add("tensors " + at + "blocks", "two blocks or more", str(depth))
    if d % N_HEAD:
        problems.unsupported("tensor " + at + "pos_embed", "a width of {} heads".format(N_HEAD), str(d))
    return Vision(d, max(depth - 1, 1), N_HEAD, d_ff, side, PATCH, NORM_EPS)


def module_keys(s: Sizes) -> Dict[str, Fields]:
    """Key values of the towers and the language model, by module."""
    dino, siglip = {**vars(s.dino), "n_register": s.n_register}, {**vars(s.siglip), "position_rule": "row_major"}
    return {"dino": dino, "siglip": siglip, "lm": s.lm}


def network_keys(s: Sizes) -> List[Key]:
    return keys_of(
        {
            "policy": pick(s, "d_state d_action horizon"),
            **module_keys(s),
            "solver": dict(kind="greedy", steps=s.d_action, noise="none", stop_token=s.stop_token),
            "action_tokens": dict(kind="bins", n_bin=s.n_bin, first_id=s.first_id),
        }
    )


def weights(s: Sizes, pixels: Tuple[Dict[str, tuple], Dict[str, tuple]]) -> Rows:
    """Rows of all tensors. `pixels`: mean and std of each tower's pixels."""
    return [*image_weights(s, pixels), *decoder(s.lm, LM), *linear("lm.head", HEAD, s.lm.n_vocab, s.lm.d_model, bias=False)]


def image_weights(s: Sizes, pixels: Tuple[Dict[str, tuple], Dict[str, tuple]]) -> Rows:
    """Rows of towers and projector. `pixels`: mean and std of each tower's pixels."""
    dino, siglip, d = s.dino, s.siglip, s.lm.d_model
    d_patch = dino.d_model + siglip.d_model
    return [
        *_patch_embed("dino", DINO, dino, pixels[0]),
        *table("dino.position", DINO + "pos_embed", dino.n_patch, dino.d_model, (1, dino.n_patch, dino.d_model)),
        *vector("dino.class_token.weight", DINO + "cls_token", dino.d_model, (1, 1, dino.d_model)),
        *table("dino.registers", DINO + "reg_token", s.n_register, dino.d_model, (1, s.n_register, dino.d_model)),
        *blocks("dino.", DINO + "blocks.{}.", DINO_BLOCK, dino.n_layer, dino.d_model, dino.d_ff),
        *_patch_embed("siglip", SIGLIP, siglip, pixels[1]),
        *table("siglip.position", SIGLIP + "pos_embed", siglip.n_patch, siglip.d_model, (1, siglip.n_patch, siglip.d_model)),
        *blocks("siglip.", SIGLIP + "blocks.{}.", SIGLIP_BLOCK, siglip.n_layer, siglip.d_model, siglip.d_ff),
        *linear("projector_up", PROJECTOR + "fc1", 4 * d_patch, d_patch),
        *linear("projector_mid", PROJECTOR + "fc2", d, 4 * d_patch),
        *linear("projector_down", PROJECTOR + "fc3", d, d),
    ]


def _patch_embed(target: str, source: str, v: Vision, pixels: Dict[str, tuple]) -> Rows:
    at, name = target + ".patch_embed", source + "patch_embed.proj"
    stored, how = (v.d_model, 3, PATCH, PATCH), dict(pixels=Standardized(name + ".weight", **pixels))
    return [
        Weight(at + ".weight", name + ".weight", MATRIX, stored, (v.d_model, int(np.prod(stored[1:]))), keep_f32=True, **how),
        Weight(at + ".bias", name + ".bias", VECTOR, (v.d_model,), (v.d_model,), **how),
    ]


def dropped(s) -> List[Dropped]:
    """The tensors after the block whose output is used."""
    out = []
    for at, v, names in ((DINO, s.dino, DINO_BLOCK), (SIGLIP, s.siglip, SIGLIP_BLOCK)):
        last = blocks("", at + "blocks.{}.", names, v.n_layer + 1, v.d_model, v.d_ff)
        last = [row for row in last if row.source.startswith("{}blocks.{}.".format(at, v.n_layer))] + norm("", at + "norm", v.d_model)
        out += [Dropped(row.source, row.stored, "features are read in front of it") for row in last]
    d, pool = s.siglip.d_model, SIGLIP + "attn_pool."
    rows = vector("", pool + "latent", d, (1, 1, d)) + norm("", pool + "norm", d)
    for name, d_out, d_in in (("q", d, d), ("kv", 2 * d, d), ("proj", d, d), ("mlp.fc1", s.siglip.d_ff, d), ("mlp.fc2", d, s.siglip.d_ff)):
        rows += linear("", pool + name, d_out, d_in)
    return out + [Dropped(row.source, row.stored, "no patch goes through it") for row in rows]
