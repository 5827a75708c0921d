#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Our CUDA kernels as PTX and as machine code of seven architectures, without a GPU.

    scripts/cuda_kernels.py ptx OUT                  OUT/*.ptx, as tests/cuda runs them
    scripts/cuda_kernels.py embed OUT [--module M]   what the library has inside: OUT/*.ptx and, for Hopper, OUT/*.sm_90.cubin
    scripts/cuda_kernels.py cubins OUT [--sm 87]     registers, spills and shared memory of every kernel, and its main loop

A main loop is the innermost loop with tensor instructions, from its label to the branch back. Shares of the tensor units'
time that other units need are estimates from published rates, not measurements.
"""

import argparse
import collections
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src"
#                Ampere, Orin,       Ada, Hopper, Thor, Blackwell
ARCHITECTURES = (80, 86, 87, 89, 90, 110, 120)
TENSOR = ("IMMA", "HMMA", "IGMMA", "HGMMA")
# Cycles of the tensor unit of a quarter of an SM for 16 x 8 x 32 bytes (IMMA) and 16 x 8 x 16 bf16 with sums in float32
# (HMMA), from peak rates that NVIDIA publishes, without sparsity: AGX Orin 85 TOPS int8 and 43 TFLOPS of 16 SMs at
# 1.3 GHz, RTX 3060 102 TOPS and 26 TFLOPS of 28 SMs at 1.78 GHz. An integer instruction of a warp takes two cycles.
CYCLES = {87: {"IMMA": 8, "HMMA": 8}, 86: {"IMMA": 16, "HMMA": 32}}
INTEGER = (
    "LOP3",
    "SHF",
    "PRMT",
    "IADD3",
    "LEA",
    "ISETP",
    "SEL",
    "VIADD",
    "PLOP3",
    "IMNMX",
    "MOV",
    "SGXT",
    "ISUB",
    "VIMNMX",
)


def tool(name):
    """The pinned nvcc, ptxas or nvdisasm, one of VLA_NVCC_DIR's, or None."""
    folders = [
        os.environ.get("VLA_NVCC_DIR"),
        ROOT / ".cache/nvcc/nvidia/cu13/bin",
        ROOT / ".cache/cuda/nvidia/cu13/bin",
    ]
    return next((found for folder in folders if folder and (found := shutil.which(name, path=str(folder)))), None)


def kernel_files(sources=SOURCES):
    return sorted((sources / "cuda/kernels").glob("*.cu"))


def run(command):
    process = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if process.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))}:\n{process.stdout}{process.stderr}")
    return process.stdout + process.stderr


def targets(source):
    """What a source is compiled for: from Ampere on, from Hopper on, or Hopper alone, whose own units no other GPU has."""
    return ("90a",) if source.stem.startswith("hopper_") else ("80", "90")


def fits(ptx, sm):
    """Whether a GPU of an architecture runs a file, as Gpu::open chooses."""
    target = re.search(r"_sm(\d+a?)$", ptx.stem)[1]
    return {"80": sm < 90, "90": sm >= 90, "90a": sm == 90}[target]


def compile_ptx(source, out, target, sources=SOURCES, warnings=("-Werror", "all-warnings")):
    """PTX for drivers from CUDA 12.6 on (JetPack 6), whose PTX is version 8.5."""
    target_file = Path(out) / f"{source.stem}_sm{target}.ptx"
    arch = f"-arch=compute_{target}"
    run([tool("nvcc"), "-std=c++20", "-O3", *warnings, arch, f"-I{sources}", "-ptx", source, "-o", target_file])
    target_file.write_text(re.sub(r"^\.version .*", ".version 8.5", target_file.read_text(), flags=re.M))
    return target_file


def compile_module(source, out, target, embeds=False):
    """PTX, and where it `embeds` Hopper's machine code beside it. Orin would gain nothing: JetPack 6 has a driver for CUDA 12."""
    ptx = compile_ptx(source, out, target)
    if embeds and target != "80":
        assemble(ptx, 90, out)
    return ptx


def compile_all(out, module=None, embeds=False, architectures=ARCHITECTURES):
    """Every kernel for each target that one of the architectures runs, or one module alone."""
    jobs = [(source, out, target, embeds) for source in kernel_files() for target in targets(source)]
    names = [Path(f"{source.stem}_sm{target}.ptx") for source, _, target, _ in jobs]
    jobs = [job for job, name in zip(jobs, names) if module in (None, name.stem) and any(fits(name, sm) for sm in architectures)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(lambda job: compile_module(*job), jobs))


def assemble(ptx, sm, out):
    """(machine code, {kernel: {registers, spills in bytes, static shared memory}})."""
    cubin = Path(out) / f"{ptx.stem}.sm_{sm}.cubin"
    arch = f"-arch=sm_{sm}{'a' if ptx.stem.endswith('a') else ''}"
    told = run([tool("ptxas"), "-v", arch, ptx, "-o", cubin])
    if "serialized" in told:  # wgmma that the assembler lets wait for each other
        raise RuntimeError(told)
    kernels = {}
    for part in told.split("Compiling entry function")[1:]:
        name = re.match(r" '(\S+)'", part)[1]
        spills = sum(int(n) for n in re.findall(r"(\d+) bytes spill", part))
        shared = re.search(r"(\d+) bytes smem", part)
        kernels[name] = {
            "registers": int(re.search(r"Used (\d+) registers", part)[1]),
            "spills": spills,
            "shared": int(shared[1]) if shared else 0,
        }
    return cubin, kernels


def instructions(cubin):
    """{kernel: [("label" or "op", text)]}."""
    kernels, lines = {}, []
    for line in run([tool("nvdisasm"), "-c", cubin]).splitlines():
        if section := re.match(r"\s*\.section\s+\.text\.(\S+?),", line):
            lines = kernels.setdefault(section[1], [])
        elif label := re.match(r"(\.L\S+):", line):
            lines.append(("label", label[1]))
        elif op := re.match(r"\s+/\*[0-9a-f]{4,}\*/\s+(.*?)\s*;", line):
            lines.append(("op", op[1]))
    return kernels


def opcode(op):
    return re.sub(r"^@!?U?P(\d+|T)\s+", "", op).split()[0]


def main_loop(lines):
    """Counts of opcodes in the innermost loop with most tensor instructions; empty where there is none."""
    at = {what: i for i, (kind, what) in enumerate(lines) if kind == "label"}
    best = (0, 0, [])
    for i, (kind, what) in enumerate(lines):
        target = re.search(r"BRA\S*\s.*?`\((\.L\S+?)\)", what) if kind == "op" else None
        if target and at.get(target[1], i) < i:
            body = [opcode(op) for k, op in lines[at[target[1]] : i + 1] if k == "op"]
            n = sum(op.startswith(TENSOR) for op in body)
            best = max(best, (n, -len(body), body))
    return collections.Counter(best[2]) if best[0] else collections.Counter()


def shares(counts, sm):
    """Of the tensor units' time: what issue slots, integer units and shared memory need."""
    time = sum(n * CYCLES[sm][op[:4]] for op, n in counts.items() if op.startswith(TENSOR))
    integer = sum(n for op, n in counts.items() if op.split(".")[0] in INTEGER)
    # 512 bytes of shared memory for each of these, of which an SM, four quarters, has 128 in a cycle.
    shared = sum(n for op, n in counts.items() if op.startswith(("LDSM", "LDS.128", "LDGSTS")))
    return {
        "issue slots": counts.total() / time,
        "integer units": 2 * integer / time,
        "shared memory": 16 * shared / time,
    }


def report(ptx_files, sm, out):
    """Yields (kernel, resources, counts of its main loop) of the files that the architecture runs."""
    for ptx in [one for one in ptx_files if fits(one, sm)]:
        cubin, kernels = assemble(ptx, sm, out)
        code = instructions(cubin) if tool("nvdisasm") else {}
        for name in sorted(kernels):
            yield name, kernels[name], main_loop(code.get(name, []))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["ptx", "embed", "cubins"])
    parser.add_argument("out", type=Path)
    parser.add_argument("--sm", type=int, action="append", help="an architecture; default: all seven")
    parser.add_argument("--module", help="one alone, such as rows_sm90; default: all")
    options = parser.parse_args()
    if not tool("nvcc"):
        sys.exit("no nvcc: scripts/cuda.sh .cache/nvcc nvcc downloads it, or VLA_NVCC_DIR names its folder")
    options.out.mkdir(parents=True, exist_ok=True)
    files = compile_all(options.out, options.module, options.what == "embed")
    if options.what != "cubins":
        return
    print("sm   kernel                registers  spills  shared  main loop: instructions, tensor, LDSM")
    for sm in options.sm or ARCHITECTURES:
        for name, used, loop in report(files, sm, options.out):
            tensor = sum(n for op, n in loop.items() if op.startswith(TENSOR))
            matrices = sum(n for op, n in loop.items() if op.startswith("LDSM"))
            said = f"{loop.total()}, {tensor}, {matrices}" if loop else ""
            if loop and sm in CYCLES:
                said += "; of the tensor time: " + ", ".join(
                    f"{unit} {share:.0%}" for unit, share in shares(loop, sm).items()
                )
            print(f"{sm:<4} {name:<21} {used['registers']:>9} {used['spills']:>7} {used['shared']:>7}  {said}")


if __name__ == "__main__":
    main()
