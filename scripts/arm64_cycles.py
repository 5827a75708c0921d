#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Cycles of ARM64's inner loops by llvm-mca's models of processors, as a share of what their multiply-adds alone would take.

    scripts/arm64_cycles.py [--objects FOLDER] [--mca llvm-mca-19] [--cpus neoverse-n1,neoverse-v1]

Reads the loops from the objects of src/kernels/arm (those of make test-arm64). Every load hits L1 in a model, so that the
shares are upper bounds. The limit is what the same model takes for as many multiply-adds on registers that do not wait for each other.
Exits with 1 where a loop that the table names spills registers or moves vectors, or is not there; --mca "" asks for nothing else.
"""

import argparse
import re
import subprocess
import sys
from pathlib import Path

# Of each object the loops: name, a part of the function's name, the instruction, and how many of them an iteration has.
LOOPS = [
    ("linear_neon", "float32, 6 rows", r"tile<6, .*Floats>", "fmla", 96),
    ("linear_neon", "bf16 widened, 6 rows", r"tile<6, .*Pairs>", "fmla", 96),
    ("linear_neon", "f16 widened, 6 rows", r"tile<6, .*Halves>", "fmla", 96),
    ("int8_dotprod", "int8, 6 rows", r"tile<6, .*BytePanels::Strips", "sdot", 96),
    ("int8_dotprod", "ternary expanded, 6 rows", r"tile<6, .*ExpandedStrips", "sdot", 96),
    ("linear_neon_bf16", "bf16 by BFMMLA, 6 rows", r"NeonBf16Tile::multiply", "bfmmla", 24),
    ("linear_neon_bf16", "bf16 by BFMMLA, 4 rows", r"NeonBf16Tile::multiply", "bfmmla", 16),
    ("linear_neon_bf16", "bf16 by BFMMLA, 2 rows", r"NeonBf16Tile::multiply", "bfmmla", 8),
    ("linear_neon_bf16", "bf16 in fours widened, 4 rows", r"QuadTile::tile<4>", "fmla", 64),
    ("int8_i8mm", "int8, int4, ternary by SMMLA, 6 rows", r"MatrixTile::multiply", "smmla", 24),
    ("int8_i8mm", "int8, int4, ternary by SMMLA, 4 rows", r"MatrixTile::multiply", "smmla", 16),
    ("cpu_kernels_neon", "attention, queries by keys", r"::multiply_keys", "fmla", 96),
    ("cpu_kernels_neon", "attention, weights by values", r"::mix_values", "fmla", 96),
]
LATER = {"bfmmla", "smmla"}  # which Neoverse-N1 lacks
FEATURES = "+dotprod,+bf16,+i8mm,+fullfp16"


def run(*command, given=None):
    return subprocess.run(command, input=given, capture_output=True, text=True, check=True).stdout


def functions(path):
    """{name: [(address, instruction)]}"""
    found, lines = {}, []
    for line in run("aarch64-linux-gnu-objdump", "-d", "-C", "--no-show-raw-insn", path).splitlines():
        if start := re.match(r"[0-9a-f]+ <(.*)>:$", line):
            lines = found.setdefault(start[1], [])
        elif part := re.match(r"\s*([0-9a-f]+):\t(.*)$", line):
            lines.append((int(part[1], 16), part[2].split("//")[0].replace("\t", " ").strip()))
    return found


def loops(lines):
    """Stretches from the target of a branch backwards to the branch."""
    for i, (address, text) in enumerate(lines):
        branch = re.match(r"(?:b\.\w+|cbn?z \w+,|tbn?z \w+, #\d+,|b) ?([0-9a-f]+) <", text)
        if branch and int(branch[1], 16) <= address:
            yield [text for place, text in lines[:i] if place >= int(branch[1], 16)] + [text]


def smallest_loop(functions, add, count):
    """The smallest loop with so many multiply-adds."""
    bodies = (body for lines in functions for body in loops(lines))
    return min((body for body in bodies if sum(line.split()[0] == add for line in body) == count), key=len, default=None)


def wasted(body):
    """Accesses to the stack, and moves of vectors."""
    return sum("[sp" in line for line in body), sum(line.startswith("mov v") for line in body)


def cycles(mca, cpu, body):
    """Of one iteration."""
    n = 200
    text = "\n".join(re.sub(r"(b\.\w+|cbn?z \w+,) ?[0-9a-f]+ <.*>", r"\1 loop", line) for line in body)
    report = run(mca, "-mtriple=aarch64", f"-mcpu={cpu}", f"-mattr={FEATURES}", f"-iterations={n}", given=text + "\n")
    return int(re.search(r"Total Cycles:\s+(\d+)", report)[1]) / n


def share(mca, cpu, add, count, body):
    if cpu == "neoverse-n1" and add in LATER:
        return "-"
    kind = {"fmla": "4s", "bfmmla": "8h"}.get(add, "16b")
    alone = cycles(mca, cpu, [f"{add} v{i}.4s, v30.{kind}, v31.{kind}" for i in range(24)]) * count / 24
    return f"{100 * alone / cycles(mca, cpu, body):.0f} %"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", default="build/arm64/src/CMakeFiles/vla_kernels.dir/kernels/arm", type=Path)
    parser.add_argument("--mca", default="llvm-mca-19")
    parser.add_argument("--cpus", default="neoverse-n1,neoverse-v1")
    args = parser.parse_args()
    cpus = args.cpus.split(",") if args.mca else []
    heads = ["loop", "multiply-adds", "instructions", "spills", "moves", *cpus]
    print(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}")
    wrong = False
    for source, title, name, add, count in LOOPS:
        named = [lines for function, lines in functions(args.objects / f"{source}.cpp.o").items() if re.search(name, function)]
        body = smallest_loop(named, add, count)
        if body is None:
            print(f"| {title} | not found |")
            wrong = True
            continue
        spills, moves = wasted(body)
        wrong |= spills + moves > 0
        shares = [share(args.mca, cpu, add, count, body) for cpu in cpus]
        print(f"| {' | '.join(map(str, [title, count, len(body), spills, moves, *shares]))} |")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
