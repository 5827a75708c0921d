# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Every observation that the policy cannot answer is one typed error that names its place."""

import numpy as np
import pytest
from golden_cases import Golden
from image_files import jpeg_with_size, png, png_header, png_of_rows


@pytest.fixture
def refused(vla, golden):
    """Calls `vla run` with one thing changed; it must be refused as `code`."""
    return lambda code, *parts, **change: vla(*golden.arguments(**change)).refused(code, *parts)


@pytest.fixture
def frame_refused(refused, golden, tmp_path):
    """The same with these bytes as the frame of camera1."""

    def check(data, *parts, code="bad_observation"):
        path = tmp_path / "frame"
        path.write_bytes(data)
        return refused(code, "observation.images.camera1: ", *parts, images=golden.with_image("camera1", path))

    return check


# Names and counts.


def test_an_unknown_view_is_refused_with_the_names_that_there_are(refused, golden):
    images = {**golden.images, "camera3": golden.images["camera1"]}
    refused(
        "bad_observation",
        'view "camera3": expected one of observation.images.camera1, observation.images.camera2',
        images=images,
    )


def test_a_view_that_is_not_mentioned_is_refused(refused, golden):
    images = {"camera1": golden.images["camera1"]}
    refused(
        "bad_observation",
        "observation.images.camera2: expected an image, or the view declared absent, found neither",
        images=images,
    )


def test_a_view_under_two_of_its_names_is_refused(refused, golden):
    images = {**golden.images, "observation.images.camera2": golden.images["camera2"]}
    refused("bad_observation", "observation.images.camera2: expected one value", images=images)


def test_no_view_at_all_is_refused(refused):
    refused("bad_observation", "expected at least 1 of the views", images={"camera1": None, "camera2": None})


def test_a_wrong_name_of_the_state_is_refused(refused):
    refused("bad_observation", 'state "gripper": expected one of observation.state', state="gripper=0,0,0,0,0,0")


@pytest.mark.parametrize("count", [1, 5, 7, 1000])
def test_a_wrong_count_of_state_numbers_is_refused(refused, count):
    refused("bad_observation", f"observation.state: expected 6 numbers, found {count}", state=",".join(["0"] * count))


# Numbers.


@pytest.mark.parametrize("value", ["nan", "-nan", "inf", "-inf", "1e39"])
@pytest.mark.parametrize("place", [0, 4])
def test_a_state_number_that_is_not_finite_is_refused_with_its_place(refused, value, place):
    numbers = ["0"] * 6
    numbers[place] = value
    refused("bad_observation", f"observation.state[{place}]: expected a finite number, found", state=",".join(numbers))


def saved(tmp_path, noise):
    np.save(tmp_path / "noise.npy", noise)
    return tmp_path / "noise.npy"


@pytest.mark.parametrize("shape", [(5, 7), (8, 5), (40,), (1, 5, 8, 1), (0,), (6, 8)])
def test_noise_of_another_shape_is_refused_even_when_its_count_fits(refused, tmp_path, shape):
    refused(
        "bad_observation",
        "noise: expected shape (5, 8), found",
        noise=saved(tmp_path, np.zeros(shape, np.float32)),
    )


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.uint8, np.int32])
def test_noise_of_another_type_is_refused(refused, tmp_path, dtype):
    refused("bad_observation", "noise: expected", noise=saved(tmp_path, np.zeros((5, 8), dtype)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_noise_that_is_not_finite_is_refused(refused, tmp_path, value):
    refused(
        "bad_observation", "noise: expected finite numbers", noise=saved(tmp_path, np.full((5, 8), value, np.float32))
    )


def test_noise_so_large_that_actions_overflow_is_a_bad_action(refused, tmp_path):
    refused(
        "bad_action",
        'actions[0]["action.0"]: expected a finite number',
        noise=saved(tmp_path, np.full((5, 8), 3e38, np.float32)),
    )


def test_noise_from_a_file_that_is_no_array_is_refused(refused, golden):
    refused("bad_observation", "expected a .npy array", noise=golden.bundle)


def test_noise_from_a_file_that_is_missing_is_an_io_error(refused, tmp_path):
    refused("io", "nothing.npy: expected a file", noise=tmp_path / "nothing.npy")


# The instruction.


def test_an_instruction_of_100_kilobytes_is_refused_by_its_length(refused):
    refused("bad_observation", "instruction: expected at most 65536 bytes of text", text="pick up " * 12_500)


def test_an_instruction_that_is_not_utf_8_is_refused_with_the_offset(refused):
    refused("bad_observation", "instruction: expected UTF-8 text", "offset 5", text=b"open \xff door")


# Image files.


def test_an_image_of_no_bytes_is_refused(frame_refused):
    frame_refused(b"")


def test_a_text_is_not_an_image(frame_refused):
    frame_refused(b"a photograph of a cube\n" * 100)


@pytest.mark.parametrize("part", [0.02, 0.5, 0.99])
def test_a_truncated_png_is_refused(frame_refused, golden, part):
    data = golden.images["camera1"].read_bytes()
    frame_refused(data[: int(len(data) * part)])


@pytest.mark.parametrize("part", [0.02, 0.5, 0.99])
def test_a_truncated_jpeg_is_refused(frame_refused, part):
    data = Golden("long_text").images["wrist"].read_bytes()
    frame_refused(data[: int(len(data) * part)])


def test_a_png_with_one_flipped_bit_is_refused(frame_refused, golden):
    data = bytearray(golden.images["camera1"].read_bytes())
    data[len(data) // 2] ^= 16
    frame_refused(bytes(data))


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: png_of_rows(20_000, 20_000, 1), id="short png"),
        pytest.param(lambda: png_of_rows(20_000, 20_000, 20_000), id="whole png"),
        pytest.param(
            lambda: jpeg_with_size(Golden("long_text").images["wrist"].read_bytes(), 20_000, 20_000), id="jpeg header"
        ),
    ],
)
def test_an_image_of_20000_by_20000_pixels_is_refused_before_memory_is_taken(frame_refused, make):
    answer = frame_refused(make(), "20000 x 20000")
    assert answer.seconds < 10 and answer.peak < 1 << 29  # the pixels would be 1.2 GB


@pytest.mark.parametrize("width, height", [(0, 20), (20, 0), (2**31 - 1, 2**31 - 1)])
def test_an_image_of_an_impossible_size_is_refused(frame_refused, width, height):
    frame_refused(png_header(width, height))


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((3, 4, 5), np.uint8),
        np.zeros((0, 4, 3), np.uint8),
        np.zeros((4, 4, 3), np.float64),
        np.full((4, 4, 3), 1.5, np.float32),
        np.full((4, 4, 3), np.nan, np.float32),
    ],
    ids=["two axes", "four channels", "channels first", "no rows", "float64", "above 1", "nan"],
)
def test_an_array_that_is_no_frame_is_refused(frame_refused, tmp_path, array):
    np.save(tmp_path / "array.npy", array)
    frame_refused((tmp_path / "array.npy").read_bytes())


def test_a_missing_image_is_an_io_error(refused, golden, tmp_path):
    refused("io", "nothing.png: expected a file", images=golden.with_image("camera1", tmp_path / "nothing.png"))


def test_a_folder_is_not_an_image(refused, golden, tmp_path):
    refused("io", "something that is not a regular file", images=golden.with_image("camera1", tmp_path))


def test_an_image_of_one_pixel_is_an_image(vla, golden, tmp_path):
    (tmp_path / "dot.png").write_bytes(png(np.full((1, 1, 3), 200, np.uint8)))
    images = golden.with_image("camera1", tmp_path / "dot.png")
    assert np.isfinite(vla(*golden.arguments(images=images)).json()["actions"]).all()
