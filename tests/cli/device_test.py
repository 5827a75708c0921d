# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""--device where there is none but the CPU; tests/gpu has the rest."""

import json
import shutil

import pytest


@pytest.fixture
def alone(vla, tmp_path):
    """The program without libraries beside it."""
    folder = tmp_path / "bin"
    folder.mkdir()
    shutil.copy(vla.path, folder)
    return type(vla)(folder / "vla")


def test_the_cpu_is_a_device_and_the_default(vla, golden):
    plain, named = (vla(*golden.arguments(options=["--json", *o])).json() for o in ([], ["--device", "cpu"]))
    assert plain["actions"] == named["actions"] and plain["device"] == named["device"] == "cpu, 2 threads"


@pytest.mark.parametrize("kind", ["vulkan", "cuda"])
def test_an_absent_device_is_refused_with_what_is_there_and_where_its_library_would_be(alone, golden, kind):
    for name in (kind, f"{kind}:0"):
        answer = alone(*golden.arguments(options=["--device", name]))
        answer.refused("device", f"{kind}:0: expected one of cpu, found no libvla-{kind}.so in ", "docs/gpu.md")


@pytest.mark.parametrize("name", ["abacus", "vulkan:", "vulkan:x", "vulkan:-1", "vulkan:99999999999", "cpu:0", "CUDA"])
def test_other_names_are_a_usage_error(vla, golden, name):
    answer = vla(*golden.arguments(options=["--device", name]))
    answer.refused("usage", f"device: expected cpu, vulkan, vulkan:N, cuda or cuda:N, found {name}")


def test_devices_are_listed_without_a_bundle_and_the_others_with_the_reason(alone):
    text = alone("inspect", "--devices").out
    assert "\ncpu " in text and "\nno vulkan: no libvla-vulkan.so in " in text and "\nno cuda: " in text
    listed = json.loads(alone("inspect", "--devices", "--json").out)
    assert [device["name"] for device in listed["devices"]] == ["cpu"]
    assert 0 < listed["devices"][0]["free_bytes"] <= listed["devices"][0]["memory_bytes"]
    assert sorted(listed["absent"]) == ["cuda", "vulkan"]


def test_a_library_of_another_build_is_refused(alone, golden, vla):
    folder = alone.path.rsplit("/", 1)[0]
    with open(f"{folder}/libvla-vulkan.so", "wb") as file:
        file.write(b"no library at all")
    alone(*golden.arguments(options=["--device", "vulkan"])).refused("device", "vulkan:0: ", "libvla-vulkan.so")


def test_inspect_wants_one_thing_to_show(vla, golden):
    vla("inspect", golden.bundle, "--devices").refused("usage", "inspect: expected one of BUNDLE, --manifest ARCH and")
