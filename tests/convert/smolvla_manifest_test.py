# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The mapping of SmolVLA at the published size: against the published inventory, and against what the runtime declares."""

import numpy as np
import pytest

from manifests import check_keys, check_parameters
from tiny import write_json
from vla_cpp.convert.archs import Options
from vla_cpp.convert.archs.smolvla import mapping
from vla_cpp.convert.archs.smolvla.config import read_sizes
from vla_cpp.convert.checkpoint import Checkpoint
from vla_cpp.convert.errors import Problems

CONFIG = {  # what the published policy states; the rest are defaults of its class
    "type": "smolvla",
    "input_features": {
        "observation.state": {"type": "STATE", "shape": [6]},
        "observation.images.camera1": {"type": "VISUAL", "shape": [3, 256, 256]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [6]}},
    "load_vlm_weights": True,
    "prefix_length": 0,
    "num_expert_layers": 0,
    "pad_language_to": "max_length",
}
BACKBONE = {  # of the published backbone: counts that it leaves out are defaults of transformers
    "model_type": "smolvlm",
    "scale_factor": 4,
    "pad_token_id": 128002,
    "text_config": {
        "model_type": "llama",
        "head_dim": 64,
        "hidden_size": 960,
        "intermediate_size": 2560,
        "num_attention_heads": 15,
        "num_hidden_layers": 32,
        "num_key_value_heads": 5,
        "rms_norm_eps": 1e-05,
        "rope_theta": 100000,
        "torch_dtype": "bfloat16",
        "vocab_size": 49280,
        "qk_layer_norms": False,
    },
    "vision_config": {
        "model_type": "smolvlm_vision",
        "hidden_size": 768,
        "image_size": 512,
        "num_attention_heads": 12,
        "patch_size": 16,
        "size": {"longest_edge": 2048},
    },
}


@pytest.fixture
def sizes(tmp_path):
    (tmp_path / "vlm").mkdir()
    write_json(str(tmp_path / "vlm" / "config.json"), BACKBONE)
    checkpoint = Checkpoint("published", str(tmp_path), "", CONFIG, {}, {}, {}, None)
    problems = Problems("published")
    found = read_sizes(checkpoint, Options(), problems)
    problems.raise_any()
    return found


def test_the_published_configs_ask_for_the_published_tensors(sizes):
    weights, dropped = mapping.weights(sizes), mapping.dropped(sizes)
    assert len(weights) + len(dropped) == 500
    assert sum(int(np.prod(row.stored)) for row in [*weights, *dropped]) == 450_046_176
    assert len({row.source for row in [*weights, *dropped]}) == 500


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(sizes):
    check_parameters("smolvla", mapping.weights(sizes))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(sizes):
    check_keys("smolvla", mapping.network_keys(sizes), chosen={"vision.position_rule"})  # the policy's own precision decides it
