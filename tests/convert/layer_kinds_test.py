# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Which attention runs where. The expectations were taken from the reference by running its SmolVLMWithExpertModel over a
prefix and one step and recording the calls; `None` means that it raised."""

import pytest

CASES = [  # vlm layers, num_expert_layers, self_attn_every_n_layers, attention_mode, kinds, input widths of k and v (own 6, cross 4)
    (2, -1, 2, "cross_attn", ["self", "cross"], [6, 4]),
    (4, 0, 2, "cross_attn", ["self", "cross", "self", "cross"], [6, 4, 6, 4]),
    (4, -1, 3, "cross_attn", ["self", "cross", "cross", "self"], [6, 4, 4, 6]),
    (3, -1, 1, "cross_attn", ["self", "self", "self"], [6, 6, 6]),
    (2, -1, 0, "cross_attn", ["cross", "cross"], [4, 4]),
    (2, -1, 2, "self_attn", ["self", "self"], [6, 6]),
    (4, 2, -1, "cross_attn", ["cross", "none", "cross", "none"], [4, 4]),
    (4, 2, 4, "cross_attn", ["self", "none", "cross", "none"], [6, 4]),
    (4, 1, 8, "cross_attn", ["self", "none", "none", "none"], [6]),
    (4, 2, 2, "cross_attn", None, None),  # k and v built by the expert's index, run by the language model's
    (4, 2, 1, "cross_attn", None, None),  # self-attention in a layer that the expert lacks
    (4, 2, 2, "self_attn", None, None),
    (4, 3, 2, "cross_attn", None, None),  # not a divisor
]


def configure(tiny, n_layer, n_expert, every, mode, widths):
    import numpy as np

    from tiny import D_EXPERT, D_EXPERT_FF, D_FF, D_MODEL, EXPERT, VLM, llama_block

    tiny.config.update(
        num_vlm_layers=n_layer, num_expert_layers=n_expert, self_attn_every_n_layers=every, attention_mode=mode
    )
    tiny.backbone["text_config"]["num_hidden_layers"] = 8
    tiny.tensors = {
        name: value
        for name, value in tiny.tensors.items()
        if "text_model.layers." not in name and "lm_expert.layers." not in name
    }
    blocks = {}
    for i in range(n_layer):
        blocks.update(llama_block("{}text_model.layers.{}.".format(VLM, i), D_MODEL, D_FF, D_MODEL))
    for j, width in enumerate(widths or []):
        blocks.update(llama_block("{}layers.{}.".format(EXPERT, j), D_EXPERT, D_EXPERT_FF, width))
    tiny.tensors.update({name: np.ones(shape, np.float32) for name, shape in blocks.items()})


@pytest.mark.parametrize("n_layer, n_expert, every, mode, kinds, widths", [case for case in CASES if case[4]])
def test_layer_kinds_and_widths_are_those_of_the_reference(
    converter, tiny, n_layer, n_expert, every, mode, kinds, widths
):
    configure(tiny, n_layer, n_expert, every, mode, widths)
    bundle = converter.bundle(tiny)
    assert bundle.keys["expert.layer_kinds"] == kinds
    assert [bundle.tensors["expert.blk.{}.attn_k.weight".format(j)].shape[1] for j in range(len(widths))] == widths


@pytest.mark.parametrize("n_layer, n_expert, every, mode, kinds, widths", [case for case in CASES if not case[4]])
def test_a_combination_that_the_reference_cannot_run_is_refused_with_the_reason(
    converter, tiny, n_layer, n_expert, every, mode, kinds, widths
):
    configure(tiny, n_layer, n_expert, every, mode, widths)
    error = converter.refusal(tiny)
    assert "num_expert_layers" in error.message() and "the reference" in error.message()
