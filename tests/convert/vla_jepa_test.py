# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""VLA-JEPA: names against the reference's and the runtime's, prompt and tokens, images, the gripper's steps, refusals."""

import json
import shutil

import numpy as np
import pytest

from configs import of_config, sizes_of
from goldens import vla_jepa
from goldens.files import write_json
from manifests import check_keys, check_parameters
from vla_cpp.convert.archs import Options
from vla_cpp.convert.archs.vla_jepa import mapping
from vla_cpp.convert.archs.vla_jepa.config import read_sizes
from vla_cpp.convert.checkpoint import open_checkpoint
from vla_cpp.convert.conversion import convert_checkpoint
from vla_cpp.convert.errors import ConvertError

ARCH = "vla_jepa"
VIEWS = {"top": (30, 40), "wrist": (30, 40)}
SIZES = vla_jepa.vision(8, 2, 1, 12, 3, (0, 1)), vla_jepa.text(12, 2, 2, 1, 8, 16, (2, 1, 1))
POLICY = vla_jepa.policy(3, 2, (1, 6), 2, 8, 2, resize_images_to=[20, 20], num_action_tokens_per_timestep=2)
SMALL = vla_jepa.Checkpoint(*SIZES, POLICY, VIEWS, 2, 7, side=24)
PUBLISHED = vla_jepa.published({"image": (256, 256), "wrist_image": (256, 256)})


class Odd(vla_jepa.Checkpoint):
    """Without a tensor, with one too many, and with one of another shape."""

    def shapes(self):
        out = super().shapes()
        del out["model.action_model.future_tokens.weight"]
        return out | {"model.action_model.extra.weight": (2, 2), "model.action_model.action_decoder.layer2.bias": (8,)}


def sizes_at(checkpoint, folder):
    checkpoint.write(1, folder)
    return sizes_of(read_sizes, open_checkpoint(str(folder), {}))


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Sizes at the published configs."""
    folder = tmp_path_factory.mktemp("published")
    PUBLISHED.backbone.write_backbone(folder / "vlm")
    return sizes_of(read_sizes, of_config(PUBLISHED.config, folder=folder))


def recipe_of(keys):
    return json.loads(keys["processor.recipe"])


@pytest.mark.parametrize("case", vla_jepa.CASES.values())
def test_every_config_asks_for_the_tensors_of_the_reference(case, tmp_path):
    sizes = sizes_at(case.checkpoint, tmp_path)
    sizes.lm.n_vocab = case.checkpoint.n_row
    rows = {row.source: row.stored for row in [*mapping.weights(sizes), *mapping.dropped(sizes)]}
    stored = case.checkpoint.shapes()
    assert {name: rows.get(name) for name in stored} == stored
    assert rows.keys() - stored.keys() <= {vla_jepa.TABLE, vla_jepa.LM_HEAD}


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(published):
    check_parameters("vla_jepa", mapping.weights(published))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(published):
    check_keys("vla_jepa", mapping.network_keys(published), chosen=("policy.view_starts",))


def test_the_backbone_is_rounded_as_the_reference_holds_it_and_the_head_is_not(published):
    rows = {row.target: row for row in mapping.weights(published)}
    assert rows["lm.token_embd.weight"].in_bf16 and rows["vision.blk.0.attn_norm.weight"].in_bf16
    assert rows["dit.blk.0.attn_q.weight"].keep_f32 and not rows["dit.blk.0.attn_q.weight"].in_bf16


def test_the_policys_tokens_have_the_ids_behind_the_others(planned):
    keys, made = planned()
    added = [token["content"] for token in json.loads(keys["tokenizer.added"])]
    assert added[-13:] == [*(f"<|action_{i}|>" for i in range(12)), "<|embodied_action|>"]
    assert keys["tokenizer.tokens"][-1] == "<|embodied_action|>" and keys["lm.n_vocab"] == len(keys["tokenizer.tokens"]) == SMALL.n_row
    table = next(row for row in made.weights if row.target == "lm.token_embd.weight")
    assert table.shape == (SMALL.n_row, 12)


def test_a_tokenizer_that_has_the_tokens_keeps_their_ids(planned, folder):
    tokens = json.loads((folder / "vlm/tokenizer.json").read_text())["added_tokens"]
    there = {**tokens[-1], "id": tokens[-1]["id"] + 1, "content": "<|action_1|>"}
    keys, _ = planned("vlm/tokenizer.json", "added_tokens", [*tokens, there], without=["vlm/tokenizer_config.json"])
    ids = {token["content"]: token["id"] for token in json.loads(keys["tokenizer.added"])}
    assert [ids[f"<|action_{i}|>"] - there["id"] for i in (0, 1, 2)] == [1, 0, 2]


def test_the_recipe_is_that_of_the_reference(planned):
    keys, made = planned()
    recipe = recipe_of(keys)
    assert recipe["image"] == [
        {"op": "resize_floats", "width": 20, "height": 20, "filter": "area"},
        {"op": "resize_floats", "width": 24, "height": 24, "filter": "bicubic"},
        {"op": "standardize", "mean": [0.5] * 3, "std": [0.5] * 3, "arithmetic": "float32"},
    ]
    frames = "<|action_0|>" * 2 + "<|action_1|>" * 2 + "<|action_2|>" * 2
    prompt = f"Your task is {{instruction}}. Infer the temporal dynamics from frames {frames} and produce the corresponding policy actions "
    assert [op.get("text") for op in recipe["text"]][-4] == prompt + "<|embodied_action|>" * 2
    assert [op["op"] for op in recipe["text"]] == ["refuse"] * 4 + ["template", "views", "template", "tokenize"]
    assert recipe["text"][-2]["text"] == "<|im_start|>user\n{instruction}" and recipe["text"][-1]["truncate"] == "left"
    assert [op["op"] for op in recipe["state"]] == ["normalize"] and keys["observation.min_views"] == 2
    assert keys["policy.n_embodied"] == keys["policy.n_future"] == 2
    assert set(made.statistics) == {"stats.action.max", "stats.action.min", "stats.observation.state.mean", "stats.observation.state.std"}


def test_a_cameras_own_size_decides_where_the_policy_states_none(planned):
    keys, _ = planned(path="resize_images_to", value=None)
    assert recipe_of(keys)["image"][0] == {"op": "resize_floats", "width": 40, "height": 32, "filter": "bicubic", "from_width": 40, "from_height": 30}
    assert (keys["vision.image_width"], keys["vision.image_height"]) == (40, 32)


def test_the_gripper_is_at_its_threshold_what_the_reference_makes_of_it(planned):
    """Saved without its numbers: column 6, which snaps at 0.5 and is turned above it."""
    ops = recipe_of(planned()[0])["action"]
    assert [op["op"] for op in ops] == ["clip", "threshold", "unnormalize", "threshold"]
    below = np.nextafter(np.float32(0.5), np.float32(0))
    assert ops[1] == {"op": "threshold", "columns": [6], "above": float(below), "then": 1.0, "else": 0.0}
    assert ops[3] == {"op": "threshold", "columns": [6], "above": 0.5, "then": -1.0, "else": 1.0}


def test_a_gripper_that_the_chunk_does_not_have_changes_nothing(planned):
    ops = recipe_of(planned("policy_postprocessor.json", "steps/1/config", {"gripper_dim": 7, "threshold": 0.25})[0])["action"]
    assert [op["op"] for op in ops] == ["clip", "unnormalize", "threshold"]


def test_missing_extra_and_misshapen_tensors_are_refused_together(tmp_path):
    Odd(*SIZES, POLICY, VIEWS, 2, 7, side=24).write(1, tmp_path / "odd")
    with pytest.raises(ConvertError) as caught:
        convert_checkpoint(str(tmp_path / "odd"), str(tmp_path / "odd.gguf"), Options())
    message = str(caught.value)
    assert "model.action_model.future_tokens.weight: expected (2, 6), found none" in message
    assert "model.action_model.extra.weight: expected no such tensor" in message
    assert "model.action_model.action_decoder.layer2.bias: expected (7,), found (8,)" in message
    assert not (tmp_path / "odd.gguf").exists()


def test_tensors_of_a_world_model_that_the_config_denies_are_refused(tmp_path, folder):
    shutil.copytree(folder, tmp_path / "policy")
    write_json(tmp_path / "policy/config.json", SMALL.config | {"enable_world_model": False})
    with pytest.raises(ConvertError, match="config.json has no world model"):
        convert_checkpoint(str(tmp_path / "policy"), str(tmp_path / "odd.gguf"), Options())


def test_without_pipelines_nothing_is_assumed(refusal):
    message = refusal(without=["policy_preprocessor.json", "policy_postprocessor.json"])
    assert "expected the pipelines that LeRobot saves with this policy" in message


@pytest.mark.parametrize(
    ("file", "path", "value", "message"),
    [
        ("config.json", "action_model_type", "DiT-XL", "action_model_type: expected DiT-B or DiT-L or DiT-test"),
        ("config.json", "action_num_heads", -1, "action_num_heads: expected a whole number from 1"),
        ("config.json", "action_attention_head_dim", 5, "action_num_heads: expected heads of an even width together"),
        ("config.json", "chunk_size", 2, "n_action_steps: expected at most chunk_size 2"),
        ("config.json", "torch_dtype", "float16", "torch_dtype: expected 'bfloat16' or 'float32'"),
        ("config.json", "gate", 1, "gate: expected a key of VLAJEPAConfig"),
        ("config.json", "empty_cameras", 1, "empty_cameras: expected a key of VLAJEPAConfig"),
        ("config.json", "n_obs_steps", 2, "n_obs_steps: expected 1"),
        ("config.json", "resize_images_to", [224], "resize_images_to: expected [height, width] or null"),
        ("config.json", "resize_images_to", [2, 600], "resize_images_to: expected images of at most 200 times the other side"),
        ("config.json", "num_video_frames", 3, "num_video_frames: expected at least 4, for two moments"),
        ("config.json", "prompt_template", "Do {e_actions} {instruction}", "prompt_template: expected text with {instruction} and behind it"),
        ("config.json", "prompt_template", "Do {instruction!r} {e_actions}", "prompt_template: expected text with {instruction} and behind it"),
        ("config.json", "prompt_template", "Do {instruction} {{}} {e_actions}", "prompt_template: expected text with {instruction} and behind it"),
        ("config.json", "prompt_template", "{instruction} <|image_pad|> {e_actions}", "prompt_template: expected no token of images"),
        ("config.json", "prompt_template", "{instruction} <|embodied_action|> {e_actions}", "prompt_template: expected no token of images"),
        ("config.json", "prompt_template", "x" * 4096 + "{instruction}{e_actions}", "prompt_template: expected a prompt of at most 4096 bytes"),
        ("config.json", "special_action_token", "<action>", "special_action_token: expected text with {} once"),
        ("config.json", "embodied_action_token", "<{}>", "embodied_action_token: expected the text of a token"),
        ("config.json", "embodied_action_token", "Q", "model.vocab: expected no token Q of the model's"),
        ("config.json", "input_features/observation.state", {"type": "STATE", "shape": [2, 2]}, "observation.state: expected type STATE"),
        ("config.json", "input_features", {"observation.images.top": {"type": "VISUAL", "shape": [3, 4, 4]}}, "state_dim: expected 0, since"),
        ("config.json", "input_features", {}, "input_features: expected a VISUAL feature or several"),
        ("vlm/config.json", "model_type", "qwen2_5_vl", "model_type: expected 'qwen3_vl'"),
        ("vlm/config.json", "tie_word_embeddings", False, "backbone config.json: tie_word_embeddings: expected true, since the checkpoint has no"),
        ("vlm/config.json", "text_config/hidden_act", "gelu", "hidden_act: expected 'silu'"),
        ("vlm/preprocessor_config.json", "image_mean", [0.48, 0.46, 0.41], "image_mean: expected [0.5, 0.5, 0.5]"),
        ("policy_postprocessor.json", "steps/1/config", {"gripper_dim": -1}, "gripper_dim: expected a column from 0 on"),
        ("policy_postprocessor.json", "steps/1/config", {"threshold": "half"}, "threshold: expected a number"),
        ("policy_postprocessor.json", "steps/0/config", {"low": -2}, "vla_jepa_clip_actions: low: expected no such field"),
        ("policy_postprocessor.json", "steps/0/registry_name", "vla_jepa_wink", "expected one of unnormalizer_processor"),
    ],
)
def test_what_the_runtime_does_not_do_is_refused_by_name(refusal, file, path, value, message):
    assert message in refusal(file, path, value)


def test_another_backbone_is_refused_with_the_name_of_the_policys(refusal):
    message = refusal("vlm/config.json", "model_type", "qwen2_5_vl")
    assert "Qwen/Qwen3-VL-2B-Instruct" in message and "Cosmos" not in message


def test_cameras_of_several_sizes_need_a_size_of_the_policys(tmp_path):
    mixed = vla_jepa.Checkpoint(*SIZES, POLICY | {"resize_images_to": None}, {"top": (30, 40), "wrist": (20, 20)}, 2, 7, side=24)
    with pytest.raises(ConvertError, match="input_features: expected cameras of one size, since resize_images_to is null"):
        sizes_at(mixed, tmp_path)


def test_a_world_model_without_its_encoder_leaves_the_prompt_open(tmp_path):
    class Half(vla_jepa.Checkpoint):
        def world_model(self):
            return {}

    with pytest.raises(ConvertError, match="patch_embeddings.proj.weight: expected \\(width, 3, frames, 16, 16\\)"):
        sizes_at(Half(*SIZES, POLICY, VIEWS, 2, 7, side=24), tmp_path)
