# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LoRA adapters beside the policy that they were trained on. tests/reference/compare_adapters.py compares the sums with PEFT's own."""

import copy
import json
import math
import shutil

import numpy as np
import pytest

from goldens.files import write_json, write_safetensors
from tiny import EXPERT, TEXT_EMBEDDING, Tiny
from tiny_pi import TinyPi
from vla_cpp.convert.adapters import CONFIG, WEIGHTS_FILE
from vla_cpp.convert.dtypes import f32_to_bf16
from vla_cpp.convert.errors import Code

Q, STATE, PATCH = EXPERT + "layers.0.self_attn.q_proj", "model.state_proj", TEXT_EMBEDDING.replace(
    "text_model.embed_tokens", "vision_model.embeddings.patch_embedding"
)
LORA = {"peft_type": "LORA", "r": 2, "lora_alpha": 6, "target_modules": ["q_proj", "state_proj"], "bias": "none", "use_dora": False}


class Adapter:
    """An adapter in a folder of its own, with the policy's config and pipelines, as LeRobot saves one."""

    def __init__(self, tmp_path, base, config=LORA):
        self.folder, self.base, self.policy = tmp_path / "policy", tmp_path / "base", base
        self.config = {**copy.deepcopy(config), "base_model_name_or_path": str(self.base)}
        self.tensors, self.rng = {}, np.random.default_rng(7)

    def add(self, module, rank=2, kinds=("lora_A.weight", "lora_B.weight"), prefix="base_model.model."):
        shape = self.policy.tensors[module + ".weight"].shape
        down, up = (rank, *shape[1:]), (shape[0], rank, *[1] * (len(shape) - 2))
        if "embedding" in kinds[0]:
            down, up = (rank, shape[0]), (shape[1], rank)
        for kind, own in zip(kinds, (down, up)):
            self.tensors["{}{}.{}".format(prefix, module, kind)] = self.rng.standard_normal(own).astype(np.float32)
        return [self.tensors["{}{}.{}".format(prefix, module, kind)] for kind in kinds]

    def save(self, **without):
        self.policy.save(self.base)
        shutil.copytree(self.base, self.folder)
        (self.folder / "model.safetensors").unlink()
        shutil.rmtree(self.folder / "vlm", ignore_errors=True)
        config = json.loads((self.folder / "config.json").read_text())
        write_json(self.folder / "config.json", {**config, "use_peft": True})
        write_json(self.folder / CONFIG, self.config)
        write_safetensors(str(self.folder / WEIGHTS_FILE), self.tensors)
        return self


@pytest.fixture
def adapter(tmp_path):
    return Adapter(tmp_path, Tiny())


def close(got, wanted):
    np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-6)


def test_products_are_added_and_the_rest_is_the_bases(converter, adapter):
    (a, b), (c, d) = adapter.add(Q), adapter.add(STATE)
    adapter.save()
    bundle = converter.bundle()
    close(bundle.tensors["expert.blk.0.attn_q.weight"], adapter.policy.tensors[Q + ".weight"] + 3 * b @ a)
    close(bundle.tensors["state_in.weight"], adapter.policy.tensors[STATE + ".weight"] + 3 * d @ c)
    np.testing.assert_array_equal(bundle.tensors["action_in.weight"], adapter.policy.tensors["model.action_in_proj.weight"])
    assert bundle.keys["vla.source.name"] == "policy on base"
    assert any(note == "adapter merged into 2 tensors of the base; 0 tensors are its own" for note in converter.summary.notes)


def test_scales_go_by_module(converter, adapter):
    adapter.config.update(use_rslora=True, rank_pattern={"state_proj": 4}, alpha_pattern={r".*layers\.0\..*q_proj": 1})
    (a, b), (c, d) = adapter.add(Q), adapter.add(STATE, rank=4)
    adapter.save()
    bundle = converter.bundle()
    close(bundle.tensors["expert.blk.0.attn_q.weight"], adapter.policy.tensors[Q + ".weight"] + b @ a / math.sqrt(2))
    close(bundle.tensors["state_in.weight"], adapter.policy.tensors[STATE + ".weight"] + 6 / math.sqrt(4) * d @ c)


def test_embeddings_convolutions_and_biases(converter, adapter):
    a, b = adapter.add(TEXT_EMBEDDING, kinds=("lora_embedding_A", "lora_embedding_B"))
    c, d = adapter.add(PATCH)
    adapter.add(STATE)
    bias = adapter.tensors["base_model.model.{}.lora_B.bias".format(STATE)] = np.full(12, 2, np.float32)
    adapter.save()
    bundle = converter.bundle()
    close(bundle.tensors["lm.token_embd.weight"], adapter.policy.tensors[TEXT_EMBEDDING + ".weight"] + 3 * (b @ a).T)
    added = 3 * d.reshape(len(d), -1) @ c.reshape(len(c), -1)
    close(bundle.tensors["vision.patch_embed.weight"], adapter.policy.tensors[PATCH + ".weight"].reshape(added.shape) + added)
    close(bundle.tensors["state_in.bias"], adapter.policy.tensors[STATE + ".bias"] + 3 * bias)


@pytest.mark.parametrize("infix", ["", "modules_to_save.default.", "base_layer."])
def test_what_was_trained_as_a_whole_replaces(converter, adapter, infix):
    adapter.add(Q)
    new = adapter.tensors["base_model.model.{}.{}bias".format(STATE, infix)] = np.full(12, 9, np.float32)
    adapter.save()
    np.testing.assert_array_equal(converter.bundle().tensors["state_in.bias"], new)


def test_names_of_adapters_and_of_wrappers_are_left_out(converter, adapter):
    a, b = adapter.add(Q, kinds=("lora_A.default.weight", "lora_B.default.weight"), prefix="")
    adapter.save()
    close(converter.bundle().tensors["expert.blk.0.attn_q.weight"], adapter.policy.tensors[Q + ".weight"] + 3 * b @ a)


def test_a_sum_is_rounded_once_and_has_the_type_of_the_base(converter, adapter):
    a, b = adapter.add(Q)
    bits = {name: f32_to_bf16(value) for name, value in adapter.policy.tensors.items()}
    base = (bits[Q + ".weight"].astype(np.uint32) << 16).view(np.float32)
    adapter.policy.tensors = bits
    adapter.save()
    bundle = converter.bundle()
    assert bundle.dtypes["expert.blk.0.attn_q.weight"] == bundle.keys["vla.dtype"] == "bf16"
    exact = base.astype(np.float64) + 3 * b.astype(np.float64) @ a
    np.testing.assert_array_equal(bundle.tensors["expert.blk.0.attn_q.weight"], f32_to_bf16(exact.astype(np.float32)))


def test_chunks_do_not_change_a_sum(converter, adapter, monkeypatch):
    adapter.add(Q)
    adapter.save()
    whole = converter.bundle().keys["vla.checksum"]
    monkeypatch.setattr("vla_cpp.convert.adapters.Merged.chunks.__defaults__", (16,))
    assert converter.bundle().keys["vla.checksum"] == whole


@pytest.mark.parametrize("kind", ["pi0", "pi05"])
def test_adapters_find_towers_under_older_names(converter, tmp_path, kind):
    adapter = Adapter(tmp_path, TinyPi(kind))
    module = "model.paligemma_with_expert.gemma_expert.model.layers.1.self_attn.q_proj"
    a, b = adapter.add(module)
    wanted = adapter.policy.tensors[module + ".weight"] + 3 * b @ a
    adapter.policy.rename("model.", "")
    adapter.save()
    close(converter.bundle().tensors["expert.blk.1.attn_q.weight"], wanted)


def test_the_base_may_lie_elsewhere(converter, adapter, tmp_path):
    adapter.add(Q)
    adapter.config["base_model_name_or_path"] = "lerobot/smolvla_base"
    adapter.save()
    error = converter.refusal()
    assert error.code == Code.UNSUPPORTED and "a LoRA adapter of lerobot/smolvla_base" in error.message()
    assert "--base hub:lerobot/smolvla_base@main fetches it" in error.message()
    assert converter.bundle(base=str(adapter.base)).keys["vla.source.name"] == "policy on base"


def test_config_and_pipelines_of_the_base_do_where_the_adapter_has_none(converter, adapter):
    adapter.add(Q)
    adapter.save()
    for name in ("config.json", "policy_preprocessor.json", "policy_postprocessor.json", "pre.safetensors", "post.safetensors"):
        (adapter.folder / name).unlink()
    assert "stats.action.mean" in converter.bundle().tensors


REFUSED = {
    "config: adapter_config.json: peft_type: expected LORA, found 'LOHA'": lambda a: a.config.update(peft_type="LOHA"),
    "use_dora: expected False, found True; DoRA scales": lambda a: a.config.update(use_dora=True),
    "found DoRA (lora_magnitude_vector)": lambda a: a.tensors.update(
        {"base_model.model.{}.lora_magnitude_vector".format(Q): np.ones(12, np.float32)}
    ),
    "init_lora_weights: expected one that leaves the base as it is, found 'pissa'": lambda a: a.config.update(init_lora_weights="pissa"),
    "trainable_token_indices: expected no such field": lambda a: a.config.update(trainable_token_indices=[1]),
    "target_parameters: expected no such field": lambda a: a.config.update(target_parameters=["x"]),
    "new_thing: expected no such field": lambda a: a.config.update(new_thing=3),
    "r: expected 2, the rank of the tensors of " + Q: lambda a: a.config.update(r=4),
    "lora_alpha: expected a number above 0": lambda a: a.config.update(lora_alpha=0),
    "expected lora_A and lora_B, found lora_A": lambda a: a.tensors.pop("base_model.model.{}.lora_B.weight".format(Q)),
    "expected lora_B of 2 columns": lambda a: a.tensors.update({"base_model.model.{}.lora_B.weight".format(Q): np.ones((12, 3), np.float32)}),
    "expected a tensor of the base of 4 rows of 3 numbers, found none": lambda a: a.tensors.update(
        {"base_model.model.x.lora_A.weight": np.ones((2, 3), np.float32), "base_model.model.x.lora_B.weight": np.ones((4, 2), np.float32)}
    ),
    "adapter: tensor model.y.weight: expected a tensor of the base of its shape": lambda a: a.tensors.update(
        {"base_model.model.model.y.weight": np.ones(2, np.float32)}
    ),
    "expected finite numbers": lambda a: a.tensors["base_model.model.{}.lora_B.weight".format(Q)].fill(np.nan),
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_not_a_plain_lora_is_refused_by_name(converter, adapter, text):
    adapter.add(Q)
    REFUSED[text](adapter)
    adapter.save()
    assert text.removeprefix("config: ") in converter.refusal().message()


# --- complete weights --------------------------------------------------------------------------------------------------------------------


def test_merged_weights_are_read_though_the_config_still_speaks_of_an_adapter(converter, tiny):
    plain = converter.bundle(tiny).keys["vla.checksum"]
    tiny.config["use_peft"] = True
    assert converter.bundle(tiny).keys["vla.checksum"] == plain
    assert any("use_peft is true" in note and "read as merged" in note for note in converter.summary.notes)


def test_an_adapter_among_the_weights_is_merged_where_its_config_is_there(converter, adapter):
    a, b = adapter.add(Q, kinds=("lora_A.default.weight", "lora_B.default.weight"), prefix="")
    wanted = adapter.policy.tensors[Q + ".weight"] + 3 * b @ a
    adapter.policy.tensors.update(adapter.tensors)
    adapter.policy.tensors[Q + ".base_layer.weight"] = adapter.policy.tensors.pop(Q + ".weight")
    adapter.policy.config["use_peft"] = True
    folder = converter.folder
    adapter.policy.save(folder)
    assert "expected merged weights, found an adapter whose alpha nothing states" in converter.refusal().message()
    write_json(folder / CONFIG, adapter.config)
    close(converter.bundle().tensors["expert.blk.0.attn_q.weight"], wanted)


def test_weights_beside_an_adapter_are_not_guessed_about(converter, adapter):
    adapter.add(Q)
    adapter.save()
    shutil.copy(adapter.base / "model.safetensors", adapter.folder / "model.safetensors")
    assert "both model.safetensors and adapter_model.safetensors" in converter.refusal().message()
    assert converter.bundle(base=str(adapter.base)).keys["vla.source.name"] == "policy on base"


def test_a_base_is_for_adapters_alone(converter, tiny, tmp_path):
    tiny.save(tmp_path / "base")
    assert "--base: expected a LoRA adapter" in converter.refusal(tiny, base=str(tmp_path / "base")).message()


@pytest.mark.parametrize("prefix", ["module.", "_orig_mod.", "model.", "_orig_mod.module.", "module.model."])
def test_a_wrappers_prefix_in_front_of_all_names_is_left_out(converter, tiny, prefix):
    plain = converter.bundle(tiny).keys["vla.checksum"]
    tiny.tensors = {prefix + name: value for name, value in tiny.tensors.items()}
    assert converter.bundle(tiny).keys["vla.checksum"] == plain
    assert any("begin with " + prefix in note for note in converter.summary.notes)
