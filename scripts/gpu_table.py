#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/gpu.md from what scripts/measure_gpu.sh left in a folder.

    scripts/gpu_table.py OUT
"""

import argparse
import json
import re
import statistics
from pathlib import Path

NONE = "not measured"
MODES = ("eager", "compiled", "graphs")


def read(path):
    """The JSON object on the last line of a file, or None."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return json.loads(lines[-1]) if lines else None


def network(report):
    """Median milliseconds of the stages that compute on the device."""
    return report["stages"]["network"]["p50_ms"]


def ms(value):
    return NONE if value is None else f"{value:.2f}"


def families(out):
    """One line a family: milliseconds of vla and of PyTorch's three ways, and how many times the best of those takes."""
    yield "| policy | predicted | vla | vla, int8 | PyTorch eager | compiled | CUDA graphs | best of three / vla |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for name in sorted({path.name.split(".")[0] for path in out.glob("*.predicted.json")} | {path.name.split(".")[0] for path in out.glob("*.stored.json")}):
        predicted, stored, int8 = (read(out / f"{name}.{kind}.json") for kind in ("predicted", "stored", "int8"))
        torch = [report and statistics.median(report["ms"]) for report in (read(out / f"{name}.torch_{mode}.json") for mode in MODES)]
        ours = stored and network(stored)
        best = min((value for value in torch if value is not None), default=None)
        times = NONE if best is None or not ours else f"{best / ours:.2f}"
        cells = [predicted and predicted["stages"]["total"]["ms"], ours, int8 and network(int8), *torch]
        yield f"| {name} | {' | '.join(ms(cell) for cell in cells)} | {times} |"


def products(out):
    """The fastest shape of blocks of each product."""
    path = out / "products.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    if not rows:
        return
    yield ""
    yield "| product | rows x depth x columns | fastest: block, splits | microseconds | T operations/s |"
    yield "| --- | --- | --- | ---: | ---: |"
    by_size = {}
    for row in rows:
        by_size.setdefault((row["kind"], row["rows"], row["depth"], row["columns"]), []).append(row)
    for (kind, n_row, depth, column), shapes in by_size.items():
        best = min(shapes, key=lambda row: row["us"])
        yield f"| {kind} | {n_row} x {depth} x {column} | {best['shape']}, {best['splits']} | {best['us']:.1f} | {best['tera']:.1f} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    ladder = (out / "ladder.txt").read_text() if (out / "ladder.txt").is_file() else ""
    said = re.findall(r"^=*\s*(\d+ .*?(?:passed|failed).*?)\s*=*$", ladder, re.M)
    print(f"{(out / 'machine.txt').read_text().strip()}; golden cases: {said[-1] if said else 'not run'}. Milliseconds, medians.\n")
    print("\n".join([*families(out), *products(out)]))


if __name__ == "__main__":
    main()
