# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Calls that the command line itself refuses, and places that it cannot write to."""

import pytest


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["run"],
        ["inspect"],
        ["compare"],
        ["compare", "only-one.gguf"],
        ["--frobnicate"],
        ["inspect", "policy.gguf", "--frobnicate"],
        ["inspect", "policy.gguf", "--manifest", "smolvla"],
        ["compare", "a.gguf", "b.gguf", "--tolerance", "-1"],
        ["compare", "a.gguf", "b.gguf", "--tolerance", "x"],
    ],
    ids=" ".join,
)
def test_a_call_that_makes_no_sense_is_a_usage_error_in_one_line(vla, arguments):
    answer = vla(*arguments)
    assert answer.code == 2 and answer.out == ""
    assert answer.err.startswith("error: usage: ") and answer.err.count("\n") == 1


@pytest.mark.parametrize(
    "options",
    [
        ["--seed", "1"],
        ["--tap", "*"],
        ["--taps-out", "taps.gguf"],
        ["--threads", "-1"],
        ["--threads", "x"],
        ["--text", "again"],
        ["--image", "camera1"],
        ["--image", "=frame.png"],
        ["--state"],
        ["--frobnicate"],
        ["stray"],
        ["--noise", ""],
        ["--out", ""],
        ["--tap", "", "--taps-out", "t.gguf"],
        ["--tap", "*", "--taps-out", ""],
        ["--threads", ""],
    ],
    ids=" ".join,
)
def test_options_of_run_that_contradict_or_miss_something_are_a_usage_error(vla, golden, options):
    answer = vla(*golden.arguments(options=options))
    assert answer.code == 2 and answer.out == ""
    assert answer.err.startswith("error: usage: ") and answer.err.count("\n") == 1


@pytest.mark.parametrize("left_out", ["--image", "--state"])
def test_run_without_an_image_or_a_state_is_a_usage_error_that_names_it(vla, golden, left_out):
    arguments = golden.arguments()
    while left_out in arguments:
        at = arguments.index(left_out)
        del arguments[at : at + 2]
    answer = vla(*arguments)
    assert answer.code == 2 and answer.out == "" and left_out in answer.err and answer.err.count("\n") == 1


@pytest.mark.parametrize(
    "arguments, unknown",
    [
        (["runn"], "vla does not know runn; did you mean run? see vla --help"),
        (["run", "policy.gguf", "--images", "top=top.png"], "vla run does not know --images top=top.png; did you mean --image? see vla run --help"),
        (["serve", "policy.gguf", "--port", "5555"], "vla serve does not know --port; see vla serve --help"),
    ],
    ids=str,
)
def test_a_word_that_the_command_does_not_know_is_named_before_one_that_it_misses(vla, arguments, unknown):
    vla(*arguments).refused("usage", f"arguments: {unknown}")


@pytest.mark.parametrize("seed", ["-1", "1.5", "x", "", str(2**64)])
def test_a_seed_that_is_no_unsigned_integer_is_a_usage_error(vla, golden, seed):
    arguments = [a for a in golden.arguments() if a not in ("--noise", golden.noise)]
    answer = vla(*arguments, "--seed", seed)
    assert answer.code == 2 and answer.out == "" and "--seed" in answer.err


@pytest.mark.parametrize(
    "state", ["", "1,2,3,4,5,", ",1", "1;2", "a,b", "1 2", "0x1p3", "1,,2", "1e999,0,0,0,0,0", "state="]
)
def test_a_state_that_is_no_list_of_numbers_is_refused(vla, golden, state):
    answer = vla(*golden.arguments(state=state))
    assert answer.code in (2, 4) and answer.out == "" and answer.err.count("\n") == 1
    assert answer.err.startswith(
        (
            "error: usage: --state: expected numbers separated by commas, found ",
            "error: bad_observation: observation.state: expected 6 numbers, found 0",
        )
    )


def test_the_same_view_twice_is_a_usage_error(vla, golden):
    vla(*golden.arguments(), "--image", f"camera1={golden.images['camera2']}").refused("usage", "camera1 twice")


@pytest.mark.parametrize("options", [["--out"], ["--tap", "*", "--taps-out"]], ids=" ".join)
def test_a_file_that_cannot_be_written_is_an_io_error_and_no_chunk_is_printed(vla, golden, tmp_path, options):
    vla(*golden.arguments(options=["--json", *options, tmp_path / "no" / "file"])).refused(
        "io", "expected a file that can be written"
    )


def test_output_that_cannot_be_written_is_an_io_error(vla, golden):
    with open("/dev/full", "wb") as full:
        answer = vla(*golden.arguments(), stdout=full)
    answer.refused("io", "standard output")


COMMANDS = ["run", "inspect", "compare", "bench", "serve", "keygen", "replay"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_a_terminal_and_says_ranges_in_words(vla, command):
    answer = vla(command, "--help")
    assert answer.code == 0
    assert vla("help", command).out == answer.out
    assert max(map(len, answer.out.splitlines())) <= 130  # examples stay in one line
    assert ":INT in [" not in answer.out and "TEXT:" not in answer.out


@pytest.mark.parametrize(
    "arguments, meant",
    [(["brench"], "bench"), (["run", "policy.gguf", "--txt", "go"], "--text"), (["serve", "--thread", "2"], "--threads")],
)
def test_a_misspelled_word_is_answered_with_the_one_that_was_meant(vla, arguments, meant):
    answer = vla(*arguments)
    assert answer.code == 2 and f"did you mean {meant}?" in answer.err


def test_a_word_like_no_other_is_answered_without_a_guess(vla):
    assert "did you mean" not in vla("inspect", "policy.gguf", "--frobnicate").err
