# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The examples say what they are given wrong; that they are right, install_test.py shows."""

import subprocess

import pytest
from commands import ROOT, run


@pytest.fixture(scope="module", params=["c/act.c", "cpp/act.cpp"])
def example(request, build, tmp_path_factory):
    program = tmp_path_factory.mktemp("example") / "act"
    compiler = ["c++", "-std=c++17"] if request.param.endswith("pp") else ["cc", "-std=c99"]
    library = ["-L", build / "lib", "-lvla", f"-Wl,-rpath,{build / 'lib'}"]
    run(*compiler, f"-I{ROOT}/include", ROOT / "examples" / request.param, *library, "-o", program)
    return program


@pytest.mark.parametrize(
    "at, wrong, part",
    [
        (0, "/nonexistent.gguf", "io: /nonexistent.gguf"),
        (1, "go " * 30_000, "bad_observation: instruction"),
        (2, "0.1,x", ""),
        (2, "0.1", "bad_observation: observation.state: expected 6 numbers, found 1"),
        (3, "seven", ""),
        (4, "camera1=/nonexistent.png", "/nonexistent.png"),
        (4, "camera9=", "camera9"),
    ],
)
def test_a_wrong_argument_is_an_error_on_stderr_and_no_output(example, golden, example_arguments, at, wrong, part):
    arguments = [str(a) for a in example_arguments(golden, 1)]
    arguments[at] = wrong
    result = subprocess.run([str(example), *arguments], capture_output=True, text=True)
    assert result.returncode > 0 and result.stdout == ""
    assert "error: " in result.stderr and part in result.stderr


def test_too_few_arguments_are_told_with_those_that_are_needed(example):
    result = subprocess.run([str(example)], capture_output=True, text=True)
    assert result.returncode > 0 and "act BUNDLE TEXT STATE SEED NAME=FILE" in result.stderr
