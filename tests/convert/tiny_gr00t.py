# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7 checkpoints small enough to make in every test, as their authors publish them, by numpy alone.

Their shapes are written down here a second time, independently of the converter, from the references' constructors.
"""

import copy
import os

import numpy as np

import tiny_evo1
from tiny import save_shards, save_vlm, write_jsons

D_VISION, D_VISION_FF, N_VISION_LAYER, PATCH, N_POSITION = 8, 10, 3, 2, 9
D_MODEL, D_FF, N_HEAD, N_KV, D_HEAD, N_LAYER = 12, 14, 4, 2, 8, 2
D_HIDDEN, D_DIT, N_DIT_LAYER, N_VL_LAYER, D_TIME = 5, 6, 4, 1, 256
D_STATE, D_ACTION, HORIZON, MAX_SEQ, N_EMBODIMENT = 11, 9, 7, 10, 3
EDGE, CROP = 12, 11
SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>"]
FIRST_ADDED = tiny_evo1.FIRST_ADDED
N_VOCAB = FIRST_ADDED + len(SPECIAL) + 1
TAG, OTHER = "arm", "humanoid"
IDS = {TAG: 2, OTHER: 1}


def tokenizer():
    spec = tiny_evo1.tokenizer()
    for token, content in zip(spec["added_tokens"], SPECIAL):
        token["content"] = content
    return spec


CONFIG = {
    "model_type": "Gr00tN1d7",
    "architectures": ["Gr00tN1d7"],
    "model_name": "nobody/none",
    "select_layer": N_LAYER,
    "backbone_embedding_dim": D_MODEL,
    "hidden_size": D_HIDDEN,
    "input_embedding_dim": D_DIT,
    "max_state_dim": D_STATE,
    "max_action_dim": D_ACTION,
    "action_horizon": HORIZON,
    "max_seq_len": MAX_SEQ,
    "max_num_embodiments": N_EMBODIMENT,
    "num_inference_timesteps": 3,
    "state_dropout_prob": 0.2,
    "tune_llm": False,
    "diffusion_model_cfg": {
        "positional_embeddings": None,
        "num_layers": N_DIT_LAYER,
        "num_attention_heads": 3,
        "attention_head_dim": 2,
        "norm_type": "ada_norm",
        "dropout": 0.2,
        "final_dropout": True,
        "output_dim": D_HIDDEN,
        "interleave_self_attention": True,
    },
    "vl_self_attention_cfg": {
        "positional_embeddings": None,
        "num_layers": N_VL_LAYER,
        "num_attention_heads": 6,
        "attention_head_dim": 2,
    },
}
BACKBONE = {
    "model_type": "qwen3_vl",
    "image_token_id": FIRST_ADDED + 5,
    "vision_start_token_id": FIRST_ADDED + 3,
    "text_config": {
        "model_type": "qwen3_vl_text",
        "hidden_size": D_MODEL,
        "intermediate_size": D_FF,
        "num_hidden_layers": N_LAYER + 3,
        "num_attention_heads": N_HEAD,
        "num_key_value_heads": N_KV,
        "head_dim": D_HEAD,
        "vocab_size": N_VOCAB,
        "max_position_embeddings": 4096,
        "rms_norm_eps": 1e-6,
        "rope_theta": 5000000,
        "rope_scaling": {"mrope_interleaved": True, "mrope_section": [2, 1, 1], "rope_type": "default"},
        "hidden_act": "silu",
    },
    "vision_config": {
        "depth": N_VISION_LAYER,
        "hidden_size": D_VISION,
        "num_heads": 2,
        "intermediate_size": D_VISION_FF,
        "patch_size": PATCH,
        "num_position_embeddings": N_POSITION,
        "out_hidden_size": D_MODEL,
        "deepstack_visual_indexes": [0, 2],
    },
}
IMAGES = {
    "image_processor_type": "Qwen2VLImageProcessorFast",
    "size": {"shortest_edge": 144, "longest_edge": 4096},
    "patch_size": PATCH,
    "image_mean": [0.5, 0.5, 0.5],
    "image_std": [0.5, 0.5, 0.5],
}
ABSOLUTE = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
STATES, ACTIONS = {"x": 1, "gripper": 2}, {"x": 1, "gripper": 1}


def modality(keys, delta_indices, **others):
    none = {"sin_cos_embedding_keys": None, "mean_std_embedding_keys": None, "action_configs": None}
    return {**none, "delta_indices": delta_indices, "modality_keys": list(keys), **others}


def robot(cameras, states, actions, n_row):
    return {
        "video": modality(cameras, [0]),
        "state": modality(states, [0]),
        "action": modality(actions, list(range(n_row)), action_configs=[dict(ABSOLUTE) for _ in actions]),
        "language": modality(["task"], [0]),
    }


def numbers(rng, width):
    low = rng.standard_normal(width) - 2
    offsets = {"min": 0, "max": 4, "mean": 2, "std": 1 - low, "q01": 1, "q99": 3}
    return {name: (low + offset).tolist() for name, offset in offsets.items()}


def linear(name, d_out, d_in):
    return {name + ".weight": (d_out, d_in), name + ".bias": (d_out,)}


def norm(name, d):
    return {name + ".weight": (d,), name + ".bias": (d,)}


def merger(name, d_norm):
    d = 4 * D_VISION
    return {
        **norm(name + ".norm", d_norm),
        **linear(name + ".linear_fc1", d, d),
        **linear(name + ".linear_fc2", D_MODEL, d),
    }


def attention(name, d, d_in):
    s = {}
    for part, width in (("to_q", d), ("to_k", d_in), ("to_v", d_in), ("to_out.0", d)):
        s.update(linear("{}.attn1.{}".format(name, part), d, width))
    return {**s, **linear(name + ".ff.net.0.proj", 4 * d, d), **linear(name + ".ff.net.2", d, 4 * d)}


def category(name, d_in, d_out):
    return {name + ".W": (N_EMBODIMENT, d_in, d_out), name + ".b": (N_EMBODIMENT, d_out)}


def shapes():
    visual, lm, head = "backbone.model.model.visual.", "backbone.model.model.language_model.", "action_head."
    s = {
        visual + "patch_embed.proj.weight": (D_VISION, 3, 2, PATCH, PATCH),
        visual + "patch_embed.proj.bias": (D_VISION,),
        visual + "pos_embed.weight": (N_POSITION, D_VISION),
        **merger(visual + "merger", D_VISION),
        **merger(visual + "deepstack_merger_list.0", 4 * D_VISION),
        **merger(visual + "deepstack_merger_list.1", 4 * D_VISION),
        lm + "embed_tokens.weight": (N_VOCAB, D_MODEL),
        lm + "norm.weight": (D_MODEL,),
    }
    for i in range(N_VISION_LAYER):
        block = "{}blocks.{}.".format(visual, i)
        s.update({**norm(block + "norm1", D_VISION), **norm(block + "norm2", D_VISION)})
        s.update(
            {**linear(block + "attn.qkv", 3 * D_VISION, D_VISION), **linear(block + "attn.proj", D_VISION, D_VISION)}
        )
        s.update(linear(block + "mlp.linear_fc1", D_VISION_FF, D_VISION))
        s.update(linear(block + "mlp.linear_fc2", D_VISION, D_VISION_FF))
    for i in range(N_LAYER):
        layer = "{}layers.{}.".format(lm, i)
        for part, d_out, d_in in (
            ("self_attn.q_proj", N_HEAD * D_HEAD, D_MODEL),
            ("self_attn.k_proj", N_KV * D_HEAD, D_MODEL),
            ("self_attn.v_proj", N_KV * D_HEAD, D_MODEL),
            ("self_attn.o_proj", D_MODEL, N_HEAD * D_HEAD),
            ("mlp.gate_proj", D_FF, D_MODEL),
            ("mlp.up_proj", D_FF, D_MODEL),
            ("mlp.down_proj", D_MODEL, D_FF),
        ):
            s[layer + part + ".weight"] = (d_out, d_in)
        s[layer + "self_attn.q_norm.weight"] = s[layer + "self_attn.k_norm.weight"] = (D_HEAD,)
        s[layer + "input_layernorm.weight"] = s[layer + "post_attention_layernorm.weight"] = (D_MODEL,)
    s.update(norm(head + "vlln", D_MODEL))
    for i in range(N_VL_LAYER):
        block = "{}vl_self_attention.transformer_blocks.{}".format(head, i)
        s.update(
            {**norm(block + ".norm1", D_MODEL), **norm(block + ".norm3", D_MODEL), **attention(block, D_MODEL, D_MODEL)}
        )
    time = head + "model.timestep_encoder.timestep_embedder."
    s.update({**linear(time + "linear_1", D_DIT, D_TIME), **linear(time + "linear_2", D_DIT, D_DIT)})
    for i in range(N_DIT_LAYER):
        block = "{}model.transformer_blocks.{}".format(head, i)
        s.update(
            {
                **linear(block + ".norm1.linear", 2 * D_DIT, D_DIT),
                **attention(block, D_DIT, D_DIT if i % 2 else D_MODEL),
            }
        )
    return {
        **s,
        **linear(head + "model.proj_out_1", 2 * D_DIT, D_DIT),
        **linear(head + "model.proj_out_2", D_HIDDEN, D_DIT),
        head + "position_embedding.weight": (MAX_SEQ, D_DIT),
        **category(head + "state_encoder.layer1", D_STATE, D_HIDDEN),
        **category(head + "state_encoder.layer2", D_HIDDEN, D_DIT),
        **category(head + "action_encoder.W1", D_ACTION, D_DIT),
        **category(head + "action_encoder.W2", 2 * D_DIT, D_DIT),
        **category(head + "action_encoder.W3", D_DIT, D_DIT),
        **category(head + "action_decoder.layer1", D_HIDDEN, D_HIDDEN),
        **category(head + "action_decoder.layer2", D_HIDDEN, D_ACTION),
    }


class TinyGr00t:
    """Everything of a published checkpoint as plain values to change before `save`."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        self.config, self.backbone, self.images = copy.deepcopy(CONFIG), copy.deepcopy(BACKBONE), copy.deepcopy(IMAGES)
        self.tokenizer = tokenizer()
        self.tokenizer_config = {"tokenizer_class": "Qwen2Tokenizer", "pad_token": SPECIAL[0], "eos_token": SPECIAL[2]}
        self.template = None
        self.tensors = {name: rng.standard_normal(shape).astype(np.float32) for name, shape in shapes().items()}
        self.robots = {
            TAG: robot(["front", "wrist"], STATES, ACTIONS, 4),
            OTHER: robot(["head"], {"legs": 3}, {"legs": 3}, 5),
        }
        self.kwargs = {
            "modality_configs": self.robots,
            "image_crop_size": [CROP, CROP],
            "image_target_size": [EDGE, EDGE],
            "shortest_image_edge": None,
            "crop_fraction": None,
            "use_albumentations": True,
            "letter_box_transform": False,
            "formalize_language": True,
            "max_state_dim": D_STATE,
            "max_action_dim": D_ACTION,
            "use_percentiles": True,
            "clip_outliers": True,
            "use_relative_action": True,
            "color_jitter_params": None,
        }
        self.processor = {"processor_class": "Gr00tN1d7Processor", "processor_kwargs": self.kwargs}
        self.embodiments = dict(IDS)
        self.statistics = {
            TAG: {
                "state": {key: numbers(rng, width) for key, width in STATES.items()},
                "action": {key: numbers(rng, width) for key, width in ACTIONS.items()},
                "relative_action": {},
            },
            OTHER: {"state": {"legs": numbers(rng, 3)}, "action": {"legs": numbers(rng, 3)}},
        }
        self.below = ""  # folder of the processor's files

    def relative(self, key="x", **how):
        """Makes an action of the arm relative to its state."""
        configs = self.robots[TAG]["action"]["action_configs"]
        configs[list(ACTIONS).index(key)].update(rep="RELATIVE", **how)
        self.statistics[TAG]["relative_action"][key] = {"min": [-0.25] * ACTIONS[key], "max": [0.5] * ACTIONS[key]}
        return self

    def save(self, folder, shards=2):
        folder = str(folder)
        files = {"processor_config": self.processor, "statistics": self.statistics, "embodiment_id": self.embodiments}
        write_jsons(folder, config=self.config)
        write_jsons(os.path.join(folder, self.below), **files)
        save_vlm(self, folder)
        write_jsons(os.path.join(folder, "vlm"), preprocessor_config=self.images)
        if self.template is not None:
            with open(os.path.join(folder, "vlm", "chat_template.jinja"), "w") as file:
                file.write(self.template)
        save_shards(folder, self.tensors, shards)
        return folder
