# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BitVLA: codes, scales, statistics and prompt of a small random fine-tune, and what is refused of one."""

import json
import shutil

import numpy as np
import pytest

from goldens.bitvla import MICRO, STATISTICS, TWO_LAYERS
from goldens.draw import bfloat16
from saved import Saved
from vla_cpp.convert.cli import main
from vla_cpp.convert.errors import Code

SEED = 5
HEAD, PROPRIO = "action_head--10000_checkpoint.pt", "proprio_projector--10000_checkpoint.pt"


def saved(checkpoint=MICRO, **changes):
    return Saved(checkpoint, SEED, **changes)


def value(name, file="model", checkpoint=MICRO):
    return checkpoint.value(file, name, checkpoint.shapes()[file][name], SEED)


def numbers(codes):
    """-1, 0 and 1 of two bits each, the first in the lowest."""
    bits = codes.view(np.uint8)
    return np.stack([bits >> shift & 3 for shift in (0, 2, 4, 6)], -1).reshape(len(bits), -1).astype(int) - 1


def test_codes_and_scales_are_those_of_the_reference(converter):
    bundle = converter.bundle(saved(TWO_LAYERS))
    names = {
        "vision.blk.1.ffn_down": "vision_tower.vision_model.encoder.layers.1.mlp.fc2.weight",
        "vision.blk.0.attn_out": "vision_tower.vision_model.encoder.layers.0.self_attn.out_proj.weight",
        "lm.blk.0.attn_v": "language_model.model.layers.0.self_attn.v_proj.weight",
        "lm.blk.1.ffn_gate": "language_model.model.layers.1.mlp.gate_proj.weight",
    }
    for ours, theirs in names.items():
        w = value(theirs, checkpoint=TWO_LAYERS)
        s = np.float32(1) / np.float32(np.abs(w).astype(np.float64).mean())
        expected = np.clip(np.rint(w * s), -1, 1)
        assert bundle.dtypes[ours + ".weight"] == "i8"
        assert (numbers(bundle.tensors[ours + ".weight"]) == expected).all(), ours
        assert bundle.tensors[ours + ".scale"].tolist() == [bfloat16(np.float32([1]) / s)[0]], ours
    half = numbers(bundle.tensors["lm.blk.0.attn_v.weight"])
    assert (np.mod(np.arange(half.size).reshape(half.shape), 4) != 0)[half != 0].all()  # |W| s of exactly a half is 0


def test_a_number_near_where_its_code_changes_is_told(converter, capsys):
    converter.save(saved())
    assert main([str(converter.folder), "-o", converter.out]) == 0
    assert "WARNING" in capsys.readouterr().out  # layer 0 has numbers that round from exactly a half


def test_numbers_that_the_reference_rounds_at_load_are_rounded(converter):
    w = value("fc1.weight", "proprio_projector")
    assert (w != bfloat16(w)).any()
    for dtype in ("f32", "bf16"):
        bundle = converter.bundle(saved(), dtype=dtype)
        stored = bundle.tensors["state_in.weight"]
        stored = stored if dtype == "f32" else (stored.astype(np.uint32) << 16).view(np.float32)
        assert (stored == bfloat16(w)).all()
        assert (bundle.tensors["state_in.bias"] == bfloat16(value("fc1.bias", "proprio_projector"))).all()
    assert converter.bundle(saved()).keys["vla.dtype"] == "bf16"


def test_statistics_stay_doubles_and_the_gripper_is_not_stretched(converter):
    bundle = converter.bundle(saved())
    expected = MICRO.statistics(SEED)
    for feature, key in (("observation.state", "proprio"), ("action", "action")):
        for quantile in ("q01", "q99"):
            name = "stats.{}.{}".format(feature, quantile)
            assert bundle.dtypes[name] == "f64"
            assert bundle.tensors[name].tolist() == expected[key][quantile]
    recipe = json.loads(bundle.keys["processor.recipe"])
    assert recipe["image"][0] == {"op": "jpeg", "quality": 95}
    plain = json.loads(converter.bundle(plain_images=True).keys["processor.recipe"])
    assert plain["image"] == recipe["image"][1:]
    assert recipe["action"][0]["columns"] == [0, 1, 2, 3, 4, 5]
    assert [op["op"] for op in recipe["action"]] == ["unnormalize", "affine", "sign"]


def test_views_stand_behind_the_system_sentence_and_the_users_name(converter):
    keys = converter.bundle(saved()).keys
    starts = keys["policy.view_starts"]
    assert starts[1] - starts[0] == 4 and keys["policy.max_views"] == 2
    assert keys["policy.stop_token"] == 377 and keys["tokenizer.prefix_ids"] == [376]
    assert keys["observation.views"] == ["observation.images.image", "observation.images.image2"]
    assert converter.bundle(saved(), views=["a", "b", "c"]).keys["policy.view_starts"] == [starts[0] + 4 * i for i in range(3)]


def test_shards_prefixes_and_spellings_make_one_bundle(converter, tmp_path):
    def content(bundle):
        return {name: tensor.tobytes() for name, tensor in bundle.tensors.items()}

    first = converter.bundle(saved())
    assert content(converter.bundle(saved(config=lambda c: c.update(model_type="openvla")))) == content(first)
    assert content(converter.bundle(saved(config=lambda c: c.update(vision_feature_layer=1)))) == content(first)
    whole = saved(type(MICRO)(MICRO.vision, MICRO.text, n_shard=1))
    assert content(converter.bundle(whole)) == content(first)


def test_layers_behind_the_one_that_is_read_are_dropped(converter):
    bundle = converter.bundle(saved(TWO_LAYERS, config=lambda c: c.update(vision_feature_layer=-2)))
    assert bundle.keys["vision.n_layer"] == 1
    assert not any(name.startswith("vision.blk.1") for name in bundle.tensors)


def bits(**values):
    def change(config):
        config["vision_config"].update(values)
        for key in [key for key, found in values.items() if found is None]:
            del config["vision_config"][key]

    return {"config": change}


def statistics_without(*path):
    def change(content):
        place = content[STATISTICS]
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return {"dataset_statistics": change}


REFUSED = [
    (bits(vit_weight_bits=16), "vision_config: vit_weight_bits", Code.UNSUPPORTED),
    (bits(vit_weight_bits=None), "vision_config: vit_weight_bits: expected 1, found no such key, which means 32", Code.UNSUPPORTED),
    (bits(vit_act_bits=32), "vision_config: vit_act_bits", Code.UNSUPPORTED),
    (bits(vit_weight_quant_method="absmax"), "vit_weight_quant_method", Code.UNSUPPORTED),
    (bits(hidden_act="gelu"), "hidden_act", Code.UNSUPPORTED),
    (statistics_without("action", "mask"), STATISTICS + ".action.mask", Code.BAD_BUNDLE),
    (statistics_without("action", "q99"), STATISTICS + ".action.q99", Code.BAD_BUNDLE),
    (statistics_without("proprio"), STATISTICS + ".proprio.q01", Code.BAD_BUNDLE),
    ({"dataset_statistics": lambda s: s.update(other=s[STATISTICS])}, "--stats NAME", Code.BAD_BUNDLE),
    ({"dataset_statistics": lambda s: s[STATISTICS]["action"].update(mask=[True] * 7)}, "the gripper", Code.UNSUPPORTED),
    ({"preprocessor_config": lambda c: c.update(image_mean=[0.4] * 3)}, "image_mean", Code.UNSUPPORTED),
    ({"preprocessor_config": lambda c: c.update(size={"height": 224, "width": 224})}, "size", Code.UNSUPPORTED),
    ({"tokenizer_config": lambda c: c.update(chat_template="{{ messages }}")}, "chat_template", Code.UNSUPPORTED),
    ({"tokenizer": lambda c: c.update(post_processor=None)}, "post_processor", Code.UNSUPPORTED),
    ({"config": lambda c: c["text_config"].update(model_type="llama")}, "text_config: model_type", Code.UNSUPPORTED),
    ({"config": lambda c: c.update(vision_feature_select_strategy="default")}, "vision_feature_select_strategy", Code.UNSUPPORTED),
    ({"config": lambda c: c.update(vision_feature_layer=-3)}, "vision_feature_layer", Code.BAD_BUNDLE),
    ({"config": lambda c: c.update(something="new")}, "config.json: something", Code.UNSUPPORTED),
]


@pytest.mark.parametrize("changes, part, code", REFUSED, ids=[part for _, part, _ in REFUSED])
def test_what_is_not_understood_is_refused_by_name(converter, changes, part, code):
    error = converter.refusal(saved(**changes))
    assert part in str(error) and error.code == code


def test_statistics_of_a_data_set_are_chosen_by_name(converter):
    both = saved(dataset_statistics=lambda s: s.update(other=s[STATISTICS]))
    assert converter.bundle(both, stats="other").keys["vla.arch"] == "bitvla"


def test_a_missing_sidecar_and_one_of_another_step_are_refused_by_name(converter):
    converter.save(saved())
    (converter.folder / HEAD).rename(converter.folder / "head.pt")
    assert "action_head--STEP_checkpoint.pt: expected one such file, found none" in str(converter.refusal())
    (converter.folder / "head.pt").rename(converter.folder / HEAD)
    (converter.folder / PROPRIO).rename(converter.folder / "proprio_projector--5000_checkpoint.pt")
    error = str(converter.refusal())
    assert "proprio_projector--5000_checkpoint.pt: expected the step of " + HEAD in error
    shutil.copy(converter.folder / "proprio_projector--5000_checkpoint.pt", converter.folder / PROPRIO)
    assert "proprio_projector--STEP_checkpoint.pt: expected one such file" in str(converter.refusal())


def test_a_head_of_another_robot_is_refused(converter):
    checkpoint = type(MICRO)(MICRO.vision, MICRO.text, d_state=7)
    assert "which are LIBERO's" in str(converter.refusal(saved(checkpoint)))


def test_widths_that_share_no_byte_are_refused(converter):
    odd = type(MICRO)({**MICRO.vision, "intermediate_size": 46}, MICRO.text)
    assert "intermediate_size: expected a multiple of 4" in str(converter.refusal(saved(odd)))
