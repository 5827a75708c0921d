# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The golden cases by the runtime, beside the reference's numbers: the rows of docs/models.md.

    python tools/parity_golden.py ARCH [--vla build/cpu/bin/vla]

Needs numpy and gguf, not torch: what the reference computed lies in expected.gguf.  Distances are relative to the largest
magnitude of each tap.
"""
import argparse
import tempfile
from pathlib import Path

import numpy as np
from goldens.build import make
from goldens.recorder import read_taps
from parity_full import ROOT, distance, run_vla


def row(vla, case, taps_file):
    """One line of the table: worst block, actions, and how far the published dtypes are in PyTorch."""
    expected = read_taps(case / "expected.gguf")
    got, _, _ = run_vla(vla, case, case / "bundle.gguf", "*", taps_file, threads=1)
    shared = {n: distance(got[n].ravel(), x.ravel())[1] for n, x in expected.items() if n in got}
    blocks = {n: d for n, d in shared.items() if n != "actions"}
    worst = max(blocks, key=blocks.get)
    published = distance(expected["chunk.bf16"], expected["chunk"])[1]
    same_rows = np.array_equal(expected.get("position_ids"), expected.get("position_ids.bf16"))
    note = "" if same_rows else " (reads other position rows)"
    return (f"| `{case.name}` | {len(blocks)} | {blocks[worst]:.1e} at `{worst}` | {shared['actions']:.1e} "
            f"| {published:.1e}{note} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arch", help="folder of tests/golden")
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    args = parser.parse_args()
    print("| case | blocks | largest distance of a block | actions | chunk of PyTorch in the published dtypes |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for expected in sorted(make().glob(f"{args.arch}/*/expected.gguf")):
            print(row(args.vla, expected.parent, Path(folder) / "taps.gguf"))


if __name__ == "__main__":
    main()
