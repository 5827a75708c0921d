# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""VLA-Adapter: names against the reference's and the runtime's, both versions of the head, robots, prompt, refusals."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from goldens import vla_adapter
from goldens.draw import bfloat16
from goldens.openvla import MEANS, STDS, Tower
from goldens.parameters import decoder
from goldens.vla_adapter import STATISTICS
from manifests import check_keys, check_parameters
from saved import Saved
from tokenizer_from_keys import ids_of, tokenizer_of
from vla_cpp.convert.archs.vla_adapter import mapping
from vla_cpp.convert.errors import Code, Problems

SEED = 6
SMALL = vla_adapter.Checkpoint(Tower(16, 2, 20), Tower(32, 3, 28), decoder(32, 2, 2, 1, 24), is_pro=True)
ORIGINAL = replace(SMALL, is_pro=False)
PIXELS = [{"mean": tuple(mean), "std": tuple(std)} for mean, std in zip(MEANS, STDS)]


def saved(checkpoint=SMALL, **changes):
    return Saved(checkpoint, SEED, **changes)


def all_shapes(checkpoint):
    """Names as the converter has them."""
    shapes = checkpoint.shapes()
    return shapes["model"] | {f"{part}.{name}": shape for part in ("action_head", "proprio_projector") for name, shape in shapes[part].items()}


def sizes_of(checkpoint, **config):
    problems, shapes = Problems("test"), all_shapes(checkpoint)
    tensors = {name: SimpleNamespace(shape=shape, path="model.safetensors") for name, shape in shapes.items()}
    s = mapping.read_sizes(SimpleNamespace(config={**checkpoint.config(), **config}, tensors=tensors), problems)
    problems.raise_any()
    s.horizon = 8
    return s


@pytest.fixture(scope="module")
def published():
    """With the vocabulary of Qwen2.5."""
    checkpoint = vla_adapter.published()
    return sizes_of(checkpoint, text_config={**checkpoint.config()["text_config"], "vocab_size": 151936})


@pytest.mark.parametrize("checkpoint", [SMALL, ORIGINAL], ids=["pro", "original"])
def test_every_tensor_of_the_reference_is_read_or_dropped(checkpoint):
    s, shapes = sizes_of(checkpoint), all_shapes(checkpoint)
    read = {row.source: row.stored for row in mapping.weights(s, PIXELS)}
    unread = {row.source: row.stored for row in mapping.dropped(s)}
    assert read | unread == shapes and not read.keys() & unread.keys()


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(published):
    check_parameters("vla_adapter", mapping.weights(published, PIXELS))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(published):
    check_keys("vla_adapter", mapping.network_keys(published))
    count = sum(int(np.prod(row.stored)) for row in {row.source: row for row in mapping.weights(published, PIXELS)}.values())
    assert count == pytest.approx(1.38e9, rel=1e-2)


def test_the_versions_of_the_head_have_their_own_keys_and_values(converter):
    pro, original = converter.bundle(saved(), platform="libero"), converter.bundle(saved(ORIGINAL), platform="libero")
    assert (pro.keys["head.version"], original.keys["head.version"]) == ("pro", "original")
    parts = {name[len("head.blk.1.") :] for name in pro.tensors if name.startswith("head.blk.1.") and "attn_" in name}
    assert {"actions.attn_k.weight", "task.attn_v.bias", "attn_q.weight"} < parts
    parts = {name for name in original.tensors if name.startswith("head.blk.1.") and "attn_" in name}
    assert len(parts) == 8 and not any("film" in name for name in pro.tensors)
    gate = SMALL.value("action_head", "model.mlp_resnet_blocks.1.gating_factor", (1,), SEED)
    assert pro.tensors["head.blk.1.gate.weight"].tolist() == gate.tolist()


def test_the_head_and_the_projector_are_rounded_as_the_reference_loads_them(converter):
    w = SMALL.value("proprio_projector", "fc1.weight", (32, 8), SEED)
    assert (w != bfloat16(w)).any()
    assert (converter.bundle(saved(), dtype="f32", platform="libero").tensors["state_in.weight"] == bfloat16(w)).all()


def test_names_of_files_prefixes_shards_and_a_tied_head_make_one_bundle(converter):
    def content(checkpoint):
        bundle = converter.bundle(saved(checkpoint), platform="libero")
        return {name: tensor.tobytes() for name, tensor in bundle.tensors.items()}

    first = content(SMALL)
    for other in (dict(step=""), dict(step="latest_"), dict(prefixes=("", "module.")), dict(n_shard=3), dict(has_language_head=False)):
        assert content(replace(SMALL, **other)) == first, other


def test_of_tied_rows_of_tokens_the_last_ones_count(converter):
    tied = {"config": lambda c: c["text_config"].update(tie_word_embeddings=True)}
    for changes, name in (({}, "language_model.model.embed_tokens.weight"), (tied, "language_model.lm_head.weight")):
        rows = converter.bundle(saved(**changes), dtype="f32", platform="libero").tensors["lm.token_embd.weight"]
        assert (rows == SMALL.value("model", name, rows.shape, SEED)).all()


def test_a_robot_is_a_platform_of_theirs(converter):
    error = converter.refusal(saved())
    assert "--platform: expected libero or calvin, found none" in str(error) and error.code == Code.USAGE
    libero, calvin = (converter.bundle(saved(), platform=name).keys for name in ("libero", "calvin"))
    assert libero["observation.views"] == ["observation.images.image", "observation.images.image2"]
    assert libero["observation.view_aliases"] == ["observation.images.full_image", "observation.images.wrist_image"]
    assert calvin["observation.views"] == ["observation.images.rgb_static", "observation.images.rgb_gripper"]
    assert libero["policy.horizon"] == calvin["policy.horizon"] == 8 and libero["observation.min_views"] == 2
    recipes = [json.loads(keys["processor.recipe"]) for keys in (libero, calvin)]
    assert recipes[0]["image"] == recipes[1]["image"] and recipes[0]["image"][0] == {"op": "jpeg", "quality": 95}
    assert [op["op"] for op in recipes[0]["action"]] == ["unnormalize", "affine", "sign"]
    assert [op["op"] for op in recipes[1]["action"]] == ["unnormalize", "threshold"]
    assert recipes[0]["action"][0]["columns"] == [0, 1, 2, 3, 4, 5]
    one = converter.bundle(views=["a"], platform="libero").keys
    assert one["observation.min_views"] == 1 and one["observation.view_aliases"] == [""]


def test_statistics_are_chosen_by_their_data_set(converter):
    several = replace(SMALL, other_stats=("libero_goal_no_noops",))
    assert "expected one of libero_spatial_no_noops, libero_goal_no_noops, found 2" in str(converter.refusal(saved(several), platform="libero"))
    bundle = converter.bundle(stats="libero_goal_no_noops", platform="libero")
    expected = several.statistics(SEED + 1)
    for feature, key in (("observation.state", "proprio"), ("action", "action")):
        assert bundle.dtypes[f"stats.{feature}.q99"] == "f64"
        assert bundle.tensors[f"stats.{feature}.q99"].tolist() == expected[key]["q99"]


def test_the_prompt_is_a_question_to_qwen(converter):
    bundle = converter.bundle(saved(), platform="libero")
    text = json.loads(bundle.keys["processor.recipe"])["text"]
    assert [op["op"] for op in text] == ["lower", "template", "tokenize"]
    tokenizer = tokenizer_of(bundle.keys)
    for instruction in ("pick up the cube", "öffne das 2. fach, 漢字", "<|im_end|> a <tool_call>b", ""):
        prompt = text[1]["text"].format(instruction=instruction)
        assert prompt == ("<|im_start|>system\nYou are Qwen, created by Alibaba Cloud. You are a helpful assistant.<|im_end|>\n"
                          f"<|im_start|>user\nWhat action should the robot take to {instruction}?<|im_end|>\n<|im_start|>assistant\n")
        assert ids_of(tokenizer, bundle.keys, prompt) == tokenizer.encode(prompt).ids


def test_the_towers_read_pixels_as_the_published_files_say(converter):
    """Of means in full and rounded ones, the latter."""
    bundle = converter.bundle(saved(), platform="libero")
    name = "vision_backbone.featurizer.patch_embed.proj."
    weight, bias = (SMALL.value("model", name + part, SMALL.shapes()["model"][name + part], SEED) for part in ("weight", "bias"))
    expected = bias - (weight * np.reshape(np.divide(MEANS[0], STDS[0]), (3, 1, 1))).sum((1, 2, 3))
    assert bundle.tensors["dino.patch_embed.bias"] == pytest.approx(expected, abs=2e-6)


def text(**values):
    return {"config": lambda c: c["text_config"].update(values)}


def top(**values):
    return {"config": lambda c: c.update(values)}


def statistics(*path, value):
    def change(content):
        place = content[STATISTICS["libero"]]
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return {"dataset_statistics": change}


REFUSED = [
    (top(llm_backbone_id="qwen25-0_5b-pure", vision_backbone_id="x", timm_model_ids=["vit_large_patch14_clip_336.openai"] * 2), "timm_model_ids", Code.UNSUPPORTED),
    (top(use_fused_vision_backbone=False), "use_fused_vision_backbone", Code.UNSUPPORTED),
    (top(image_sizes=[28, 42]), "image_sizes", Code.UNSUPPORTED),
    (top(something="new"), "config.json: something", Code.UNSUPPORTED),
    (text(model_type="llama"), "text_config: model_type", Code.UNSUPPORTED),
    (text(hidden_act="gelu"), "hidden_act", Code.UNSUPPORTED),
    (text(use_sliding_window=True), "use_sliding_window", Code.UNSUPPORTED),
    (text(rope_scaling={"type": "linear", "factor": 2.0}), "rope_scaling", Code.UNSUPPORTED),
    (text(head_dim=4), "head_dim", Code.UNSUPPORTED),
    (text(num_hidden_layers=3), "num_hidden_layers: expected 2, the blocks of the action head", Code.UNSUPPORTED),
    (text(something="new"), "text_config: something", Code.UNSUPPORTED),
    (statistics("action", "q99", value=[1.0] * 6), "action.q99", Code.BAD_BUNDLE),
    (statistics("proprio", "q01", value=None), "proprio.q01", Code.BAD_BUNDLE),
    (statistics("action", "mask", value=[True]), "action.mask", Code.BAD_BUNDLE),
    ({"preprocessor_config": lambda c: c.update(image_resize_strategy="letterbox")}, "image_resize_strategy", Code.UNSUPPORTED),
    ({"preprocessor_config": lambda c: c["tvf_normalize_params"][0].pop("std")}, "tvf_normalize_params", Code.UNSUPPORTED),
    ({"tokenizer": lambda c: c["added_tokens"][1].update(lstrip=True),
      "tokenizer_config": lambda c: c["added_tokens_decoder"]["373"].update(lstrip=True)}, "added token <|im_start|>", Code.BAD_BUNDLE),
]


@pytest.mark.parametrize("changes, part, code", REFUSED, ids=[str(i) + " " + part for i, (_, part, _) in enumerate(REFUSED)])
def test_what_is_not_understood_is_refused_by_name(converter, changes, part, code):
    error = converter.refusal(saved(**changes), platform="libero")
    assert part in str(error) and code in {problem.code for problem in error.problems}


def test_a_head_of_another_robot_or_width_is_refused(converter):
    assert "8 numbers of state and 7 of an action" in str(converter.refusal(saved(replace(SMALL, d_state=7)), platform="calvin"))
    odd = replace(SMALL, text=decoder(24, 2, 2, 1, 24))
    assert "hidden_size: expected a multiple of 16" in str(converter.refusal(saved(odd), platform="libero"))
    assert converter.bundle(saved(replace(odd, is_pro=False)), platform="libero").keys["head.version"] == "original"


def test_a_missing_file_and_one_of_another_step_are_refused_by_name(converter):
    converter.save(saved())
    head = converter.folder / "action_head--150000_checkpoint.pt"
    proprio = converter.folder / "proprio_projector--150000_checkpoint.pt"
    head.rename(converter.folder / "head.pt")
    assert "action_head--STEP_checkpoint.pt: expected one such file, found none" in str(converter.refusal(platform="libero"))
    (converter.folder / "head.pt").rename(head)
    proprio.rename(converter.folder / "proprio_projector--5000_checkpoint.pt")
    assert "the step of action_head--150000_checkpoint.pt" in str(converter.refusal(platform="libero"))


def test_towers_with_film_are_refused(converter):
    converter.save(saved())
    (converter.folder / "vision_backbone--150000_checkpoint.pt").write_bytes(b"")
    error = converter.refusal(platform="libero")
    assert "vision_backbone--150000_checkpoint.pt" in str(error) and "use_film" in str(error) and error.code == Code.UNSUPPORTED
