# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of openpi's JAX code: read as its PyTorch code's, with LoRA merged."""

import functools
import json
import sys

import contracts
import numpy as np
import pytest
from vla_cpp.convert import read_bundle

tensorstore = pytest.importorskip("tensorstore")
import jax_checkpoint  # noqa: E402

VARIANTS = ("pi0_libero", "pi05_libero", "pi0_aloha_sim")


def row_of(variant, **more):
    row = next(row for row in contracts.ROWS if row["family"] == "openpi" and row["variant"] == variant and "jax_lora" not in row)
    return row | more


def converted(row, folder):
    """The bundle of a row."""
    _, checkpoint = contracts.write(row, folder)
    assert contracts.convert(row, folder, checkpoint) == 0
    return read_bundle(str(folder / "bundle.gguf"))


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_bundle_of_a_jax_checkpoint_is_that_of_the_pytorch_one(variant, tmp_path):
    torch, jax = converted(row_of(variant), tmp_path / "torch"), converted(row_of(variant, jax_lora=[]), tmp_path / "jax")
    assert torch.tensors.keys() == jax.tensors.keys() and len(torch.tensors) > 100
    for name, tensor in torch.tensors.items():
        np.testing.assert_array_equal(tensor, jax.tensors[name], err_msg=name)


def test_lora_is_merged(tmp_path, capsys):
    plain, merged = converted(row_of("pi0_libero"), tmp_path / "plain"), converted(row_of("pi0_libero", jax_lora=[16, 32]), tmp_path / "lora")
    moved = 0
    for name, tensor in plain.tensors.items():
        np.testing.assert_allclose(merged.tensors[name], tensor, rtol=0, atol=1e-6 * max(1, np.abs(tensor).max()), err_msg=name)
        moved += not np.array_equal(merged.tensors[name], tensor)
    assert moved > 20  # sums are rounded, so that they are no copies of what they came from


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Writes each checkpoint once: (where all of it is, the checkpoint inside it)."""

    @functools.cache
    def write(*ranks):
        place = tmp_path_factory.mktemp("written")
        _, folder = contracts.write(row_of("pi0_libero", jax_lora=list(ranks)), place)
        return place, folder.relative_to(place)

    return write


@pytest.fixture
def checkpoint(tmp_path, written):
    """Copies a checkpoint and writes its arrays again where a test changes them; gives its folder."""

    def write(change=None, ranks=(16, 32), **how):
        row = row_of("pi0_libero", jax_lora=list(ranks))
        place, inside = written(*ranks)
        contracts.shutil.copytree(place, tmp_path / "made")
        folder, lerobot = tmp_path / "made" / inside, tmp_path / "made/checkpoint"
        if not change and not how:
            return row, folder
        tensors = {name: contracts.to_f32(contracts.values(entry), entry.dtype)
                   for name, entry in contracts.read_safetensors(str(lerobot / "model.safetensors")).entries.items()}  # fmt: skip
        arrays = jax_checkpoint.arrays_of(tensors, json.loads((lerobot / "dims.json").read_text()), dict(zip(("", "_1"), ranks)))
        if change:
            change(arrays)
        contracts.shutil.rmtree(folder / "params")
        jax_checkpoint.write(folder / "params", arrays, **how)
        return row, folder

    return write


def refused(capsys, tmp_path, row, folder):
    assert contracts.convert(row, tmp_path / "made", folder) != 0
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("how", [{"value": False}, {"in_database": False}])
def test_every_form_of_an_orbax_checkpoint_is_read(checkpoint, tmp_path, how):
    row, folder = checkpoint(**how)
    assert contracts.convert(row, tmp_path / "made", folder) == 0


Q = "PaliGemma/llm/layers/attn/q_einsum/"


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda a: a.pop(Q + "w"), f"array {Q}w: expected the array in params, found none"),
        (lambda a: a.pop(Q + "lora_b"), f"array {Q}lora_b: expected the array in params, found none"),
        (lambda a: a.update({Q + "lora_c": np.ones(3, np.float32)}), f"array {Q}lora_c"),
        (lambda a: a.update({Q + "w": a[Q + "w"].astype(np.int32)}), "expected floats"),
        (lambda a: a.update({Q + "lora_b": a[Q + "lora_b"][:, :, :, :4]}), "LoRA of"),
    ],
)
def test_other_arrays_than_openpis_are_refused_by_name(checkpoint, tmp_path, capsys, change, words):
    assert words in refused(capsys, tmp_path, *checkpoint(change))


def test_another_rank_than_the_configurations_is_refused_since_no_file_states_alpha(checkpoint, tmp_path, capsys):
    said = refused(capsys, tmp_path, *checkpoint(ranks=(8, 32)))
    assert "rank 16, as gemma_2b_lora has" in said and "alpha" in said


def test_damage_is_refused(checkpoint, tmp_path, capsys):
    row, folder = checkpoint()
    (folder / "params/_METADATA").write_text('{"tree_metadata": {"a": {"key_metadata": [{"key": "../../etc"}]}}}')
    assert "expected names of arrays" in refused(capsys, tmp_path, row, folder)
    (folder / "params/_METADATA").write_text("{")
    assert "expected JSON" in refused(capsys, tmp_path, row, folder)


def test_a_missing_database_is_refused(checkpoint, tmp_path, capsys):
    row, folder = checkpoint()
    (folder / "params/manifest.ocdbt").unlink()
    assert "expected an array" in refused(capsys, tmp_path, row, folder)


def test_without_tensorstore_the_refusal_says_what_to_install(checkpoint, tmp_path, capsys, monkeypatch):
    row, folder = checkpoint()
    monkeypatch.setitem(sys.modules, "tensorstore", None)
    assert "pip install tensorstore" in refused(capsys, tmp_path, row, folder)


def test_weights_of_pytorch_that_name_lora_are_refused(tmp_path, capsys):
    """openpi's converter leaves LoRA out without a word."""
    row = row_of("pi0_libero", config={"paligemma_variant": "gemma_2b_lora"})
    _, folder = contracts.write(row, tmp_path / "made")
    assert "leaves LoRA out" in refused(capsys, tmp_path, row, folder)
