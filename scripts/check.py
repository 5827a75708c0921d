#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Builds and runs the tests of one name.

make check T=processor/letterbox        the files of tests/ whose path has this in it, in C++ or Python
make check T=fills_the_rest             else the tests whose name has these words in it
make check T=cli/run::seed              tests of the first kind whose name has the second in it
"""

import argparse
import difflib
import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS, BUILD = ROOT / "tests", ROOT / "build/cpu"
CASE = re.compile(r'^\s*TEST_CASE\w*\(\s*((?:"(?:[^"\\]|\\.)*"\s*)+)', re.M)
FUNCTION = re.compile(r"^\s*def (test_\w+)\(", re.M)


def plain(text):
    """Words in lower case: names of tests are sentences in C++ and identifiers in Python."""
    return " ".join(re.findall(r"[a-z0-9/]+", text.lower()))


def names_of(file):
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".py":
        return FUNCTION.findall(text)
    return [re.sub(r'"\s*"', "", literals.strip())[1:-1] for literals in CASE.findall(text)]


def short(file):
    return file.relative_to(TESTS).with_suffix("").as_posix().removesuffix("_test")


def find(wanted):
    """{file: names of tests, or None for the whole file}."""
    files = sorted([*TESTS.glob("*/*_test.cpp"), *TESTS.glob("*/*_test.py")])
    path, _, name = wanted.partition("::")
    if not name:
        path = re.sub(r"^tests/|(_test)?(\.cpp|\.py)?$", "", path)
        exact = [f for f in files if path in (short(f), f.parent.name)]
        found = exact or [f for f in files if plain(path) in plain(short(f))]
        if found:
            return dict.fromkeys(found)
        path, name = "", wanted
    found = {f: [n for n in names_of(f) if plain(name) in plain(n)] for f in files if plain(path) in plain(short(f))}
    return {f: names for f, names in found.items() if names}


def near(wanted):
    files = sorted([*TESTS.glob("*/*_test.cpp"), *TESTS.glob("*/*_test.py")])
    known = {}
    for file in files:
        known.update({plain(short(file)): short(file), plain(file.stem): short(file)})
        known.update({plain(name): name for name in names_of(file)})
    return [known[key] for key in difflib.get_close_matches(plain(wanted), known, n=5, cutoff=0.5)]


def sources(file):
    """What a file compiles: of a group, those that it includes."""
    return [Path(name) for name in re.findall(r'^#include "(.+)"', file.read_text(), re.M)] if "Unity" in file.parts else [file]


def programs():
    """{source file: the program that has its tests}, where several have: that of its folder."""
    out = {}
    for entry in json.loads((BUILD / "compile_commands.json").read_text()):
        # Before -o a command names the folder of its precompiled headers too; not every CMake has "output".
        target = re.search(r"-o \S*CMakeFiles/(\w+)\.dir/", entry["command"])
        for file in sources(Path(entry["file"])) if target else []:
            if file not in out or target[1] == f"test_{file.parent.name}":
                out[file] = target[1]
    return out


def suites():
    """[(words of a command, environment)] of ctest."""
    listing = subprocess.run(["ctest", "--test-dir", BUILD, "--show-only=json-v1"], capture_output=True, text=True, check=True)
    out = []
    for test in json.loads(listing.stdout)["tests"]:
        values = {p["name"]: p["value"] for p in test["properties"]}
        environment = dict(pair.split("=", 1) for pair in values.get("ENVIRONMENT", []) if "=" in pair)
        out.append((test.get("command", []), environment))
    return out


def build(targets):
    if targets and subprocess.run(["cmake", "--build", BUILD, "--target", *sorted(targets)]).returncode:
        sys.exit("check: it does not build")


def run(command, environment):
    return subprocess.run(command, env={**os.environ, **environment}, cwd=ROOT).returncode


def check_cpp(found):
    of = programs()
    by_program = defaultdict(list)
    for file in found:
        if file in of:
            by_program[of[file]].append(file)
        else:
            print(f"check: {file.relative_to(ROOT)} is in no program of {BUILD.relative_to(ROOT)}: make asan && ctest --preset asan")
    build(by_program)
    failed = len(by_program) == 0
    for program, files in by_program.items():
        path = str(BUILD / "bin" / program)
        environment = next((e for command, e in suites() if command[:1] == [path]), {})
        # A filter of doctest has commas between its patterns, and no way to write one that all releases know.
        names = [re.sub(r'[,\\"]+', "?", name) + "*" for file in files for name in found[file] or []]
        sources = ",".join(f"*{file.relative_to(TESTS).as_posix()}" for file in files)
        filters = [f"--source-file={sources}"] + ([f"--test-case={','.join(names)}"] if names else [])
        failed |= run([path, *filters], environment) != 0
    return failed


def modules(folder):
    """What its tests import: modules of theirs, and of the folders that its conftest.py names."""
    conftest = folder / "conftest.py"
    others = re.findall(r'"(tests/\w+)"', conftest.read_text()) if conftest.is_file() else []
    return [m for f in (folder, *(ROOT / o for o in others)) for m in f.glob("*.py") if not m.name.endswith("_test.py")]


def outputs():
    lines = subprocess.run(["ninja", "-C", BUILD, "-t", "targets", "all"], capture_output=True, text=True, check=True).stdout
    return re.findall(r"^([^:\n]+): (?!phony)", lines, re.M)


def check_python(found):
    failed = False
    for folder in sorted({file.parent for file in found}):
        files = [file for file in found if file.parent == folder]
        text = "".join(module.read_text() for module in [*files, *modules(folder)])
        names = [name for file in files for name in found[file] or []]
        script = str(ROOT / "scripts/pytest.sh")
        # Two suites of a folder may differ only in what they leave out.
        environments = {tuple(sorted(environment.items())) for command, environment in suites() if command[:2] == [script, str(folder)]}
        for environment in map(dict, sorted(environments)):
            made = [value.removeprefix(f"{BUILD}/") for name, value in environment.items() if name in text]
            build([o for o in outputs() if any(o == m or o.startswith(f"{m}/") for m in made)])
            failed |= run([script, *map(str, files), *(["-k", " or ".join(names)] if names else [])], environment) != 0
    return failed


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="of a file or a test")
    wanted = parser.parse_args().name
    if not wanted:
        sys.exit("check: which test? make check T=processor/letterbox, or words of a test's name")
    found = find(wanted)
    if not found:
        close = near(wanted)
        sys.exit(f"check: no file or test of tests/ has {wanted!r} in its name"
                 + ("; near ones:\n  " + "\n  ".join(close) if close else ""))
    for file, names in found.items():
        print(f"check: {file.relative_to(ROOT)}" + "".join(f"\n         {name}" for name in names or []), flush=True)
    failed = [check(part) for check, suffix in ((check_cpp, ".cpp"), (check_python, ".py"))
              if (part := {f: n for f, n in found.items() if f.suffix == suffix})]
    return 1 if any(failed) else 0


if __name__ == "__main__":
    sys.exit(main())
