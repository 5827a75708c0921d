# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Files of a checkpoint that are damaged, missing or contradict each other, and what their refusals say."""

import json
import os
import shutil

import pytest

from tiny import write_json, write_safetensors
from vla_cpp.convert import Code, ConvertError, Options, convert_checkpoint
from vla_cpp.convert.cli import main

BAD, IO = Code.BAD_BUNDLE, Code.IO


def test_one_processor_file_without_the_other_is_refused(converter, tiny):
    converter.save(tiny)
    (converter.folder / "policy_postprocessor.json").unlink()
    error = converter.refusal()
    assert (
        "policy_postprocessor.json: expected the file beside policy_preprocessor.json" in error.message()
        and error.code == IO
    )


@pytest.mark.parametrize(
    "file", ["config.json", "vlm/config.json", "vlm/tokenizer.json", "policy_preprocessor.json", "pre.safetensors"]
)
@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b'{"a": NaN}', b"[" * 100000])
def test_a_damaged_file_is_refused_by_its_name(converter, tiny, file, content):
    converter.save(tiny)
    (converter.folder / file).write_bytes(content)
    error = converter.refusal()
    assert file.rsplit("/", 1)[-1] in error.message() and error.code == BAD


@pytest.mark.parametrize("file", ["config.json", "model.safetensors", "vlm/tokenizer.json", "pre.safetensors"])
def test_a_missing_file_is_refused_by_its_name(converter, tiny, file):
    converter.save(tiny)
    (converter.folder / file).unlink()
    error = converter.refusal()
    assert file in error.message() and error.code == IO


@pytest.mark.parametrize("file", ["config.json", "model.safetensors", "vlm/tokenizer.json", "pre.safetensors"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_file_is_refused_by_its_name_and_not_waited_for(converter, tiny, file, kind):
    converter.save(tiny)
    path = converter.folder / file
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    error = converter.refusal()
    assert file in error.message() and "not a regular file" in error.message() and error.code == IO


def test_a_shard_that_lacks_what_the_index_promises_is_refused(converter, tiny):
    folder = converter.save(tiny, shards=2)
    index = json.load(open(folder + "/model.safetensors.index.json"))
    moved = next(name for name, file in index["weight_map"].items() if file == "model-00002-of-00002.safetensors")
    index["weight_map"][moved] = "model-00001-of-00002.safetensors"
    index["weight_map"]["model.ghost"] = "model-00002-of-00002.safetensors"
    write_json(folder + "/model.safetensors.index.json", index)
    message = converter.refusal().message()
    assert "tensor model.ghost: expected the tensor in model-00002-of-00002.safetensors" in message
    assert (
        "tensor {}: expected the tensor in model-00001-of-00002.safetensors, found model-00002-of-00002.safetensors".format(
            moved
        )
        in message
    )


def test_an_index_that_points_outside_the_folder_is_refused(converter, tiny):
    folder = converter.save(tiny, shards=1)
    write_json(
        folder + "/model.safetensors.index.json", {"weight_map": {"model.state_proj.bias": "../other.safetensors"}}
    )
    assert "weight_map: expected tensor names with file names" in converter.refusal().message()


def test_two_sets_of_weights_in_one_folder_are_refused(converter, tiny):
    converter.save(tiny)
    converter.save(tiny, shards=2)
    assert (
        "expected either model.safetensors or model.safetensors.index.json, found both" in converter.refusal().message()
    )


def test_the_folder_above_a_trainers_policy_is_told_where_the_policy_is(converter, tiny):
    converter.save(tiny)
    (converter.folder.parent / "step").mkdir()
    converter.folder.rename(converter.folder.parent / "step" / "pretrained_model")
    converter.folder = converter.folder.parent / "step"
    error = converter.refusal()
    assert "give " + str(converter.folder / "pretrained_model") in error.message() and error.code == IO


def test_a_lora_adapter_without_its_base_is_refused_with_how_to_give_it(converter):
    converter.folder.mkdir()
    (converter.folder / "adapter_config.json").write_text(json.dumps({"base_model_name_or_path": "lerobot/smolvla_base"}))
    (converter.folder / "adapter_model.safetensors").write_bytes(b"")
    error = converter.refusal()
    assert "found a LoRA adapter of lerobot/smolvla_base; --base DIR, or --base hub:lerobot/smolvla_base@main" in error.message()
    assert error.code == Code.UNSUPPORTED


@pytest.mark.parametrize(
    "root, runs, given",
    [
        ("outputs/train/arm", ["checkpoints/000100", "checkpoints/last"], "checkpoints/last"),
        ("outputs/train/arm", ["checkpoints/000100", "checkpoints/000200"], "checkpoints/000200"),
        ("outputs/train/arm/checkpoints", ["000100", "last"], "last"),
        ("outputs/train", ["2026-01-02/10-00-00_smolvla/checkpoints/last"], "2026-01-02/10-00-00_smolvla/checkpoints/last"),
        ("outputs/train", ["arm/checkpoints/last"], "arm/checkpoints/last"),
    ],
)
def test_a_folder_of_lerobots_training_is_refused_with_the_policy_in_it(tmp_path, root, runs, given):
    for run in runs:
        policy = tmp_path / root / run / "pretrained_model"
        policy.mkdir(parents=True)
        (policy / "config.json").write_text("{}")
    with pytest.raises(ConvertError) as info:
        convert_checkpoint(str(tmp_path / root), str(tmp_path / "out.gguf"), Options())
    assert info.value.code == IO
    assert info.value.message().endswith("found a folder of LeRobot's training; give {}".format(tmp_path / root / given / "pretrained_model"))


def test_a_smolvla_without_its_backbones_files_is_refused_with_the_pinned_repository(converter, tiny):
    tiny.config["vlm_model_name"] = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
    converter.save(tiny)
    shutil.rmtree(converter.folder / "vlm")
    hint = "run vla-convert again with --backbone hub:HuggingFaceTB/SmolVLM2-500M-Video-Instruct@7b375e1b73b11138ff12fe22c8f2822d8fe03467"
    assert converter.refusal().message().endswith(hint)


def test_a_folder_of_this_machine_that_a_checkpoint_names_is_not_read_unless_the_option_says_so(converter, tiny, tmp_path):
    outside = tmp_path / "outside"
    tiny.config["vlm_model_name"] = str(outside)
    converter.save(tiny)
    (converter.folder / "vlm").rename(outside)
    message = converter.refusal().message()
    assert "expected --backbone DIR, or vlm/ inside the checkpoint" in message
    assert message.endswith("where that folder is the one you mean, run vla-convert again with --backbone {}".format(outside))
    assert main([str(converter.folder), "-o", str(converter.out), "--quiet", "--backbone", str(outside)]) == 0


def test_a_declared_tokenizer_folder_that_is_missing_is_refused(converter, tiny):
    tiny.step("tokenizer_processor")["artifacts"] = {"tokenizer_name": "tokenizer"}
    error = converter.refusal(tiny)
    assert "tokenizer/tokenizer.json" in error.message() and error.code == IO


def test_without_a_backbone_the_refusal_names_the_option(converter, tiny, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    converter.save(tiny)
    for file in (converter.folder / "vlm").iterdir():
        file.unlink()
    error = converter.refusal()
    assert "backbone nobody/none" in error.message() and "--backbone" in error.message() and error.code == IO


def test_a_statistics_file_with_a_hostile_header_is_refused(converter, tiny):
    folder = converter.save(tiny)
    write_safetensors(folder + "/pre.safetensors", tiny.stats)
    with open(folder + "/pre.safetensors", "r+b") as file:
        file.write((1 << 63).to_bytes(8, "little"))
    assert "expected a safetensors header inside the file" in converter.refusal().message()
