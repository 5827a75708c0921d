# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What nvcc makes of the kernels: run as PTX, and assembled for every architecture."""

import collections
import os
import re
from concurrent.futures import ThreadPoolExecutor

import cuda_kernels
import pytest
from conftest import ARCHITECTURES, run_tests

# Tensor instructions of a step of the main loop, on every architecture. The warp has 64 x 64 sums in the shapes of 128,
# 32 x 32 in those of 64, in products of 16 x 8; attention has 16 rows, and the keys and elements of attention.h.
MAIN_LOOPS = {
    "linear_ternary_128": ("IMMA.16832.S8.S8", 64),
    "linear_ternary_64": ("IMMA.16832.S8.S8", 16),
    "linear_int4_128": ("IMMA.16832.S8.S8", 64),
    "linear_int4_64": ("IMMA.16832.S8.S8", 16),
    "linear_int8_128": ("IMMA.16832.S8.S8", 64),
    "linear_int8_64": ("IMMA.16832.S8.S8", 16),
    "linear_bf16_128": ("HMMA.16816.F32.BF16", 64),
    "linear_bf16_64": ("HMMA.16816.F32.BF16", 16),
    "attention_bf16_64": ("HMMA.16816.F32.BF16", 64),
    "attention_bf16_64_32": ("HMMA.16816.F32.BF16", 64),
    "attention_bf16_64_16": ("HMMA.16816.F32.BF16", 32),
    "attention_bf16_80": ("HMMA.16816.F32.BF16", 80),
    "attention_bf16_128": ("HMMA.16816.F32.BF16", 128),
    "attention_bf16_128_32": ("HMMA.16816.F32.BF16", 64),
    "attention_bf16_128_16": ("HMMA.16816.F32.BF16", 32),
    "attention_bf16_256": ("HMMA.16816.F32.BF16", 64),
    "attention_bf16_256_32": ("HMMA.16816.F32.BF16", 64),
}
# Strips: two or three steps of 64 rows and 16 or 32 columns.
STRIP_LOOPS = {
    name: ("HMMA.16816.F32.BF16", 48 if "_16" in name else 96 if "_32_gated" in name else 64)
    for width in (16, 32, 64, 128)
    for name in (
        *(f"linear_strip_{width}", f"linear_strip_{width}_gated"),
        *([f"linear_strips_{width}", f"linear_strip_{width}_rotated", f"linear_strips_{width}_rotated"] if width < 128 else []),
        *([f"linear_strip_{width}_begins"] if width < 128 else []),
    )
}
HOPPER_PRODUCTS = ("hopper_linear", "hopper_tma")
# Of a tile for Hopper a warpgroup multiplies 128 bytes of the depth.
HOPPER_LOOP = {"bf16": "HGMMA.64x{}x16.F32.BF16", "int8": "IGMMA.64x{}x32.S8.S8", "ternary": "IGMMA.64x{}x32.S8.S8"}
TWO_BLOCKS = {name for name in MAIN_LOOPS if name.startswith("linear")} | {"attention_bf16_64"}


def test_kernels_pass_their_tests_as_ptx(ptx):
    code, output = run_tests(ptx)
    assert code == 0, output


def test_policies_match_the_reference_on_ptx(ptx):
    """With VLA_ALL_FAMILIES also what the driver's callers do, which is the same whatever compiled the kernels."""
    chosen = [] if os.environ.get("VLA_ALL_FAMILIES") else ["--source-file=*lowering_test.cpp"]
    code, output = run_tests(ptx, *chosen, program="VLA_TEST_CUDA_POLICIES")
    assert code == 0, output
    assert re.search(r"\b[1-9]\d* passed", output), output


def test_the_ptx_is_of_a_version_that_jetpack_6_takes(ptx):
    """CUDA 12.6, whose PTX is version 8.5; what is assembled below is the same text."""
    assert all(re.search(r"^\.version 8\.5$", module.read_text(), re.M) for module in ptx)


@pytest.fixture(scope="session")
def machine_code(ptx, tmp_path_factory):
    """{(architecture, kernel): (resources, counts of the main loop)}."""
    out = tmp_path_factory.mktemp("cubins")

    def of(job):
        sm, module = job
        return [((sm, name), (used, loop)) for name, used, loop in cuda_kernels.report([module], sm, out)]

    with ThreadPoolExecutor(2) as pool:
        return dict(one for part in pool.map(of, [(sm, module) for sm in ARCHITECTURES for module in ptx]) for one in part)


def test_no_kernel_of_any_architecture_spills(machine_code):
    for (sm, name), (used, _) in sorted(machine_code.items()):
        print(
            f"sm_{sm} {name}: {used['registers']} registers, {used['spills']} bytes spilled, {used['shared']} bytes of shared memory"
        )
    assert not [key for key, (used, _) in machine_code.items() if used["spills"]]


def test_tiles_for_hopper_fit_it_and_their_products_do_not_wait_for_each_other(machine_code):
    if not cuda_kernels.tool("nvdisasm"):
        pytest.skip("no nvdisasm: it is beside the nvcc that `make test` downloads")
    kernels = {name: code for (_, name), code in machine_code.items() if name.startswith(HOPPER_PRODUCTS)}
    assert len(kernels) > 40
    for name, (used, loop) in kernels.items():
        way, kind, columns, rows = re.match(r"hopper_(linears?|tma)_([a-z0-9]+)_(\d+)x(\d+)", name).groups()
        n_thread = 2 * int(columns) + (32 if way == "tma" else 0)
        assert not used["spills"], name
        assert n_thread * -(-used["registers"] // 8) * 8 <= 65536, name
        tensor = {op: n for op, n in loop.items() if op.startswith(cuda_kernels.TENSOR)}
        assert tensor == {HOPPER_LOOP[kind].format(rows): 4}, name


def test_attention_by_wgmma_fits_hopper_and_its_products_do_not_wait_for_each_other(machine_code):
    """The assembler puts the loop around what comes before and behind it, which multiplies once more each."""
    if not cuda_kernels.tool("nvdisasm"):
        pytest.skip("no nvdisasm: it is beside the nvcc that `make test` downloads")
    kernels = {name: code for (_, name), code in machine_code.items() if name.startswith("hopper_flash")}
    header = (cuda_kernels.SOURCES / "cuda/kernels/hopper_flash.h").read_text()
    shapes = {name: tuple(map(int, of.split(","))) for name, of in re.findall(r'\{"(hopper_flash_\w+)", (\d+, \d+, \d+)', header)}
    assert kernels.keys() == shapes.keys() and kernels
    for name, (used, loop) in kernels.items():
        depth, rows, keys = shapes[name]
        n_block = 2 if rows == 64 and depth < 256 else 1
        n_warp = -(-n_block * (rows // 16 + 1) // 4)  # of a quarter of an SM, which has 16384 registers
        assert n_warp * 32 * -(-used["registers"] // 8) * 8 <= 16384, name
        expected = collections.Counter()
        expected[f"HGMMA.64x{keys}x16.F32.BF16"] += 2 * depth // 16
        expected[f"HGMMA.64x{depth}x16.F32.BF16"] += 2 * keys // 16
        assert {op: n for op, n in loop.items() if op.startswith(cuda_kernels.TENSOR)} == expected, name


def test_two_blocks_of_a_product_fit_the_registers_of_an_sm(machine_code):
    for (sm, name), (used, _) in machine_code.items():
        if name in TWO_BLOCKS:
            assert 2 * 128 * -(-used["registers"] // 8) * 8 <= 65536, (sm, name)


def test_main_loops_have_the_tensor_instructions_that_they_need(machine_code):
    if not cuda_kernels.tool("nvdisasm"):
        pytest.skip("no nvdisasm: it is beside the nvcc that `make test` downloads")
    for (sm, name), (_, loop) in machine_code.items():
        tensor = {op: n for op, n in loop.items() if op.startswith(cuda_kernels.TENSOR)}
        if not name.startswith((*HOPPER_PRODUCTS, "hopper_flash")):
            expected = MAIN_LOOPS.get(name.removeprefix("hopper_")) or STRIP_LOOPS.get(name)
            assert tensor == (dict([expected]) if expected else {}), (sm, name)


def test_predictions_count_the_instructions_of_main_loops(machine_code):
    """The table is of sm_90; before it the compiler writes other address arithmetic, and after it instructions that wait."""
    if not cuda_kernels.tool("nvdisasm"):
        pytest.skip("no nvdisasm: it is beside the nvcc that `make test` downloads")
    table = (cuda_kernels.SOURCES / "lower/cuda/gpu_model.cpp").read_text()
    rows = {name: list(map(int, row.split(","))) for name, row in re.findall(r'\{"(\w+)", (\d+, \d+, \d+), ', table)}
    assert rows.keys() == MAIN_LOOPS.keys()
    for sm in [sm for sm in ARCHITECTURES if sm <= 90]:
        for name, (instructions, tensor, registers) in rows.items():
            used, loop = machine_code[sm, name]
            assert tensor == MAIN_LOOPS[name][1]
            assert instructions * 5 / 6 <= loop.total() <= instructions * 6 / 5, (sm, name, loop.total())
            if sm == 90:
                assert (loop.total(), used["registers"]) == (instructions, registers), name


def test_ternary_products_leave_half_of_the_tensor_time_to_spare(machine_code):
    """By published rates: other units need at most half of it on AGX Orin and on an RTX 3060."""
    if not cuda_kernels.tool("nvdisasm"):
        pytest.skip("no nvdisasm: it is beside the nvcc that `make test` downloads")
    if not {87, 86} <= set(ARCHITECTURES):
        pytest.skip("Orin's and an RTX 3060's code: VLA_ALL_ARCHITECTURES, as `make test-cuda` sets it")
    for sm in (86, 87):
        shares = cuda_kernels.shares(machine_code[sm, "linear_ternary_128"][1], sm)
        print(sm, shares)
        assert max(shares.values()) <= 0.5
