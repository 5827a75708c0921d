# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Files of a checkpoint that are damaged, missing or contradict each other, and what their refusals say."""

import json
import os

import pytest

from tiny import write_json, write_safetensors
from vla_cpp.convert import Code

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


def test_an_adapter_without_weights_is_told_to_be_merged(converter, tiny):
    converter.save(tiny)
    (converter.folder / "model.safetensors").rename(converter.folder / "adapter_model.safetensors")
    write_json(str(converter.folder / "adapter_config.json"), {})
    assert "merge the adapter into the policy" in converter.refusal().message()


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
