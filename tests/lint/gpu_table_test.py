#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""docs/gpu.md says of GPUs what docs/gpu/*.json has, and scripts/gpu_table.py keeps predictions apart from measurements.

    python3 tests/lint/gpu_table_test.py
"""

import json
import sys
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "scripts"))
import gpu_table  # noqa: E402

VISIT = {
    "card": "NVIDIA H100 80GB HBM3",
    "driver": "driver for CUDA 13.0",
    "date": "2026-12-01",
    "commit": "0123456789ab",
    "checks": {"tests of kernels": {"passed": True, "seconds": 3}, "golden cases": {"passed": False, "seconds": 9}},
    "cases": {"passed": 199, "failed": ["pi0/two_views, bf16: why"]},
    "families": {
        "smolvla": {
            "stored": {"ms": {"steps": 8.0, "network": 12.0, "total": 13.0}},
            "traced": {"act_ms": 12.5, "kernels": [{"kernel": "norm_rows", "n": 2, "ms": 0.1, "median_us": 3.0, "least_us": 2.0, "most_us": 9.0}]},
            "torch": {"eager": 100.0, "graph": 25.0, "compiled": None},
            "predicted": {"model": "h100", "ms": {"total": 6.0}},
        },
        "pi05": {"stored": None, "predicted": {"model": "h100", "ms": {"total": 12.4}}},
    },
    "products": [{"kind": "bf16", "rows": 1, "depth": 2, "columns": 3, "shape": "few", "splits": 4, "us": 6.0, "warm_us": 5.0, "tera": 1.0}],
    "cublas": [{"rows": 1, "depth": 2, "columns": 3, "us": 5.0, "warm_us": 4.0}],
}


def cells(text, first):
    """The table's row that begins with this, by the names of its columns."""
    table = next(part for part in text.split("\n\n") if f"\n| {first} " in part).splitlines()
    row = next(line for line in table if line.startswith(f"| {first} "))
    split = lambda line: [cell.strip() for cell in line.strip("|").split("|")]  # noqa: E731
    return dict(zip(split(table[0]), split(row)))


class GpuTableTest(unittest.TestCase):
    def test_the_page_says_what_the_data_say(self):
        self.assertEqual((ROOT / "docs/gpu.md").read_text(encoding="utf-8"), gpu_table.written(ROOT), "run python3 scripts/gpu_table.py")

    def test_a_measurement_stands_beside_its_prediction_and_the_best_of_pytorch(self):
        row = cells(gpu_table.block([VISIT]), "`smolvla`")
        self.assertEqual((row["network"], row["predicted"], row["predicted / network"]), ("12.00", "6.00", "0.50"))
        self.assertEqual((row["acts back to back"], row["best of PyTorch / acts"], row["compiled"]), ("12.50", "2.00", "not measured"))

    def test_what_was_not_measured_says_so_where_a_prediction_stands(self):
        row = cells(gpu_table.block([VISIT]), "`pi05`")
        measured = {name: cell for name, cell in row.items() if name not in ("ms, medians", "predicted")}
        self.assertEqual(set(measured.values()), {"not measured"})
        self.assertEqual(row["predicted"], "12.40")

    def test_acts_in_another_way_stand_beside_those_as_estimated(self):
        ways = {"without clusters": {"ms": {"network": 7.5}}, "with tma": None}
        families = {"smolvla": {"stored": {"ms": {"network": 7.0}}, "ways": ways}}
        row = cells("\n".join(gpu_table.ways({"families": families})).strip(), "`smolvla`")
        self.assertEqual((row["as estimated"], row["without clusters"], row["with tma"]), ("7.00", "7.50", "not measured"))

    def test_failed_checks_and_cuBLAS_are_told(self):
        text = gpu_table.block([VISIT])
        self.assertIn("1 of 2 checks passed (failed: golden cases); golden cases: 199 hold, 1 do not.", text)
        self.assertEqual(cells(text, "bf16, 1 x 2 x 3")["ours / cuBLAS"], "1.20")

    def test_a_result_is_kept_by_card_and_date_but_not_one_of_the_driver_of_tests(self):
        with tempfile.TemporaryDirectory() as folder:
            root, result = Path(folder), Path(folder) / "result.json"
            (root / "docs").mkdir()
            (root / "docs/gpu.md").write_text("a\n<!-- gpu: measured -->\nold\n<!-- end -->\nb\n")
            result.write_text(json.dumps(VISIT))
            self.assertEqual(gpu_table.keep(root, result), root / "docs/gpu/nvidia-h100-80gb-hbm3-2026-12-01.json")
            self.assertEqual(gpu_table.written(root), f"a\n<!-- gpu: measured -->\n{gpu_table.block([VISIT])}<!-- end -->\nb\n")
            for change in ({"driver_of_tests": True}, {"card": None}):
                result.write_text(json.dumps({**VISIT, **change}))
                with self.assertRaises(SystemExit):
                    gpu_table.keep(root, result)


if __name__ == "__main__":
    unittest.main()
