# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The command as a person or a script meets it: exit codes, streams, wording."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import vla_cpp.convert.hub
from vla_cpp.convert import read_bundle
from vla_cpp.convert.cli import main, report
from vla_cpp.convert.conversion import Summary

PACKAGE = os.path.join(os.path.dirname(__file__), "..", "..", "python")


def run(*args, **environment):
    command = [sys.executable, "-m", "vla_cpp.convert.cli", *map(str, args)]
    return subprocess.run(
        command, env={**os.environ, "PYTHONPATH": PACKAGE, **environment}, capture_output=True, text=True
    )


def test_a_conversion_exits_with_zero_and_says_what_it_wrote_and_dropped(converter, tiny):
    result = run(converter.save(tiny), "-o", converter.out)
    assert result.returncode == 0 and result.stderr == ""
    lines = result.stdout.splitlines()
    assert (
        lines[0].startswith("wrote " + converter.out + ": smolvla, ")
        and "{:,} bytes".format(os.path.getsize(converter.out)) in lines[0]
    )
    assert any("lm_head" in line and "dropped" in line for line in lines)


def test_quiet_says_nothing(converter, tiny):
    result = run(converter.save(tiny), "-o", converter.out, "--quiet")
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_a_refusal_goes_to_stderr_in_the_form_of_the_runtime(converter, tiny, capsys):
    tiny.config["add_image_special_tokens"] = True
    assert main([converter.save(tiny), "-o", converter.out]) == 6
    streams = capsys.readouterr()
    assert streams.out == ""
    assert (
        streams.err
        == "error: config.json: add_image_special_tokens: expected False, found True; the prefix would hold further tokens\n"
    )


@pytest.mark.parametrize(
    "code, change",
    [(3, lambda t: t.tensors.pop("model.state_proj.bias")), (6, lambda t: t.config.update(use_cache=False))],
)
def test_each_class_of_refusal_has_its_exit_code(converter, tiny, capsys, code, change):
    change(tiny)
    assert main([converter.save(tiny), "-o", converter.out]) == code


HOSTILE = "x\x1b]0;owned\x07\x1b[2J\nwrote out.gguf: smolvla\u202e"


def test_names_of_tensors_and_types_reach_the_terminal_escaped(converter, tiny, capsys):
    tiny.tensors[HOSTILE] = np.zeros(1, np.float32)
    assert main([converter.save(tiny), "-o", converter.out]) == 3
    shown = [capsys.readouterr().err]
    tiny.tensors.pop(HOSTILE)
    tiny.config["type"] = HOSTILE
    assert main([converter.save(tiny), "-o", converter.out]) == 6
    shown.append(capsys.readouterr().err)
    for text in shown:
        assert "\\x1b]0;owned\\x07" in text and "\\nwrote out.gguf" in text
        assert all(line.isprintable() for line in text.splitlines()) and len(text.splitlines()) == 1


def test_the_summary_is_escaped_too():
    summary = Summary("out\x1b[2J.gguf", "smolvla", "f32")
    summary.dropped["never read"], summary.notes = ["\x1b[31mname"], [HOSTILE]
    assert all(line.isprintable() for line in report(summary).split("\n")) and len(report(summary).split("\n")) == 3


def test_a_checkpoint_that_is_not_there_is_an_io_error(tmp_path, capsys):
    assert main([str(tmp_path / "nothing"), "-o", str(tmp_path / "o.gguf")]) == 9
    assert "expected a checkpoint folder or hub:OWNER/NAME@REVISION" in capsys.readouterr().err


@pytest.mark.parametrize(
    "source, hint",
    [
        ("lerobot/smolvla_base", "hub:lerobot/smolvla_base@main fetches it from the hub"),
        ("policy.gguf", "a bundle is converted already: vla run takes it"),
        (__file__, "give the folder that holds the file"),
    ],
)
def test_a_checkpoint_that_is_something_else_is_refused_with_what_to_give(source, hint, tmp_path, capsys):
    assert main([source, "-o", str(tmp_path / "o.gguf")]) == 9
    assert capsys.readouterr().err.endswith("found neither; " + hint + "\n")


def test_a_hub_without_a_network_is_an_io_error_that_says_what_to_do(tmp_path):
    result = run("hub:nobody/nothing@main", "-o", tmp_path / "o.gguf", HF_HUB_OFFLINE="1", HF_HOME=str(tmp_path))
    assert result.returncode == 9
    assert result.stderr.startswith("error: hub:nobody/nothing@main: expected a reachable hub repository")
    assert "download it and give the folder" in result.stderr


@pytest.mark.parametrize("bound", ["0.5", "-10", "1e10", "nan"])
def test_a_bound_that_makes_no_sense_is_a_usage_error(converter, tiny, bound, capsys):
    assert main([converter.save(tiny), "-o", converter.out, "--state-bound=" + bound]) == 2
    assert capsys.readouterr().err.startswith("error: --state-bound: expected 1 to 1e9, found ")
    assert not os.path.exists(converter.out)


@pytest.mark.parametrize("args", [[], ["only"], ["a", "-o", "b", "--dtype", "int3"], ["a", "-o", "b", "--frobnicate"]])
def test_wrong_arguments_are_a_usage_error(args, capsys):
    with pytest.raises(SystemExit) as info:
        main(args)
    assert info.value.code == 2 and capsys.readouterr().err.startswith("error: arguments: ")


def test_an_existing_file_is_overwritten_only_by_force(converter, tiny, capsys):
    folder = converter.save(tiny)
    open(converter.out, "w").write("precious")
    assert main([folder, "-o", converter.out]) == 2
    assert "--force overwrites it" in capsys.readouterr().err and open(converter.out).read() == "precious"
    assert main([folder, "-o", converter.out, "--force"]) == 0
    assert open(converter.out, "rb").read(4) == b"GGUF"


def test_an_output_folder_that_is_missing_is_an_io_error(converter, tiny, tmp_path, capsys):
    assert main([converter.save(tiny), "-o", str(tmp_path / "no" / "o.gguf")]) == 9


def test_a_full_disk_is_an_io_error_that_leaves_nothing(converter, tiny, monkeypatch, capsys):
    import vla_cpp.output as output

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(output.os, "fsync", full)
    assert main([converter.save(tiny), "-o", converter.out]) == 9
    assert "found No space left on device" in capsys.readouterr().err
    assert os.listdir(os.path.dirname(converter.out)) == ["policy"]


def test_help_names_every_architecture_and_exit_code():
    text = run("--help").stdout
    for word in ("smolvla", "--backbone", "--identity-stats", "--position-precision", "load_vlm_weights", "Exit codes"):
        assert word in text


def test_a_fault_of_the_converter_is_one_line_and_class_internal(converter, tiny, monkeypatch, capsys):
    import vla_cpp.convert.conversion as conversion

    def fault(*_):
        raise KeyError("surprise")

    monkeypatch.setattr(conversion, "_choose_dtype", fault)
    assert main([converter.save(tiny), "-o", converter.out]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def mutate(rng, value, depth=0):
    """One random change somewhere in a JSON value."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = list(value)[rng.integers(len(value))]
        return (
            {**value, key: mutate(rng, value[key], depth + 1)}
            if rng.random() < 0.85
            else {k: v for k, v in value.items() if k != key}
        )
    if isinstance(value, list) and value and rng.random() < 0.8:
        i = int(rng.integers(len(value)))
        return value[:i] + [mutate(rng, value[i], depth + 1)] + value[i + 1 :]
    junk = [
        None,
        True,
        -1,
        0,
        3,
        10**30,
        1.5,
        1e308,
        "",
        "x",
        "../..",
        [],
        [1],
        {},
        {"a": 1},
        [[]],
        ["a", 2],
        {"type": "STATE"},
    ]
    return junk[rng.integers(len(junk))]


@pytest.mark.parametrize(
    "file",
    [
        "config.json",
        "vlm/config.json",
        "vlm/tokenizer.json",
        "vlm/tokenizer_config.json",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
    ],
)
def test_damaged_json_is_converted_or_refused_but_never_a_fault(converter, tiny, capsys, file):
    rng = np.random.default_rng(len(file))
    converter.save(tiny)
    path = converter.folder / file
    good = json.loads(path.read_text())
    codes = set()
    for _ in range(40):
        path.write_text(json.dumps(mutate(rng, good)))
        codes.add(main([str(converter.folder), "-o", converter.out, "--force", "--quiet"]))
        assert 1 not in codes, (capsys.readouterr().err, path.read_text()[:3000])
    assert codes & {3, 6}


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """A hub of two repositories, whose cache keeps a snapshot in a folder that is named by its commit. The list has what was asked."""
    asked = []

    def download(source, repo, revision, patterns, again):
        asked.append((repo, revision, tuple(patterns)))
        return str(tmp_path / repo.replace("/", "--") / "0123abc")

    monkeypatch.setattr(vla_cpp.convert.hub, "fetched", download)
    return asked


def test_a_repository_of_the_hub_is_recorded_with_the_commit_that_its_revision_was(converter, tiny, hub, tmp_path):
    tiny.save(tmp_path / "someone--policy" / "0123abc")
    assert main(["hub:someone/policy@main", "-o", converter.out, "--quiet"]) == 0
    keys = read_bundle(converter.out).keys
    assert (keys["vla.source.name"], keys["vla.source.revision"]) == ("someone/policy", "0123abc")
    assert [ask[:2] for ask in hub] == [("someone/policy", "main")] and "*.safetensors" in hub[0][2]


@pytest.mark.parametrize("source", ["runs/last", "someone/policy", "hub:someone/policy", "hub:policy@main", "hub:a/b/c@d", "hub:../x@d", "hub:"])
def test_nothing_is_fetched_that_does_not_say_hub_and_revision(converter, hub, capsys, source):
    code = main([source, "-o", converter.out, "--quiet"])
    assert code == (2 if source.startswith("hub:") else 9)
    assert "hub:OWNER/NAME@REVISION" in capsys.readouterr().err
    assert hub == []


def test_a_backbone_that_only_the_checkpoint_names_is_not_fetched(converter, tiny, hub, capsys, tmp_path):
    folder = converter.save(tiny)
    (converter.folder / "vlm").rename(tmp_path / "vlm")
    assert main([folder, "-o", converter.out, "--quiet"]) == 9
    assert "--backbone hub:" in capsys.readouterr().err
    assert hub == []
    (tmp_path / "their--vlm").mkdir()
    (tmp_path / "vlm").rename(tmp_path / "their--vlm" / "0123abc")
    assert main([folder, "-o", converter.out, "--quiet", "--backbone", "hub:their/vlm@v1"]) == 0
    keys = read_bundle(converter.out).keys
    assert keys["lm.n_vocab"] == 300
    assert keys["vla.source.backbone"] == "their/vlm@0123abc"
    assert [ask[:2] for ask in hub] == [("their/vlm", "v1")]


@pytest.mark.parametrize("limit", [0, 1000, 20_000, 60_000])
def test_a_full_disk_leaves_nothing_behind_wherever_it_strikes(converter, tiny, limit):
    """A limit on the size of files stands for the disk: writes beyond it fail as they do there."""
    folder = converter.save(tiny)
    os.mkdir(os.path.dirname(converter.out) + "/disk")
    script = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0})); from vla_cpp.convert.cli import main; sys.exit(main())"
    out = os.path.dirname(converter.out) + "/disk/out.gguf"
    arguments = [sys.executable, "-c", script.format(limit), folder, "-o", out, "--quiet"]
    result = subprocess.run(arguments, capture_output=True, text=True, env=dict(os.environ, PYTHONPATH=PACKAGE))
    assert (result.returncode, os.listdir(os.path.dirname(out))) == (9, []), result.stderr
    assert "expected a file that can be written" in result.stderr


def test_a_file_or_link_beside_the_bundle_is_not_written_through(converter, tiny, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("kept")
    os.symlink(precious, converter.out + ".part")
    converter.bundle(tiny)
    assert precious.read_text() == "kept"
    assert sorted(os.listdir(os.path.dirname(converter.out))) == ["out.gguf", "out.gguf.part", "policy", "precious"]
