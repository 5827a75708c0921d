# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What bundles of π0 and π0.5 hold, and what LeRobot checkpoints of them are refused for."""

import json

import numpy as np
import pytest

from tiny_pi import (
    ACTION_DIM,
    D_ACTION,
    D_EXPERT,
    D_HEAD,
    D_LM,
    D_STATE,
    EXPERT,
    EXPERT_HEAD,
    HEAD,
    LM,
    N_VOCAB,
    PWE,
    STATE_DIM,
    VISION,
    TinyPi,
)
from vla_cpp.convert.archs import _pi, _pi_names, _pi_sizes, pi0, pi05
from vla_cpp.convert.checkpoint import Checkpoint
from vla_cpp.convert.dtypes import f32_to_bf16
from vla_cpp.convert.errors import Code, Problems
from vla_cpp.convert.section import Section

PAIRS = {  # the bundle's name -> the checkpoint's, one per rule of the mapping
    "vision.position.weight": VISION + "embeddings.position_embedding.weight",
    "vision.blk.0.ffn_norm.bias": VISION + "encoder.layers.0.layer_norm2.bias",
    "vision.blk.0.attn_out.weight": VISION + "encoder.layers.0.self_attn.out_proj.weight",
    "vision.post_norm.weight": VISION + "post_layernorm.weight",
    "projector.weight": PWE + "paligemma.model.multi_modal_projector.linear.weight",
    "projector.bias": PWE + "paligemma.model.multi_modal_projector.linear.bias",
    "lm.token_embd.weight": HEAD,
    "lm.blk.0.attn_q.weight": LM + "layers.0.self_attn.q_proj.weight",
    "lm.blk.0.ffn_gate.weight": LM + "layers.0.mlp.gate_proj.weight",
    "lm.blk.1.attn_k.weight": LM + "layers.1.self_attn.k_proj.weight",
    "lm.blk.1.attn_v.weight": LM + "layers.1.self_attn.v_proj.weight",
    "expert.blk.0.attn_k.weight": EXPERT + "layers.0.self_attn.k_proj.weight",
    "expert.blk.1.attn_out.weight": EXPERT + "layers.1.self_attn.o_proj.weight",
    "expert.blk.1.ffn_down.weight": EXPERT + "layers.1.mlp.down_proj.weight",
    "action_in.weight": "model.action_in_proj.weight",
    "action_out.bias": "model.action_out_proj.bias",
}
OWN = {
    "pi0": {
        "state_in.weight": "model.state_proj.weight",
        "action_time_in.weight": "model.action_time_mlp_in.weight",
        "action_time_out.bias": "model.action_time_mlp_out.bias",
    },
    "pi05": {
        "time_mlp_in.weight": "model.time_mlp_in.weight",
        "time_mlp_out.bias": "model.time_mlp_out.bias",
        "expert.blk.0.attn_norm.dense.weight": EXPERT + "layers.0.input_layernorm.dense.weight",
        "expert.blk.1.ffn_norm.dense.bias": EXPERT + "layers.1.post_attention_layernorm.dense.bias",
        "expert.norm.dense.weight": EXPERT + "norm.dense.weight",
    },
}
NORMS = {
    "lm.blk.0.attn_norm.weight": LM + "layers.0.input_layernorm.weight",
    "lm.blk.0.ffn_norm.weight": LM + "layers.0.post_attention_layernorm.weight",
    "lm.blk.1.attn_norm.weight": LM + "layers.1.input_layernorm.weight",
}
EXPERT_NORMS = {
    "expert.blk.0.attn_norm.weight": EXPERT + "layers.0.input_layernorm.weight",
    "expert.blk.1.ffn_norm.weight": EXPERT + "layers.1.post_attention_layernorm.weight",
    "expert.norm.weight": EXPERT + "norm.weight",
}
KINDS = pytest.mark.parametrize("kind", ["pi0", "pi05"])


def recipe(bundle):
    return json.loads(bundle.keys["processor.recipe"])


@KINDS
def test_every_rule_of_the_mapping_carries_its_tensor_unchanged(converter, kind):
    tiny = TinyPi(kind)
    bundle = converter.bundle(tiny)
    for target, source in {**PAIRS, **OWN[kind]}.items():
        np.testing.assert_array_equal(bundle.tensors[target], tiny.tensors[source], err_msg=target)


@KINDS
def test_norms_of_gemma_are_stored_as_the_factor_that_the_reference_computes(converter, kind):
    tiny = TinyPi(kind)
    bundle = converter.bundle(tiny, dtype="bf16")
    for target, source in {**NORMS, **(EXPERT_NORMS if kind == "pi0" else {})}.items():
        assert bundle.tensors[target].dtype == np.float32
        np.testing.assert_array_equal(bundle.tensors[target], np.float32(1) + tiny.tensors[source], err_msg=target)
    np.testing.assert_array_equal(
        bundle.tensors["vision.post_norm.weight"], tiny.tensors[VISION + "post_layernorm.weight"]
    )


def in_bf16(tiny, choose):
    return {name: ("BF16", f32_to_bf16(value)) if choose(name) else value for name, value in tiny.tensors.items()}


def is_rounded(name):
    """As the reference decides in bfloat16, by the names of its parameters."""
    kept = ("vision_tower", "multi_modal_projector", "input_layernorm", "post_attention_layernorm", "model.norm")
    return name.startswith(PWE) and not any(part in name for part in kept)


@KINDS
def test_a_policy_that_the_reference_saved_in_bfloat16_loses_nothing(converter, kind):
    tiny = TinyPi(kind)
    tiny.tensors = in_bf16(tiny, is_rounded)
    bundle = converter.bundle(tiny)
    assert bundle.keys["vla.dtype"] == "bf16" and converter.summary.rounding[0] == 0
    assert bundle.dtypes["lm.blk.0.attn_k.weight"] == bundle.dtypes["lm.token_embd.weight"] == "bf16"
    assert bundle.dtypes["vision.blk.0.ffn_up.weight"] == bundle.dtypes["action_out.weight"] == "f32"


@KINDS
def test_bf16_rounds_what_the_reference_rounds(converter, kind):
    bundle = converter.bundle(TinyPi(kind), dtype="bf16")
    rounded = {name for name, dtype in bundle.dtypes.items() if dtype == "bf16"}
    assert "expert.blk.1.ffn_down.weight" in rounded and all(name.startswith(("lm.", "expert.blk.")) for name in rounded)
    assert not any("norm" in name for name in rounded)


@KINDS
def test_what_is_stored_in_bfloat16_stays_so(converter, kind):
    tiny = TinyPi(kind)
    tiny.tensors = in_bf16(tiny, lambda name: True)
    dtypes = converter.bundle(tiny).dtypes
    assert dtypes["action_out.weight"] == dtypes["vision.blk.0.ffn_up.weight"] == "bf16"


@KINDS
def test_what_no_action_depends_on_stays_out_and_is_named(converter, kind):
    bundle = converter.bundle(TinyPi(kind))
    assert not [name for name in bundle.tensors if name.startswith("lm.blk.1.ffn") or name == "lm.norm.weight"]
    dropped = [name for names in converter.summary.dropped.values() for name in names]
    assert EXPERT_HEAD in dropped and LM + "norm.weight" in dropped
    assert len(dropped) == 2 + 6


def test_sizes_and_rules_of_the_network_are_keys(converter):
    keys = converter.bundle(TinyPi("pi0")).keys
    for name, value in {
        "vla.arch": "pi0",
        "policy.d_state": D_STATE,
        "policy.d_action": D_ACTION,
        "vision.image_size": 28,
        "vision.position_rule": "row_major",
        "lm.n_vocab": N_VOCAB,
        "lm.d_head": D_HEAD,
        "expert.d_model": D_EXPERT,
        "solver.steps": 3,
        "solver.noise": "normal",
        "lm.rope_base": 10000.0,
    }.items():
        assert keys[name] == value, name
    assert keys["policy.text_scale"] == np.float32(np.sqrt(D_LM))
    assert converter.bundle(TinyPi("pi05")).keys["policy.d_state"] == 0


def test_the_recipe_of_pi0_is_the_references(converter):
    found = recipe(converter.bundle(TinyPi("pi0")))
    assert [op["op"] for op in found["image"]] == ["letterbox", "clip", "affine"]
    assert found["image"][0]["align"] == "center" and found["image"][0]["antialias"] is False
    assert found["text"] == [
        {"op": "ensure_suffix", "suffix": "\n"},
        {"op": "tokenize", "max_tokens": 20, "truncate": "right"},
    ]
    assert found["state"][-1] == {"op": "pad", "size": D_STATE}
    assert [op.get("kind") for op in found["state"]] == ["mean_std", None]
    assert found["action"][0] == {"op": "take", "size": ACTION_DIM}


def test_the_recipe_of_pi05_puts_the_state_into_the_prompt(converter):
    bundle = converter.bundle(TinyPi("pi05"))
    found = recipe(bundle)
    assert [op["op"] for op in found["text"]] == ["strip", "replace", "replace", "template", "tokenize"]
    assert found["text"][3]["text"] == "Task: {instruction}, State: {state};\nAction: "
    assert found["state"] == [
        {"op": "normalize", "kind": "quantiles", "stats": "stats.observation.state", "eps": 1e-8},
        {"op": "bins", "low": -1.0, "high": 1.0, "count": 256},
    ]
    assert bundle.tensors["stats.observation.state.q01"].shape == (STATE_DIM,)


def test_cameras_that_the_config_adds_stand_last_and_may_stay_unmentioned(converter):
    keys = converter.bundle(TinyPi("pi0")).keys
    assert keys["observation.views"][-1] == "observation.images.empty_camera_0"
    assert keys["observation.view_optional"] == [0, 0, 1]
    assert keys["observation.min_views"] == 1


@pytest.mark.parametrize(
    "names, exclude, columns",
    [
        (None, ["gripper"], [0, 1, 2, 3, 4]),
        (["a", "b", "Left_Gripper", "c", "gripper.pos"], ["gripper"], [0, 1, 3]),
        (["a", "gripper"], ["GRIPPER", ""], [0, 2, 3, 4]),
        (["a", "gripper"], [], [0, 1, 2, 3, 4]),
    ],
)
def test_relative_actions_are_added_to_the_joints_that_are_not_excluded(converter, names, exclude, columns):
    found = recipe(converter.bundle(TinyPi("pi0").relative(names, exclude)))
    assert found["action"][-1] == {"op": "add_state", "columns": columns}


TREES = {
    "no prefix": lambda tiny: tiny.rename("model.", ""),
    "towers without model": lambda tiny: tiny.rename(VISION, PWE + "paligemma.vision_tower.vision_model.")
    .rename(PWE + "paligemma.model.multi_modal_projector.", PWE + "paligemma.multi_modal_projector.")
    .rename(LM, PWE + "paligemma.language_model.model.")
    .rename(HEAD, PWE + "paligemma.language_model.lm_head.weight"),
    "no vision_model": lambda tiny: tiny.rename(VISION, PWE + "paligemma.model.vision_tower."),
    "language model without model": lambda tiny: tiny.rename(LM, PWE + "paligemma.language_model."),
    "embedding under its own name": lambda tiny: tiny.rename(HEAD, LM + "embed_tokens.weight"),
    "the other family's time layers": lambda tiny: tiny.rename("model.action_time_mlp", "model.time_mlp"),
    "compiled": lambda tiny: tiny.rename("model.state_proj", "model._orig_mod.state_proj"),
}


@pytest.mark.parametrize("tree", TREES)
def test_trees_of_other_releases_give_the_same_tensors(converter, tree):
    expected = converter.bundle(TinyPi("pi0")).tensors
    found = converter.bundle(TREES[tree](TinyPi("pi0"))).tensors
    assert set(found) == set(expected)
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)


def test_an_embedding_that_is_stored_twice_is_taken_under_its_own_name(converter):
    tiny = TinyPi("pi0")
    tiny.tensors[LM + "embed_tokens.weight"] = tiny.tensors[HEAD] + 1
    bundle = converter.bundle(tiny)
    np.testing.assert_array_equal(bundle.tensors["lm.token_embd.weight"], tiny.tensors[HEAD] + 1)


def test_one_tensor_under_two_names_is_refused(converter):
    tiny = TinyPi("pi0")
    tiny.tensors["state_proj.bias"] = tiny.tensors["model.state_proj.bias"]
    assert "one tensor of this meaning" in converter.refusal(tiny).message()


def test_tensors_of_pi0_that_the_reference_passes_over_in_pi05_are_named(converter):
    tiny = TinyPi("pi05")
    tiny.tensors["model.state_proj.bias"] = np.zeros(D_EXPERT, np.float32)
    tiny.tensors[EXPERT + "layers.0.input_layernorm.weight"] = np.zeros(D_EXPERT, np.float32)
    converter.bundle(tiny)
    assert len([names for reason, names in converter.summary.dropped.items() if "prompt" in reason][0]) == 2


@KINDS
def test_missing_extra_and_misshapen_tensors_are_named_at_once(converter, kind):
    tiny = TinyPi(kind)
    del tiny.tensors["model.action_in_proj.bias"]
    tiny.tensors["model.extra"] = np.zeros(2, np.float32)
    tiny.tensors["model.action_out_proj.weight"] = np.zeros((2, 2), np.float32)
    tiny.tensors[LM + "layers.2.mlp.up_proj.weight"] = np.zeros((2, 2), np.float32)
    error = converter.refusal(tiny)
    assert len(error.problems) == 4 and "the language model's layers are 0 to 1" in error.message()


def without(name):
    return lambda tiny: tiny.stats.pop(name)


def setting(**values):
    return lambda tiny: tiny.config.update(values)


def dims(variant, **values):
    return lambda tiny: tiny.dims[variant].update(values)


REFUSED = {
    "statistics of observation.state: q01: expected 6 numbers for QUANTILES, found none": without("observation.state.q01"),
    "statistics of action: q99: expected 5 numbers": without("action.q99"),
    "config.json: use_visual_memory: expected False": setting(use_visual_memory=True),
    "config.json: brand_new: expected a key of PI05Config": setting(brand_new=1),
    "config.json: image_resolution: expected two equal sides": setting(image_resolution=[28, 42]),
    "config.json: image_resolution: expected two equal sides from": setting(image_resolution=[7, 7]),
    "config.json: paligemma_variant: expected gemma_2b or gemma_300m": setting(paligemma_variant="gemma_2b_lora"),
    "config.json: dtype: expected float32 or bfloat16": setting(dtype="float16"),
    "config.json: rtc_config: expected none": setting(rtc_config={"enabled": True}),
    "config.json: n_action_steps: expected at most chunk_size 4": setting(n_action_steps=5),
    "config.json: use_relative_actions: expected False": setting(use_relative_actions=True),
    "config.json: max_action_dim: expected at least": setting(max_action_dim=3),
    "dims.json: gemma_300m: depth: expected that of the language model": dims("gemma_300m", depth=3),
    "dims.json: gemma_2b: layers: expected one of": dims("gemma_2b", layers=3),
    "dims.json: vision: num_attention_heads: expected a divisor": dims("vision", num_attention_heads=4),
    "dims.json: gemma_2b: head_dim: expected an even number": dims("gemma_2b", head_dim=5),
    "config.json: image_resolution: expected the image_size of dims.json": dims("vision", image_size=224),
    "dims.json: tower: expected": lambda tiny: tiny.dims.update(tower={}),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_checkpoint_of_pi05_is_refused_by_name(converter, message):
    tiny = TinyPi("pi05")
    REFUSED[message](tiny)
    assert message in converter.refusal(tiny).message()


def swap(first, second):
    def change(tiny):
        steps = tiny.pre["steps"]
        i, j = (next(k for k, step in enumerate(steps) if step["registry_name"] == name) for name in (first, second))
        steps[i], steps[j] = steps[j], steps[i]

    return change


def enable(name, value=True):
    return lambda tiny: tiny.step(name)["config"].update(enabled=value)


WORDS = "pi05_prepare_state_tokenizer_processor_step"
ORDERS = {
    "expected normalization before it and tokenization after it": swap(WORDS, "normalizer_processor"),
    "expected the state of the robot, before normalization": swap("relative_actions_processor", "normalizer_processor"),
    "absolute_actions_processor: enabled: expected True": enable("relative_actions_processor"),
    "absolute_actions_processor: enabled: expected False": enable("absolute_actions_processor"),
    "relative_actions_processor: enabled: expected True or False": enable("relative_actions_processor", "yes"),
    "steps: expected " + WORDS: lambda tiny: tiny.pre["steps"].remove(tiny.step(WORDS)),
    "and not the other family's": lambda tiny: tiny.pre["steps"].insert(0, {"registry_name": "pi0_new_line_processor"}),
}


@pytest.mark.parametrize("message", ORDERS)
def test_pipelines_that_the_recipe_cannot_follow_are_refused(converter, message):
    tiny = TinyPi("pi05")
    ORDERS[message](tiny)
    assert message in converter.refusal(tiny).message()


def test_relative_actions_of_which_every_joint_is_excluded_add_nothing(converter):
    found = recipe(converter.bundle(TinyPi("pi0").relative(["a1", "a2", "a3", "a4", "a5"], ["a"])))
    assert [op["op"] for op in found["action"]] == ["take", "unnormalize"]


def test_absolute_actions_without_the_step_that_makes_them_relative_are_refused(converter):
    tiny = TinyPi("pi0").relative()
    tiny.pre["steps"].remove(tiny.step("relative_actions_processor"))
    assert "enabled: expected False as the relative_actions_processor has it" in converter.refusal(tiny).message()


def test_relative_actions_beyond_the_state_are_refused(converter):
    tiny = TinyPi("pi0").relative()
    tiny.config["input_features"]["observation.state"]["shape"] = [3]
    assert "a state with a number for each of the 5 actions" in converter.refusal(tiny).message()


def test_pi0s_newline_is_required_and_smolvlas_is_not_pi0s(converter):
    tiny = TinyPi("pi0")
    tiny.step("pi0_new_line_processor")["registry_name"] = "smolvla_new_line_processor"
    assert "smolvla_new_line_processor" in converter.refusal(tiny).message()


def test_without_pipelines_a_checkpoint_is_of_the_old_layout(converter):
    tiny = TinyPi("pi0")
    tiny.pre = tiny.post = None
    error = converter.refusal(tiny)
    assert error.code == Code.UNSUPPORTED and "save it again" in error.message()


def test_missing_quantiles_can_be_passed_over_only_in_words(converter):
    tiny = TinyPi("pi05")
    for name in ("observation.state.q01", "observation.state.q99"):
        del tiny.stats[name]
    bundle = converter.bundle(tiny, identity_stats=["observation.state"])
    assert [op["op"] for op in recipe(bundle)["state"]] == ["bins"]
    assert any("DEGRADED" in note for note in converter.summary.notes)


def test_weights_that_are_not_finite_are_refused(converter):
    tiny = TinyPi("pi05")
    tiny.tensors["model.time_mlp_in.weight"][1, 2] = np.inf
    assert "finite numbers" in converter.refusal(tiny).message()


@pytest.mark.parametrize(
    "family, total, count", [(pi0.FAMILY, 3_238_048_528, 776), (pi05.FAMILY, 3_353_433_872, 811)]
)
def test_the_published_size_asks_for_the_published_tensors(tmp_path, family, total, count):
    checkpoint = Checkpoint("published", str(tmp_path), "", {}, {}, {}, {}, None)
    problems = Problems("published")
    policy = Section("config.json", {}, {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}, problems)
    sizes = _pi_sizes.read_towers(policy, checkpoint, problems)
    problems.raise_any()
    sizes.image_size, sizes.d_state, sizes.d_action = 224, 32, 32
    unused = ("gemma_expert.lm_head", "state_proj") if family is pi05.FAMILY else ("gemma_expert.lm_head",)
    dropped = [
        row
        for row in _pi._dropped(family, sizes, checkpoint)
        if not any(part in row.source for part in unused) and (family is pi0.FAMILY or EXPERT not in row.source)
    ]
    rows = [*_pi._weights(family, sizes, checkpoint), *dropped]
    assert len({row.source for row in rows}) == len(rows) == count
    assert sum(int(np.prod(row.stored)) for row in rows) == total


def test_every_name_of_today_is_its_own_canonical_name():
    for kind in ("pi0", "pi05"):
        family = pi0.FAMILY if kind == "pi0" else pi05.FAMILY
        for name in TinyPi(kind).tensors:
            assert _pi_names.canonical(name, family.time_mlp, family.other_time_mlp) == name
