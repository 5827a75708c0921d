# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The mapping of BitVLA at the published size: against the published inventory, and against what the runtime declares."""

import numpy as np
import pytest

from manifests import check_keys, check_parameters
from vla_cpp.convert.archs import SCALE, TERNARY
from vla_cpp.convert.archs.bitvla import mapping
from vla_cpp.convert.errors import Problems

CONFIG = {  # of the fine-tunes for LIBERO, as far as it is known
    "model_type": "bitvla",
    "vision_feature_layer": -1,
    "vision_feature_select_strategy": "full",
    "vision_config": {
        "model_type": "siglip_vision_model",
        "hidden_size": 1152,
        "intermediate_size": 4304,
        "num_hidden_layers": 26,
        "num_attention_heads": 16,
        "image_size": 224,
        "patch_size": 14,
        "vit_weight_bits": 1,
        "vit_act_bits": 8,
    },
    "text_config": {"model_type": "BitNet", "vocab_size": 128264},
}


@pytest.fixture
def published():
    problems = Problems("published")
    sizes = mapping.read_sizes(CONFIG, problems)
    sizes.d_state, sizes.d_action, sizes.horizon, sizes.max_views = 8, 7, 8, 2
    problems.raise_any()
    return sizes


def test_the_published_config_asks_for_the_published_numbers(published):
    count, ternary = {}, {}
    for row in mapping.weights(published):
        part, size = row.target.split(".")[0].split("_")[0], int(np.prod(row.stored))
        if row.kind != SCALE:
            count[part] = count.get(part, 0) + size
        if row.kind == TERNARY:
            ternary[part] = ternary.get(part, 0) + size
    assert ternary == {"vision": 26 * (4 * 1152**2 + 2 * 1152 * 4304), "lm": 30 * (2 * 2560**2 + 2 * 640 * 2560 + 3 * 2560 * 6912)}
    assert count["vision"] - ternary["vision"] == 1152 * (3 * 14**2 + 1 + 256) + 26 * (9 * 1152 + 4304)
    assert count["lm"] - ternary["lm"] == 128264 * 2560 + 30 * (3 * 2560 + 6912) + 2560
    assert count["connector"] == 1152 * 2560 + 2560**2 + 2 * 2560 and count["state"] == 8 * 2560 + 2560**2 + 2 * 2560
    assert sum(count.values()) == pytest.approx(2.885e9, rel=1e-3)


def declared(row):
    if row.kind == TERNARY:
        return list(row.stored), row.kind
    return list(row.shape), "vector" if row.kind == SCALE else row.kind


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(published):
    check_parameters("bitvla", mapping.weights(published), declared)


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(published):
    check_keys("bitvla", mapping.network_keys(published), chosen={"policy.stop_token", "policy.view_starts"})  # of the tokenizer
