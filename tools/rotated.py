# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The same policy with rotated channels, for tools/quantize_held_out.py --rotated: what rotation would gain before codes.

A residual stream is rotated by an orthogonal matrix Q: what writes to it gets Q from the left, what reads it Q transposed from the right, and
the gains of the norms between go into the readers (QuaRot, arXiv 2404.00456, with a random Q instead of Hadamard's, since widths are no powers of
two).  A LayerNorm subtracts the mean, so that Q leaves the vector of ones where it is.  Inside attention the values of a head are rotated, and the
columns of the output's matrix back.  Streams behind norms that residuals read (BERT, TurboVLA's fusion and decoder) cannot be rotated, and `down` of an MLP
only by a product at run time.
"""
import re

import numpy as np


def orthogonal(d, generator, keeps_ones=False):
    """(d, d): uniformly random."""
    if not keeps_ones:
        q, r = np.linalg.qr(generator.normal(size=(d, d)))
        return q * np.sign(np.diag(r))
    basis = np.linalg.qr(np.column_stack([np.ones(d), generator.normal(size=(d, d - 1))]))[0]
    inner = np.eye(d)
    inner[1:, 1:] = orthogonal(d - 1, generator)
    return basis @ inner @ basis.T


class Rotated:
    """Rotates tensors.  tensors: {name: float64}."""

    def __init__(self, tensors, seed=54):
        self.tensors, self.generator = tensors, np.random.default_rng(seed)

    def blocks(self, part):
        return sorted({int(found[1]) for name in self.tensors if (found := re.match(part + r"\.blk\.(\d+)\.", name))})

    def present(self, names):
        return [name for name in names if name + ".weight" in self.tensors]

    def scale_output(self, matrix, scale):
        """A vector that multiplies a product's result goes into the product."""
        by = self.tensors[scale]
        for name, values in ((f"{matrix}.weight", by[:, None]), (f"{matrix}.bias", by)):
            self.tensors[name] = self.tensors[name] * values
        self.tensors[scale] = np.ones_like(by)

    def write(self, name, rotation):
        self.tensors[f"{name}.weight"] = rotation @ self.tensors[f"{name}.weight"]
        if f"{name}.bias" in self.tensors:
            self.tensors[f"{name}.bias"] = rotation @ self.tensors[f"{name}.bias"]

    def write_rows(self, name, rotation):
        self.tensors[name] = self.tensors[name] @ rotation.T

    def read(self, name, rotation):
        """Columns may be several tokens of the stream, one after another."""
        values = self.tensors[f"{name}.weight"]
        self.tensors[f"{name}.weight"] = (values.reshape(len(values), -1, len(rotation)) @ rotation.T).reshape(values.shape)

    def norm(self, name, readers, rotation):
        """gain * z + bias = gain * (z + bias / gain): the gain goes into the readers."""
        gain, bias = self.tensors[f"{name}.weight"], self.tensors.get(f"{name}.bias")
        self.tensors[f"{name}.weight"] = np.ones_like(gain)
        if bias is not None:
            self.tensors[f"{name}.bias"] = rotation @ (bias / gain)
        for reader in self.present(readers):
            values = self.tensors[f"{reader}.weight"]
            self.tensors[f"{reader}.weight"] = values * np.tile(gain, values.shape[1] // len(gain))
            self.read(reader, rotation)

    def stream(self, part, writers, rows, last, cached=()):
        """writers and rows: what writes to it before its blocks; last: (norm, reader) or None; cached: matrices that read other values."""
        first = self.tensors[f"{part}.blk.0.attn_norm.weight"]
        rotation = orthogonal(len(first), self.generator, keeps_ones=f"{part}.blk.0.attn_norm.bias" in self.tensors)
        for name in writers:
            self.write(name, rotation)
        for name in rows:
            self.write_rows(name, rotation)
        for i in self.blocks(part):
            block = f"{part}.blk.{i}."
            for norm, readers in (("attn_norm", ("attn_q", "attn_k", "attn_v")), ("ffn_norm", ("ffn_gate", "ffn_up"))):
                if block + norm + ".weight" in self.tensors:
                    self.norm(block + norm, [block + name for name in readers if block + name not in cached], rotation)
            for name in self.present([block + "attn_out", block + "ffn_down"]):
                self.write(name, rotation)
        if last:
            self.norm(last[0], [last[1]], rotation)

    def heads(self, value, n, readers, rotation=None):
        """Rotates the values of each of n heads.  readers: matrices whose columns are the heads of the queries, or the values' own."""
        rows = len(self.tensors[f"{value}.weight"])
        rotation = [orthogonal(rows // n, self.generator) for _ in range(n)] if rotation is None else rotation
        self.write(value, diagonal(rotation))
        for reader in self.present(readers):
            group = self.tensors[f"{reader}.weight"].shape[1] // rows
            self.read(reader, diagonal([one for one in rotation for _ in range(group)]))
        return rotation


def diagonal(blocks):
    d = len(blocks[0])
    out = np.zeros((len(blocks) * d,) * 2)
    for i, block in enumerate(blocks):
        out[i * d : (i + 1) * d, i * d : (i + 1) * d] = block
    return out


def rotate_smolvla(rotated, keys):
    crossed = [i for i in rotated.blocks("expert") if i % 2]  # they read the language model's keys and values
    rotated.stream("vision", ["vision.patch_embed"], ["vision.position.weight"], ("vision.post_norm", "connector"))
    rotated.stream("lm", ["connector", "state_in"], ["lm.token_embd.weight"], None)
    rotated.stream("expert", ["action_time_out"], [], ("expert.norm", "action_out"), [f"expert.blk.{i}.{name}" for i in crossed for name in ("attn_k", "attn_v")])
    for i in rotated.blocks("vision"):
        rotated.heads(f"vision.blk.{i}.attn_v", keys["vision.n_head"], [f"vision.blk.{i}.attn_out"])
    for i in rotated.blocks("lm"):
        expert = f"expert.blk.{i}."
        rotation = rotated.heads(f"lm.blk.{i}.attn_v", keys["lm.n_head_kv"], [f"lm.blk.{i}.attn_out", *([expert + "attn_v"] if i in crossed else [])])
        rotated.heads(expert + "attn_v", keys["lm.n_head_kv"], [expert + "attn_out"], None if i in crossed else rotation)


def rotate_turbovla(rotated, keys):
    for i in rotated.blocks("vision"):
        rotated.scale_output(f"vision.blk.{i}.attn_out", f"vision.blk.{i}.attn_scale.weight")
        rotated.scale_output(f"vision.blk.{i}.ffn_down", f"vision.blk.{i}.ffn_scale.weight")
    rotated.stream("vision", ["vision.patch_embed"], ["vision.class_token.weight", "vision.registers.weight"], ("vision.post_norm", "projector"))
    for name in [name for name in rotated.tensors if name.endswith(".attn_v.weight")]:
        block = name[: -len("attn_v.weight")]
        part = name.split(".")[0]
        rotated.heads(block + "attn_v", keys[f"{part if part in ('vision', 'lm') else 'transformer'}.n_head"], [block + "attn_out"])


FAMILIES = {"smolvla": rotate_smolvla, "turbovla": rotate_turbovla}


def rotated_tensors(content):
    """{tensor: float32} of the rotated policy, for each of its floats."""
    dtypes = content.dtypes
    floats = {name: as_floats(values, dtypes[name]).astype(np.float64) for name, values in content.tensors.items() if dtypes[name] in ("bf16", "f32")}
    FAMILIES[content.keys["vla.arch"]](Rotated(floats), content.keys)
    return {name: values.astype(np.float32) for name, values in floats.items()}


def as_floats(values, dtype):
    return (values.astype(np.uint32) << 16).view(np.float32) if dtype == "bf16" else values
