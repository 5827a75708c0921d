# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What `vla` says of a bundle before the bundle gets its name."""

import os
from pathlib import Path

import pytest

from goldens import xvla
from manifests import vla
from vla_cpp.convert import ConvertError, Options, convert_checkpoint, conversion, runtime
from vla_cpp.convert.errors import Code


@pytest.fixture(autouse=True)
def nothing_at_hand(monkeypatch):
    monkeypatch.delenv("VLA_BINARY", raising=False)
    monkeypatch.setattr(runtime, "candidates", list)
    monkeypatch.setenv("PATH", "/nowhere")


@pytest.fixture
def fake(tmp_path):
    """A program called vla that says something, exits with a code, and writes down how it was called."""

    def make(code=0, says="", folder="bin"):
        path = tmp_path / folder / "vla"
        path.parent.mkdir(exist_ok=True)
        path.write_text('#!/bin/sh\necho "$@" >>{}.calls\necho "{}" >&2\nexit {}\n'.format(path, says, code))
        path.chmod(0o755)
        return path

    return make


def calls(path):
    log = Path(str(path) + ".calls")
    return log.read_text().splitlines() if log.exists() else []


def test_a_bundle_that_the_runtime_refuses_is_no_bundle(converter, tiny, fake):
    program = fake(3, "error: out.gguf does not fit: 2 problems\n  missing key a\n  missing key b")
    converter.save(tiny)
    Path(converter.out).write_bytes(b"the one before")
    with pytest.raises(ConvertError) as caught:
        convert_checkpoint(str(converter.folder), converter.out, Options(vla=str(program)), force=True)
    assert caught.value.code == Code.BAD_BUNDLE
    assert "found out.gguf does not fit: 2 problems; missing key a; missing key b; " in caught.value.message()
    assert str(program) in caught.value.message() and "--vla" in caught.value.message()
    assert Path(converter.out).read_bytes() == b"the one before"
    assert sorted(os.listdir(os.path.dirname(converter.out))) == ["bin", "out.gguf", "policy"]


def test_it_is_called_with_the_complete_file_under_another_name(converter, tiny, fake):
    program = fake()
    converter.bundle(tiny, vla=str(program))
    (call,) = calls(program)
    command, bundle = call.split()
    assert command == "inspect" and bundle.startswith(converter.out + ".") and bundle.endswith(".part")
    assert not any("runtime" in note for note in converter.summary.notes)


def test_what_the_machine_lacks_is_noted_and_no_refusal(converter, tiny, fake):
    converter.bundle(tiny, vla=str(fake(7, "error: memory: expected 5 GB, found 4 GB")))
    assert any("not opened by the runtime" in note and "expected 5 GB" in note for note in converter.summary.notes)


def test_without_a_runtime_the_summary_says_so(converter, tiny):
    converter.bundle(tiny)
    assert any("there is no vla here" in note for note in converter.summary.notes)


def test_the_option_goes_before_the_variable_and_that_before_the_path(converter, tiny, fake, monkeypatch):
    on_path, beside, named, given = (fake(folder=name) for name in ("path", "beside", "named", "given"))
    monkeypatch.setenv("PATH", str(on_path.parent) + ":/bin:/usr/bin")
    converter.bundle(tiny)
    monkeypatch.setattr(runtime, "candidates", lambda: [Path("/nowhere/vla"), beside])
    converter.bundle()
    monkeypatch.setenv("VLA_BINARY", str(named))
    converter.bundle()
    converter.bundle(vla=str(given))
    converter.bundle(vla="none")
    assert [len(calls(program)) for program in (on_path, beside, named, given)] == [1, 1, 1, 1]
    assert not any("runtime" in note for note in converter.summary.notes)


def test_a_program_that_was_asked_for_and_is_not_there_is_an_error_before_anything_is_read(converter, tiny):
    refusal = converter.refusal(tiny, vla="/nowhere/vla")
    assert refusal.code == Code.IO and "/nowhere/vla" in refusal.message()


def test_every_robot_of_a_bundle_is_opened(converter, fake):
    case = next(iter(xvla.CASES.values()))
    case.checkpoint.write(case.seed, converter.folder)
    program = fake()
    backbone = next((str(folder) for folder in (converter.folder / "vlm", converter.folder / "tokenizer") if folder.is_dir()), "")
    converter.bundle(embodiment="0,1", vla=str(program), backbone=backbone)
    assert [call.split()[2:] for call in calls(program)] == [["--embodiment", "0"], ["--embodiment", "1"]]


def test_the_runtime_opens_what_is_converted_and_refuses_what_it_does_not_know(converter, tiny, monkeypatch):
    converter.bundle(tiny, vla=vla())
    assert not any("runtime" in note for note in converter.summary.notes)
    monkeypatch.setattr(conversion, "BUNDLE_VERSION", 999)
    os.remove(converter.out)
    refusal = converter.refusal(vla=vla())
    assert "version" in refusal.message() and "999" in refusal.message()
