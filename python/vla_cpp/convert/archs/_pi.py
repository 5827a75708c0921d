# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What π0 and π0.5 share: one plan for both, from LeRobot's checkpoints and from openpi's."""

from __future__ import annotations

import json
import os
from typing import Dict, List

from .. import recipe
from ..bundle import Key, keys_by_type
from ..checkpoint import OPENPI, Checkpoint
from ..errors import Code, ConvertError, Problems, refuse
from ..files import BACKBONE_PATTERNS, download
from ..tokenizer import TokenizerPlan, read_tokenizer
from . import TABLE, Dropped, Options, Plan, Weight
from . import _pi_names as names
from ._lerobot import tokenizer_folder
from ._openpi import read_openpi
from ._pi_lerobot import read_lerobot
from ._pi_sizes import Sizes, network_keys
from ._pi_source import Family
from ._rows import KEPT_OF_LAST, gated_block, linear, siglip, vector

TOKENIZER = "google/paligemma-3b-pt-224"  # a literal of the reference


def make_plan(family: Family, checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    read = read_openpi if checkpoint.layout == OPENPI else read_lerobot
    source = read(family, checkpoint, options, problems)
    checkpoint.tensors = names.rename(
        checkpoint.tensors, family.time_mlp, family.other_time_mlp, checkpoint.notes, problems
    )
    tokenizer = read_tokenizer(
        _tokenizer(checkpoint, options, source.processors), source.sizes.n_vocab, problems, checkpoint.notes
    )
    _check_newline(source.text, tokenizer, problems)
    tokenize = {"op": "tokenize", "max_tokens": source.max_tokens, "truncate": tokenizer.truncate}
    document = {
        "image": source.image,
        "text": [*source.text, tokenize],
        "state": source.state,
        "action": source.action,
    }
    keys = [
        *keys_by_type(network_keys(source.sizes)),
        *source.features,
        Key("observation.max_text_tokens", "u32", source.max_tokens),
        *tokenizer.keys,
        Key("processor.recipe", "string", json.dumps(document, ensure_ascii=False)),
    ]
    problems.raise_any()
    weights = [row._replace(keep_f32=not _rounded(row)) for row in _weights(family, source.sizes, checkpoint)]
    return Plan(keys, weights, _dropped(family, source.sizes, checkpoint), source.statistics, _hints(source.sizes))


def _tokenizer(checkpoint: Checkpoint, options: Options, processors: recipe.Processors) -> str:
    """The folder with the tokenizer: the checkpoint's own, --backbone, or the one that the reference names."""
    own = tokenizer_folder(checkpoint, options, processors) or options.backbone
    if own:
        if not os.path.isdir(own):
            raise refuse("--backbone " + own, "a folder", "none", code=Code.IO)
        return own
    try:
        folder, revision = download(TOKENIZER, BACKBONE_PATTERNS)
    except ConvertError as error:
        raise refuse(
            "tokenizer " + TOKENIZER,
            "--backbone DIR, tokenizer/ inside the checkpoint, or a reachable hub",
            error.problems[0].found,
            "give the folder with its tokenizer.json or tokenizer.model by --backbone",
            Code.IO,
        )
    checkpoint.notes.append("tokenizer: {} at revision {}".format(TOKENIZER, revision))
    return folder


def _check_newline(text: List[dict], tokenizer: TokenizerPlan, problems: Problems) -> None:
    """openpi encodes the newline apart from the text. The same ids come out of both together unless a token spans them."""
    if not any(op["op"] == "ensure_suffix" for op in text):
        return
    tokens = next(key.value for key in tokenizer.keys if key.name == "tokenizer.tokens")
    spanning = next((token for token in tokens if token.endswith("\n") and token.strip("\n")), None)
    if spanning is not None:
        problems.unsupported("tokenizer.json: model.vocab", "a newline in no token but its own runs", repr(spanning))


def _rounded(weight: Weight) -> bool:
    """What LeRobot rounds in bfloat16: neither the vision tower nor norms, nor the projections outside the towers
    (to_bfloat16_for_selected_params)."""
    return weight.target.startswith(("lm.", "expert.blk.")) and ".dense." not in weight.target


def _weights(family: Family, s: Sizes, checkpoint: Checkpoint) -> List[Weight]:
    embedding = names.EMBEDDING if names.EMBEDDING in checkpoint.tensors else names.LM_HEAD
    return [
        *siglip(names.VISION, s.d_vision, s.d_vision_ff, s.n_vision_layer, s.patch_size, s.n_position),
        *linear("projector", names.PROJECTOR, s.d_model, s.d_vision, bias=True),
        Weight("lm.token_embd.weight", embedding, TABLE, (s.n_vocab, s.d_model), (s.n_vocab, s.d_model)),
        *_language(s),
        *_projections(family, s),
        *_expert(family, s),
        *linear("action_out", names.ROOT + "action_out_proj", s.d_action, s.d_expert, bias=True),
    ]


def _language_block(s: Sizes, i: int) -> Dict[str, List[Weight]]:
    target, source = "lm.blk.{}.".format(i), "{}layers.{}.".format(names.LM, i)
    d_kv = s.n_head_kv * s.d_head
    block = gated_block(target, source, s.d_model, s.n_head * s.d_head, d_kv, s.d_model, s.d_ff)
    return {part: [_plus_one(weight) for weight in rows] if "norm" in part else rows for part, rows in block.items()}


def _plus_one(weight: Weight) -> Weight:
    return weight._replace(plus_one=True)


def _language(s: Sizes) -> List[Weight]:
    return [
        weight
        for i in range(s.n_layer)
        for part, rows in _language_block(s, i).items()
        if i < s.n_layer - 1 or part in KEPT_OF_LAST
        for weight in rows
    ]


def _projections(family: Family, s: Sizes) -> List[Weight]:
    d, root = s.d_expert, names.ROOT
    rows = linear("action_in", root + "action_in_proj", d, s.d_action, bias=True)
    if not family.state_token:
        rows += linear("time_mlp_in", root + "time_mlp_in", d, d, bias=True)
        return rows + linear("time_mlp_out", root + "time_mlp_out", d, d, bias=True)
    rows += linear("state_in", root + "state_proj", d, s.d_state, bias=True)
    rows += linear("action_time_in", root + "action_time_mlp_in", d, 2 * d, bias=True)
    return rows + linear("action_time_out", root + "action_time_mlp_out", d, d, bias=True)


def _expert(family: Family, s: Sizes) -> List[Weight]:
    rows: List[Weight] = []
    for i in range(s.n_layer):
        target, source = "expert.blk.{}.".format(i), "{}layers.{}.".format(names.EXPERT, i)
        d_kv = s.n_head_kv * s.d_head
        block = gated_block(target, source, s.d_expert, s.n_head * s.d_head, d_kv, s.d_expert, s.d_expert_ff)
        block["attn_norm"] = _expert_norm(family, s, target + "attn_norm", source + "input_layernorm")
        block["ffn_norm"] = _expert_norm(family, s, target + "ffn_norm", source + "post_attention_layernorm")
        rows += [weight for part in block.values() for weight in part]
    return rows + _expert_norm(family, s, "expert.norm", names.EXPERT + "norm")


def _expert_norm(family: Family, s: Sizes, target: str, source: str) -> List[Weight]:
    if family.state_token:
        return [_plus_one(weight) for weight in vector(target + ".weight", source + ".weight", s.d_expert)]
    return linear(target + ".dense", source + ".dense", 3 * s.d_expert, s.d_expert, bias=True)


def _dropped(family: Family, s: Sizes, checkpoint: Checkpoint) -> List[Dropped]:
    last = [
        weight for part, rows in _language_block(s, s.n_layer - 1).items() if part not in KEPT_OF_LAST for weight in rows
    ]
    head = [Dropped(names.LM_HEAD, (s.n_vocab, s.d_model), "the embedding table is stored under its own name too")]
    rows = [
        *(head if names.EMBEDDING in checkpoint.tensors else []),
        Dropped(names.EXPERT_HEAD, (s.n_vocab, s.d_expert), "no action depends on the expert's language head"),
        Dropped(names.LM + "norm.weight", (s.d_model,), "the prefix leaves only keys and values"),
        *(Dropped(row.source, row.stored, "the last language layer leaves only keys and values") for row in last),
    ]
    if family.state_token:
        return rows
    # The reference's loader passes these over in a checkpoint of π0.5.
    reason = "π0.5 has its state in the prompt and its norms without weights of their own"
    norms = ["{}layers.{}.{}.weight".format(names.EXPERT, i, n) for i in range(s.n_layer) for n in NORMS]
    rows += [Dropped(name, (s.d_expert,), reason) for name in [*norms, names.EXPERT + "norm.weight"]]
    rows.append(Dropped(names.ROOT + "state_proj.weight", (s.d_expert, s.d_action), reason))
    return [*rows, Dropped(names.ROOT + "state_proj.bias", (s.d_expert,), reason)]


NORMS = ("input_layernorm", "post_attention_layernorm")


def _hints(s: Sizes) -> Dict[str, str]:
    text = "the {} layers are 0 to {}".format("{}", s.n_layer - 1)
    return {
        names.LM + "layers.": text.format("language model's"),
        names.EXPERT + "layers.": text.format("expert's"),
        names.VISION + "encoder.layers.": "the tower's layers are 0 to {}".format(s.n_vision_layer - 1),
    }
