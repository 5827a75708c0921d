#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the tables of architectures into README.md, docs/models.md and docs/bundle.md: a row for each name of
src/policies/registry.inc, from docs/models/NAME.json, between the comments `models: TABLE` and `end`.

    python3 scripts/model_tables.py            # tests/lint/registry_test.py compares

docs/models/NAME.json holds {"name": what people call it, TABLE: its row, or its rows, without the first column, ...}.
"""
import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = ("README.md", "docs/models.md", "docs/bundle.md")
BLOCK = re.compile(r"(?<=<!-- models: )(\w+)( -->)(\n(?:[^\n]*\n){2})?(.*?)(?=<!-- end -->)", re.S)  # a table begins with two lines


def registered(root):
    text = (root / "src/policies/registry.inc").read_text(encoding="utf-8")
    return re.findall(r"^\s*POLICY\(\s*(\w+)\s*\)", text, re.M)


def cells(table, arch, model):
    """(first column, row) of every row of a table."""
    found = model.get(table, [])
    rows = found if found and isinstance(found[0], list) else [found] if found else []
    if table == "overview":  # sizes behind the name
        return [(", ".join([model["name"], *row[:1]]).removesuffix(", "), row[1:]) for row in rows]
    if table == "golden":  # the cases are counted
        n_case = len(list((ROOT / "tests/golden" / arch).glob("*/expected.gguf")))
        return [(f"`{arch}`", [row[0], str(n_case), *row[1:]]) for row in rows]
    return [("" if i else f"`{arch}`", row) for i, row in enumerate(rows)]


def block(table, models):
    if table == "names":
        *most, last = [model["name"] for model in models.values()]
        return f"{', '.join(most)} and {last}"
    if table == "types":
        return ", ".join(f"`{arch}`" for arch in models)
    rows = [cell for arch, model in models.items() for cell in cells(table, arch, model)]
    return "".join(re.sub(r" {2,}", " ", f"| {' | '.join([first, *row])} |\n") for first, row in rows)


def written(root):
    """{document: its text with the tables as they should be}"""
    models = {name: json.loads((root / f"docs/models/{name}.json").read_text(encoding="utf-8")) for name in registered(root)}
    texts = {name: (root / name).read_text(encoding="utf-8") for name in DOCUMENTS}
    return {name: BLOCK.sub(lambda m: m[1] + m[2] + (m[3] or "") + block(m[1], models), text) for name, text in texts.items()}


if __name__ == "__main__":
    for document, text in written(ROOT).items():
        (ROOT / document).write_text(text, encoding="utf-8")
