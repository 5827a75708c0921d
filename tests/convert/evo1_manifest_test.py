# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The mapping of Evo-1 at the published size: against the published inventory, and against what the runtime declares."""

import numpy as np
import pytest

from manifests import check_keys, check_parameters
from vla_cpp.convert.archs.evo1 import mapping
from vla_cpp.convert.archs.evo1.mapping import Sizes, read_chat_backbone, read_hf_backbone
from vla_cpp.convert.errors import Problems

TEXT = {
    "model_type": "qwen2",
    "hidden_size": 896,
    "intermediate_size": 4864,
    "num_hidden_layers": 24,
    "num_attention_heads": 14,
    "num_key_value_heads": 2,
    "vocab_size": 151674,
    "rms_norm_eps": 1e-6,
    "rope_theta": 1000000.0,
    "rope_scaling": {"factor": 2.0, "rope_type": "dynamic", "type": "dynamic"},
    "max_position_embeddings": 32768,
    "sliding_window": 32768,
    "use_sliding_window": False,
}
CHAT = {  # of the published backbone OpenGVLab/InternVL3-1B
    "model_type": "internvl_chat",
    "downsample_ratio": 0.5,
    "force_image_size": 448,
    "ps_version": "v2",
    "select_layer": -1,
    "use_backbone_lora": 0,
    "use_llm_lora": 0,
    "vision_config": {
        "hidden_size": 1024,
        "intermediate_size": 4096,
        "num_hidden_layers": 24,
        "num_attention_heads": 16,
        "image_size": 448,
        "patch_size": 14,
        "layer_norm_eps": 1e-6,
        "norm_type": "layer_norm",
        "qk_normalization": False,
        "qkv_bias": True,
        "drop_path_rate": 0.1,
    },
    "llm_config": {**TEXT, "architectures": ["Qwen2ForCausalLM"]},
}
HF = {  # and of OpenGVLab/InternVL3-1B-hf
    "model_type": "internvl",
    "image_seq_length": 256,
    "image_token_id": 151667,
    "vision_config": {"attention_bias": True, "image_size": [448, 448], "patch_size": [14, 14]},
    "text_config": TEXT,
}


@pytest.fixture(params=[(read_chat_backbone, CHAT, "AUTHORS"), (read_hf_backbone, HF, "LEROBOT")], ids=["authors", "lerobot"])
def published(request):
    """Sizes, and the names of the layout."""
    read, config, names = request.param
    sizes = Sizes(
        n_layer=14,
        n_token=1024,
        n_head_layer=8,
        n_head_head=8,
        d_hidden=1024,
        d_state_hidden=1024,
        d_state=24,
        d_action=24,
        d_robot=7,
        horizon=50,
        max_views=3,
        n_step=50,
        time_scale=999.0,
        masked_rows="zero_attention",
        absent_views="in_place",
    )
    problems = Problems("published")
    read(config, sizes, problems)
    problems.raise_any()
    return sizes, getattr(mapping, names)


def test_the_published_configs_ask_for_the_published_numbers(published):
    rows = mapping.weights(*published)
    count = {}
    for row in rows:
        part = row.target.split(".")[0]
        count[part] = count.get(part, 0) + int(np.prod(row.shape))
    assert count["vision"] == 304_012_288 and count["connector"] == 4_482_816  # InternViT-300M and its mlp1
    assert count["lm"] == 151674 * 896 + 14 * 14_912_384 + 896
    assert sum(count.values()) == 776_139_440
    stored = {row.source: int(np.prod(row.stored)) for row in rows}
    assert sum(stored.values()) == sum(count.values())


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(published):
    check_parameters("evo1", mapping.weights(*published))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(published):
    check_keys("evo1", mapping.network_keys(published[0]), chosen={"policy.pad_token", "policy.view_starts"})  # of the tokenizer
