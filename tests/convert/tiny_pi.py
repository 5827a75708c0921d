# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5 checkpoints small enough to make in every test, as LeRobot and as openpi write them, by numpy alone.

Their shapes are written down here a second time, independently of the converter, from the reference's constructors.
"""

import copy
import os

import numpy as np

from goldens import lerobot_layout as layout
from tiny import normalizer, pipelines, save_pipelines, save_vlm, step_of, write_jsons, write_safetensors

PWE = "model.paligemma_with_expert."
VISION = PWE + "paligemma.model.vision_tower.vision_model."
LM = PWE + "paligemma.model.language_model."
HEAD = PWE + "paligemma.lm_head.weight"
EXPERT = PWE + "gemma_expert.model."
EXPERT_HEAD = PWE + "gemma_expert.lm_head.weight"
STATE_DIM, ACTION_DIM, D_STATE, D_ACTION, HORIZON = 6, 5, 8, 9, 4
D_VISION, D_VISION_FF, IMAGE, PATCH = 6, 10, 28, 14
D_LM, D_LM_FF, D_EXPERT, D_EXPERT_FF, N_LAYER = 12, 14, 10, 18, 2
N_HEAD, D_HEAD = 3, 4
DIMS = {
    "size": "tiny",
    "gemma_2b": dict(width=D_LM, depth=N_LAYER, mlp_dim=D_LM_FF, num_heads=N_HEAD, num_kv_heads=1, head_dim=D_HEAD),
    "gemma_300m": dict(width=D_EXPERT, depth=N_LAYER, mlp_dim=D_EXPERT_FF, num_heads=N_HEAD, num_kv_heads=1, head_dim=D_HEAD),
    "vision": dict(hidden_size=D_VISION, num_hidden_layers=1, num_attention_heads=2, intermediate_size=D_VISION_FF),
}
SPECIAL = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"]
BLANK = "\u2581"


def tokenizer(n_unused=3):
    """The shape of PaliGemma's: bytes, a few pieces, <image> right behind the last row of the embedding."""
    pieces = [*SPECIAL, *("<0x{:02X}>".format(b) for b in range(256)), *"pickuthe", BLANK, "\n", "\n\n"]
    merges = [["p", "i"], ["t", "h"], ["th", "e"], [BLANK, "the"], [BLANK, BLANK]]
    pieces += [a + b for a, b in merges]
    pieces += ["<unused{}>".format(i) for i in range(n_unused)]
    vocab = {text: i for i, text in enumerate(dict.fromkeys(pieces))}
    n_vocab = len(vocab)
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False, "special": True}
    added = [{"id": vocab[text], "content": text, **flags} for text in SPECIAL]
    added.append({"id": vocab["\n\n"], "content": "\n\n", **flags, "special": False})
    added.append({"id": n_vocab, "content": "<image>", **flags})
    front = [{"SpecialToken": {"id": "<bos>", "type_id": 0}}, {"Sequence": {"id": "A", "type_id": 0}}]
    return n_vocab, {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": added,
        "normalizer": {"type": "Replace", "pattern": {"String": " "}, "content": BLANK},
        "pre_tokenizer": {
            "type": "Split",
            "pattern": {"String": " "},
            "behavior": "MergedWithPrevious",
            "invert": False,
        },
        "post_processor": {
            "type": "TemplateProcessing",
            "single": front,
            "pair": front,
            "special_tokens": {"<bos>": {"id": "<bos>", "ids": [2], "tokens": ["<bos>"]}},
        },
        "decoder": None,
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": "<unk>",
            "continuing_subword_prefix": None,
            "end_of_word_suffix": None,
            "fuse_unk": True,
            "byte_fallback": True,
            "ignore_merges": False,
            "vocab": vocab,
            "merges": merges,
        },
    }


N_VOCAB = tokenizer()[0]


def block(prefix, d, d_ff, norms):
    heads = N_HEAD * D_HEAD
    shapes = {
        prefix + "self_attn.q_proj.weight": (heads, d),
        prefix + "self_attn.k_proj.weight": (D_HEAD, d),
        prefix + "self_attn.v_proj.weight": (D_HEAD, d),
        prefix + "self_attn.o_proj.weight": (d, heads),
        prefix + "mlp.gate_proj.weight": (d_ff, d),
        prefix + "mlp.up_proj.weight": (d_ff, d),
        prefix + "mlp.down_proj.weight": (d, d_ff),
    }
    for name in ("input_layernorm", "post_attention_layernorm"):
        shapes.update(norms(prefix + name, d))
    return shapes


def plain_norm(name, d):
    return {name + ".weight": (d,)}


def adaptive_norm(name, d):
    return {name + ".dense.weight": (3 * d, d), name + ".dense.bias": (3 * d,)}


def linear(name, d_out, d_in):
    return {name + ".weight": (d_out, d_in), name + ".bias": (d_out,)}


def shapes(kind, n_position=(IMAGE // PATCH) ** 2):
    """Every tensor that the reference saves, by name; the language head holds the embedding table."""
    norms = plain_norm if kind == "pi0" else adaptive_norm
    s = {
        VISION + "embeddings.patch_embedding.weight": (D_VISION, 3, PATCH, PATCH),
        VISION + "embeddings.patch_embedding.bias": (D_VISION,),
        VISION + "embeddings.position_embedding.weight": (n_position, D_VISION),
        HEAD: (N_VOCAB, D_LM),
        EXPERT_HEAD: (N_VOCAB, D_EXPERT),
        LM + "norm.weight": (D_LM,),
        **norms(EXPERT + "norm", D_EXPERT),
        **linear(PWE + "paligemma.model.multi_modal_projector.linear", D_LM, D_VISION),
        **linear("model.action_in_proj", D_EXPERT, D_ACTION),
        **linear("model.action_out_proj", D_ACTION, D_EXPERT),
    }
    layer = VISION + "encoder.layers.0."
    for part in ("q_proj", "k_proj", "v_proj", "out_proj"):
        s.update(linear(layer + "self_attn." + part, D_VISION, D_VISION))
    s.update({**linear(layer + "mlp.fc1", D_VISION_FF, D_VISION), **linear(layer + "mlp.fc2", D_VISION, D_VISION_FF)})
    for norm in (layer + "layer_norm1", layer + "layer_norm2", VISION + "post_layernorm"):
        s[norm + ".weight"] = s[norm + ".bias"] = (D_VISION,)
    for i in range(N_LAYER):
        s.update(block("{}layers.{}.".format(LM, i), D_LM, D_LM_FF, plain_norm))
        s.update(block("{}layers.{}.".format(EXPERT, i), D_EXPERT, D_EXPERT_FF, norms))
    if kind == "pi0":
        s.update(linear("model.state_proj", D_EXPERT, D_STATE))
        s.update(linear("model.action_time_mlp_in", D_EXPERT, 2 * D_EXPERT))
        s.update(linear("model.action_time_mlp_out", D_EXPERT, D_EXPERT))
    else:
        s.update({**linear("model.time_mlp_in", D_EXPERT, D_EXPERT), **linear("model.time_mlp_out", D_EXPERT, D_EXPERT)})
    return s


def config(kind):
    mode = "MEAN_STD" if kind == "pi0" else "QUANTILES"
    inputs, outputs = layout.features({"base": (20, 28), "wrist": (36, 36)}, STATE_DIM, ACTION_DIM)
    return {
        "type": kind,
        "n_obs_steps": 1,
        "input_features": inputs,
        "output_features": outputs,
        "dtype": "float32",
        "chunk_size": HORIZON,
        "n_action_steps": HORIZON,
        "max_state_dim": D_STATE,
        "max_action_dim": D_ACTION,
        "num_inference_steps": 3,
        "image_resolution": [IMAGE, IMAGE],
        "empty_cameras": 1,
        "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode},
        "use_relative_actions": False,
        "relative_exclude_joints": ["gripper"],
        "action_feature_names": None,
        "rtc_config": None,
        "time_sampling_offset": 0.001,
        "compile_mode": "max-autotune",
    }


class TinyPi:
    """Everything of a checkpoint as plain values to change before `save`."""

    def __init__(self, kind="pi0", seed=0):
        rng = np.random.default_rng(seed)
        self.kind, self.config, self.dims = kind, config(kind), copy.deepcopy(DIMS)
        self.tokenizer = tokenizer()[1]
        self.dims["vocab_size"] = N_VOCAB
        self.tokenizer_config = {"tokenizer_class": "GemmaTokenizer"}
        self.tensors = {name: rng.standard_normal(shape).astype(np.float32) for name, shape in shapes(kind).items()}
        self.stats = {}
        for feature, dim in (("observation.state", STATE_DIM), ("action", ACTION_DIM)):
            low = np.abs(rng.standard_normal(dim)).astype(np.float32) + 0.1
            for statistic, value in zip(("mean", "std", "q01", "q99"), (low, low + 1, low + 2, low + 4)):
                self.stats["{}.{}".format(feature, statistic)] = value
        self.pre, self.post = self._pipelines()

    def _pipelines(self):
        relative = ("relative_actions_processor", {"enabled": False, "exclude_joints": ["gripper"], "action_names": None})
        first, device = [layout.rename({}), layout.BATCH], layout.device()
        tokenize = layout.tokenizer("google/paligemma-3b-pt-224", 20)
        normalize = normalizer(self.config)
        if self.kind == "pi0":
            pre = [*first, ("pi0_new_line_processor", {}), tokenize, device, relative, normalize]
        else:
            pre = [*first, relative, normalize, ("pi05_prepare_state_tokenizer_processor_step", {}), tokenize, device]
        post = [normalizer(self.config, "unnormalizer_processor"), ("absolute_actions_processor", {"enabled": False}), device]
        return pipelines(pre, post)

    def step(self, name):
        return step_of(self, name)

    def relative(self, names=None, exclude=("gripper",)):
        self.config["use_relative_actions"] = True
        self.step("relative_actions_processor")["config"] = {
            "enabled": True,
            "exclude_joints": list(exclude),
            "action_names": names,
        }
        self.step("absolute_actions_processor")["config"]["enabled"] = True
        return self

    def rename(self, old, new):
        """Moves every tensor below a prefix."""
        self.tensors = {
            new + name[len(old) :] if name.startswith(old) else name: value for name, value in self.tensors.items()
        }
        return self

    def save(self, folder):
        folder = str(folder)
        save_pipelines(self, folder, self.stats)
        self._save_rest(folder)
        return folder

    def _save_rest(self, folder):
        write_jsons(folder, config=self.config, dims=self.dims)
        save_vlm(self, folder, "tokenizer")
        write_safetensors(os.path.join(folder, "model.safetensors"), self.tensors)


class TinyOpenpi(TinyPi):
    """The same numbers as openpi lays them out: no prefix, a small config.json or none, statistics under assets/."""

    def __init__(self, kind="pi0", asset="physical-intelligence/libero", width=32, seed=0):
        super().__init__(kind, seed)
        rng = np.random.default_rng(seed + 1)
        weights = shapes(kind, n_position=(224 // PATCH) ** 2)
        weights = {n: s for n, s in weights.items() if n not in (EXPERT_HEAD, LM + "norm.weight")}
        self.tensors = {n[len("model.") :]: rng.standard_normal(s).astype(np.float32) for n, s in weights.items()}
        for name in [name for name in self.tensors if "action_in_proj.w" in name or "state_proj.w" in name]:
            self.tensors[name] = rng.standard_normal((D_EXPERT, 32)).astype(np.float32)
        self.tensors["action_out_proj.weight"] = rng.standard_normal((32, D_EXPERT)).astype(np.float32)
        self.tensors["action_out_proj.bias"] = rng.standard_normal(32).astype(np.float32)
        self.config = {
            "action_dim": 32,
            "action_horizon": 7,
            "paligemma_variant": "gemma_2b",
            "action_expert_variant": "gemma_300m",
            "precision": "bfloat16",
        }
        self.asset = asset
        names = ("mean", "std", "q01", "q99")
        self.norm_stats = {
            key: {name: [k + i / 16 + j / 100 for i in range(width)] for j, name in enumerate(names)}
            for k, key in enumerate(("state", "actions"))
        }

    def save(self, folder):
        folder = str(folder)
        write_jsons(os.path.join(folder, "assets", *self.asset.split("/")), norm_stats={"norm_stats": self.norm_stats})
        self._save_rest(folder)
        return folder
