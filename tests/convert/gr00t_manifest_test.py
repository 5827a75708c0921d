# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The mappings of GR00T at the published sizes: against the published counts, and against what the runtime declares."""

import json

import numpy as np
import pytest

from manifests import check_keys, check_parameters
from vla_cpp.convert.archs import gr00t_n1_5, gr00t_n1_6, gr00t_n1_7
from vla_cpp.convert.archs.gr00t.plan import network_keys, read_sizes, weights
from vla_cpp.convert.bundle import Key
from vla_cpp.convert.errors import Problems

CONFIG = {  # of the published checkpoint: what differs from the defaults of its class
    "model_type": "Gr00tN1d7",
    "select_layer": 16,
    "diffusion_model_cfg": {
        "positional_embeddings": None,
        "num_layers": 32,
        "num_attention_heads": 32,
        "attention_head_dim": 48,
        "norm_type": "ada_norm",
        "dropout": 0.2,
        "final_dropout": True,
        "output_dim": 1024,
        "interleave_self_attention": True,
    },
    "vl_self_attention_cfg": {
        "positional_embeddings": None,
        "num_layers": 4,
        "num_attention_heads": 32,
        "attention_head_dim": 64,
        "dropout": 0.2,
        "final_dropout": True,
    },
}
BACKBONE = {  # of the published backbone
    "model_type": "qwen3_vl",
    "text_config": {
        "hidden_size": 2048,
        "intermediate_size": 6144,
        "num_hidden_layers": 28,
        "num_attention_heads": 16,
        "num_key_value_heads": 8,
        "head_dim": 128,
        "vocab_size": 151936,
        "max_position_embeddings": 262144,
        "rms_norm_eps": 1e-6,
        "rope_theta": 5000000,
        "rope_scaling": {"mrope_interleaved": True, "mrope_section": [24, 20, 20], "rope_type": "default"},
    },
    "vision_config": {
        "depth": 24,
        "hidden_size": 1024,
        "intermediate_size": 4096,
        "num_heads": 16,
        "num_position_embeddings": 2304,
        "out_hidden_size": 2048,
        "deepstack_visual_indexes": [5, 11, 17],
    },
}


RELEASE = gr00t_n1_7.RELEASE


@pytest.fixture(scope="module")
def sizes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("backbone")
    (folder / "config.json").write_text(json.dumps(BACKBONE))
    problems = Problems("published")
    sizes = read_sizes(RELEASE, CONFIG, str(folder), problems)
    problems.raise_any()
    sizes.max_views, sizes.image_width, sizes.image_height = 2, 256, 256
    return sizes


@pytest.mark.parametrize(
    "prefixes, millions",
    [
        (("vision.blk.",), 302.3),
        (("connector.", "deepstack."), 100.7),
        (("lm.blk.",), 805.4),
        (("lm.token_embd.",), 311.2),
        (("vl.",), 201.4),
        (("dit.", "time_"), 1091.7),
        (("state_", "action_", "decode_"), 11.8),
    ],
)
def test_each_part_has_the_published_count_of_parameters(sizes, prefixes, millions):
    rows = [row for row in weights(RELEASE, sizes) if row.target.startswith(prefixes)]
    assert sum(int(np.prod(row.shape)) for row in rows) / 1e6 == pytest.approx(millions, abs=0.06)


def view_starts(name, *starts):
    """A key that follows from the prompt's tokens."""
    return Key("policy." + name, "u32[]", list(starts))


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(sizes):
    check_parameters("gr00t_n1_7", weights(RELEASE, sizes))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(sizes):
    # <|im_start|>, "user", a line's end, <|vision_start|>; 64 image tokens a view
    check_keys("gr00t_n1_7", [*network_keys(RELEASE, sizes), view_starts("view_starts", 4, 70)])


EAGLE_3 = {
    "model_type": "eagle_3_vl",
    "use_pixel_shuffle": True,
    "mlp_connector_layers": 2,
    "select_layer": -1,
    "text_config": {
        "hidden_size": 2048,
        "intermediate_size": 6144,
        "num_hidden_layers": 28,
        "num_attention_heads": 16,
        "num_key_value_heads": 8,
        "vocab_size": 151680,
        "max_position_embeddings": 40960,
        "rope_theta": 1000000,
    },
    "vision_config": {
        "hidden_size": 1152,
        "intermediate_size": 4304,
        "num_hidden_layers": 27,
        "num_attention_heads": 16,
        "patch_size": 14,
    },
}


def test_n1_6_declares_what_its_checkpoint_has(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(EAGLE_3))
    release, problems = gr00t_n1_6.RELEASE, Problems("published")
    config = {"model_type": "Gr00tN1d6", "max_state_dim": 128, "max_action_dim": 128, "action_horizon": 50}
    sizes = read_sizes(release, config, str(tmp_path), problems)
    problems.raise_any()
    sizes.max_views, sizes.image_width, sizes.image_height = 2, 252, 252
    check_parameters("gr00t_n1_6", weights(release, sizes))
    # 81 tokens a view, its mark and its number; two marks at the end
    check_keys("gr00t_n1_6", [*network_keys(release, sizes), view_starts("view_starts_from_end", 172, 84)])
    tower = sum(int(np.prod(row.shape)) for row in weights(release, sizes) if row.target.startswith("vision."))
    assert tower / 1e6 == pytest.approx(412.4, abs=0.1)


N1_5 = {
    "model_type": "gr00t_n1_5",
    "backbone_cfg": {"select_layer": 12, "project_to_dim": None},
    "action_head_cfg": {
        "backbone_embedding_dim": 2048,
        "input_embedding_dim": 1536,
        "hidden_size": 1024,
        "max_state_dim": 64,
        "action_dim": 32,
        "action_horizon": 16,
        "num_target_vision_tokens": 32,
        "num_inference_timesteps": 4,
        "diffusion_model_cfg": {**CONFIG["diffusion_model_cfg"], "num_layers": 16, "cross_attention_dim": 2048},
        "vl_self_attention_cfg": CONFIG["vl_self_attention_cfg"],
    },
}


def test_n1_5_declares_what_its_checkpoint_has(tmp_path):
    eagle = {**EAGLE_3, "model_type": "eagle_2_5_vl", "use_pixel_shuffle": False, "mlp_connector_layers": 1}
    (tmp_path / "config.json").write_text(json.dumps(eagle))
    problems = Problems("published")
    sizes, n_future = gr00t_n1_5.read_sizes(N1_5, str(tmp_path), problems)
    problems.raise_any()
    sizes.max_views = 2
    rows = gr00t_n1_5.weights(sizes, n_future)
    check_parameters("gr00t_n1_5", rows)
    # behind the system's turn, the user's mark and the first view's number
    check_keys("gr00t_n1_5", [*gr00t_n1_5.network_keys(sizes, n_future), view_starts("view_starts", 20, 283)])
    # What is published, but for the rows of 31 other robots and the pooling head.
    count = sum(int(np.prod(row.shape)) for row in rows)
    assert count / 1e6 == pytest.approx(412.4 + 2.36 + 604.0 + 310.6 + 201.4 + 550.4 + 9.9 + 1.57, abs=0.3)
