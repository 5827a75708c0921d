#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes what was measured on GPUs into docs/gpu.md, between the comments `gpu: measured` and `end`, from docs/gpu/<card>-<date>.json.

    python3 scripts/gpu_table.py                   # tests/lint/gpu_table_test.py compares
    python3 scripts/gpu_table.py --keep RESULT     # RESULT, of scripts/gpu_kit/try_gpu.py, becomes such a file first

A prediction has a column of its own, and what was not measured says so."""

import argparse
import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"(?<=<!-- gpu: measured -->\n).*?(?=<!-- end -->)", re.S)
NONE = "not measured"
MODES = {"eager": "PyTorch eager", "graph": "in a CUDA graph", "compiled": "compiled"}


def get(found, *path):
    """The value at a path of keys, or None."""
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return found


def number(value, form="{:.2f}"):
    return NONE if value is None else form.format(value)


def ratio(above, below):
    return NONE if not above or not below else f"{above / below:.2f}"


def table(head, rows):
    """A first column of text and others of numbers; nothing where there are no rows."""
    if not rows:
        return []
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return ["", *(f"| {' | '.join(line)} |" for line in lines)]


def title(result):
    checks = get(result, "checks") or {}
    failed = [name for name, one in checks.items() if not one["passed"]]
    cases = result.get("cases")
    parts = [
        f"**{result['card']}**, {result['driver']}, {result['date']}, commit {result['commit']}",
        *[f"{key} {value}" for key, value in (result.get("nvidia_smi") or {}).items()],
        f"{len(checks) - len(failed)} of {len(checks)} checks passed" + (f" (failed: {', '.join(failed)})" if failed else ""),
        f"golden cases: {cases['passed']} hold, {len(cases['failed'])} do not" if cases else f"golden cases: {NONE}",
    ]
    return "; ".join(parts) + "."


def families(result):
    head = ["ms, medians", "network", "of it steps", "in int8", "acts back to back", *MODES.values(), "best of PyTorch / acts", "predicted", "predicted / network"]
    rows = []
    for name, found in sorted(result["families"].items()):
        network, act = get(found, "stored", "ms", "network"), get(found, "traced", "act_ms")
        torch = [get(found, "torch", mode) for mode in MODES]
        best = min([ms for ms in torch if ms], default=None)
        guess = get(found, "predicted", "ms", "total")
        cells = [network, get(found, "stored", "ms", "steps"), get(found, "int8", "ms", "network"), act, *torch]
        rows.append([f"`{name}`", *map(number, cells), ratio(best, act), "no model" if guess is None else number(guess), ratio(guess, network)])
    return table(head, rows)


def ways(result):
    """Networks in other ways than estimates chose (VLA_CUDA_WITHOUT, VLA_CUDA_WITH)."""
    names = sorted({way for found in result["families"].values() for way in found.get("ways") or {}})
    rows = [[f"`{name}`", number(get(found, "stored", "ms", "network")), *(number(get(found, "ways", way, "ms", "network")) for way in names)]
            for name, found in sorted(result["families"].items()) if found.get("ways")]
    return table(["network, ms", "as estimated", *names], rows)


def kernels(result):
    """The kernels that take most of an act, of families that were traced."""
    rows = []
    for name, found in sorted(result["families"].items()):
        for row in (get(found, "traced", "kernels") or [])[:5]:
            rows.append([f"`{name}`", f"`{row['kernel']}`", str(row["n"]), *(number(row[key]) for key in ("ms", "median_us", "least_us", "most_us"))])
    return table(["an act of", "kernel", "launches", "ms", "median us", "least", "most"], rows)


def products(result):
    cublas = {(row["rows"], row["depth"], row["columns"]): row for row in result.get("cublas") or []}
    rows = []
    for row in result.get("products") or []:
        size = row["rows"], row["depth"], row["columns"]
        other = get(cublas.get(size), "us") if row["kind"] == "bf16" else None
        rows.append([f"{row['kind']}, {' x '.join(map(str, size))}", f"{row['shape']}, {row['splits']}", number(row["us"], "{:.1f}"), number(row["warm_us"], "{:.1f}"),
                     number(row["tera"], "{:.1f}"), number(other, "{:.1f}") if row["kind"] == "bf16" else "", ratio(row["us"], other) if row["kind"] == "bf16" else ""])
    return table(["product, rows x depth x columns", "fastest block, splits", "us, matrices in turn", "us, one matrix", "T operations/s", "cuBLAS, us in turn", "ours / cuBLAS"], rows)


def processor(result):
    rows = [[f"`{name}`", threads, number(get(run, "ms", "network"))]
            for name, found in sorted(result["families"].items()) for threads, run in (found.get("cpu") or {}).items()]
    return table([f"on its {result.get('processor', 'processor')}", "threads", "network, ms"], rows)


def section(result, is_newest):
    """Of a visit: what it ran and acts; of a card's newest one, its kernels and products too."""
    details = [*ways(result), *kernels(result), *products(result)] if is_newest else []
    return "\n".join([title(result), *families(result), *details, *processor(result)]) + "\n"


def block(results):
    """Of all visits, the newest first."""
    newest = sorted(results, key=lambda result: result["date"], reverse=True)
    seen, sections = set(), []
    for result in newest:
        sections.append(section(result, result["card"] not in seen))
        seen.add(result["card"])
    return "\n".join(sections) or "No GPU was measured yet.\n"


def written(root):
    """docs/gpu.md as it should be."""
    results = [json.loads(file.read_text(encoding="utf-8")) for file in sorted((root / "docs/gpu").glob("*.json"))]
    return BLOCK.sub(lambda _: block(results), (root / "docs/gpu.md").read_text(encoding="utf-8"))


def keep(root, file):
    """The file of docs/gpu that a result becomes. What ran on no GPU is none."""
    result = json.loads(file.read_text(encoding="utf-8"))
    if result.get("driver_of_tests") or not result.get("card"):
        sys.exit(f"error: {file}: expected the result of a GPU, found one of {'the driver of tests' if result.get('card') else 'no device'}")
    name = re.sub(r"[^a-z0-9]+", "-", result["card"].lower()).strip("-")
    kept = root / f"docs/gpu/{name}-{result['date']}.json"
    kept.parent.mkdir(exist_ok=True)
    kept.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return kept


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="RESULT")
    options = parser.parse_args()
    if options.keep:
        print(keep(ROOT, options.keep))
    (ROOT / "docs/gpu.md").write_text(written(ROOT), encoding="utf-8")


if __name__ == "__main__":
    main()
