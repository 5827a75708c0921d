# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes src/processor/python_classes.inc and python_lower.inc: characters as the reference's Python sees them, found by asking it.

    python tests/reference/make_python_unicode.py src/processor

Needs Python 3.11, whose tables are of Unicode 14: a later Python lower-cases and keeps more characters.
"""

import sys
import unicodedata

ALNUM, CASED, IGNORABLE = 1, 2, 4
CODE_POINTS = [c for c in range(0x110000) if not 0xD800 <= c <= 0xDFFF]


def classes() -> list[int]:
    """The last sigma of a word is lower-cased in another way, which tells the characters that make words from those that do not."""
    flags = [0] * 0x110000
    for c in CODE_POINTS:
        ends = [(head + chr(c) + "\u03a3").lower()[-1] == "\u03c2" for head in ("", "a")]
        flags[c] = ALNUM * chr(c).isalnum() + CASED * ends[0] + IGNORABLE * (ends[1] and not ends[0])
    return flags


def lowered() -> list[list[int]]:
    """[first, last, step, distance] of characters whose lower case lies equally far away."""
    runs: list[list[int]] = []
    for c in CODE_POINTS:
        lower = chr(c).lower()
        if lower == chr(c) or c == 0x130:
            continue
        assert len(lower) == 1, hex(c)  # U+0130 alone becomes two
        distance = ord(lower) - c
        if runs and runs[-1][3] == distance:
            first, last, step, _ = runs[-1]
            if c - last == step or (first == last and c - last <= 2):
                runs[-1] = [first, c, c - last, distance]
                continue
        runs.append([c, c, 1, distance])
    return runs


def write(path: str, what: str, cells: list[str]) -> None:
    lines = []
    for cell in cells:
        if not lines or len(lines[-1]) + len(cell) + 1 > 118:
            lines.append(cell)
        else:
            lines[-1] += " " + cell
    with open(path, "w") as out:
        out.write("// SPDX-FileCopyrightText: The vla.cpp authors\n// SPDX-License-Identifier: Apache-2.0\n")
        out.write("// Written by tests/reference/make_python_unicode.py from Python's Unicode ")
        out.write(f"{unicodedata.unidata_version}: {what}.\n// clang-format off\n")
        out.write("\n".join(lines) + "\n")
    print(f"{path}: {len(cells)} runs")


def main() -> None:
    assert unicodedata.unidata_version == "14.0.0", unicodedata.unidata_version
    flags = classes()
    runs = [(c, flags[c]) for c in range(0x110000) if c == 0 or flags[c] != flags[c - 1]]
    write(sys.argv[1] + "/python_classes.inc", "first code point of a run, classes", [f"{{0x{c:x}, {f}}}," for c, f in runs])
    cells = [f"{{0x{a:x}, 0x{b:x}, {step}, {d}}}," for a, b, step, d in lowered()]
    write(sys.argv[1] + "/python_lower.inc", "first and last of a run, step, distance to lower case", cells)


main()
