# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a caller gives is brought into one form, or refused by name."""

import numpy as np
import PIL.Image
import pytest

from vla_cpp import BadObservation, StateSpec, UsageError, ViewSpec
from vla_cpp.observation import check_start, image_arg, noise_of, place, states_of

JOINTS = (StateSpec("observation.state", 2),)
JPEG, PNG = b"\xff\xd8\xff\xe0rest", b"\x89PNG\r\n\x1a\nrest"


def test_a_frame_that_is_not_contiguous_is_copied_with_its_pixels_in_place():
    frame = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    kind, rows = image_arg("top", frame[:, ::-1])
    assert kind == "rgb" and rows.flags.c_contiguous and (rows == frame[:, ::-1]).all()


@pytest.mark.parametrize(
    "data, kind", [(JPEG, "jpeg"), (PNG, "png"), (bytearray(PNG), "png"), (memoryview(JPEG), "jpeg")]
)
def test_the_kind_of_a_file_is_read_from_its_first_bytes(data, kind):
    assert image_arg("top", data) == (kind, bytes(data))


def test_none_declares_a_view_absent():
    assert image_arg("top", None) == ("absent", None)


@pytest.mark.parametrize(
    "image, found",
    [
        (np.zeros((4, 4, 3), np.float32), "float32"),
        (np.zeros((3, 4, 4), np.uint8), "(3, 4, 4)"),
        (np.zeros((4, 4), np.uint8), "(4, 4)"),
        (np.zeros((4, 4, 4), np.uint8), "(4, 4, 4)"),
        (np.zeros((0, 4, 3), np.uint8), "(0, 4, 3)"),
        (b"GIF89a", "6 bytes"),
        (b"", "0 bytes"),
        ([[[0, 0, 0]]], "list"),
        ("top.png", "str"),
    ],
)
def test_another_image_is_refused_by_the_view(image, found):
    with pytest.raises(BadObservation) as caught:
        image_arg("wrist", image)
    assert caught.value.where == "wrist" and found in caught.value.found


@pytest.mark.parametrize(
    "state", [[1, 2], (1.0, 2.0), np.array([1, 2], np.float64), [[1, 2]], {"observation.state": [1, 2]}]
)
def test_a_state_is_float32_by_name(state):
    ((name, values),) = states_of(state, JOINTS).items()
    assert name == "observation.state" and values.dtype == np.float32 and values.tolist() == [1, 2]


def test_a_pillow_image_is_a_frame_as_it_is():
    picture = PIL.Image.effect_noise((6, 4), 50).convert("RGB")
    kind, rows = image_arg("top", picture)
    assert kind == "rgb" and rows.shape == (4, 6, 3) and (rows == np.asarray(picture)).all()
    with pytest.raises(BadObservation, match=r'a picture of mode RGB, found mode RGBA; image.convert\("RGB"\)'):
        image_arg("top", picture.convert("RGBA"))


class Tensor:
    """As torch's, as far as a message looks."""

    def __init__(self, array):
        self.shape, self.dtype, self._array = array.shape, "torch." + str(array.dtype), array

    def numpy(self):
        return self._array


@pytest.mark.parametrize(
    "image, hint",
    [
        (np.zeros((3, 4, 6), np.float32), "(255 * image).round().astype(numpy.uint8).transpose(1, 2, 0)"),
        (np.zeros((4, 6, 3), np.float64), "(255 * image).round().astype(numpy.uint8)"),
        (np.zeros((3, 4, 6), np.uint8), "image.transpose(1, 2, 0) puts the channels last"),
        (Tensor(np.zeros((3, 4, 6), np.float32)), "(255 * image).round().byte().permute(1, 2, 0).numpy()"),
        (Tensor(np.zeros((3, 4, 6), np.uint8)), "image.permute(1, 2, 0).numpy()"),
    ],
)
def test_frames_as_lerobot_has_them_are_refused_with_how_to_convert_them(image, hint):
    with pytest.raises(BadObservation) as caught:
        image_arg("top", image)
    assert caught.value.hint.endswith(hint)


def test_one_number_is_a_state_of_one():
    assert states_of(0.5, (StateSpec("grip", 1),))["grip"].tolist() == [0.5]


@pytest.mark.parametrize(
    "state, found",
    [
        ([[1, 2], [3, 4]], "(2, 2)"),
        (["1", "2"], "list"),
        ("12", "str"),
        (None, "NoneType"),
        ([1, [2]], "list"),
        ([1 + 2j], "list"),
    ],
)
def test_a_state_that_is_no_vector_of_finite_numbers_is_refused(state, found):
    with pytest.raises(BadObservation) as caught:
        states_of(state, JOINTS)
    assert found in caught.value.found and caught.value.where == "observation.state"
    with pytest.raises(BadObservation, match='^state "arm"'):
        states_of({"arm": state}, JOINTS)


@pytest.mark.parametrize(
    "state, found", [([0, float("nan")], "nan"), ([0, float("inf")], "inf"), (np.array([0, 1e300]), "1e+300")]
)
def test_a_number_that_is_not_finite_is_refused_by_its_place(state, found):
    with pytest.raises(BadObservation) as caught:
        states_of(state, JOINTS)
    assert found in caught.value.found and caught.value.where == "observation.state[1]"


CAMERAS = (ViewSpec("observation.images.top", False, 8, 8, ("camera1",)), ViewSpec("rig.left", False, 8, 8))


@pytest.mark.parametrize(
    "given, where",
    [
        ("top", "observation.images.top"),
        ("camera1", "observation.images.top"),
        ("rig.left", "rig.left"),
        ("left", "rig.left"),
        ("right", 'view "right"'),
        ("", 'view ""'),
    ],
)
def test_an_error_names_a_view_as_the_runtime_does(given, where):
    assert place("view", given, CAMERAS) == where


@pytest.mark.parametrize("specs", [(), (StateSpec("a", 1), StateSpec("b", 1))])
def test_one_array_is_refused_where_the_policy_has_not_one_state(specs):
    with pytest.raises(BadObservation, match="a dict with"):
        states_of([0.0], specs)


def test_noise_has_the_policys_shape_or_is_refused():
    noise = np.arange(6.0).reshape(2, 3)
    assert (noise_of(noise[None], 2, 3) == noise).all()
    with pytest.raises(BadObservation, match=r"expected shape \(2, 3\), found \(3, 2\)"):
        noise_of(noise.T, 2, 3)


@pytest.mark.parametrize("seed", [-1, 2**64, 1.0, True, "7"])
def test_a_seed_is_a_number_of_64_bits(seed):
    with pytest.raises(UsageError):
        check_start(seed, None)


def test_seed_and_noise_together_are_refused():
    check_start(2**64 - 1, None)
    check_start(np.uint64(3), None)
    with pytest.raises(UsageError, match="both"):
        check_start(0, [[0.0]])
