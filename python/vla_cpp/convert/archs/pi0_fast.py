# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0-FAST: PaliGemma generates tokens, which FAST decodes to a chunk; there is no expert, and the state is part of the prompt.

Reference: lerobot src/lerobot/policies/pi0_fast. pi0/ has the common part with π0 and π0.5.
"""

from __future__ import annotations

import os
from typing import Dict, List

from .. import recipe
from ..action_tokens import Spoken, read_action_tokens
from ..bundle import Key
from ..checkpoint import Checkpoint
from ..errors import Code, Problems, refuse
from ..features import robot_keys
from ..hub import ACTION_TOKENIZER_PATTERNS, HUB_FORM, hub_folder
from ..layers import Rows, linear
from ..lerobot import action_width, check_keys, check_widths, given_tokenizer, no_position_rule, read_views, state_width, view_keys
from ..networks import keys_of, pick
from ..section import Section
from ..tokenizer import TokenizerPlan, read_tokenizer
from . import Options, Plan
from .pi0 import TOKENIZER
from .pi0.layouts import BINS, CLEAN
from .pi0.mapping import EMBEDDING, LM, LM_HEAD, VISION, Sizes, canonical, check_image, paligemma, read_paligemma, rename, rounded

ACTION_TOKENIZER, FOLDER = "lerobot/fast-action-tokenizer", "action_tokenizer"
# Keys of config.json with the defaults of the reference's class.
CONFIG: Dict[str, object] = {
    "paligemma_variant": "gemma_2b",
    "dtype": "float32",
    "chunk_size": 50,
    "n_action_steps": 50,
    "max_state_dim": 32,
    "max_action_dim": 32,
    "image_resolution": [224, 224],
    "empty_cameras": 0,
    "use_relative_actions": False,
    "max_decoding_steps": 256,
    "fast_skip_tokens": 128,
    "validate_action_token_prefix": True,
}
FIXED = {"temperature": (0.0, "the runtime takes the likeliest token and draws none")}
# Keys without effect on the numbers of an action chunk: the reference reads them only in training, or the pipelines state them; its cache does
# not change results.
IGNORED = set(
    """
    action_expert_variant tokenizer_max_length text_tokenizer_name action_tokenizer_name max_action_tokens use_kv_cache
    gradient_checkpointing relative_exclude_joints action_feature_names
    """.split()
)
STEPS: recipe.Steps = {
    recipe.PRE: {
        "pi0_fast_prepare_state_tokenizer_processor_step": {"max_state_dim": recipe.ANY, "task_key": ("task",)},
        # Only training uses this step: an observation has no action.
        "action_tokenizer_processor": {"trust_remote_code": recipe.ANY, "max_action_tokens": recipe.ANY, "action_tokenizer_name": recipe.ANY},
        **recipe.RELATIVE[recipe.PRE],
    },
    recipe.POST: recipe.RELATIVE[recipe.POST],
}
PROMPT = {"op": "template", "text": "Task: {instruction}, State: {state};\n"}


def plan(checkpoint: Checkpoint, options: Options, problems: Problems) -> Plan:
    policy = Section("config.json", checkpoint.config, CONFIG, problems)
    no_position_rule(policy, options, problems)
    check_keys(policy, "PI0FastConfig", set(CONFIG) | IGNORED, FIXED)
    sizes, spoken = _sizes(policy, checkpoint, options, problems)
    views, _ = read_views(policy, checkpoint)
    problems.raise_any()
    dims = {recipe.STATE: sizes.state_dim, recipe.ACTION: sizes.action_dim}
    if checkpoint.processors is None:
        raise refuse(recipe.PRE, "the pipelines of LeRobot, with statistics", "none", "save the policy with LeRobot", Code.UNSUPPORTED)
    processors = recipe.read_processors(checkpoint, dims, options.identity_stats, problems, STEPS)
    if not processors.discrete_state:
        problems.add(recipe.PRE + ": steps", "pi0_fast_prepare_state_tokenizer_processor_step", "none")
    if processors.relative != bool(policy.get("use_relative_actions")):
        policy.bad("use_relative_actions", "{} as the pipelines have it".format(processors.relative))
    checkpoint.tensors = rename(checkpoint.tensors, "time_mlp", "time_mlp", checkpoint.notes, problems)
    if checkpoint.adapter:
        checkpoint.adapter = checkpoint.adapter.renamed(lambda name: canonical(name, "time_mlp", "time_mlp"))
    text = _with_bos(read_tokenizer(given_tokenizer(checkpoint, options, processors, TOKENIZER), sizes.lm.n_vocab, problems, checkpoint.notes), problems)
    actions = read_action_tokens(_action_tokenizer(checkpoint, options), text, sizes.lm.n_vocab, spoken, problems)
    max_tokens = processors.max_tokens + 1  # the reference's limit does not count the token after the prompt
    tokenize = {"op": "tokenize", "max_tokens": max_tokens, "truncate": text.truncate}
    document = {
        "image": [
            recipe.letterbox(*[sizes.vision.image_size] * 2, "center"),
            {"op": "clip", "low": 0.0, "high": 1.0},
            {"op": "affine", "scale": 2.0, "shift": -1.0},
        ],
        "text": [*CLEAN, PROMPT, tokenize],
        "state": [*processors.state.op("normalize", recipe.STATE), BINS],
        "action": [
            *processors.action.op("unnormalize", recipe.ACTION),
            *([{"op": "add_state", "columns": list(processors.add_state)}] if processors.add_state else []),
        ],
    }
    keys = [
        *network_keys(sizes),
        *robot_keys(view_keys(checkpoint, views, processors, problems), dims, options.dataset_info, checkpoint.notes, problems),
        Key("observation.max_text_tokens", "u32", max_tokens),
        *text.keys,
        *actions,
        recipe.recipe_key(document),
    ]
    problems.raise_any()
    rows = [row._replace(keep_f32=not rounded(row)) for row in weights(sizes, checkpoint)]
    return Plan(keys, rows, [], processors.statistics(), _hints(sizes))


def weights(s: Sizes, checkpoint: Checkpoint) -> Rows:
    head = LM_HEAD if LM_HEAD in checkpoint.tensors or EMBEDDING not in checkpoint.tensors else EMBEDDING
    return [*paligemma(s, checkpoint, "norm"), *linear("lm.head", head[: -len(".weight")], s.lm.n_vocab, s.lm.d_model, bias=False)]


def _sizes(policy: Section, checkpoint: Checkpoint, options: Options, problems: Problems):
    s = read_paligemma(policy, checkpoint, problems)
    check_image(policy, "image_resolution", s, policy.get("image_resolution"))
    s.state_dim, s.action_dim = policy.count("max_state_dim"), policy.count("max_action_dim")
    if recipe.STATE in (policy.get("input_features") or {}):
        s.state_dim = state_width(policy, checkpoint, options)
    if recipe.ACTION in (policy.get("output_features") or {}):
        s.action_dim = action_width(policy, checkpoint, options)
    check_widths(policy, {})
    s.d_action, s.horizon, s.n_step = s.action_dim, policy.count("n_action_steps"), policy.count("max_decoding_steps")
    if s.horizon < policy.count("chunk_size"):
        told = "n_action_steps: the reference decodes an answer as {} rows, though the policy learned to answer with {}"
        checkpoint.notes.append(told.format(s.horizon, policy.get("chunk_size")))
    if policy.get("dtype") not in ("float32", "bfloat16"):
        policy.bad("dtype", "float32 or bfloat16", hint="the reference refuses it too", unsupported=True)
    rtc = policy.get("rtc_config")
    if isinstance(rtc, dict) and rtc.get("enabled", True):
        policy.bad("rtc_config", "none, or enabled: false", hint="the reference does not guide tokens", unsupported=True)
    required = policy.get("validate_action_token_prefix")
    if not isinstance(required, bool):
        policy.bad("validate_action_token_prefix", "true or false")
    return s, Spoken(policy.count("fast_skip_tokens", 0), bool(required))


def _with_bos(text: TokenizerPlan, problems: Problems) -> TokenizerPlan:
    """The tokenizer with <bos> after the prompt too, as in the reference, which truncates the prompt without counting this token."""
    front = next((key.value for key in text.keys if key.name == "tokenizer.prefix_ids"), [])
    if not isinstance(front, list) or len(front) != 1 or text.tokens[front[0]] != "<bos>":
        problems.unsupported("tokenizer", "<bos> in front of every text, as PaliGemma's has", repr(front))
        return text
    return text._replace(keys=[*text.keys, Key("tokenizer.suffix_ids", "u32[]", front)])


def _action_tokenizer(checkpoint: Checkpoint, options: Options) -> str:
    """The folder of --action-tokenizer, else the one in the checkpoint. Errors: I/O."""
    given = options.action_tokenizer
    hub = hub_folder(given, ACTION_TOKENIZER_PATTERNS)
    if hub:
        checkpoint.notes.append("tokenizer of actions: {} at revision {}".format(hub.repo, hub.commit))
        return hub.folder
    if given:
        if not os.path.isdir(given):
            raise refuse("--action-tokenizer " + given, "a folder or " + HUB_FORM, "neither", code=Code.IO)
        return given
    if os.path.isdir(checkpoint.path(FOLDER)):
        checkpoint.notes.append("tokenizer of actions: from {}/ inside the checkpoint".format(FOLDER))
        return checkpoint.path(FOLDER)
    named = str(checkpoint.config.get("action_tokenizer_name", ACTION_TOKENIZER))[:100]
    hint = "--action-tokenizer {} fetches it from the hub".format(HUB_FORM)
    where = "tokenizer of actions {}, which config.json: action_tokenizer_name names".format(named)
    raise refuse(where, "--action-tokenizer DIR, or {}/ inside the checkpoint".format(FOLDER), "neither", hint, Code.IO)


def network_keys(s: Sizes) -> List[Key]:
    return keys_of(
        {
            "policy": dict(pick(s, "d_state d_action horizon"), text_scale=s.lm.d_model**0.5),
            "vision": {**vars(s.vision), "position_rule": "row_major"},
            "lm": s.lm,
            "solver": dict(steps=s.n_step, kind="greedy", noise="none"),
        }
    )


def _hints(s: Sizes) -> Dict[str, str]:
    return {
        LM + "layers.": "the language model's layers are 0 to {}".format(s.lm.n_layer - 1),
        VISION + "encoder.layers.": "the tower's layers are 0 to {}".format(s.vision.n_layer - 1),
    }
