# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A SmolVLA checkpoint small enough to make in every test, in the layout that LeRobot writes, by numpy alone.

Its shapes are written down here a second time, independently of the converter, from the reference's constructors.
"""

import copy
import os

import numpy as np

from goldens import lerobot_layout as layout
from goldens.files import write_json, write_safetensors

VLM = "model.vlm_with_expert.vlm.model."
EXPERT = "model.vlm_with_expert.lm_expert."
TEXT_EMBEDDING = VLM + "text_model.embed_tokens"
STATE_DIM, ACTION_DIM, D_STATE, D_ACTION = 3, 2, 4, 5
D_VISION, D_VISION_FF, PATCH, IMAGE, FACTOR = 8, 12, 4, 16, 2
D_MODEL, D_FF, N_HEAD, N_KV, D_HEAD, N_VOCAB = 12, 10, 3, 1, 4, 300
N_LAYER, N_LAYER_BACKBONE, D_EXPERT, D_EXPERT_FF = 2, 3, 6, 256

REMOVED = object()


def changed(tiny, changes, separator="/"):
    """A checkpoint with other values at paths of its attributes."""
    for path, value in changes.items():
        *parents, last = path.split(separator)
        place = getattr(tiny, parents[0])
        for parent in parents[1:]:
            place = place[parent]
        if value is REMOVED:
            del place[last]
        else:
            place[last] = value
    return tiny


INPUTS, OUTPUTS = layout.features({"top": (12, 16), "wrist": (16, 16)}, STATE_DIM, ACTION_DIM)
CONFIG = {
    "type": "smolvla",
    "n_obs_steps": 1,
    "input_features": INPUTS,
    "output_features": OUTPUTS,
    "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
    "chunk_size": 6,
    "n_action_steps": 6,
    "max_state_dim": D_STATE,
    "max_action_dim": D_ACTION,
    "resize_imgs_with_padding": [IMAGE, IMAGE],
    "empty_cameras": 0,
    "tokenizer_max_length": 7,
    "num_steps": 3,
    "vlm_model_name": "nobody/none",
    "load_vlm_weights": False,
    "num_vlm_layers": N_LAYER,
    "expert_width_multiplier": 0.5,
    "self_attn_every_n_layers": 2,
    "rtc_config": None,
}
BACKBONE = {
    "model_type": "smolvlm",
    "scale_factor": FACTOR,
    "text_config": {
        "model_type": "llama",
        "hidden_size": D_MODEL,
        "intermediate_size": D_FF,
        "num_attention_heads": N_HEAD,
        "num_key_value_heads": N_KV,
        "head_dim": D_HEAD,
        "num_hidden_layers": N_LAYER_BACKBONE,
        "vocab_size": N_VOCAB,
        "rms_norm_eps": 1e-5,
        "rope_theta": 100000.0,
    },
    "vision_config": {
        "model_type": "smolvlm_vision",
        "hidden_size": D_VISION,
        "intermediate_size": D_VISION_FF,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": IMAGE,
        "patch_size": PATCH,
    },
}
SPECIAL = ["<|end|>", "<image>"]


def pipelines(pre, post):
    """The two processor files of (name, config)."""
    files = {"normalizer_processor": "pre.safetensors", "unnormalizer_processor": "post.safetensors"}

    def step(name, config):
        return {"registry_name": name, "config": copy.deepcopy(config), **({"state_file": files[name]} if name in files else {})}

    both = {"policy_preprocessor": pre, "policy_postprocessor": post}
    return tuple({"name": name, "steps": [step(*s) for s in steps]} for name, steps in both.items())


def normalizer(config, name="normalizer_processor"):
    """The step that reads statistics."""
    features = copy.deepcopy({**config["input_features"], **config["output_features"]})
    return name, {"eps": 1e-8, "norm_map": dict(config["normalization_mapping"]), "features": features}


def step_of(tiny, name):
    """The step of either pipeline by its registry name."""
    return next(step for step in tiny.pre["steps"] + tiny.post["steps"] if step["registry_name"] == name)


def byte_alphabet():
    """The 256 symbols of byte-level vocabularies, in the order of the bytes."""
    shown = set(range(33, 127)) | set(range(161, 173)) | set(range(174, 256))
    hidden = [b for b in range(256) if b not in shown]
    return [chr(b) if b in shown else chr(256 + hidden.index(b)) for b in range(256)]


def tokenizer():
    symbols = byte_alphabet()
    merges = [["t", "o"], ["\u0120", "to"], ["\u0120to", "p"], ["\u0120", "\u0120"], ["i", "n"]]
    vocab = {text: i for i, text in enumerate([SPECIAL[0]] + symbols + [a + b for a, b in merges])}
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False, "special": True}
    added = [{"id": 0, "content": SPECIAL[0], **flags}, {"id": len(vocab), "content": SPECIAL[1], **flags}]
    return {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": added,
        "normalizer": None,
        "pre_tokenizer": {
            "type": "Sequence",
            "pretokenizers": [
                {"type": "Digits", "individual_digits": True},
                {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": True},
            ],
        },
        "post_processor": {"type": "ByteLevel", "add_prefix_space": True, "trim_offsets": False, "use_regex": True},
        "decoder": None,
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": None,
            "continuing_subword_prefix": None,
            "end_of_word_suffix": None,
            "fuse_unk": False,
            "byte_fallback": False,
            "ignore_merges": False,
            "vocab": vocab,
            "merges": merges,
        },
    }


def shapes():
    """Every tensor that the reference saves for CONFIG, by name."""
    d, s = D_VISION, {}
    for name, d_out, d_in in (
        ("state_proj", D_MODEL, D_STATE),
        ("action_in_proj", D_EXPERT, D_ACTION),
        ("action_time_mlp_in", D_EXPERT, 2 * D_EXPERT),
        ("action_time_mlp_out", D_EXPERT, D_EXPERT),
        ("action_out_proj", D_ACTION, D_EXPERT),
    ):
        s["model." + name + ".weight"], s["model." + name + ".bias"] = (d_out, d_in), (d_out,)
    vision = VLM + "vision_model."
    s[vision + "embeddings.patch_embedding.weight"], s[vision + "embeddings.patch_embedding.bias"] = (
        (d, 3, PATCH, PATCH),
        (d,),
    )
    s[vision + "embeddings.position_embedding.weight"] = ((IMAGE // PATCH) ** 2, d)
    block = vision + "encoder.layers.0."
    for norm in (block + "layer_norm1", block + "layer_norm2", vision + "post_layernorm"):
        s[norm + ".weight"] = s[norm + ".bias"] = (d,)
    for part in ("q_proj", "k_proj", "v_proj", "out_proj"):
        s[block + "self_attn." + part + ".weight"], s[block + "self_attn." + part + ".bias"] = (d, d), (d,)
    s[block + "mlp.fc1.weight"], s[block + "mlp.fc1.bias"] = (D_VISION_FF, d), (D_VISION_FF,)
    s[block + "mlp.fc2.weight"], s[block + "mlp.fc2.bias"] = (d, D_VISION_FF), (d,)
    s[VLM + "connector.modality_projection.proj.weight"] = (D_MODEL, d * FACTOR**2)
    s[VLM + "text_model.embed_tokens.weight"] = s["model.vlm_with_expert.vlm.lm_head.weight"] = (N_VOCAB, D_MODEL)
    s[VLM + "text_model.norm.weight"], s[EXPERT + "norm.weight"] = (D_MODEL,), (D_EXPERT,)
    for i in range(N_LAYER):
        s.update(llama_block("{}text_model.layers.{}.".format(VLM, i), D_MODEL, D_FF, D_MODEL))
        s.update(
            llama_block("{}layers.{}.".format(EXPERT, i), D_EXPERT, D_EXPERT_FF, N_KV * D_HEAD if i % 2 else D_EXPERT)
        )
    return s


def llama_block(prefix, d, d_ff, d_kv_in):
    heads, kv = N_HEAD * D_HEAD, N_KV * D_HEAD
    return {
        prefix + "input_layernorm.weight": (d,),
        prefix + "post_attention_layernorm.weight": (d,),
        prefix + "self_attn.q_proj.weight": (heads, d),
        prefix + "self_attn.k_proj.weight": (kv, d_kv_in),
        prefix + "self_attn.v_proj.weight": (kv, d_kv_in),
        prefix + "self_attn.o_proj.weight": (d, heads),
        prefix + "mlp.gate_proj.weight": (d_ff, d),
        prefix + "mlp.up_proj.weight": (d_ff, d),
        prefix + "mlp.down_proj.weight": (d, d_ff),
    }


class Tiny:
    """Everything of a checkpoint as plain values to change before `save`."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        self.config, self.backbone, self.tokenizer = copy.deepcopy(CONFIG), copy.deepcopy(BACKBONE), tokenizer()
        self.tokenizer_config = {"tokenizer_class": "TokenizersBackend", "pad_token": SPECIAL[0]}
        self.tensors = {name: rng.standard_normal(shape).astype(np.float32) for name, shape in shapes().items()}
        self.metadata = {"format": "pt"}
        self.stats = {}
        for feature, dim in (("observation.state", STATE_DIM), ("action", ACTION_DIM)):
            for statistic in ("mean", "std", "min", "max", "q01", "q99", "q10", "q90"):
                self.stats["{}.{}".format(feature, statistic)] = (
                    np.abs(rng.standard_normal(dim)).astype(np.float32) + 0.1
                )
        self.pre, self.post = self._pipelines()

    def _pipelines(self):
        pre = [
            layout.rename({}),
            layout.BATCH,
            ("smolvla_new_line_processor", {}),
            layout.tokenizer("nobody/none", 7),
            ("device_processor", {"device": "cuda", "float_dtype": None}),
            normalizer(self.config),
        ]
        return pipelines(pre, [normalizer(self.config, "unnormalizer_processor"), layout.device()])

    def step(self, name):
        return step_of(self, name)

    def normalization(self, mode, kind="STATE"):
        self.config["normalization_mapping"][kind] = mode
        for step in ("normalizer_processor", "unnormalizer_processor"):
            self.step(step)["config"]["norm_map"][kind] = mode

    def old_layout(self):
        """Statistics inside the weights and no processor files."""
        for group, feature in (
            ("normalize_inputs", "observation.state"),
            ("normalize_targets", "action"),
            ("unnormalize_outputs", "action"),
        ):
            for statistic in ("mean", "std"):
                name = "{}.buffer_{}.{}".format(group, feature.replace(".", "_"), statistic)
                self.tensors[name] = self.stats["{}.{}".format(feature, statistic)]
        self.pre = self.post = None
        return self

    def save(self, folder, shards=0):
        folder = str(folder)
        write_jsons(folder, config=self.config)
        save_vlm(self, folder)
        save_pipelines(self, folder, self.stats)
        if not shards:
            write_safetensors(os.path.join(folder, "model.safetensors"), self.tensors, self.metadata)
        else:
            save_shards(folder, self.tensors, shards)
        return folder


def write_jsons(folder, **values):
    for name, value in values.items():
        if value is not None:
            write_json(os.path.join(folder, name + ".json"), value)


def save_vlm(tiny, folder, below="vlm"):
    """The folder that the hub keeps apart: the backbone's config, where there is one, and the tokenizer."""
    backbone = getattr(tiny, "backbone", None)
    write_jsons(os.path.join(folder, below), config=backbone, tokenizer=tiny.tokenizer, tokenizer_config=tiny.tokenizer_config)


def save_pipelines(tiny, folder, statistics):
    if tiny.pre is None:
        return
    write_jsons(folder, policy_preprocessor=tiny.pre, policy_postprocessor=tiny.post)
    for file in ("pre", "post"):
        write_safetensors(os.path.join(folder, file + ".safetensors"), statistics)


def save_shards(folder, tensors, shards):
    names, index = sorted(tensors), {}
    for k in range(shards):
        file = "model-{:05d}-of-{:05d}.safetensors".format(k + 1, shards)
        index.update(dict.fromkeys(names[k::shards], file))
        write_safetensors(os.path.join(folder, file), {name: tensors[name] for name in names[k::shards]})
    write_json(os.path.join(folder, "model.safetensors.index.json"), {"metadata": {}, "weight_map": index})
