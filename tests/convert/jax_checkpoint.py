# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A π0 or π0.5 of LeRobot as openpi's JAX training would have saved it: stacked layers, and of LoRA the weights before it with its factors.

The products of LoRA are the einsums of openpi's models/lora.py (`Einsum._make_lora_eqns`, `FeedForward._dot`).
"""

import json

import numpy as np

TOWERS = "model.paligemma_with_expert."
PALIGEMMA = TOWERS + "paligemma.model."
VISION = PALIGEMMA + "vision_tower.vision_model."
IMG, LLM = "PaliGemma/img/", "PaliGemma/llm/"
# Module -> weights, the first factor, the second one, of one layer.
PRODUCTS = {"q_einsum": "NDL,NLH->NDH", "kv_einsum": "kNDL,kNLH->kNDH", "attn_vec_einsum": "NHL,MLD->NHD",
            "gating_einsum": "kDL,kLF->kDF", "linear": "FL,LD->FD"}


def arrays_of(tensors, dims, ranks=None, seed=0):
    """{name: array}. dims: of dims.json. ranks: of LoRA by module's suffix ("", "_1"), none without it."""
    reader = _Reader(tensors)
    arrays = reader.tower(dims["vision"]["num_attention_heads"])
    arrays |= reader.decoder("", PALIGEMMA + "language_model.", dims["gemma_2b"])
    arrays |= reader.decoder("_1", TOWERS + "gemma_expert.model.", dims["gemma_300m"])
    arrays[LLM + "embedder/input_embedding"] = reader.embedding()
    arrays |= reader.heads()
    random = np.random.default_rng(seed)
    for which, rank in (ranks or {}).items():
        for name in [name for name in arrays if which == ("_1" if "_1/" in name else "") and name.startswith(LLM + "layers/")]:
            _add_lora(arrays, name, rank, random)
    return arrays


def _add_lora(arrays, name, rank, random):
    """Takes the sum out of the weights, which so are those from before."""
    module = next((module for module in PRODUCTS if module in name), None)
    if module is None:
        return
    whole = arrays[name]
    left = random.normal(0, 0.05, (*whole.shape[:-1], rank)).astype(np.float32)
    right = random.normal(0, 0.05, (*whole.shape[:-2], rank, whole.shape[-1])).astype(np.float32)
    equation = PRODUCTS[module]
    sums = [np.einsum(equation, a.astype(np.float64), b.astype(np.float64)) for a, b in zip(left, right)]
    at = name.removesuffix("w") if name.endswith("/w") else name + "_"
    arrays |= {name: (whole - np.stack(sums)).astype(np.float32), at + "lora_a": left, at + "lora_b": right}


class _Reader:
    def __init__(self, tensors):
        self.tensors = tensors

    def stacked(self, at, turn=lambda x: x):
        layers = []
        while (name := at.format(len(layers))) in self.tensors:
            layers.append(turn(self.tensors[name]))
        return np.stack(layers)

    def tower(self, n_head):
        at, to = VISION + "encoder.layers.{}.", IMG + "Transformer/encoderblock/"
        heads = lambda x: x.T.reshape(x.shape[1], n_head, -1)  # noqa: E731
        out = {}
        for i in (0, 1):
            norm, dense = f"{to}LayerNorm_{i}/", f"{to}MlpBlock_0/Dense_{i}/"
            out |= {norm + "scale": self.stacked(f"{at}layer_norm{i + 1}.weight"), norm + "bias": self.stacked(f"{at}layer_norm{i + 1}.bias")}
            out |= {dense + "kernel": self.stacked(f"{at}mlp.fc{i + 1}.weight", np.transpose), dense + "bias": self.stacked(f"{at}mlp.fc{i + 1}.bias")}
        to += "MultiHeadDotProductAttention_0/"
        for name in ("query", "key", "value"):
            out[f"{to}{name}/kernel"] = self.stacked(f"{at}self_attn.{name[0]}_proj.weight", heads)
            out[f"{to}{name}/bias"] = self.stacked(f"{at}self_attn.{name[0]}_proj.bias", lambda x: x.reshape(n_head, -1))
        out[to + "out/kernel"] = self.stacked(at + "self_attn.out_proj.weight", lambda x: x.T.reshape(n_head, -1, len(x)))
        out[to + "out/bias"] = self.stacked(at + "self_attn.out_proj.bias")
        t, projector = self.tensors, PALIGEMMA + "multi_modal_projector.linear."
        return out | {
            IMG + "embedding/kernel": t[VISION + "embeddings.patch_embedding.weight"].transpose(2, 3, 1, 0),
            IMG + "embedding/bias": t[VISION + "embeddings.patch_embedding.bias"],
            IMG + "pos_embedding": t[VISION + "embeddings.position_embedding.weight"][None],
            IMG + "Transformer/encoder_norm/scale": t[VISION + "post_layernorm.weight"],
            IMG + "Transformer/encoder_norm/bias": t[VISION + "post_layernorm.bias"],
            IMG + "head/kernel": t[projector + "weight"].T, IMG + "head/bias": t[projector + "bias"],
        }  # fmt: skip

    def decoder(self, which, at, dims):
        n_head, d_head = dims["num_heads"], dims["head_dim"]
        layer, to = at + "layers.{}.", LLM + "layers/"
        heads = lambda x: x.reshape(-1, d_head, x.shape[1]).transpose(0, 2, 1)  # noqa: E731
        both = lambda a, b, turn: np.stack([self.stacked(layer + a, turn), self.stacked(layer + b, turn)], axis=1)  # noqa: E731
        out = {
            f"{to}attn/q_einsum{which}/w": self.stacked(layer + "self_attn.q_proj.weight", heads),
            f"{to}attn/kv_einsum{which}/w": both("self_attn.k_proj.weight", "self_attn.v_proj.weight", heads),
            f"{to}attn/attn_vec_einsum{which}/w": self.stacked(layer + "self_attn.o_proj.weight", lambda x: x.T.reshape(n_head, d_head, -1)),
            f"{to}mlp{which}/gating_einsum": both("mlp.gate_proj.weight", "mlp.up_proj.weight", np.transpose),
            f"{to}mlp{which}/linear": self.stacked(layer + "mlp.down_proj.weight", np.transpose),
        }
        for name, tensor in (("pre_attention_norm", "input_layernorm"), ("pre_ffw_norm", "post_attention_layernorm")):
            out |= self.norm(f"{to}{name}{which}", layer + tensor, self.stacked)
        return out | self.norm(f"{LLM}final_norm{which}", at + "norm", lambda name, turn=lambda x: x: turn(self.tensors[name]))

    def norm(self, to, at, read):
        if at.format(0) + ".dense.weight" in self.tensors:
            return {to + "/Dense_0/kernel": read(at + ".dense.weight", np.transpose), to + "/Dense_0/bias": read(at + ".dense.bias")}
        return {to + "/scale": read(at + ".weight")}

    def embedding(self):
        return self.tensors.get(PALIGEMMA + "language_model.embed_tokens.weight", self.tensors.get(TOWERS + "paligemma.lm_head.weight"))

    def heads(self):
        out = {}
        for name, tensor in self.tensors.items():
            layer, part = name.removeprefix("model.").split(".")[:2]
            if layer.endswith(("_proj", "_mlp_in", "_mlp_out")):
                out[f"{layer}/kernel" if part == "weight" else f"{layer}/bias"] = tensor.T
        return out


def write(folder, arrays, value=True, in_database=True):
    """The folder params/ as Orbax writes it. value: whether flax's State was saved, which puts `value` behind every name."""
    import tensorstore

    folder.mkdir(parents=True)
    leaves = {}
    for name, array in arrays.items():
        keys = ["params", *name.split("/"), *(["value"] if value else [])]
        path = ".".join(keys) + "/"
        store = {"driver": "ocdbt", "base": f"file://{folder}/", "path": path} if in_database else f"file://{folder}/{path}"
        opened = tensorstore.open({"driver": "zarr", "kvstore": store}, create=True, dtype=array.dtype, shape=array.shape).result()
        opened.write(np.ascontiguousarray(array)).result()
        leaves[str(tuple(keys))] = {"key_metadata": [{"key": key, "key_type": 2} for key in keys], "value_metadata": {"value_type": "jax.Array"}}
    (folder / "_METADATA").write_text(json.dumps({"tree_metadata": leaves, "use_zarr3": False}))
