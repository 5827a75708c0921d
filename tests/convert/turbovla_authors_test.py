# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""TurboVLA of its authors: names against the reference's and the runtime's, rows of padding, sentences, statistics, refusals."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from goldens import turbovla_authors as authors
from manifests import check_keys, check_parameters
from saved import Saved
from vla_cpp.convert.archs import Options
from vla_cpp.convert.archs import authors as layouts
from vla_cpp.convert.archs.turbovla_authors import mapping
from vla_cpp.convert.archs.turbovla_authors.config import read_sizes
from vla_cpp.convert.checkpoint import open_checkpoint
from vla_cpp.convert.errors import Code, Problems

SEED = 3
TEXTS = {"padding_length": 12, "padding_length_by_instruction": {"open it": 6, "close it": 6, "push": 9, "pull": 12}}
PARTS = authors.parts(8, (8, 4, 1, 12, 20), (3, 2, 1, 16, 24), TEXTS)
SMALL = authors.Checkpoint(authors.vision(24, 1, 3, 20, 4, 2), authors.text(20, 1, 2, 28, 16), PARTS)


def changed(part, **values):
    """SMALL with other values in a part of model_config."""
    return replace(SMALL, parts={**PARTS, part: {**PARTS[part], **values}})


def saved(checkpoint=SMALL, **changes):
    return Saved(checkpoint, SEED, **changes)


def sizes_at(checkpoint, folder, **options):
    checkpoint.write(SEED, folder)
    problems = Problems("test")
    opened = open_checkpoint(str(folder), layouts())
    sizes = read_sizes(opened, Options(**{"vision_tokens": "normed", **options}), problems)
    problems.raise_any()
    return sizes, opened


@pytest.mark.parametrize("name", authors.CASES)
def test_every_config_asks_for_the_tensors_of_the_reference(name, tmp_path):
    case = authors.CASES[name]
    options = {key: value for key, value in case.options.items() if key != "stats"}
    sizes, _ = sizes_at(case.checkpoint, tmp_path, **options)
    rows = [*mapping.weights(sizes), *mapping.dropped(sizes)]
    assert {row.source: row.stored for row in rows} == case.checkpoint.shapes()


def test_the_released_files_have_672_tensors():
    """As a log of a strict load of the release for LIBERO-Object says."""
    assert len(authors.published().shapes()) == 672


def published_sizes(folder):
    """Of configs alone: 0.2 B weights are not written."""
    small, _ = sizes_at(SMALL, folder)
    vision = replace(small.vision, d_model=768, n_layer=12, n_head=12, d_ff=3072, image_size=256, patch_size=16, norm_eps=1e-5)
    lm = replace(small.lm, d_model=768, n_layer=12, n_head=12, d_ff=3072, n_vocab=30522, n_position=512)
    wide = dict(d_model=256, n_head=8, d_ff=2048, n_fusion=6, n_fusion_head=4, d_inner=1024, n_decoder=3, d_hidden=512, d_state_hidden=256)
    return replace(small, vision=vision, lm=lm, rope_base=100.0, n_register=4, horizon=12, n_row=21, max_tokens=21, **wide)


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(tmp_path):
    check_parameters("turbovla_authors", mapping.weights(published_sizes(tmp_path)))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(tmp_path):
    sentences = ("policy.sentence_ends", "policy.text_end")
    check_keys("turbovla_authors", mapping.network_keys(published_sizes(tmp_path)), sentences)


def test_the_recipe_is_that_of_the_reference(converter):
    keys = converter.bundle(saved(), vision_tokens="normed").keys
    recipe = json.loads(keys["processor.recipe"])
    size = {"width": 8, "height": 8}
    assert recipe["image"][:2] == [{"op": "camera_size", **size}, {"op": "size", **size}]
    assert recipe["image"][2]["mean"] == [0.485, 0.456, 0.406] and recipe["image"][2]["std"] == [0.229, 0.224, 0.225]
    assert recipe["text"] == [
        {"op": "limit", "max_tokens": 6, "instructions": ["open it", "close it"]},
        {"op": "limit", "max_tokens": 9, "instructions": ["push"]},
        {"op": "tokenize", "max_tokens": 12, "truncate": "right", "pad_id": 0},
    ]
    assert recipe["state"] == [{"op": "normalize", "kind": "mean_std", "stats": "stats.observation.state", "eps": 1e-6}]
    assert recipe["action"][0]["columns"] == [0, 1, 2, 3, 4, 5] and recipe["action"][1]["columns"] == [6]
    assert list(keys["observation.views"]) == ["observation.images.image", "observation.images.image2"] and keys["observation.min_views"] == 2


def test_ends_of_sentences_are_the_tokenizers(converter):
    keys = converter.bundle(saved(), vision_tokens="normed").keys
    assert [keys["tokenizer.tokens"][i] for i in keys["policy.sentence_ends"]] == ["[CLS]", "[SEP]", ".", "?"]
    assert keys["tokenizer.tokens"][keys["policy.text_end"]] == "[SEP]"


def test_an_end_that_the_tokenizer_does_not_have_is_its_unknown_token(converter):
    def without_question_mark(spec):
        del spec["model"]["vocab"]["?"]

    keys = converter.bundle(saved(tokenizer=without_question_mark), vision_tokens="normed").keys
    assert keys["policy.sentence_ends"][3] == keys["tokenizer.unknown_id"]


def test_statistics_are_those_of_proprio_and_the_arm(converter):
    stated = SMALL.statistics(SEED)["libero_all4_no_noops"]
    bundle = converter.bundle(saved(), vision_tokens="normed")
    for name, values in {"observation.state.mean": stated["proprio"]["mean"], "action.max": stated["action"]["max"]}.items():
        assert np.array_equal(bundle.tensors["stats." + name], np.float32(values))


def test_without_proprio_the_state_is_read(converter):
    def without_proprio(content):
        del content["libero_all4_no_noops"]["proprio"]

    assert converter.bundle(saved(libero_all4_stats=without_proprio), vision_tokens="normed").tensors["stats.observation.state.mean"].tolist() == [0] * 8


def test_one_of_several_data_sets_is_chosen(converter):
    several = replace(SMALL, other_stats=("goal",))
    assert "expected one of libero_all4_no_noops, goal, found several" in str(converter.refusal(saved(several), vision_tokens="normed"))
    stated = several.statistics(SEED)["goal"]["action"]["min"]
    bundle = converter.bundle(saved(several), vision_tokens="normed", stats="goal")
    assert np.array_equal(bundle.tensors["stats.action.min"], np.float32(stated))


def test_the_last_norm_of_the_tower_is_left_out_where_the_policy_does_not_read_it(converter):
    assert "vision.post_norm.weight" in converter.bundle(saved(), vision_tokens="normed").tensors
    assert "vision.post_norm.weight" not in converter.bundle(saved(), vision_tokens="last_block").tensors


@pytest.mark.parametrize("member", ["model_state_dict", "model", "state_dict"])
def test_weights_are_found_under_every_name_that_the_reference_knows(converter, member):
    assert converter.bundle(saved(replace(SMALL, member=member)), vision_tokens="normed").keys["vla.arch"] == "turbovla_authors"


def test_transformers_5_calls_the_layers_of_the_tower_otherwise(converter):
    bundle = converter.bundle(saved(replace(SMALL, layers="model.layer")), vision_tokens="last_block")
    assert "vision.blk.0.attn_q.weight" in bundle.tensors


def test_which_tokens_of_the_tower_is_asked_for(converter):
    error = converter.refusal(saved())
    assert "--vision-tokens: expected normed or last_block, found none" in str(error) and error.code == Code.USAGE


@pytest.mark.parametrize(
    ("part", "values", "message"),
    [
        ("interaction", {"residual_style": "post"}, "residual_style: expected normalized or pre_norm"),
        ("interaction", {"padding_strategy": "none"}, "padding_strategy: expected key_padding_mask or zero_fill"),
        ("interaction", {"enhancer_inner_dim": 21}, "enhancer_inner_dim: expected a multiple of 2 heads"),
        ("interaction", {"nheads": 3}, "hidden_dim: expected a multiple of 3 heads"),
        ("interaction", {"cross_gate": True}, "cross_gate: expected a key that this converter knows"),
        ("vision", {"position_embedding": "sine"}, "position_embedding: expected view or learned_patch"),
        ("vision", {"image_size": 10}, "image_size: expected a multiple of patch_size 4"),
        ("text", {"padding_length": None}, "padding_length: expected a number of rows"),
        ("text", {"padding_length": 5}, "expected instructions with 2 to padding_length 5 tokens"),
        ("text", {"padding_length": 17}, "padding_length: expected at most the 16 positions of BERT"),
        ("text", {"max_length": 11}, "padding_length: expected at most max_length 11"),
        ("text", {"sub_sentence_present": 1}, "sub_sentence_present: expected True or False"),
        ("action", {"state_dim": 7}, "state_dim: expected 8, as of LIBERO's robot"),
        ("action", {"action_dim": 14}, "action_dim: expected 7, as of LIBERO's robot"),
        ("action", {"horizon": 0}, "horizon: expected a whole number from 1"),
    ],
)
def test_what_the_runtime_does_not_do_is_refused_by_name(converter, part, values, message):
    assert message in str(converter.refusal(saved(changed(part, **values)), vision_tokens="normed"))


def test_fields_that_no_number_depends_on_are_passed_over(converter):
    with_them = changed("interaction", fusion_droppath=0.5, attention_backend="sdpa", compute_precision="bf16_autocast")
    assert converter.bundle(saved(with_them), vision_tokens="normed").keys["fusion.n_head"] == 2


def drop(name):
    def change(content):
        del content[name]

    return change


@pytest.mark.parametrize(
    ("saved", "message"),
    [
        (saved(without=["libero_all4_stats.json"]), "one file *stats*.json, the statistics, found none"),
        (saved(without=["language_encoder"]), "--backbone DIR, or language_encoder/ inside the checkpoint"),
        (saved(without=["vision_encoder"]), "a DINOv3 of facebook/dinov3-vits16-pretrain-lvd1689m"),
        (saved(preprocessor_config=lambda c: c.update(rescale_factor=1.0)), "rescale_factor: expected 1 / 255, found 1.0"),
        (saved(preprocessor_config=lambda c: c.update(image_std=[0.0, 1.0, 1.0])), "image_std: expected three numbers"),
        (saved(libero_all4_stats=lambda c: c["libero_all4_no_noops"]["action"]["max"].pop()), "action.max: expected 7 finite numbers"),
        (saved(libero_all4_stats=lambda c: drop("std")(c["libero_all4_no_noops"]["proprio"])), "proprio.std: expected 8 finite numbers"),
        (saved(tokenizer_config=lambda c: c.update(truncation_side="left")), "truncation_side: expected 'right'"),
    ],
)
def test_files_that_are_missing_or_say_something_else_are_refused(converter, saved, message):
    assert message in str(converter.refusal(saved, vision_tokens="normed"))


class Reshaped:
    """SMALL whose tensors are changed before they are written."""

    def __init__(self, change):
        self.change = change

    def save(self, folder):
        shapes = SMALL.shapes()
        self.change(shapes)

        class Other(authors.Checkpoint):
            def shapes(self):
                return shapes

        shutil.rmtree(folder, ignore_errors=True)
        Other(**{name: getattr(SMALL, name) for name in SMALL.__dataclass_fields__}).write(SEED, folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("vision_projection.skip.weight"), "tensor vision_projection.skip.weight"),
        (lambda s: s.update({"view_embedding": (1, 3, 8)}), "tensor view_embedding"),
        (lambda s: s.update({"patch_position_scale": (1, 2, 1, 1)}), "position_embedding is view"),
        (lambda s: s.update({"action_head.extra.weight": (2, 2)}), "tensor action_head.extra.weight"),
    ],
)
def test_missing_misshapen_and_foreign_tensors_are_refused(converter, change, message):
    assert message in str(converter.refusal(Reshaped(change), vision_tokens="normed"))


def test_two_files_of_weights_are_refused(converter):
    converter.save(saved())
    shutil.copy(converter.folder / "policy.pth", converter.folder / "other.pth")
    assert "one file *.pth, the weights, found other.pth, policy.pth" in str(converter.refusal(vision_tokens="normed"))
