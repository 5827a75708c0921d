# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes src/processor/python_classes.inc and python_lower.inc: characters as the reference's Python sees them, found by asking it.

    python tests/reference/make_python_unicode.py src/processor

Needs Python 3.11, whose tables are of Unicode 14: a later Python lower-cases and keeps more characters.
"""

import sys
import unicodedata

from unicode_tables import CODE_POINTS, write_classes, write_lowered

ALNUM, CASED, IGNORABLE, PRINTABLE = 1, 2, 4, 8


def classes() -> list[int]:
    """The last sigma of a word is lower-cased in another way, which tells the characters that make words from those that do not."""
    flags = [0] * 0x110000
    for c in CODE_POINTS:
        ends = [(head + chr(c) + "\u03a3").lower()[-1] == "\u03c2" for head in ("", "a")]
        flags[c] = ALNUM * chr(c).isalnum() + CASED * ends[0] + IGNORABLE * (ends[1] and not ends[0]) + PRINTABLE * chr(c).isprintable()
    return flags


def main() -> None:
    assert unicodedata.unidata_version == "14.0.0", unicodedata.unidata_version
    source = f"tests/reference/make_python_unicode.py from Python's Unicode {unicodedata.unidata_version}"
    write_classes(sys.argv[1] + "/python_classes.inc", source, classes())
    write_lowered(sys.argv[1] + "/python_lower.inc", source, str.lower)


main()
