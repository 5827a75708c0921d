# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla inspect: what a bundle is, for a person and for a machine, and what an architecture declares."""

import json
from math import prod

import gguf
import numpy as np
import pytest
from golden_cases import NAMES, Golden, tensors
from program import EXIT, every_third_if_sanitized


def test_a_person_reads_features_statistics_recipe_sizes_and_memory(vla):
    case = Golden("absent_view")
    answer = vla("inspect", case.bundle)
    assert answer.code == 0 and answer.err == ""
    rows = [line.split() for line in answer.out.splitlines()]
    heads = [line.split()[0] for line in answer.out.splitlines() if not line.startswith(" ")]
    assert heads == [
        "bundle",
        "policy",
        "source",
        "checksum",
        "views",
        "state",
        "action",
        "executed",
        "instruction",
        "solver",
        "leftover",
        *["recipe"] * 4,
        "modules",
        "device",
        "products",
        "memory",
    ]
    assert ["observation.images.base", "(also", "observation.images.left)"] in [row[:3] for row in rows]
    assert ["name", "unit", "max", "min"] in rows or ["name", "unit", "min", "max"] in rows
    assert "at least 1 of 4 must be present" in answer.out and '"op":"letterbox"' in answer.out
    stats = tensors(case.bundle)["stats.observation.state.min"]
    assert any(row[:2] == ["state.0", "unstated"] and f"{stats[0]:.6g}" in row for row in rows)


@pytest.mark.parametrize("name", every_third_if_sanitized(NAMES, 1))
def test_json_has_every_key_and_statistic_of_the_file_and_counts_its_parameters(vla, name):
    case = Golden(name)
    answer = vla("inspect", case.bundle, "--json")
    assert answer.code == 0 and answer.err == ""
    root, file = json.loads(answer.out), gguf.GGUFReader(case.bundle)
    keys = {k for k in file.fields if not k.startswith(("GGUF.", "tokenizer."))}
    assert (
        set(root["keys"]) == keys and root["keys"]["observation.views"] == file.fields["observation.views"].contents()
    )
    found = tensors(case.bundle)
    stats = {n: v for n, v in found.items() if n.startswith("stats.")}
    assert set(root["stats"]) == set(stats)
    assert all(np.array_equal(np.asarray(root["stats"][n], v.dtype), v.ravel()) for n, v in stats.items())
    codes = gguf.GGMLQuantizationType.I8  # four to a byte
    assert sum(m["parameters"] for m in root["modules"].values()) == sum(
        prod(map(int, t.shape)) * (4 if t.tensor_type == codes else 1)
        for t in file.tensors
        if not t.name.startswith("stats.")
    )
    memory = root["memory_bytes"]
    assert memory["weights"] > 0 and memory["total"] == memory["weights"] + memory["plan"] + memory["working"]
    assert root["bundle"]["checksum"] == file.fields["vla.checksum"].contents()


def test_the_manifest_lists_the_parameters_of_the_published_size(vla):
    root = vla("inspect", "--manifest", "smolvla")
    assert root.code == 0 and root.err == ""
    root = json.loads(root.out)
    assert root["arch"] == "smolvla" and root["config"]["lm.n_layer"] == 16
    shapes = {p["name"]: (p["storage"], p["shape"]) for p in root["parameters"]}
    assert len(shapes) == len(root["parameters"])
    assert shapes["lm.token_embd.weight"] == ("table", [49280, 960])
    assert shapes["state_in.weight"] == ("matrix", [960, 32]) and shapes["state_in.bias"] == ("vector", [960])
    assert shapes["expert.blk.1.attn_k.weight"] == ("matrix", [320, 320])  # a cross layer reads cached keys
    assert shapes["expert.blk.2.attn_k.weight"] == ("matrix", [320, 720])
    assert "lm.blk.15.attn_k.weight" in shapes and "lm.blk.15.attn_q.weight" not in shapes


@pytest.mark.parametrize("arch, n_parameter", [("pi0", 3_128_992_528), ("pi05", 3_244_377_872)])
def test_the_published_pi_policies_have_the_references_parameters_without_those_that_no_action_needs(vla, arch, n_parameter):
    # Of 3,238,048,528 and 3,353,433,872: without the last language layer's queries, outputs and MLP, and the final norm.
    root = json.loads(vla("inspect", "--manifest", arch).out)
    assert sum(prod(p["shape"]) for p in root["parameters"]) == n_parameter


@pytest.mark.parametrize("name", every_third_if_sanitized(NAMES, 1))
def test_a_bundle_has_the_names_of_the_manifest_layer_for_layer(vla, name):
    def without_numbers(names):
        return {".".join("#" if part.isdigit() else part for part in name.split(".")) for name in names}

    case = Golden(name)
    manifest = json.loads(vla("inspect", "--manifest", case.arch).out)
    bundle = [n for n in tensors(case.bundle) if not n.startswith("stats.")]
    declared = without_numbers(p["name"] for p in manifest["parameters"])
    # What these have, or lack, beside the published size.
    other = {
        "act/environment": {"environment_in.weight", "environment_in.bias"},
        "act/pre_norm": {"encoder.norm.weight", "encoder.norm.bias"},
        "xvla/joints": {"prompt.weight"},
        "turbovla/no_state": {"state_in.weight", "state_in.bias", "state_token.weight", "vision.registers.weight"},
        "turbovla_authors/exact_fit": {"vision.registers.weight"},
        "turbovla_authors/last_block": {"vision.post_norm.weight", "vision.post_norm.bias"},
        "turbovla_authors/zero_fill": {"place.weight", "place_scale.weight"},
        "diffusion/ddim": {n for n in declared if n.startswith("vision.")} | encoder_with_batch_norms("vision.#"),
        "diffusion/environment": {n for n in declared if n.startswith(("unet.down", "unet.up"))},
        "diffusion/no_cameras": {n for n in declared if n.startswith("vision.")},
        "openvla_oft/film": two_layers("state", "dino.blk.#.film", "siglip.blk.#.film"),
        "openvla_oft/diffusion": two_layers("noise"),
        **dict.fromkeys(("vla_adapter/spatial", "vla_adapter/calvin"), {n for n in declared if n.startswith(("head.blk.#.actions.", "head.blk.#.task."))}),
        "vla_jepa/camera": two_layers("state"),
    }
    assert without_numbers(bundle) == declared ^ other.get(name, set())


def two_layers(*paths):
    """Names of projections to a token, and of the factor and the shift of FiLM."""
    parts = {"film": ("scale", "shift")}
    return {f"{at}_{layer}.{kind}" for at in paths for layer in parts.get(at.split(".")[-1], ("in", "out")) for kind in ("weight", "bias")}


def encoder_with_batch_norms(at):
    """Names of a Diffusion Policy's encoder whose norms are part of its convolutions."""
    layers = ["stem", *(f"blk.#.{part}" for part in ("conv1", "conv2", "shortcut")), "keypoints", "out"]
    return {f"{at}.{layer}.{kind}" for layer in layers for kind in ("weight", "bias")} | {f"{at}.keypoints.places"}


def test_the_manifest_of_an_unknown_architecture_is_unsupported(vla):
    vla("inspect", "--manifest", "octo").refused("unsupported", "xvla, found octo")


def test_inspect_takes_no_more_memory_for_weights_than_the_file_has(vla):
    case = Golden("long_text")
    answer = vla("inspect", case.bundle)
    assert answer.code == 0 and answer.peak < 1 << 29
    assert EXIT["io"] == vla("inspect", case.folder / "nothing.gguf").code
