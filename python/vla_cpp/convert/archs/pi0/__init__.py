# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0: PaliGemma prefix, an action expert with joint attention, and the state as a separate token.

Reference: lerobot src/lerobot/policies/pi0 and openpi src/openpi/models_pytorch; π0.5 (pi05.py) has the same plan.
"""

from __future__ import annotations

from functools import partial
from typing import List

from ...bundle import Key
from ...checkpoint import OPENPI, Checkpoint
from ...errors import Problems
from ...lerobot import given_tokenizer
from ...recipe import recipe_key
from ...tokenizer import TokenizerPlan, read_tokenizer
from .. import Options, Plan
from .layouts import read_lerobot, read_openpi, read_variant, variants_of
from .mapping import Family, canonical, dropped, hints, network_keys, rename, rounded, weights

TOKENIZER = "google/paligemma-3b-pt-224"  # a literal of the reference


def make_plan(family: Family, checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    read = read_openpi if checkpoint.layout == OPENPI else read_lerobot
    source = read(family, checkpoint, options, problems)
    merged = sum(getattr(tensor, "has_adapter", False) for tensor in checkpoint.tensors.values())
    if merged:
        checkpoint.notes.append("LoRA of openpi's training: merged into {} tensors".format(merged))
    checkpoint.tensors = rename(checkpoint.tensors, family.time_mlp, family.other_time_mlp, checkpoint.notes, problems)
    if checkpoint.adapter:
        checkpoint.adapter = checkpoint.adapter.renamed(lambda name: canonical(name, family.time_mlp, family.other_time_mlp))
    folder = given_tokenizer(checkpoint, options, source.processors, TOKENIZER)
    tokenizer = read_tokenizer(folder, source.sizes.lm.n_vocab, problems, checkpoint.notes)
    _check_newline(source.text, tokenizer, problems)
    tokenize = {"op": "tokenize", "max_tokens": source.max_tokens, "truncate": tokenizer.truncate}
    document = {"image": source.image, "text": [*source.text, tokenize], "state": source.state, "action": source.action}
    keys = [
        *network_keys(source.sizes),
        *source.features,
        Key("observation.max_text_tokens", "u32", source.max_tokens),
        *tokenizer.keys,
        recipe_key(document),
    ]
    problems.raise_any()
    rows = [row._replace(keep_f32=not rounded(row)) for row in weights(family, source.sizes, checkpoint)]
    return Plan(keys, rows, dropped(family, source.sizes, checkpoint), source.statistics, hints(source.sizes))


def _check_newline(text: List[dict], tokenizer: TokenizerPlan, problems: Problems) -> None:
    """Checks that no token spans text and newline: openpi encodes the final newline separately, the runtime together with the text."""
    if not any(op["op"] == "ensure_suffix" for op in text):
        return
    spanning = next((token for token in tokenizer.tokens if token.endswith("\n") and token.strip("\n")), None)
    if spanning is not None:
        problems.unsupported("tokenizer.json: model.vocab", "a newline in no token but its own runs", repr(spanning))


FAMILY = Family(arch="pi0", config_class="PI0Config", max_tokens=48, time_mlp="action_time_mlp", other_time_mlp="time_mlp")
VARIANTS = variants_of("pi0")
__all__ = ["FAMILY", "VARIANTS", "make_plan", "plan", "read_variant"]
plan = partial(make_plan, FAMILY)
