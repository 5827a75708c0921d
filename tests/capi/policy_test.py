# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla_cpp.Policy: the engine in a Python process."""

import json
import os
import pickle
import resource
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from commands import ROOT
from golden_cases import NAMES, Golden
from image_files import hostile_pngs
from PIL import Image

import vla_cpp

FAMILY = hostile_pngs(Golden("two_views").images["camera1"].read_bytes())


def frames(case):
    """The images of a case as arrays; None where a view is declared absent."""
    return {
        view: None if file is None else np.array(Image.open(file).convert("RGB")) for view, file in case.images.items()
    }


@pytest.fixture(scope="module")
def policy():
    with vla_cpp.Policy(Golden("two_views").bundle, threads=2) as policy:
        yield policy


@pytest.fixture
def act(policy, golden):
    """A sound call, of which a test changes one thing."""

    def call(**changes):
        return policy.act(**{**dict(images=frames(golden), state=golden.state, text=golden.text, seed=3), **changes})

    return call


@pytest.mark.parametrize("name", NAMES)
def test_every_golden_case_gives_the_bytes_of_vla_run_from_a_seed_and_from_noise(name, chunk_of_run):
    case = Golden(name)
    observation = dict(images=frames(case), state=case.state if isinstance(case.state, dict) else {"state": case.state}, text=case.text)
    with vla_cpp.Policy(case.bundle, threads=2) as policy:
        for seed in (0, 2**64 - 1):
            chunk = policy.act(**observation, seed=seed)
            assert np.asarray(chunk).tobytes() == chunk_of_run(case, seed).tobytes() and chunk.seed == seed
        chunk = policy.act(**observation, noise=np.load(case.noise))
        assert np.asarray(chunk).tobytes() == chunk_of_run(case).tobytes() and chunk.seed is None


def test_a_frame_in_any_memory_order_and_the_bytes_of_its_file_are_the_same_frame(act, golden):
    expected = np.asarray(act())
    rgb = frames(golden)
    bgr = {view: np.ascontiguousarray(frame[:, :, ::-1]) for view, frame in rgb.items()}
    wide = {view: np.pad(frame, ((0, 0), (3, 2), (0, 0)))[:, 3:-2] for view, frame in rgb.items()}
    for images in (
        {view: frame[:, :, ::-1] for view, frame in bgr.items()},
        {view: np.asfortranarray(frame) for view, frame in rgb.items()},
        wide,
        {view: file.read_bytes() for view, file in golden.images.items()},
        {view: bytearray(file.read_bytes()) for view, file in golden.images.items()},
    ):
        assert np.array_equal(act(images=images), expected)


def test_state_may_be_float64_and_come_by_name_or_alone(act, golden):
    expected = np.asarray(act())
    for state in (
        np.array(golden.state),
        tuple(golden.state),
        {"observation.state": golden.state},
        {"state": golden.state},
    ):
        assert np.array_equal(act(state=state), expected)


def test_int8_is_near_float32_and_told_and_must_be_asked_for():
    """The shipped policy on a recorded frame; a chunk's distance in parts of its root mean square."""
    bundle, frame = ROOT / "models/metaworld-tiny.gguf", ROOT / "examples/metaworld/episodes/faucet-open/step_00.png"
    observation = dict(images={"corner4": frame.read_bytes()}, state=[0.0045, 0.4003, 0.1957, 1], text="open the faucet", seed=1)
    chunks, precisions = {}, {}
    for kernels in ("float32", "int8", None):
        with vla_cpp.Policy(bundle, threads=1, kernels=kernels) as policy:
            chunks[kernels], precisions[kernels] = np.asarray(policy.act(**observation)), policy.spec.precision
    assert precisions["int8"] == "int8" and precisions["float32"] == "f32" and precisions[None] in ("f32", "bf16")

    def distance(kernels):
        return np.sqrt(np.mean((chunks[kernels] - chunks["float32"]) ** 2) / np.mean(chunks["float32"] ** 2))

    assert distance(None) < distance("int8") < 0.02


def test_the_policy_for_libero_answers_a_recorded_look_as_pytorch_did():
    look = ROOT / "examples/libero/look"
    told, expected = json.loads((look / "look.json").read_text()), np.load(look / "expected.npy")
    frames = {view: (look / f"{view}.png").read_bytes() for view in ("image", "image2")}
    with vla_cpp.Policy(ROOT / "models/libero-object-tiny.gguf", threads=1, kernels="float32") as policy:
        chunk = policy.act(images=frames, state=told["state"], text=told["sentence"], noise=np.load(look / "noise.npy"))
    assert np.abs(np.asarray(chunk) - expected).max() < 1e-6 * np.abs(expected).max()


def test_the_policy_for_aloha_answers_a_recorded_look_nearly_as_pytorch_did_before_it_was_quantized():
    look = ROOT / "examples/aloha/look"
    told, expected = json.loads((look / "look.json").read_text()), np.load(look / "expected.npy")
    with vla_cpp.Policy(ROOT / "models/aloha-cube-tiny.gguf", threads=1, kernels="float32") as policy:
        chunk = np.asarray(policy.act(images={"observation.images.top": (look / "top.png").read_bytes()}, state=told["state"]))
        assert policy.spec.action_names[0] == "left_waist" and policy.spec.rate_hz == 50
    assert 0 < np.sqrt(np.mean((chunk - expected) ** 2) / np.mean(expected**2)) < 0.02


def test_without_seed_and_noise_the_seed_that_was_drawn_gives_the_chunk_again(act):
    first, second = act(seed=None), act(seed=None)
    assert first.seed != second.seed and not np.array_equal(first, second)
    assert np.array_equal(act(seed=first.seed), first)


def test_a_chunk_says_what_its_numbers_are(act, policy, vla, golden):
    chunk, spec = act(capture_time_ns=17), policy.spec
    assert np.asarray(chunk).dtype == np.float32 and np.shape(chunk) == (spec.horizon, spec.d_action) == (5, 7)
    assert chunk.names == spec.action_names and chunk.bundle == spec.bundle and chunk.rate_hz == spec.rate_hz
    assert ["load", *chunk.timing] == list(vla(*golden.arguments()).json()["timing_ms"])
    assert (chunk.notes, chunk.capture_time_ns, chunk.seed) == ((), 17, 3)
    chunk.actions[:] = 0  # the caller's own memory
    assert np.asarray(act()).any()


def test_the_spec_is_what_the_program_says_of_the_bundle(vla, policy, golden):
    told, spec = json.loads(vla("inspect", golden.bundle, "--json").out), policy.spec
    keys = told["keys"]
    assert [v.name for v in spec.views] == keys["observation.views"] and spec.min_views == keys["observation.min_views"]
    assert [v.optional for v in spec.views] == [bool(o) for o in keys["observation.view_optional"]]
    assert [v.aliases for v in spec.views] == [(a,) if a else () for a in keys["observation.view_aliases"]]
    assert [(s.name, s.width) for s in spec.states] == list(
        zip(keys["observation.states"], keys["observation.state_dims"])
    )
    assert [n for s in spec.states for n in s.names] == keys["observation.state_names"]
    assert [u for s in spec.states for u in s.units] == keys["observation.state_units"]
    assert list(spec.action_names) == keys["action.names"] and list(spec.action_units) == keys["action.units"]
    assert 1 <= spec.horizon <= spec.noise_rows
    assert (spec.noise_rows, spec.d_noise, spec.noise) == (
        keys["policy.horizon"],
        keys["policy.d_action"],
        keys["solver.noise"],
    )
    assert (spec.bundle.name, spec.bundle.checksum) == (golden.bundle.name, told["bundle"]["checksum"])
    assert spec.bundle.source == keys["vla.source.name"] and spec.precision == told["precision"]


@pytest.mark.parametrize(
    "changes, error, part",
    [
        (dict(images={}), vla_cpp.BadObservation, "observation.images.camera1"),
        (dict(images={"camera1": np.zeros((8, 8, 3), np.float32)}), vla_cpp.BadObservation, "observation.images.camera1: "),
        (dict(images={"camera1": np.zeros((8, 8), np.uint8)}), vla_cpp.BadObservation, "observation.images.camera1: "),
        (dict(images={"camera1": b"GIF89a"}), vla_cpp.BadObservation, "observation.images.camera1: "),
        (dict(images={"camera1": b"\xff\xd8\xff\xe0"}), vla_cpp.BadObservation, "camera1"),
        (dict(images={"cam\0era1": None}), vla_cpp.BadObservation, "images"),
        (dict(images={"\ud800": None}), vla_cpp.BadObservation, "images"),
        (dict(images=None), vla_cpp.BadObservation, "images: expected a dict by name, found None"),
        (dict(images=np.zeros((8, 8, 3), np.uint8)), vla_cpp.BadObservation, "images: expected a dict by name, found ndarray"),
        (dict(images={"camera1": "top.png"}), vla_cpp.BadObservation, "found str; numpy.asarray(image) of a picture, open("),
        (dict(images={"camera1": None, "camera2": None}), vla_cpp.BadObservation, "at least 1"),
        (dict(state=[0.0] * 5), vla_cpp.BadObservation, "observation.state"),
        (dict(state=[0.0] * 5 + [float("nan")]), vla_cpp.BadObservation, "nan"),
        (dict(state=[0.0] * 5 + [1e300]), vla_cpp.BadObservation, "finite"),
        (dict(state={"arm": [0.0] * 6}), vla_cpp.BadObservation, "arm"),
        (dict(text=None), vla_cpp.BadObservation, "instruction"),
        (dict(text=b"open"), vla_cpp.BadObservation, "instruction"),
        (dict(text="\ud800"), vla_cpp.BadObservation, "instruction"),
        (dict(text="a" * 70000), vla_cpp.BadObservation, "instruction"),
        (dict(noise=np.zeros((5, 8))), vla_cpp.UsageError, "both"),
        (dict(seed=None, noise=np.zeros((8, 5))), vla_cpp.BadObservation, "noise"),
        (dict(seed=None, noise=np.full((5, 8), 3e38)), vla_cpp.BadAction, ""),
        (dict(seed=-1), vla_cpp.UsageError, "seed"),
        (dict(seed=2**64), vla_cpp.UsageError, "seed"),
        (dict(seed=1.5), vla_cpp.UsageError, "seed"),
    ],
)
def test_what_the_policy_cannot_take_is_an_exception_of_its_class_and_the_next_call_is_answered(
    act, changes, error, part
):
    with pytest.raises(error) as caught:
        act(**changes)
    assert part in str(caught.value) and caught.value.found
    assert np.isfinite(act()).all()


def test_a_state_far_beyond_what_the_policy_has_seen_is_noted_or_refused(golden):
    observation = dict(images=frames(golden), state=[*golden.state[:-1], 1e30], text=golden.text, seed=1)
    with vla_cpp.Policy(golden.bundle, threads=1) as policy:
        assert "far from what the policy has seen" in policy.act(**observation).notes[0]
    with vla_cpp.Policy(golden.bundle, threads=1, strict_state=True) as policy:
        with pytest.raises(vla_cpp.BadObservation, match="at most 10 when normalized"):
            policy.act(**observation)


def test_an_error_carries_all_its_parts(act):
    with pytest.raises(vla_cpp.BadObservation) as caught:
        act(state=[0.0] * 5)
    error = caught.value
    assert (error.code, error.where, error.expected, error.found) == (
        "bad_observation",
        "observation.state",
        "6 numbers",
        "5",
    )


@pytest.mark.parametrize(
    "path, options, error, part",
    [
        ("/nonexistent.gguf", {}, vla_cpp.IoError, "/nonexistent.gguf"),
        (ROOT / "README.md", {}, vla_cpp.BadBundle, "README.md"),
        ("a\0b", {}, vla_cpp.UsageError, "path"),
        (None, {}, vla_cpp.UsageError, "path"),
        ("", {}, vla_cpp.UsageError, "path"),
        (Golden("two_views").bundle, {"threads": -1}, vla_cpp.UsageError, "threads"),
        (Golden("two_views").bundle, {"threads": 2**40}, vla_cpp.UsageError, "threads"),
        (Golden("two_views").bundle, {"memory": -1}, vla_cpp.UsageError, "memory"),
        (Golden("two_views").bundle, {"memory": 1}, vla_cpp.OutOfMemory, "memory"),
        (Golden("two_views").bundle, {"kernels": "abacus"}, vla_cpp.UsageError, "abacus"),
    ],
)
def test_a_policy_that_cannot_be_opened_is_a_typed_exception(path, options, error, part):
    with pytest.raises(error, match=part):
        vla_cpp.Policy(path, **options)


def test_threads_share_a_policy_and_get_the_answers_that_each_would_get_alone(act):
    alone = [np.asarray(act(seed=seed)) for seed in range(6)]
    same = []

    def work(seed):
        same.extend(np.array_equal(act(seed=seed), alone[seed]) for _ in range(4))

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert same == [True] * 24


def test_a_closed_policy_refuses_and_closing_again_does_nothing(golden):
    policy = vla_cpp.Policy(golden.bundle, threads=1)
    policy.close()
    policy.close()
    with pytest.raises(vla_cpp.UsageError, match="closed"):
        policy.act(images=frames(golden), state=golden.state, text=golden.text, seed=1)
    assert policy.spec.horizon == 5


def test_a_child_process_and_a_pickle_are_refused_instead_of_hanging(policy, act):
    with pytest.raises(vla_cpp.UsageError, match="pickle"):
        pickle.dumps(policy)
    child = os.fork()
    if child == 0:
        try:
            act()
        except vla_cpp.UsageError:
            os._exit(0)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def in_python(code, **environment):
    paths = {"PYTHONPATH": str(ROOT / "python"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", f"import vla_cpp\n{code}"]
    return subprocess.run(
        command, env={**os.environ, **paths, **environment}, capture_output=True, text=True, timeout=60
    )


def test_a_library_that_is_missing_or_another_is_told_by_its_path(tmp_path):
    (tmp_path / "text.so").write_text("not a library")
    for library, part in (
        (tmp_path / "none.so", "no such file"),
        (tmp_path / "text.so", "text.so"),
        ("libm.so.6", "no such file"),
    ):
        result = in_python("vla_cpp.Policy('x.gguf')", VLA_LIBRARY=str(library))
        assert "IoError" in result.stderr and part in result.stderr


def test_weights_that_no_memory_holds_are_out_of_memory_and_the_process_goes_on(golden):
    result = in_python(f"""
import resource
small = vla_cpp.Policy({str(golden.bundle)!r}, threads=1)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
limit = used + (14 << 20)  # the file fits, and its weights, widened to twice the size, do not
resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
try:  # plain ggml widens the weights to twice their size; other kernels read them in place
    vla_cpp.Policy({str(ROOT / "models/metaworld-tiny.gguf")!r}, threads=1, kernels="ggml")
except vla_cpp.OutOfMemory as error:
    print(error.found)
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
print(vla_cpp.Policy({str(ROOT / "models/metaworld-tiny.gguf")!r}, threads=1).spec.horizon)
""")
    assert result.returncode == 0, result.stderr
    assert len(result.stdout.splitlines()) == 2 and result.stdout.endswith("16\n")


@pytest.mark.parametrize("what", FAMILY)
def test_a_hostile_png_takes_neither_memory_nor_time(act, golden, what):
    def most_memory():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10

    data, is_image = FAMILY[what]
    images = {**frames(golden), "camera1": data}
    act()
    before, start = most_memory(), time.monotonic()
    if is_image:
        assert np.isfinite(np.asarray(act(images=images))).all()
    else:
        with pytest.raises(vla_cpp.BadObservation, match="observation.images.camera1"):
            act(images=images)
    assert time.monotonic() - start < 5 and most_memory() < before + (64 << 20)
