# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of VLA-Adapter and the names of its tensors. The towers are OpenVLA's; an absent key of the language model has the default of the
reference's Qwen2Config, listed here with the key. The head has no config: its tensors identify its version, and other values are literals of
the reference's code.

Reference: OpenHelix-Team/VLA-Adapter prismatic/extern/hf (configuration_prismatic.py, modeling_prismatic.py), prismatic/models
(action_heads.py, projectors.py), prismatic/vla/constants.py; transformers 4.40.1 models/qwen2.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Dict, List, Tuple

from ...bundle import Key
from ...checkpoint import Checkpoint
from ...errors import Problems
from ...layers import QWEN2, Rows, linear, table, vector
from ...networks import NORM_EPS, Language, Vision, decoder, defaults, keys_of, pick
from ...section import Fixed, Section
from .. import Dropped, oft
from ..openvla import mapping as prismatic

BACKBONES = ("qwen25-0_5b-extra", "qwen25-0_5b-pure")
LM, QUERIES, HEAD = "language_model.model.", "action_queries.weight", oft.HEAD + "model."
EMBEDDING, LANGUAGE_HEAD = LM + "embed_tokens.weight", "language_model.lm_head.weight"
# Literals: NUM_TOKENS of constants.py, num_task_tokens of L1RegressionActionHead, heads of both blocks.
N_QUERY, N_TASK, N_HEAD = 64, 512, 8
TEXT = defaults(
    4096, 22016, 32, 32, num_key_value_heads=32, vocab_size=151936, rms_norm_eps=1e-6, rope_theta=10000.0, tie_word_embeddings=False
)
TEXT_FIXED: Fixed = {
    "model_type": ("qwen2", "qwen2"),
    "hidden_act": ("silu", "silu"),
    "use_sliding_window": (False, False),
    "use_mrope": (False, False),
    "rope_scaling": (None, None),
}
# Keys without effect on actions, beside those of OpenVLA: settings of answers in tokens, and of unused attention windows.
IGNORED = prismatic.IGNORED | set("eos_token_id max_window_layers n_action_bins pad_to_multiple_of sliding_window".split())


@dataclass
class Sizes:
    dino: Vision = field(default_factory=Vision)
    siglip: Vision = field(default_factory=Vision)
    lm: Language = field(default_factory=Language)
    n_register: int = 0
    d_state: int = 0
    d_action: int = 0
    horizon: int = 0
    is_pro: bool = False
    tokens: str = EMBEDDING  # name of the tensor with the token embeddings
    n_query: int = N_QUERY
    n_task: int = N_TASK


def read_sizes(checkpoint: Checkpoint, problems: Problems) -> Sizes:
    s = Sizes()
    top = Section(prismatic.WHERE, checkpoint.config, {}, problems)
    top.refuse_unknown({*prismatic.TOP_FIXED, *IGNORED})
    top.check_fixed(prismatic.TOP_FIXED)
    if top.get("llm_backbone_id") not in BACKBONES:
        top.bad("llm_backbone_id", " or ".join(BACKBONES), unsupported=True)
    text = prismatic.text_section(checkpoint, TEXT, TEXT_FIXED, IGNORED, problems)
    s.lm = prismatic.read_text(text)
    s.tokens = _token_rows(checkpoint, text)
    prismatic.read_towers(checkpoint, s, top)
    _read_head(checkpoint, s, text)
    return s


def _token_rows(checkpoint: Checkpoint, text: Section) -> str:
    """The tensor of token embeddings. Of tied tensors it is the one that the reference loads last: the language head, unless the embedding is
    in a later file."""
    own, head, tied = checkpoint.tensors.get(EMBEDDING), checkpoint.tensors.get(LANGUAGE_HEAD), text.get("tie_word_embeddings")
    if not isinstance(tied, bool):
        text.bad("tie_word_embeddings", "true or false")
    return LANGUAGE_HEAD if tied and head and (own is None or own.path <= head.path) else EMBEDDING


def _read_head(checkpoint: Checkpoint, s: Sizes, text: Section) -> None:
    problems = text.problems
    s.d_state = oft.dim(checkpoint, oft.PROPRIO + "fc1.weight", 1, problems)
    s.d_action = oft.dim(checkpoint, HEAD + "fc2.weight", 0, problems)
    s.is_pro = HEAD + "mlp_resnet_blocks.0.k_self.weight" in checkpoint.tensors
    found = (re.match(re.escape(HEAD) + r"mlp_resnet_blocks\.(\d{1,4})\.", name) for name in checkpoint.tensors)
    n_block = len({match[1] for match in found if match})
    if n_block != s.lm.n_layer:
        hint = "block i reads what layer i of the language model returns"
        text.bad("num_hidden_layers", "{}, the blocks of the action head".format(n_block), hint=hint, unsupported=True)
    multiple = 2 * N_HEAD if s.is_pro else N_HEAD
    if s.lm.d_model % multiple:
        text.bad("hidden_size", "a multiple of {}, for the heads of the action head".format(multiple))


def network_keys(s: Sizes) -> List[Key]:
    return keys_of(
        {
            "policy": pick(s, "d_state d_action horizon n_query n_task"),
            **prismatic.module_keys(s),
            "head": dict(version="pro" if s.is_pro else "original", n_head=N_HEAD, norm_eps=NORM_EPS),
            "solver": dict(steps=1, kind="direct", noise="none"),
        }
    )


def weights(s: Sizes, pixels: List[Dict[str, tuple]]) -> Rows:
    """Rows of all tensors. `pixels`: mean and std of each tower's pixels."""
    return [
        *prismatic.image_weights(s, pixels),
        *decoder(s.lm, LM, QWEN2, tokens=s.tokens),
        *table("queries", QUERIES, N_QUERY, s.lm.d_model),
        *oft.projector("state", oft.PROPRIO, s.lm.d_model, s.d_state),
        *oft.head(HEAD, s.lm.d_model, s.d_action, s.lm.n_layer, lambda target, source: _attention(s, target, source)),
    ]


def _attention(s: Sizes, target: str, source: str) -> Rows:
    d, rows = s.lm.d_model, []
    for ours, theirs in _projections(s.is_pro):
        rows += linear(target + ours, source + theirs, d, d)
    return rows + vector(target + "gate.weight", source + "gating_factor", 1)


def _projections(is_pro: bool) -> List[Tuple[str, str]]:
    """Names of a block's matrices in the bundle and in the checkpoint."""
    kinds = (("", "self"), ("actions.", "adapter"), ("task.", "task")) if is_pro else ()
    keys = [("{}attn_{}".format(ours, part), "{}_{}".format(part, theirs)) for ours, theirs in kinds for part in "kv"]
    return [("attn_q", "q_proj"), *(keys or [("attn_k", "k_proj"), ("attn_v", "v_proj")]), ("attn_out", "o_proj")]


def dropped(s: Sizes) -> List[Dropped]:
    """Tensors without effect on actions."""
    d, out = s.lm.d_model, prismatic.dropped(s)
    other = EMBEDDING if s.tokens == LANGUAGE_HEAD else LANGUAGE_HEAD
    out.append(Dropped(other, (s.lm.n_vocab, d), "no action depends on it: it is the language head, or what its tied rows replace"))
    for i in range(s.lm.n_layer if s.is_pro else 0):
        film = "{}mlp_resnet_blocks.{}.film_gen.0".format(HEAD, i)
        out += [Dropped(row.source, row.stored, "the reference does not call it") for row in linear("", film, 2 * d, d)]
    return out
