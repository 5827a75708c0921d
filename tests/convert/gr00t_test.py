# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of GR00T N1.7 checkpoints."""

import numpy as np
import pytest

from tiny_gr00t import (
    D_ACTION,
    D_DIT,
    D_HIDDEN,
    D_MODEL,
    D_STATE,
    D_VISION,
    EDGE,
    HORIZON,
    IDS,
    MAX_SEQ,
    N_DIT_LAYER,
    N_EMBODIMENT,
    N_LAYER,
    OTHER,
    PATCH,
    TAG,
    TinyGr00t,
)

VISUAL, LM, HEAD = "backbone.model.model.visual.", "backbone.model.model.language_model.", "action_head."


def convert(converter, tiny=None, **options):
    return converter.bundle(tiny or TinyGr00t(), **{"embodiment": TAG, **options})


def test_every_number_that_a_robot_needs_is_in_its_bundle(converter):
    tiny = TinyGr00t()
    bundle = convert(converter, tiny)
    own = [name for name in tiny.tensors if name.endswith((".W", ".b"))]
    needed = sum(array.size // (N_EMBODIMENT if name in own else 1) for name, array in tiny.tensors.items())
    found = sum(array.size for name, array in bundle.tensors.items() if not name.startswith("stats."))
    assert found == needed - D_MODEL  # the final norm, which nothing reads
    assert bundle.keys["vla.arch"] == "gr00t_n1_7" and bundle.keys["vla.dtype"] == "f32"
    assert list(converter.summary.dropped.values()) == [[LM + "norm.weight"]]


ONE = {
    "vision.position.weight": VISUAL + "pos_embed.weight",
    "vision.blk.2.ffn_norm.bias": VISUAL + "blocks.2.norm2.bias",
    "vision.blk.1.attn_out.weight": VISUAL + "blocks.1.attn.proj.weight",
    "vision.blk.0.ffn_down.weight": VISUAL + "blocks.0.mlp.linear_fc2.weight",
    "connector.norm.weight": VISUAL + "merger.norm.weight",
    "connector.down.bias": VISUAL + "merger.linear_fc2.bias",
    "deepstack.1.norm.bias": VISUAL + "deepstack_merger_list.1.norm.bias",
    "deepstack.1.up.weight": VISUAL + "deepstack_merger_list.1.linear_fc1.weight",
    "lm.token_embd.weight": LM + "embed_tokens.weight",
    "lm.blk.1.attn_q_norm.weight": LM + "layers.1.self_attn.q_norm.weight",
    "lm.blk.1.attn_k_norm.weight": LM + "layers.1.self_attn.k_norm.weight",
    "lm.blk.0.ffn_norm.weight": LM + "layers.0.post_attention_layernorm.weight",
    "lm.blk.0.ffn_gate.weight": LM + "layers.0.mlp.gate_proj.weight",
    "vl.norm.bias": HEAD + "vlln.bias",
    "vl.blk.0.ffn_norm.weight": HEAD + "vl_self_attention.transformer_blocks.0.norm3.weight",
    "vl.blk.0.attn_v.bias": HEAD + "vl_self_attention.transformer_blocks.0.attn1.to_v.bias",
    "time_in.weight": HEAD + "model.timestep_encoder.timestep_embedder.linear_1.weight",
    "time_out.bias": HEAD + "model.timestep_encoder.timestep_embedder.linear_2.bias",
    "dit.blk.3.ada.weight": HEAD + "model.transformer_blocks.3.norm1.linear.weight",
    "dit.blk.2.attn_k.weight": HEAD + "model.transformer_blocks.2.attn1.to_k.weight",
    "dit.blk.1.attn_out.bias": HEAD + "model.transformer_blocks.1.attn1.to_out.0.bias",
    "dit.blk.0.ffn_up.weight": HEAD + "model.transformer_blocks.0.ff.net.0.proj.weight",
    "dit.out_ada.bias": HEAD + "model.proj_out_1.bias",
    "dit.out.weight": HEAD + "model.proj_out_2.weight",
    "action_position.weight": HEAD + "position_embedding.weight",
}


def test_tensors_come_from_where_the_mapping_says(converter):
    tiny = TinyGr00t()
    bundle = convert(converter, tiny)
    for target, source in ONE.items():
        np.testing.assert_array_equal(bundle.tensors[target], tiny.tensors[source], err_msg=target)


@pytest.mark.parametrize("tag", [TAG, OTHER])
def test_a_robots_weights_are_its_slices_turned_to_outputs_before_inputs(converter, tag):
    tiny = TinyGr00t()
    bundle = convert(converter, tiny, embodiment=tag)
    for target, source in {
        "state_in": "state_encoder.layer1",
        "state_out": "state_encoder.layer2",
        "action_in": "action_encoder.W1",
        "action_mix": "action_encoder.W2",
        "action_token": "action_encoder.W3",
        "decode_in": "action_decoder.layer1",
        "decode_out": "action_decoder.layer2",
    }.items():
        stored = {part: tiny.tensors["{}{}.{}".format(HEAD, source, part)][IDS[tag]] for part in "Wb"}
        np.testing.assert_array_equal(bundle.tensors[target + ".weight"], stored["W"].T)
        np.testing.assert_array_equal(bundle.tensors[target + ".bias"], stored["b"])


def test_the_time_slices_of_the_patch_convolution_are_two_matrices(converter):
    tiny = TinyGr00t()
    bundle, stored = convert(converter, tiny), tiny.tensors[VISUAL + "patch_embed.proj.weight"]
    for target, time in (("vision.patch_embed.weight", 0), ("vision.patch_embed_next.weight", 1)):
        np.testing.assert_array_equal(bundle.tensors[target], stored[:, :, time].reshape(D_VISION, 3 * PATCH**2))


@pytest.mark.parametrize("part, name", list(enumerate(("attn_q", "attn_k", "attn_v"))))
def test_stacked_queries_keys_and_values_are_cut_apart(converter, part, name):
    tiny = TinyGr00t()
    bundle, rows = convert(converter, tiny), slice(part * D_VISION, (part + 1) * D_VISION)
    for kind in ("weight", "bias"):
        stored = tiny.tensors["{}blocks.1.attn.qkv.{}".format(VISUAL, kind)]
        np.testing.assert_array_equal(bundle.tensors["vision.blk.1.{}.{}".format(name, kind)], stored[rows])


def test_bf16_slices_are_rounded_like_all_matrices(converter):
    bundle = convert(converter, dtype="bf16")
    assert bundle.dtypes["action_mix.weight"] == "bf16" and bundle.tensors["action_mix.weight"].shape == (
        D_DIT,
        2 * D_DIT,
    )
    assert bundle.dtypes["action_mix.bias"] == "f32"


def test_keys_state_the_network(converter):
    keys = convert(converter).keys
    expected = {
        "policy.d_state": D_STATE,
        "policy.d_action": D_ACTION,
        "policy.horizon": HORIZON,
        "policy.n_position": MAX_SEQ,
        "policy.max_views": 2,
        "vision.image_width": EDGE,
        "vision.image_height": EDGE,
        "vision.n_position_side": 3,
        "vision.merge": 2,
        "vision.deepstack_layers": [0, 2],
        "lm.n_layer": N_LAYER,
        "lm.rope_base": 5e6,
        "lm.rope_sections": [2, 1, 1],
        "vl.n_layer": 1,
        "vl.n_head": 6,
        "vl.d_ff": 4 * D_MODEL,
        "dit.n_layer": N_DIT_LAYER,
        "dit.d_ff": 4 * D_DIT,
        "dit.d_out": D_HIDDEN,
        "dit.attend_text_every_n_blocks": 2,
        "dit.d_time": 256,
        "dit.n_bucket": 1000,
        "dit.norm_eps": pytest.approx(1e-5),
        "dit.out_eps": pytest.approx(1e-6),
        "vision.norm_eps": pytest.approx(1e-6),
        "solver.steps": 3,
        "solver.kind": "euler",
        "solver.noise": "normal",
        "solver.t_start": 0.0,
        "solver.t_end": 1.0,
        "observation.views": ["observation.images.front", "observation.images.wrist"],
        "observation.view_optional": [0, 0],
        "observation.min_views": 2,
        "observation.states": ["state.x", "state.gripper"],
        "observation.state_dims": [1, 2],
        "observation.state_names": ["x", "gripper.0", "gripper.1"],
        "action.names": ["x", "gripper"],
    }
    assert {name: keys[name] for name in expected} == expected


def test_views_start_behind_the_words_of_the_prompt(converter):
    keys = convert(converter).keys
    # <|im_start|>, five tokens of "user" and a line's end, <|vision_start|>, 9 image tokens, <|vision_end|>, <|vision_start|>
    assert keys["policy.view_starts"] == [7, 7 + 9 + 2]
    assert keys["observation.max_text_tokens"] == 6 + 2 * 11 + 1 + 512


def test_the_processors_files_may_lie_below_a_folder(converter):
    tiny = TinyGr00t()
    tiny.below = "processor"
    assert convert(converter, tiny).keys["observation.min_views"] == 2


def test_a_tag_without_an_index_has_that_of_the_authors_table(converter):
    tiny = TinyGr00t()
    tiny.robots["libero_sim"], tiny.statistics["libero_sim"] = tiny.robots[TAG], tiny.statistics[TAG]
    bundle = convert(converter, tiny, embodiment="libero_sim")
    stored = tiny.tensors[HEAD + "state_encoder.layer1.b"][2]
    np.testing.assert_array_equal(bundle.tensors["state_in.bias"], stored)
    assert any("authors' table" in note for note in converter.summary.notes)


def test_a_checkpoint_without_attention_over_its_features_has_no_layers_of_it(converter):
    tiny = TinyGr00t()
    del tiny.config["vl_self_attention_cfg"]
    tiny.tensors = {name: array for name, array in tiny.tensors.items() if "vl_self_attention" not in name}
    bundle = convert(converter, tiny)
    assert bundle.keys["vl.n_layer"] == 0 and not any(name.startswith("vl.blk") for name in bundle.tensors)


def test_cameras_may_bear_full_names(converter):
    tiny = TinyGr00t()
    tiny.robots[TAG]["video"]["modality_keys"][0] = "observation.images.front"
    assert convert(converter, tiny).keys["observation.views"][0] == "observation.images.front"


def test_both_spellings_of_the_rotary_embedding_are_read(converter):
    tiny = TinyGr00t()
    text = tiny.backbone["text_config"]
    text["rope_parameters"] = {**text.pop("rope_scaling"), "rope_theta": text.pop("rope_theta")}
    assert convert(converter, tiny).keys["lm.rope_base"] == 5e6
