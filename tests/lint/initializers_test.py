#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""An aggregate of more than six fields is initialized by name: `Answered{.request = job}`, not `Answered{job, ...}`.

    python3 tests/lint/initializers_test.py

Seen are `Type{...}`, `Type name{...}`, `Type name = {...}`, and `return {...}` of functions that return Type or Result<Type>. The
rows of a table (`constexpr Type kRows[] = {{...}, ...}`) are columns, which stay as they are.
"""

import re
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MOST = 6


def without_comments(text):
    """The same lines without comments; nothing else looks like one in our sources."""
    return re.sub(r"(?<![:\"])//[^\n]*", "", text)


def braced(text, start):
    """What the brace at `start` encloses."""
    depth = 0
    for i in range(start, len(text)):
        depth += {"{": 1, "}": -1}.get(text[i], 0)
        if depth == 0:
            return text[start + 1 : i]
    return text[start + 1 :]


def n_field(name, body):
    """The fields of a struct; 0 where it is no aggregate."""
    while (shorter := re.sub(r"\{[^{}]*\}|\([^()]*\)|<[^<>;]*>", "", body)) != body:
        if re.search(rf"(?<![\w~]){name}\s*\(", body):
            return 0
        body = shorter
    if re.search(r"\b(virtual|private|protected)\b", body):
        return 0
    other = re.compile(r"\s*(static|using|enum|struct|class|friend|template|explicit|constexpr|auto|bool operator|operator)\b")
    fields = [d for d in body.split(";") if not other.match(d) and re.search(r"\w[>*&]*\s+[*&]?\w", d)]
    return sum(d.count(",") + 1 for d in fields)


def structs(texts):
    """Names of large aggregates. Where two structs have one name, both must be large."""
    out = {}
    for text in texts:
        for found in re.finditer(r"\bstruct (\w+)(?: final)?(?:\s*:[^{;]*)?\s*\{", text):
            n = n_field(found[1], braced(text, found.end() - 1))
            out[found[1]] = min(out.get(found[1], n), n)
    return {name for name, n in out.items() if n > MOST}


def positional(text, names):
    """(line, type) of every initialization by position."""
    any_of = "|".join(sorted(names))
    places = [(m.start(), m[1], m.end()) for m in
              re.finditer(rf"(?<!struct )(?<!class )\b({any_of})(?: \w+(?: =)? ?| ?= ?)?\{{", text)]
    for m in re.finditer(rf"(?m)^[^\n;{{}}]*\b({any_of})\b>? [\w:]+\([^;{{}}]*\)[^;{{}}]*\{{", text):
        body = braced(text, m.end() - 1)
        places += [(m.end() + r.start(), m[1], m.end() + r.end()) for r in re.finditer(r"\breturn \{", body)]
    return [(text.count("\n", 0, at) + 1, name) for at, name, inside in places if re.match(r"\s*[^\s.}]", text[inside:])]


def problems(files, declared):
    names = structs(without_comments(text) for text in declared.values())
    return [f"{path}:{line}: {name} has more than {MOST} fields: name them" for path, text in files.items()
            for line, name in positional(without_comments(text), names)]


def sources(*folders):
    return {p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8")
            for f in folders for p in sorted((ROOT / f).rglob("*")) if p.suffix in (".h", ".cpp")}


class Initializers(unittest.TestCase):
    def test_large_aggregates_are_initialized_by_name(self):
        files = sources("src")
        self.assertEqual(problems(files, files), [])

    def test_every_way_to_leave_the_names_out_is_seen(self):
        large = {"a.h": "struct Large {\n  int a = 0, b = 0;\n  std::map<int, int> c, d;  // one\n  float *e, f;\n  bool g;\n"
                        "  int sum(int x) const { return a + x; }\n  static Large make();\n};\nstruct Small {\n  int a, b;\n};\n"}
        for text in ("Large x{1, 2};", "Large x = {1};", "f(Large{1});", "Result<Large> f(int x) {\n  return {x};\n}",
                     "Large Large::make() {\n  return {1};\n}"):
            self.assertEqual(len(problems({"b.cpp": text}, large)), 1, text)
        for text in ("Large x{.a = 1};", "Large x = {};", "Small x = {1, 2};", "struct Other : Large {\n  int h;\n};",
                     "Large f() { return {.a = 1}; }", "Large kRows[] = {{1, 2}};"):
            self.assertEqual(problems({"b.cpp": text}, large), [], text)


if __name__ == "__main__":
    unittest.main()
