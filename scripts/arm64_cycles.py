#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Cycles of ARM64's inner loops by llvm-mca's models of processors, as a share of what their multiply-adds alone would take.

    scripts/arm64_cycles.py [--build build/arm64] [--mca llvm-mca-19] [--cpus neoverse-n1,neoverse-v1]

Reads the loops from the objects of a build (make test-arm64). Every load hits the first cache in a model, so that the shares are upper
bounds. The limit is what the same model takes for as many multiply-adds on registers that do not wait for each other. Exits with 1 where
a loop that a table names spills registers or moves vectors, or is not there.
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
    ("int8_dotprod", "int8, 6 rows", r"tile<6, .*ByteStrips", "sdot", 96),
    ("int8_dotprod", "ternary expanded, 6 rows", r"tile<6, .*ExpandedStrips", "sdot", 96),
    ("cpu_kernels_neon", "attention, queries by keys", r"::multiply_keys", "fmla", 96),
    ("cpu_kernels_neon", "attention, weights by values", r"::mix_values", "fmla", 96),
]
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


def inner_loop(path, name, add, count):
    """The smallest loop with so many multiply-adds in the functions of a name."""
    bodies = [
        body
        for function, lines in functions(path).items()
        if re.search(name, function)
        for body in loops(lines)
        if sum(line.split()[0] == add for line in body) == count
    ]
    return min(bodies, key=len, default=None)


def cycles(mca, cpu, body):
    """Of one iteration."""
    n = 200
    text = "\n".join(re.sub(r"(b\.\w+|cbn?z \w+,) ?[0-9a-f]+ <.*>", r"\1 loop", line) for line in body)
    report = run(mca, "-mtriple=aarch64", f"-mcpu={cpu}", f"-mattr={FEATURES}", f"-iterations={n}", given=text + "\n")
    return int(re.search(r"Total Cycles:\s+(\d+)", report)[1]) / n


def limit(mca, cpu, add, count):
    kind = "16b" if add == "sdot" else "4s"
    return cycles(mca, cpu, [f"{add} v{i}.4s, v30.{kind}, v31.{kind}" for i in range(24)]) * count / 24


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build", default="build/arm64", type=Path)
    parser.add_argument("--mca", default="llvm-mca-19")
    parser.add_argument("--cpus", default="neoverse-n1,neoverse-v1")
    args = parser.parse_args()
    cpus = args.cpus.split(",")
    folder = args.build / "src/CMakeFiles/vla_kernels.dir/kernels/arm"
    print(
        f"| loop | multiply-adds | instructions | spills | moves | {' | '.join(cpus)} |\n|{' --- |' * (5 + len(cpus))}"
    )
    wrong = False
    for source, title, name, add, count in LOOPS:
        body = inner_loop(folder / f"{source}.cpp.o", name, add, count)
        if body is None:
            print(f"| {title} | not found |")
            wrong = True
            continue
        spills = sum("[sp" in line for line in body)
        moves = sum(line.startswith("mov v") for line in body)
        wrong |= spills + moves > 0
        shares = [f"{100 * limit(args.mca, cpu, add, count) / cycles(args.mca, cpu, body):.0f} %" for cpu in cpus]
        print(f"| {title} | {count} | {len(body)} | {spills} | {moves} | {' | '.join(shares)} |")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
