# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla run: what a user reads and what a script may rely on."""

import re
import shutil

import gguf
import image_files
import numpy as np
import pytest
from golden_cases import FLOAT32, NAMES, Golden, tensors
from program import every_third_if_sanitized

STAGES = ["load", "decode", "preprocess", "tokenize", "plan", "vision", "prefix", "steps", "postprocess"]


def actions(answer):
    return np.array(answer.json()["actions"], np.float32)


@pytest.mark.parametrize("name", every_third_if_sanitized(NAMES))
def test_actions_of_a_golden_case_equal_the_references_within_1e_5(vla, name):
    case = Golden(name)
    got, expected = actions(vla(*case.arguments(options=["--json", *FLOAT32]))), tensors(case.expected)["actions"]
    assert got.shape == expected.shape
    assert np.abs(got - expected).max() <= 1e-5 * np.abs(expected).max()


def test_json_is_the_last_line_and_one_object_with_the_promised_members(vla, golden):
    result = vla(*golden.arguments())
    answer = result.json()
    assert np.isfinite(answer["actions"]).all() and np.shape(answer["actions"]) == (5, 7)
    assert answer["action_names"] == [f"action.{i}" for i in range(7)]
    assert list(answer["timing_ms"]) == STAGES and all(ms >= 0 for ms in answer["timing_ms"].values())
    bundle = answer["bundle"]
    assert (bundle["path"], bundle["arch"], bundle["dtype"]) == (str(golden.bundle), "smolvla", "bf16")
    assert re.fullmatch("xxh3:[0-9a-f]{16}", bundle["checksum"])
    assert result.err == ""


def write_taps(file, **taps):
    writer = gguf.GGUFWriter(str(file), "vla-taps")
    for name, values in taps.items():
        writer.add_tensor(name, np.ascontiguousarray(values, np.float32))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def test_a_recorded_value_is_gone_on_from_and_told(vla, golden, tmp_path):
    recorded, changed, out = tmp_path / "recorded.gguf", tmp_path / "changed.gguf", ["--json", *FLOAT32]
    tap = ["--tap", "prefix", "--taps-out", recorded]
    before = actions(vla(*golden.arguments(options=[*out, *tap])))
    same = vla(*golden.arguments(options=[*out, "--inject", recorded]))
    assert np.abs(actions(same) - before).max() <= 1e-5 * np.abs(before).max()
    assert same.json()["notes"] == ["prefix was injected, not computed"] and "prefix was injected" in same.err
    write_taps(changed, prefix=tensors(recorded)["prefix"][::-1])
    other = actions(vla(*golden.arguments(options=[*out, "--inject", changed])))
    assert np.abs(other - before).max() > 1e-3 * np.abs(before).max()


def test_a_value_that_there_is_not_and_what_is_no_file_of_values_are_refused(vla, golden, tmp_path):
    wrong = tmp_path / "wrong.gguf"
    write_taps(wrong, prefiks=np.zeros((2, 3)))
    vla(*golden.arguments(options=["--inject", wrong])).refused("bad_observation", "injected prefiks", "prefix")
    vla(*golden.arguments(options=["--inject", golden.noise])).refused("bad_bundle", "a GGUF file")
    vla(*golden.arguments(options=["--inject", tmp_path / "none.gguf"])).refused("io", "none.gguf")


def test_out_writes_the_numbers_of_the_json(vla, golden, tmp_path):
    answer = vla(*golden.arguments(options=["--json", "--out", tmp_path / "chunk.npy"]))
    chunk = np.load(tmp_path / "chunk.npy")
    assert chunk.dtype == np.float32 and np.array_equal(chunk, actions(answer))


def test_the_table_shows_the_numbers_of_the_json_and_the_time_of_each_stage(vla, golden):
    lines = vla(*golden.arguments(options=[])).out.splitlines()
    assert lines[0].split() == ["step", *(f"action.{i}" for i in range(7))]
    rows = np.array([line.split() for line in lines[1:6]], float)
    assert list(rows[:, 0]) == list(range(5))
    assert np.abs(rows[:, 1:] - actions(vla(*golden.arguments()))).max() <= 0.5001e-4
    assert len(lines) == 8 and re.sub(r" [\d.]+(?=,|$)", "", lines[6]) == "ms: " + ", ".join(STAGES)


def test_kernels_and_precision_are_told_in_the_json_and_in_plain_words(vla, golden):
    for options in ([], FLOAT32, ["--kernels", "ggml"]):
        told = vla(*golden.arguments(options=["--json", *options])).json()
        words = "bf16 products, sums in float32; --kernels float32 avoids them"
        assert told["precision"] == ("bf16" if told["kernels"] in ("amx", "avx512_bf16", "neon_bf16") else "f32")
        line = f"kernels: {told['kernels']}, {words if told['precision'] == 'bf16' else 'float32'}"
        assert vla(*golden.arguments(options=options)).out.splitlines()[-1] == line
    assert told["kernels"] == "ggml"


def seeded(vla, golden, *options):
    arguments = [a for a in golden.arguments(options=[]) if a not in ("--noise", golden.noise)]
    return vla(*arguments, "--json", *options)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(vla, golden, tmp_path):
    files = [tmp_path / f"{i}.npy" for i in range(3)]
    for file, seed in zip(files, (7, 7, 8)):
        assert seeded(vla, golden, "--seed", seed, "--out", file).json()["seed"] == seed
    first, again, other = (file.read_bytes() for file in files)
    assert first == again and first != other


def test_without_noise_and_seed_the_seed_that_was_drawn_gives_the_chunk_again(vla, golden):
    free = seeded(vla, golden)
    seed = re.search(r"--seed (\d+)", free.err)[1]
    assert free.json()["seed"] == int(seed)
    assert np.array_equal(actions(free), actions(seeded(vla, golden, "--seed", seed)))


def test_a_call_that_is_refused_says_nothing_of_a_seed(vla, golden):
    answer = seeded(vla, golden, "--kernels", "none")
    assert answer.code == 2 and answer.err.startswith("error: ") and answer.err.count("\n") == 1


def test_the_largest_seed_is_a_seed(vla, golden):
    assert seeded(vla, golden, "--seed", 2**64 - 1).json()["seed"] == 2**64 - 1


def test_full_feature_names_mean_the_same_as_their_last_parts(vla, golden):
    full = {f"observation.images.{view}": file for view, file in golden.images.items()}
    state = "observation.state=" + ",".join(map(repr, golden.state))
    assert np.array_equal(actions(vla(*golden.arguments(images=full, state=state))), actions(vla(*golden.arguments())))


@pytest.mark.parametrize("alias", ["observation.images.left", "left"])
def test_the_name_that_a_view_had_before_renaming_is_understood(vla, alias):
    case = Golden("absent_view")
    images = {alias if view == "base" else view: file for view, file in case.images.items()}
    assert np.array_equal(actions(vla(*case.arguments(images=images))), actions(vla(*case.arguments())))


def test_the_order_of_images_on_the_command_line_does_not_matter(vla, golden):
    turned = dict(reversed(golden.images.items()))
    assert np.array_equal(actions(vla(*golden.arguments(images=turned))), actions(vla(*golden.arguments())))


def test_a_view_may_be_absent_where_it_is_said_and_that_changes_the_chunk(vla, golden):
    absent = actions(vla(*golden.arguments(images=golden.with_image("camera2", None))))
    assert np.isfinite(absent).all() and not np.allclose(absent, actions(vla(*golden.arguments())), atol=1e-4)


def test_an_empty_camera_need_not_be_mentioned(vla):
    case = Golden("absent_view")
    images = {view: file for view, file in case.images.items() if view != "empty_camera_0"}
    assert np.array_equal(actions(vla(*case.arguments(images=images))), actions(vla(*case.arguments())))


def test_the_state_may_be_named(vla, golden):
    named = "state=" + ",".join(map(repr, golden.state))
    assert np.array_equal(actions(vla(*golden.arguments(state=named))), actions(vla(*golden.arguments())))


def test_blanks_exponents_and_numbers_too_small_for_float32_are_numbers_of_a_state(vla, golden):
    plain = "1e-3, -2.5E-1,0,0.5,-0.5,0"
    tiny = "0.001,-0.25,1e-60,.5,-.5,-1e-300"
    assert np.array_equal(actions(vla(*golden.arguments(state=plain))), actions(vla(*golden.arguments(state=tiny))))


@pytest.mark.parametrize("name, bucket", [("smolvla/long_text", 12), ("pi0/long_text", 12), ("pi05/long_text", 24)])
def test_an_instruction_beyond_the_bucket_is_cut_and_the_user_is_told(vla, name, bucket):
    result = vla(*Golden(name).arguments())
    assert re.fullmatch(rf"note: instruction: \d+ tokens, cut to the first {bucket}\n", result.err)
    assert result.json()["notes"] == [result.err.removeprefix("note: ").rstrip("\n")]


def test_a_frame_as_npy_gives_the_chunk_of_the_same_png(vla, golden, tmp_path):
    frame = np.random.default_rng(1).integers(0, 256, (20, 30, 3), np.uint8)
    np.save(tmp_path / "frame.npy", frame)
    (tmp_path / "frame.png").write_bytes(image_files.png(frame))
    chunks = [
        actions(vla(*golden.arguments(images=golden.with_image("camera1", tmp_path / f"frame.{kind}"))))
        for kind in ("npy", "png")
    ]
    assert np.array_equal(*chunks)


def test_a_bundle_path_that_is_not_utf_8_does_not_spoil_the_json(vla, golden, tmp_path):
    path = bytes(tmp_path) + b"/policy-\xff.gguf"
    shutil.copy(bytes(golden.bundle), path)
    assert np.shape(vla(*golden.arguments(bundle=path)).json()["actions"]) == (5, 7)


def test_help_of_every_subcommand_teaches_with_an_example(vla):
    for command in (["--help"], ["run", "--help"], ["inspect", "--help"], ["compare", "--help"]):
        answer = vla(*command)
        assert answer.code == 0 and answer.err == "" and "\n  vla " in answer.out
    assert "Exit codes: 0 done, 1 internal, 2 usage, 3 bad_bundle, 4 bad_observation" in vla("--help").out
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", vla("--version").out)


def test_noise_with_the_references_batch_of_one_is_the_same_noise(vla, golden, tmp_path):
    np.save(tmp_path / "batch.npy", np.load(golden.noise)[None])
    batched = actions(vla(*golden.arguments(noise=tmp_path / "batch.npy")))
    assert np.array_equal(batched, actions(vla(*golden.arguments())))
