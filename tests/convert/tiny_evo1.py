# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Evo-1 checkpoints small enough to make in every test, as its authors and as LeRobot write them, by numpy alone.

Their shapes are written down here a second time, independently of the converter, from the references' constructors.
"""

import copy
import os

import numpy as np

from goldens import files
from goldens import lerobot_layout as layout
from tiny import byte_alphabet, normalizer, pipelines, save_pipelines, save_vlm, step_of, write_jsons, write_safetensors

D_VISION, D_VISION_FF, IMAGE, PATCH, N_VIEW_TOKEN = 6, 10, 56, 14, 4
D_MODEL, D_FF, N_HEAD, N_KV, N_LAYER, N_LAYER_BACKBONE = 12, 14, 3, 1, 2, 3
D_HIDDEN, D_STATE_HIDDEN, HORIZON, N_TOKEN = 10, 8, 4, 60
STATE_DIM, ACTION_DIM, WIDTH = 5, 3, 24
D_STATE, D_ACTION = 7, 6  # of LeRobot's, where they are free
SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>"]
SPLIT = "(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\\r\\n\\p{L}\\p{N}]?\\p{L}+|\\p{N}| ?[^\\s\\p{L}\\p{N}]+[\\r\\n]*|\\s*[\\r\\n]+|\\s+(?!\\S)|\\s+"
ARM, DATASET = "franka_ee_pose_delta", "libero_10_no_noops_lerobot"
ANSWERS = dict(variant="r2", views=["front", "wrist"], max_views=3, masked_rows="zero_attention")


def tokenizer():
    """The shape of InternVL3's: Qwen2's splitting, "Image" as two tokens."""
    symbols = byte_alphabet()
    merges = [["I", "m"], ["a", "g"], ["Im", "ag"], ["o", "p"], ["e", "n"]]
    vocab = {text: i for i, text in enumerate([*symbols, *(a + b for a, b in merges)])}
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False, "special": True}
    return {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": [{"id": len(vocab) + i, "content": text, **flags} for i, text in enumerate(SPECIAL)],
        "normalizer": {"type": "NFC"},
        "pre_tokenizer": {
            "type": "Sequence",
            "pretokenizers": [
                {"type": "Split", "pattern": {"Regex": SPLIT}, "behavior": "Isolated", "invert": False},
                {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": False},
            ],
        },
        "post_processor": {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": False, "use_regex": False},
        "decoder": None,
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": None,
            "continuing_subword_prefix": "",
            "end_of_word_suffix": "",
            "fuse_unk": False,
            "byte_fallback": False,
            "ignore_merges": False,
            "vocab": vocab,
            "merges": merges,
        },
    }


FIRST_ADDED = 256 + 5
N_VOCAB = FIRST_ADDED + len(SPECIAL) + 2
TOKENIZER_CONFIG = {
    "tokenizer_class": "TokenizersBackend",
    "pad_token": SPECIAL[0],
    "eos_token": SPECIAL[2],
    "padding_side": "right",
}
TEXT = {
    "model_type": "qwen2",
    "hidden_size": D_MODEL,
    "intermediate_size": D_FF,
    "num_hidden_layers": N_LAYER_BACKBONE,
    "num_attention_heads": N_HEAD,
    "num_key_value_heads": N_KV,
    "vocab_size": N_VOCAB,
    "max_position_embeddings": 64,
    "rms_norm_eps": 1e-6,
    "hidden_act": "silu",
    "use_sliding_window": False,
}
VISION = {
    "hidden_size": D_VISION,
    "intermediate_size": D_VISION_FF,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "layer_norm_eps": 1e-6,
    "norm_type": "layer_norm",
    "hidden_act": "gelu",
}
CHAT_BACKBONE = {
    "model_type": "internvl_chat",
    "downsample_ratio": 0.5,
    "ps_version": "v2",
    "select_layer": -1,
    "force_image_size": IMAGE,
    "template": "internvl2_5",
    "vision_config": {**VISION, "image_size": IMAGE, "patch_size": PATCH, "qkv_bias": True, "qk_normalization": False},
    "llm_config": {
        **TEXT,
        "architectures": ["Qwen2ForCausalLM"],
        "rope_theta": 1e6,
        "rope_scaling": {"factor": 2.0, "rope_type": "dynamic", "type": "dynamic"},
    },
}
HF_BACKBONE = {
    "model_type": "internvl",
    "downsample_ratio": 0.5,
    "image_seq_length": N_VIEW_TOKEN,
    "image_token_id": FIRST_ADDED + 5,
    "vision_config": {**VISION, "image_size": [IMAGE, IMAGE], "patch_size": [PATCH, PATCH], "attention_bias": True},
    "text_config": {**TEXT, "rope_parameters": {"rope_theta": 1e6, "rope_type": "default"}},
}
HEAD = {
    "embed_dim": D_MODEL,
    "hidden_dim": D_HIDDEN,
    "state_hidden_dim": D_STATE_HIDDEN,
    "num_heads": 2,
    "num_layers": 1,
    "dropout": 0.0,
    "num_categories": 1,
    "return_cls_only": False,
    "action_head": "flowmatching",
}
AUTHORS_CONFIG = {
    **HEAD,
    "horizon": HORIZON,
    "per_action_dim": WIDTH,
    "state_dim": WIDTH,
    "vlm_name": "nobody/none",
    "num_inference_timesteps": 7,  # the server counts its own
    "lr": 1e-5,
}
INPUTS, OUTPUTS = layout.features({"front": (20, 28), "wrist": (36, 36)}, STATE_DIM, ACTION_DIM)
LEROBOT_CONFIG = {
    **HEAD,
    "type": "evo1",
    "n_obs_steps": 1,
    "input_features": INPUTS,
    "output_features": OUTPUTS,
    "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": "MIN_MAX", "ACTION": "MIN_MAX"},
    "chunk_size": HORIZON,
    "n_action_steps": HORIZON,
    "max_state_dim": D_STATE,
    "max_action_dim": D_ACTION,
    "max_views": 3,
    "image_resolution": [IMAGE, IMAGE],
    "empty_cameras": 0,
    "postprocess_action_dim": None,
    "binarize_gripper": True,
    "gripper_index": 2,
    "gripper_threshold": 0.25,
    "gripper_below_threshold_value": 1.0,
    "gripper_above_threshold_value": -1.0,
    "vlm_model_name": "nobody/none",
    "vlm_num_layers": N_LAYER,
    "vlm_dtype": "bfloat16",
    "max_text_length": N_TOKEN,
    "num_inference_timesteps": 6,
    "task_field": "task",
    "rtc_config": None,
}


def linear(name, d_out, d_in):
    return {name + ".weight": (d_out, d_in), name + ".bias": (d_out,)}


def norm(name, d):
    return {name + ".weight": (d,), name + ".bias": (d,)}


def head_shapes(root, d_state, d_action):
    d, blocks = D_MODEL, root + "transformer_blocks.0."
    return {
        root + "time_pos_enc.pe": (1, 1000, d),
        root + "action_encoder.pos_encoding.pe": (1, HORIZON, d),
        **linear(root + "action_encoder.W1.linear", d, d_action),
        **linear(root + "action_encoder.W2.linear", d, d),
        **linear(root + "action_encoder.W3.linear", d, d),
        **linear(root + "state_encoder.fc1.linear", D_STATE_HIDDEN, d_state),
        **linear(root + "state_encoder.fc2.linear", d, D_STATE_HIDDEN),
        blocks + "attn.in_proj_weight": (3 * d, d),
        blocks + "attn.in_proj_bias": (3 * d,),
        **linear(blocks + "attn.out_proj", d, d),
        **norm(blocks + "norm1", d),
        **norm(blocks + "norm2", d),
        **linear(blocks + "ff.0", 4 * d, d),
        **linear(blocks + "ff.2", d, 4 * d),
        **norm(root + "norm_out", d),
        **linear(root + "seq_pool_proj", d, HORIZON * d),
        **linear(root + "mlp_head.fc1.linear", D_HIDDEN, d),
        **linear(root + "mlp_head.fc2.linear", HORIZON * d_action, D_HIDDEN),
    }


def language_shapes(root):
    s = {root + "embed_tokens.weight": (N_VOCAB, D_MODEL), root + "norm.weight": (D_MODEL,)}
    d_kv = D_MODEL // N_HEAD * N_KV
    for i in range(N_LAYER):
        layer = "{}layers.{}.".format(root, i)
        for part, d_out in (("q", D_MODEL), ("k", d_kv), ("v", d_kv)):
            s.update(linear(layer + "self_attn.{}_proj".format(part), d_out, D_MODEL))
        s[layer + "self_attn.o_proj.weight"] = (D_MODEL, D_MODEL)
        s[layer + "mlp.gate_proj.weight"] = s[layer + "mlp.up_proj.weight"] = (D_FF, D_MODEL)
        s[layer + "mlp.down_proj.weight"] = (D_MODEL, D_FF)
        s[layer + "input_layernorm.weight"] = s[layer + "post_attention_layernorm.weight"] = (D_MODEL,)
    return s


def authors_shapes():
    d, vision, mlp = D_VISION, "embedder.model.vision_model.", "embedder.model.mlp1."
    layer = vision + "encoder.layers.0."
    return {
        vision + "embeddings.class_embedding": (1, 1, d),
        vision + "embeddings.patch_embedding.weight": (d, 3, PATCH, PATCH),
        vision + "embeddings.patch_embedding.bias": (d,),
        vision + "embeddings.position_embedding": (1, 17, d),
        **norm(layer + "norm1", d),
        **norm(layer + "norm2", d),
        layer + "ls1": (d,),
        layer + "ls2": (d,),
        **linear(layer + "attn.qkv", 3 * d, d),
        **linear(layer + "attn.proj", d, d),
        **linear(layer + "mlp.fc1", D_VISION_FF, d),
        **linear(layer + "mlp.fc2", d, D_VISION_FF),
        **norm(mlp + "0", 4 * d),
        **linear(mlp + "1", D_MODEL, 4 * d),
        **linear(mlp + "3", D_MODEL, D_MODEL),
        **language_shapes("embedder.model.language_model.model."),
        **head_shapes("action_head.", WIDTH, WIDTH),
    }


def lerobot_shapes():
    d, root = D_VISION, "model.embedder.model."
    vision, projector = root + "vision_tower.", root + "multi_modal_projector."
    layer = vision + "encoder.layer.0."
    return {
        vision + "embeddings.cls_token": (1, 1, d),
        vision + "embeddings.patch_embeddings.projection.weight": (d, 3, PATCH, PATCH),
        vision + "embeddings.patch_embeddings.projection.bias": (d,),
        vision + "embeddings.position_embeddings": (1, 17, d),
        **norm(layer + "layernorm_before", d),
        **norm(layer + "layernorm_after", d),
        layer + "lambda_1": (d,),
        layer + "lambda_2": (d,),
        **linear(layer + "attention.q_proj", d, d),
        **linear(layer + "attention.k_proj", d, d),
        **linear(layer + "attention.v_proj", d, d),
        **linear(layer + "attention.projection_layer", d, d),
        **linear(layer + "mlp.fc1", D_VISION_FF, d),
        **linear(layer + "mlp.fc2", d, D_VISION_FF),
        **norm(projector + "layer_norm", 4 * d),
        **linear(projector + "linear_1", D_MODEL, 4 * d),
        **linear(projector + "linear_2", D_MODEL, D_MODEL),
        **language_shapes(root + "language_model."),
        **head_shapes("model.action_head.", D_STATE, D_ACTION),
    }


def statistics(rng, dim):
    low = rng.standard_normal(dim).astype(np.float32) - 2
    return {"min": low, "max": low + 4, "q01": low + 1, "q99": low + 3, "mean": low + 2, "std": np.full(dim, 0.5, np.float32)}


class TinyEvo1:
    """Everything of a checkpoint of the authors as plain values to change before `save`."""

    weights, member = "mp_rank_00_model_states.pt", "module"

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        self.config, self.backbone = copy.deepcopy(AUTHORS_CONFIG), copy.deepcopy(CHAT_BACKBONE)
        self.tokenizer, self.tokenizer_config = tokenizer(), dict(TOKENIZER_CONFIG)
        self.dims = {"language_layers": N_LAYER, "prompt_tokens": N_TOKEN}
        self.tensors = {
            name: files.bfloat16_bits(rng.integers(-64, 64, shape) / np.float32(16)) for name, shape in authors_shapes().items()
        }
        self.norm_stats = {ARM: {DATASET: self.entry(rng)}}
        self.others = {"ds_version": "0.14", "args": files.Call("argparse Namespace")}

    @staticmethod
    def entry(rng):
        both = (("observation.state", STATE_DIM), ("action", ACTION_DIM))
        return {name: {k: v.tolist() for k, v in statistics(rng, dim).items()} for name, dim in both}

    @property
    def stats(self):
        return self.norm_stats[ARM][DATASET]

    def save(self, folder):
        folder = str(folder)
        write_jsons(folder, config=self.config, norm_stats=self.norm_stats, dims=self.dims)
        save_vlm(self, folder)
        if self.weights:
            files.write_torch(os.path.join(folder, self.weights), self.tensors, self.member, **self.others)
        return folder


class TinyEvo1Lerobot(TinyEvo1):
    """The same as LeRobot lays it out."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        super().__init__(seed)
        self.config, self.backbone = copy.deepcopy(LEROBOT_CONFIG), copy.deepcopy(HF_BACKBONE)
        self.tensors = {name: rng.standard_normal(shape).astype(np.float32) for name, shape in lerobot_shapes().items()}
        self.statistics = {}
        neutral = {"min": -1, "max": 1, "q01": -1, "q99": 1, "mean": 0, "std": 1}
        for feature, dim, padded in (("observation.state", STATE_DIM, D_STATE), ("action", ACTION_DIM, D_ACTION)):
            for name, value in statistics(rng, dim).items():
                fill = np.full(padded - dim, neutral[name], np.float32)
                self.statistics["{}.{}".format(feature, name)] = np.concatenate([value, fill])
        self.pre, self.post = self.pipelines()

    def pipelines(self):
        normalize, unnormalize = (normalizer(self.config, name) for name in ("normalizer_processor", "unnormalizer_processor"))
        features = normalize[1]["features"]
        features["observation.state"]["shape"], features["action"]["shape"] = [D_STATE], [D_ACTION]
        unnormalize[1]["features"] = {"action": features["action"]}
        keys = "binarize_gripper gripper_index gripper_threshold gripper_below_threshold_value gripper_above_threshold_value"
        pre = [
            layout.rename({}),
            layout.BATCH,
            ("evo1_pad_state_processor", {"max_state_dim": D_STATE}),
            ("evo1_pad_action_processor", {"max_action_dim": D_ACTION}),
            normalize,
            layout.device(),
        ]
        post = [
            unnormalize,
            ("evo1_action_processor", {"action_dim": ACTION_DIM, **{key: self.config[key] for key in keys.split()}}),
            layout.device("float32"),
        ]
        return pipelines(pre, post)

    def step(self, name):
        return step_of(self, name)

    def normalization(self, mode):
        """Of states and actions, everywhere where it is stated."""
        for place in (self.config["normalization_mapping"], *(self.step(s)["config"]["norm_map"] for s in ("normalizer_processor", "unnormalizer_processor"))):
            place.update(STATE=mode, ACTION=mode)
        return self

    def cut_statistics(self):
        """As a data set states them, without the padded columns."""
        dims = {"observation.state": STATE_DIM, "action": ACTION_DIM}
        self.statistics = {name: value[: dims[name.rsplit(".", 1)[0]]] for name, value in self.statistics.items()}
        return self

    def save(self, folder):
        folder = str(folder)
        write_jsons(folder, config=self.config)
        save_vlm(self, folder)
        save_pipelines(self, folder, self.statistics)
        write_safetensors(os.path.join(folder, "model.safetensors"), self.tensors)
        return folder
