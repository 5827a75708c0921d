# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What bundles of π0 and π0.5 hold."""

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
from vla_cpp.convert.archs import pi0, pi05
from vla_cpp.convert.archs.pi0 import mapping
from vla_cpp.convert.checkpoint import Checkpoint
from vla_cpp.convert.dtypes import f32_to_bf16
from vla_cpp.convert.errors import Problems
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


def test_relative_actions_of_which_every_joint_is_excluded_add_nothing(converter):
    found = recipe(converter.bundle(TinyPi("pi0").relative(["a1", "a2", "a3", "a4", "a5"], ["a"])))
    assert [op["op"] for op in found["action"]] == ["take", "unnormalize"]


def test_missing_quantiles_can_be_passed_over_only_in_words(converter):
    tiny = TinyPi("pi05")
    for name in ("observation.state.q01", "observation.state.q99"):
        del tiny.stats[name]
    bundle = converter.bundle(tiny, identity_stats=["observation.state"])
    assert [op["op"] for op in recipe(bundle)["state"]] == ["bins"]
    assert any("DEGRADED" in note for note in converter.summary.notes)


def test_a_base_policy_whose_normalizers_list_no_feature_needs_statistics_or_leave(converter):
    tiny = TinyPi("pi05")
    converter.save(tiny)
    for name in ("policy_preprocessor", "policy_postprocessor"):
        file = converter.folder / f"{name}.json"
        pipeline = json.loads(file.read_text())
        for step in pipeline["steps"]:
            if "norm_map" in step["config"]:
                step["config"]["features"] = {}
                del step["state_file"]
        file.write_text(json.dumps(pipeline))
    error = converter.refusal().message()
    assert "--identity-stats observation.state" in error and "--identity-stats action" in error
    found = recipe(converter.bundle(identity_stats=["observation.state", "action"]))
    assert [op["op"] for op in found["state"]] == ["bins"] and [op["op"] for op in found["action"]] == ["take"]


@pytest.mark.parametrize(
    "family, total, count", [(pi0.FAMILY, 3_238_048_528, 776), (pi05.FAMILY, 3_353_433_872, 811)]
)
def test_the_published_size_asks_for_the_published_tensors(tmp_path, family, total, count):
    checkpoint = Checkpoint("published", str(tmp_path), "", {}, {}, {}, {}, None)
    problems = Problems("published")
    policy = Section("config.json", {}, {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}, problems)
    sizes = mapping.read_towers(policy, checkpoint, problems)
    problems.raise_any()
    sizes.vision.image_size, sizes.d_state, sizes.d_action = 224, 32, 32
    unused = ("gemma_expert.lm_head", "state_proj") if family is pi05.FAMILY else ("gemma_expert.lm_head",)
    dropped = [
        row
        for row in mapping.dropped(family, sizes, checkpoint)
        if not any(part in row.source for part in unused) and (family is pi0.FAMILY or EXPERT not in row.source)
    ]
    rows = [*mapping.weights(family, sizes, checkpoint), *dropped]
    assert len({row.source for row in rows}) == len(rows) == count
    assert sum(int(np.prod(row.stored)) for row in rows) == total


def test_every_name_of_today_is_its_own_canonical_name():
    for kind in ("pi0", "pi05"):
        family = pi0.FAMILY if kind == "pi0" else pi05.FAMILY
        for name in TinyPi(kind).tensors:
            assert mapping.canonical(name, family.time_mlp, family.other_time_mlp) == name
