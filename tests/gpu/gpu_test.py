# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""--device vulkan or cuda: every golden case, all doors, limits and refusals. One process for each case, as a robot has one."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from budgets import budgets, check_changing_file
from gguf import GGUFReader
from golden_cases import FLOAT32, NAMES, ROOT, Golden, tensors
from conftest import BINARY, KIND
from program import EXIT
from vla_cpp.convert import read_bundle
from vla_cpp.convert.bundle import ARRAY, CHECKSUM_KEY, SCALARS, STRING, BundleWriter, Key, TensorInfo

# In float32, which CUDA is asked for: there matrices are multiplied as they are stored.
KERNELS = {"kernels": "float32"} if KIND == "cuda" else {}
DEVICE = ["--device", KIND, *(["--kernels", "float32"] if KERNELS else [])]
IN_BF16 = ["--device", KIND, "--kernels", "bf16"]
LIMITS_OF_VULKAN = pytest.mark.skipif(KIND != "vulkan", reason="only Vulkan's buffers can be made small")


def smallest_of_each_family():
    by_size = sorted(NAMES, key=lambda name: -Golden(name).bundle.stat().st_size)
    return sorted({name.split("/")[0]: name for name in by_size}.values())


# On a driver in software the smallest case of every sixth family, and on Vulkan's, which compiles shaders for up to a minute a case,
# of every twelfth; make test-vulkan and make test-cuda try all cases.
CASES = NAMES if "VLA_ALL_CASES" in os.environ else smallest_of_each_family()[:: 12 if KIND == "vulkan" else 6]
LIMIT = 300  # seconds, where every shader is compiled for the first time
# Sums in another order, and a driver's own exp, sin and division: 1e-6 to 1e-5 of the largest in each operation.
TOLERANCE = 1e-4


def actions(answer):
    return np.array(answer.json()["actions"], np.float32)


@pytest.mark.parametrize("name", CASES)
def test_every_tap_of_a_golden_case_matches_the_reference_within_1e_4(vla, name, tmp_path):
    case, got = Golden(name), tmp_path / "got.gguf"
    run = vla(*case.arguments(options=["--json", *DEVICE, "--tap", "*", "--taps-out", got]), limit=LIMIT)
    assert run.json()["device"].startswith(f"{KIND}:0, "), run.err
    compared = vla("compare", case.expected, got, "--tolerance", TOLERANCE)
    assert compared.code == 0, compared.out + compared.err


@pytest.mark.parametrize("name", [name for name in CASES if name.split("/")[0] not in ("openvla", "pi0_fast")])  # equal tokens, or other ones
def test_in_bf16_the_chunk_is_nearer_to_float32_than_pytorchs_bf16(vla, name, tmp_path):
    case, got = Golden(name), tmp_path / "got.gguf"
    bf16 = [*IN_BF16, "--tap", "chunk", "--taps-out", got]
    told = vla(*case.arguments(options=["--json", *bf16]), limit=LIMIT).json()
    assert told["precision"] == ("int8" if name.startswith("bitvla/") else "bf16"), told
    expected, ours = tensors(case.expected), tensors(got)["chunk"]
    error, allowed = (np.abs(chunk - expected["chunk"]) for chunk in (ours, expected["chunk.bf16"]))
    assert 0 < np.sqrt(np.mean(error**2)) <= np.sqrt(np.mean(allowed**2))
    assert error.max() <= allowed.max()


def widened(bundle, path):
    """A bundle with its bf16 tensors, number by number, in float32."""
    kinds = {number: kind for kind, (number, _) in SCALARS.items()} | {STRING: "string"}
    fields = [field for name, field in GGUFReader(bundle).fields.items() if not name.startswith("GGUF.") and name != CHECKSUM_KEY]
    kind = lambda types: kinds[types[0]] if types[0] != ARRAY else kinds[types[1]] + "[]"  # noqa: E731
    keys = [Key(field.name, kind([int(t) for t in field.types]), field.contents()) for field in fields]
    content = read_bundle(str(bundle))
    wide = {
        name: (tensor.astype(np.uint32) << 16).view(np.float32) if content.dtypes[name] == "bf16" else tensor
        for name, tensor in content.tensors.items()
    }
    dtypes = {name: "f32" if dtype == "bf16" else dtype for name, dtype in content.dtypes.items()}
    with BundleWriter(str(path), keys, [TensorInfo(name, t.shape, dtypes[name]) for name, t in wide.items()]) as out:
        for name, tensor in wide.items():
            out.write(name, tensor)
    return path


def test_in_bf16_large_matrices_of_float32_are_rounded_and_the_answer_tells_it(vla, tmp_path):
    stored = ROOT / "models/metaworld-tiny.gguf"
    wide = widened(stored, tmp_path / "wide.gguf")
    frame = ROOT / "examples/metaworld/episodes/faucet-open/step_00.png"
    seen = ["--image", f"corner4={frame}", "--state", "0.0045,0.4003,0.1957,1", "--text", "open the faucet", "--seed", "1"]
    run = lambda bundle, options: vla("run", bundle, *seen, *options, limit=LIMIT)  # noqa: E731
    rounded, kept = run(wide, IN_BF16), run(stored, IN_BF16)
    assert "63 matrices rounded to it, as asked for" in rounded.out, rounded.out
    assert "rounded to it" not in kept.out
    assert rounded.out.splitlines()[1] != run(wide, DEVICE).out.splitlines()[1]
    inspected = vla("inspect", wide, *IN_BF16, limit=LIMIT).out
    assert {"vulkan": "63 bf16", "cuda": "linear_bf16 (63 f32)"}[KIND] in inspected, inspected


@pytest.mark.parametrize("name", ["smolvla/two_views", "bitvla/" + next(n for n in NAMES if "bitvla" in n).split("/")[1]])
def test_without_taps_the_chunk_is_the_cpus_within_1e_4(vla, name):
    case = Golden(name)
    cpu, gpu = (actions(vla(*case.arguments(options=["--json", *o]), limit=LIMIT)) for o in (FLOAT32, DEVICE))
    assert np.abs(cpu - gpu).max() <= TOLERANCE * np.abs(cpu).max()


def test_a_process_answers_again_and_other_shapes_through_the_c_interface(vla, golden):
    """Plans of two lengths of text, taking turns: the same observation gives the same bytes."""
    program = f"""
import sys
sys.path[:0] = [{str(ROOT / "python")!r}]
import vla_cpp
images = {{ {", ".join(f"{view!r}: open({str(file)!r}, 'rb').read()" for view, file in golden.images.items())} }}
with vla_cpp.Policy({str(golden.bundle)!r}, device="{KIND}:0", **{KERNELS}) as policy:
    print(policy.spec.device, policy.spec.precision, sep=";")
    act = lambda text: policy.act(images=images, state={golden.state!r}, text=text, seed=1).actions.tobytes().hex()
    first, short = act({golden.text!r}), act("go")
    print(first == act({golden.text!r}), short == act("go"), first != short, sep=";")
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT)
    assert result.returncode == 0, result.stderr
    device, same = result.stdout.splitlines()
    assert device.startswith(f"{KIND}:0, ") and device.endswith(";f32")
    assert same == "True;True;True"


def test_two_policies_on_one_device_act_at_the_same_time_and_answer_as_alone(vla, golden):
    other = Golden(next(name for name in NAMES if name.startswith("pi05/")))
    program = f"""
import json, sys, threading
sys.path[:0] = [{str(ROOT / "python")!r}]
import vla_cpp
def observation(images, **rest):
    return dict(images={{view: file and open(file, "rb").read() for view, file in images.items()}}, seed=1, **rest)
jobs = []
for bundle, images, state, text in json.loads(sys.argv[1]):
    jobs.append((vla_cpp.Policy(bundle, device="{KIND}", **{KERNELS}), observation(images, state=state, text=text), []))
alone = [policy.act(**seen).actions.tobytes() for policy, seen, _ in jobs]
start = threading.Barrier(len(jobs))
def act(policy, seen, answers):
    start.wait()
    answers.extend(policy.act(**seen).actions.tobytes() for _ in range(5))
threads = [threading.Thread(target=act, args=job) for job in jobs]
for thread in threads: thread.start()
for thread in threads: thread.join()
print([answers == [expected] * 5 for (_, _, answers), expected in zip(jobs, alone)])
"""
    cases = [
        [str(case.bundle), {view: file and str(file) for view, file in case.images.items()}, case.state, case.text]
        for case in (golden, other, golden)
    ]
    result = subprocess.run([sys.executable, "-c", program, json.dumps(cases)], capture_output=True, text=True, timeout=LIMIT)
    assert result.returncode == 0, (result.returncode, result.stderr)
    assert result.stdout.strip() == "[True, True, True]"


def test_a_server_answers_with_the_chunk_of_vla_run_and_tells_the_device(vla, golden):
    import vla_cpp

    command = [vla.path, "serve", golden.bundle, "--bind", "tcp://127.0.0.1:0", *DEVICE]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            line = server.stdout.readline()
            assert f"device='{KIND}:0, " in line and "precision=f32" in line, line
            with vla_cpp.Client(re.search(r"address=(\S+)", line)[1], timeout=LIMIT) as client:
                images = {view: file.read_bytes() for view, file in golden.images.items()}
                chunk = client.act(images=images, state=golden.state, text=golden.text, noise=np.load(golden.noise))
        finally:
            server.terminate()
    run = actions(vla(*golden.arguments(options=["--json", *DEVICE]), limit=LIMIT))
    assert np.array_equal(chunk.actions.astype(np.float32), run)


def with_environment(vla, **environment):
    import copy

    changed = copy.copy(vla)
    changed.environment = {**vla.environment, **environment}
    return changed


@pytest.mark.parametrize("name", ["smolvla/sparse_expert", "gr00t_n1_6/faint"])
def test_within_a_budget_of_device_memory_answers_are_the_same_bytes(vla, name):
    case = Golden(name)
    run = lambda *options: vla(*case.arguments(options=["--json", *DEVICE, *options]), limit=LIMIT)  # noqa: E731
    expected = run().json()["actions"]
    least, middle = budgets(vla, case.bundle, DEVICE)
    for budget in (least, middle):
        assert run("--memory", str(budget)).json()["actions"] == expected
    run("--memory", str(least - 1)).refused("out_of_memory", "memory", f"{-(-least // 1_000_000)} MB or more")


def test_a_file_that_changes_while_it_is_read_is_refused_and_the_device_goes_on(vla, tmp_path):
    case = Golden("smolvla/sparse_expert")
    least, _ = budgets(vla, case.bundle, DEVICE)
    check_changing_file(case, tmp_path / "policy.gguf", vla.environment, device=KIND, memory=least, **KERNELS)


def test_a_budget_is_told_by_inspect_and_bench(vla):
    case = Golden("smolvla/sparse_expert")
    least, _ = budgets(vla, case.bundle, DEVICE)
    text = vla("inspect", case.bundle, "--memory", str(least), *DEVICE, limit=LIMIT).out
    assert f"of the device's memory; {-(-least // 1_000_000)} MB is the least that does" in text
    once = ["--runs", "1", "--warmup", "0", "--json", "--memory", str(least)]
    assert vla("bench", case.bundle, *once, *DEVICE, limit=LIMIT).json()["memory_bytes"]["read_in_every_act"] > 0


@LIMITS_OF_VULKAN
def test_weights_are_spread_over_buffers_where_one_cannot_hold_them(vla, golden):
    plain = vla(*golden.arguments(options=["--json", *DEVICE]), limit=LIMIT)
    small = with_environment(vla, GGML_VK_FORCE_MAX_ALLOCATION_SIZE="100000", GGML_VK_FORCE_MAX_BUFFER_SIZE="100000")
    split = small(*golden.arguments(options=["--json", *DEVICE]), limit=LIMIT)
    assert np.array_equal(actions(split), actions(plain))


@LIMITS_OF_VULKAN
def test_a_matrix_that_no_buffer_can_hold_is_refused_by_name_with_both_sizes(vla, golden):
    small = with_environment(vla, GGML_VK_FORCE_MAX_ALLOCATION_SIZE="5000", GGML_VK_FORCE_MAX_BUFFER_SIZE="5000")
    answer = small(*golden.arguments(options=DEVICE), limit=LIMIT)
    assert answer.code == EXIT["unsupported"] and answer.out == ""  # ggml writes lines of its own before ours
    assert re.fullmatch(
        r"error: unsupported: [\w.]+\.weight: expected at most 5\.0 kB, a buffer of vulkan:0, found [\d.]+ kB; use another device",
        answer.err.splitlines()[-1],
    ), answer.err


LAYER = Path(BINARY).parents[1] / "layer"
LOST = re.escape("expected a device that answers, found vk::") + r"[\w:]+: ErrorDeviceLost; start the process again; "


@pytest.fixture
def losing(vla, tmp_path):
    """The program with a Vulkan layer that counts submissions, or loses the device at the one that is given."""
    if KIND != "vulkan":
        pytest.skip("the layer is Vulkan's; tests/faults has a driver of CUDA that fails")
    if not (LAYER / "lost_layer.json").is_file():
        pytest.skip(f"no {LAYER}/lost_layer.json: it is built where Vulkan's headers are")
    layer = {"VK_INSTANCE_LAYERS": "VK_LAYER_VLA_lost", "VK_LAYER_PATH": str(LAYER), "VLA_LOST_COUNTS": str(tmp_path / "n")}
    return lambda at=0: with_environment(vla, VLA_LOST_AT=str(at), **layer)


def test_a_device_that_is_lost_is_an_error_wherever_it_happens(losing, golden, tmp_path):
    arguments = golden.arguments(options=["--json", *DEVICE])
    assert losing()(*arguments, limit=LIMIT).code == 0
    n = (tmp_path / "n").stat().st_size
    for at in (1, n // 2, n):  # while it is loaded, later, and in the last step
        answer = losing(at)(*arguments, limit=LIMIT)
        assert answer.code == EXIT["device"] and answer.out == "", (at, answer.code, answer.err)
        assert re.search(rf"^error: device: vulkan:0, [^\n]+: {LOST}", answer.err, re.M), (at, answer.err)


def serve_until_lost(program, golden, options, lost, n_act, limit, **solver):
    """Acts of a server until one answers that the device is lost, within n_act of them. What the server, which must end, says."""
    import vla_cpp

    command = [program.path, "serve", golden.bundle, "--bind", "tcp://127.0.0.1:0", *options]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=program.environment) as server:
        try:
            line = server.stdout.readline()
            images = {view: file.read_bytes() for view, file in golden.images.items()}
            with vla_cpp.Client(re.search(r"address=(\S+)", line)[1], timeout=limit) as client:
                with pytest.raises(vla_cpp.DeviceError, match=lost):
                    for _ in range(n_act):
                        client.act(images=images, state=golden.state, text=golden.text, **solver)
            _, err = server.communicate(timeout=60)
        finally:
            server.kill()
    assert server.returncode == EXIT["device"], err
    return err


def test_a_server_whose_device_is_lost_answers_device_and_ends(losing, golden, tmp_path):
    losing()(*golden.arguments(options=["--json", *DEVICE]), limit=LIMIT)
    program = losing((tmp_path / "n").stat().st_size + 1)  # after the act that warms it up, in the first or second one
    err = serve_until_lost(program, golden, DEVICE, "ErrorDeviceLost", 3, LIMIT, noise=np.load(golden.noise))
    assert re.search(rf"^error: device: vulkan:0, [^\n]+: {LOST}", err, re.M), err


def test_what_inspect_predicts_is_what_a_server_takes(vla, golden):
    predicted = json.loads(vla("inspect", golden.bundle, "--json", *DEVICE).out)
    assert predicted["device"].startswith(f"{KIND}:0, ")
    program = f"""
import sys
sys.path[:0] = [{str(ROOT / "python")!r}]
import vla_cpp
with vla_cpp.Policy({str(golden.bundle)!r}, device="{KIND}", **{KERNELS}) as policy:
    d = policy._library.vla_describe(policy._handle).contents
    print(d.memory_weights, d.memory_plan, d.memory_working)
"""
    taken = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT, check=True)
    sizes = [predicted["memory_bytes"][part] for part in ("weights", "plan", "working")]
    assert list(map(int, taken.stdout.split())) == sizes


def test_devices_are_listed_with_memory_and_precision(vla):
    listed = json.loads(vla("inspect", "--devices", "--json").out)
    gpu = next(device for device in listed["devices"] if device["name"] == f"{KIND}:0")
    assert listed["devices"][0]["name"] == "cpu" and gpu["products"] == {"vulkan": "f32, bf16", "cuda": "f32, bf16, int8"}[KIND]
    assert gpu["free_bytes"] is None if KIND == "cuda" else 0 < gpu["free_bytes"] <= gpu["memory_bytes"]
    driver = {"vulkan": r"driver \S.*, Vulkan \d+\.\d+\.\d+", "cuda": r"driver for CUDA \d+\.\d+"}[KIND]
    assert re.fullmatch(rf"\S.*; {driver}", gpu["description"]), gpu


def test_a_number_beyond_the_devices_is_refused_with_the_list(vla, golden):
    answer = vla(*golden.arguments(options=["--device", f"{KIND}:77"]))
    answer.refused("device", f"{KIND}:77: expected one of cpu, ", f"{KIND}:0 (", "found none with this number")


NO_DRIVER = {"VK_DRIVER_FILES": os.devnull, "VK_ICD_FILENAMES": os.devnull, "CUDA_VISIBLE_DEVICES": "", "LD_LIBRARY_PATH": ""}


def test_a_machine_without_a_device_says_so_and_runs_the_cpu(with_library, golden):
    without = with_environment(with_library, **NO_DRIVER)
    reason = f"no {KIND}: "
    line = next(line for line in without("inspect", "--devices").out.splitlines() if line.startswith(reason))
    assert re.search("driver|no CUDA-capable device|libcuda", line), line
    answer = without(*golden.arguments(options=DEVICE))
    answer.refused("device", f"{KIND}:0: expected one of cpu", ", found " + line.removeprefix(reason))
    assert without(*golden.arguments()).code == 0


def test_kernels_of_the_cpu_are_refused(vla, golden):
    answer = vla(*golden.arguments(options=["--device", KIND, "--kernels", "avx2"]))
    codes = ", int8, int4" if KIND == "cuda" else ""
    answer.refused("usage", f"kernels: expected none, float32, bf16{codes} or ggml with device {KIND}:0, found avx2")


def test_bench_tells_the_device_and_no_share_of_the_cpus_peak_which_it_does_not_probe_between_acts(vla, golden):
    report = vla("bench", golden.bundle, "--runs", 2, "--warmup", 0, "--json", *DEVICE, limit=LIMIT).json()
    assert report["device"].startswith(f"{KIND}:0, ") and report["share_of_peak"] == 0
    assert all("peak_gflops" not in one for one in report["rounds"]), report["rounds"]
