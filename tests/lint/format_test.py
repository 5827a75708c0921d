#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""C++ sources are as clang-format writes them, every source file starts with the two SPDX lines, and no text is half merged.

    python3 tests/lint/format_test.py

Releases of clang-format disagree about the same configuration, so the layout is checked with one release only (the one
of Debian 12 and Ubuntu 22.04) and skipped with its reason elsewhere.
"""
import re
import shutil
import subprocess
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RELEASE = "14"
SOURCES = {".h", ".c", ".cpp", ".inc", ".cu", ".cuh", ".py", ".sh", ".cmake"}
NAMED = {"CMakeLists.txt", "Makefile"}
COPYRIGHT, LICENCE = "SPDX-FileCopyrightText: The vla.cpp authors", "SPDX-License-Identifier: Apache-2.0"

MERGE_MARK = re.compile(r"^(<{7}|>{7})( |$)", re.MULTILINE)


def tracked(*folders):
    """Files of the repository, as git lists them: new ones too, ignored ones not."""
    command = ["git", "-C", str(ROOT), "ls-files", "--cached", "--others", "--exclude-standard", *folders]
    try:
        listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):  # a copy of the tree without git
        listing = [p.relative_to(ROOT).as_posix() for f in folders or (".",) for p in (ROOT / f).rglob("*")]
        listing = [p for p in listing if not re.match(r"(build|\.venv|\.git)/", p)]
    return [ROOT / p for p in listing if (ROOT / p).is_file()]


def without_header(file):
    """Whether a source file lacks the two lines; a line for the shell may come before them."""
    head = file.read_text(encoding="utf-8").splitlines()[:3]
    head = head[1:] if head and head[0].startswith("#!") else head
    return len(head) < 2 or COPYRIGHT not in head[0] or LICENCE not in head[1]


def wanted_clang_format():
    """(program, None), or (None, the reason why the layout cannot be checked here)."""
    for name in (f"clang-format-{RELEASE}", "clang-format"):
        program = shutil.which(name)
        if program:
            version = subprocess.run([program, "--version"], capture_output=True, text=True).stdout
            found = re.search(r"version (\d+)", version)
            if found and found[1] == RELEASE:
                return program, None
            return None, f"clang-format is release {found[1] if found else '?'}, the layout is that of release {RELEASE}"
    return None, "clang-format is not installed"


class Format(unittest.TestCase):
    maxDiff = None

    def test_every_source_file_starts_with_the_licence_lines(self):
        files = [f for f in tracked() if f.suffix in SOURCES or f.name in NAMED]
        self.assertTrue(files, "no source files found")
        bare = [f.relative_to(ROOT).as_posix() for f in files if without_header(f)]
        self.assertFalse(bare, "\nfiles without the two SPDX lines:\n" + "\n".join(bare))

    def test_no_text_holds_the_marks_of_an_unfinished_merge(self):
        texts = [f for f in tracked() if f.suffix in SOURCES | {".md", ".txt", ".toml", ".json", ".proto"} or f.name in NAMED]
        marked = [f.relative_to(ROOT).as_posix() for f in texts if MERGE_MARK.search(f.read_text(encoding="utf-8"))]
        self.assertFalse(marked, "\nfiles with lines of <<<<<<< or >>>>>>>:\n" + "\n".join(marked))

    def test_cpp_sources_are_as_clang_format_writes_them(self):
        program, reason = wanted_clang_format()
        if reason:
            print(f"SKIP test_cpp_sources_are_as_clang_format_writes_them: {reason}")
            self.skipTest(reason)
        files = [str(f) for f in tracked("src", "tests", "include", "examples") if f.suffix in (".h", ".c", ".cpp", ".cu")]
        result = subprocess.run([program, "--dry-run", "-Werror", "--style=file", *files], capture_output=True, text=True)
        wrong = sorted({line.split(":")[0].removeprefix(f"{ROOT}/") for line in result.stderr.splitlines() if ": error:" in line})
        self.assertEqual(result.returncode, 0, "\nnot as clang-format writes them (run: make format):\n" + "\n".join(wrong))


if __name__ == "__main__":
    unittest.main()
