# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of characters as the processor includes them: what make_unicode_classes.py and make_python_unicode.py share."""

from typing import Callable

CODE_POINTS = [c for c in range(0x110000) if not 0xD800 <= c <= 0xDFFF]


def lowered(lower: Callable[[str], str]) -> list[list[int]]:
    """[first, last, step, distance] of characters whose lower case lies equally far away."""
    runs: list[list[int]] = []
    for c in CODE_POINTS:
        small = lower(chr(c))
        if small == chr(c) or c == 0x130:
            continue
        assert len(small) == 1, hex(c)  # U+0130 alone becomes two
        distance = ord(small) - c
        if runs and runs[-1][3] == distance:
            first, last, step, _ = runs[-1]
            if c - last == step or (first == last and c - last <= 2):
                runs[-1] = [first, c, c - last, distance]
                continue
        runs.append([c, c, 1, distance])
    return runs


def write_classes(path: str, source: str, flags: list[int]) -> None:
    runs = [(c, flags[c]) for c in range(0x110000) if c == 0 or flags[c] != flags[c - 1]]
    _write(path, f"{source}: first code point of a run, classes", [f"{{0x{c:x}, {f}}}," for c, f in runs])


def write_lowered(path: str, source: str, lower: Callable[[str], str]) -> None:
    cells = [f"{{0x{a:x}, 0x{b:x}, {step}, {d}}}," for a, b, step, d in lowered(lower)]
    _write(path, f"{source}: first and last of a run, step, distance to lower case", cells)


def _write(path: str, what: str, cells: list[str]) -> None:
    lines = []
    for cell in cells:
        if not lines or len(lines[-1]) + len(cell) + 1 > 118:
            lines.append(cell)
        else:
            lines[-1] += " " + cell
    with open(path, "w") as out:
        out.write("// SPDX-FileCopyrightText: The vla.cpp authors\n// SPDX-License-Identifier: Apache-2.0\n")
        out.write(f"// Written by {what}.\n// clang-format off\n")
        out.write("\n".join(lines) + "\n")
    print(f"{path}: {len(cells)} runs")
