#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A registered policy is complete: lists what is missing for every POLICY(name) of src/policies/registry.inc.

    python3 tests/lint/registry_test.py
"""
import sys
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path += [str(ROOT / "scripts"), str(ROOT / "tools")]
from goldens.recorder import EVERY_TAP  # noqa: E402
from model_tables import registered, written  # noqa: E402


def problems(root):
    """`name: what is missing`, over the five touches of an architecture."""
    found = []
    for name in registered(root):
        mapping = f"python/vla_cpp/convert/archs/{name}"
        for paths in ((f"src/policies/{name}.cpp",), (f"{mapping}/__init__.py", f"{mapping}.py")):
            if not any((root / path).is_file() for path in paths):
                found.append(f"{name}: missing {paths[0]}")
        if not list((root / "tests/golden" / name).glob("*/expected.gguf")):
            found.append(f"{name}: missing a case with expected.gguf under tests/golden/{name}/")
        if not any(case.startswith(f"{name}/") for case in EVERY_TAP):
            found.append(f"{name}: missing a case of which every tap is kept, in tools/goldens/recorder.py")
        if not (root / f"docs/models/{name}.json").is_file():
            found.append(f"{name}: missing docs/models/{name}.json")
    return found


class Registry(unittest.TestCase):
    def test_every_registered_policy_has_source_mapping_fixture_and_document(self):
        self.assertTrue(registered(ROOT), "src/policies/registry.inc registers nothing")
        found = problems(ROOT)
        self.assertFalse(found, "\n" + "\n".join(found))

    def test_the_tables_of_the_documents_are_those_of_the_registry(self):
        for document, text in written(ROOT).items():
            self.assertEqual((ROOT / document).read_text(encoding="utf-8"), text, f"{document}: run scripts/model_tables.py")

    def test_a_policy_of_one_line_lacks_four_things(self):
        with tempfile.TemporaryDirectory() as folder:
            registry = Path(folder) / "src/policies/registry.inc"
            registry.parent.mkdir(parents=True)
            registry.write_text("// one line per policy\nPOLICY(pi0)\n")
            self.assertEqual(len(problems(Path(folder))), 4)


if __name__ == "__main__":
    unittest.main()
