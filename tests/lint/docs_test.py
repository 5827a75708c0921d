#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the documents name exists: every path, `--flag`, make target and function in README.md, CONTRIBUTING.md, python/README.md and docs/*.md.

    python3 tests/lint/docs_test.py

Looked at are code spans, code blocks and links. A path is a word that starts with a top-level folder of the tree;
<name>, {name} and * stand for anything. A flag is looked up in the program that its command line starts with; a flag on its own may
belong to any of ours. Flags of other programs (cmake, pip, git) are theirs to document. A span `Type::name` or `name()` is a
function of src/ or python/.
"""
import re
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLACES = ("src", "python", "scripts", "tests", "docs", "examples", "cmake", "include", "assets", ".ci")
MADE = ("build/", ".venv/")  # written by the build: named, but not in the tree
PROGRAMS = {  # program -> files in whose text its flags are written
    "vla": ("src/cli/*.cpp",),
    "vla-convert": ("python/vla_cpp/**/*.py",),
    "vla-pull": ("python/vla_cpp/pull.py",),
    "vla-export": ("python/vla_cpp/export/*.py",),
    "vla-limits": ("python/vla_cpp/control/suggest.py",),
}
ANY_OF_OURS = ("src/cli/*.cpp", "python/**/*.py", "scripts/*", "scripts/gpu_kit/*.py", "tools/**/*.py", "examples/**/*.py", "tests/lint/*.py")
FLAG = re.compile(r"(?<![\w-])--[a-z][\w-]*")


def commands(text):
    """Code of a document as command lines: spans, and lines of blocks with what continues them on indented lines."""
    lines, block = [], False
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            block = not block
        elif block or line.startswith("    "):
            line = line.split(" # ")[0] if line.strip()[:1] != "#" else ""
            if block and line[:1].isspace() and lines:
                lines[-1] += " " + line.strip()
            else:
                lines.append(line.strip())
        else:
            lines += [span for span in re.findall(r"`([^`]+)`", line)]
    return [line.removeprefix("$ ") for line in lines if line]


def named_paths(command):
    """Words of a command that claim to be files of the tree, as patterns for glob."""
    for word in re.split(r"(?:[\s=;()'\"]|,(?![^{}]*\}))+", command):  # a comma inside {b,c} is part of the word
        word = word.rstrip(".:").removeprefix("./")
        if word.startswith(MADE) or not word.startswith(tuple(f"{p}/" for p in PLACES)):
            continue
        for one in expand(re.sub(r"::.*|:\d+$", "", word)):
            yield re.sub(r"<[^>]*>|\{[^}]*\}|\bNAME\b|…|\.\.\.", "*", one)


def expand(word):
    """`a/{b,c}` as a/b and a/c."""
    found = re.search(r"\{([^{}]*,[^{}]*)\}", word)
    if not found:
        return [word]
    return [w for part in found[1].split(",") for w in expand(word[: found.start()] + part + word[found.end():])]


def sources_of(command):
    """Glob patterns of the sources that must write the flags of this command; None if the program is not ours."""
    words = [w for w in command.split() if not re.fullmatch(r"[A-Z_]+=\S*", w)]
    if not words:  # `NAME=` alone
        return None
    program = words[0].rsplit("/", 1)[-1]
    if program in PROGRAMS:
        return PROGRAMS[program]
    if program.startswith("--") or program.startswith("[--"):
        return ANY_OF_OURS
    # The kit's programs are packed from that folder.
    scripts = [w.removeprefix("./").replace("vla-gpu-kit/", "scripts/gpu_kit/") for w in words[:2] if w.endswith((".py", ".sh"))]
    return tuple(scripts) or None


def named_functions(text):
    """(type or empty, name) of every span that is a function: `Engine::act`, `draw_noise()`."""
    for span in re.findall(r"`([^`\n]+)`", text):
        found = re.fullmatch(r"(?:(\w+)::)?(\w+)(\(\))?", span)
        if found and (found[1] or found[3]):
            yield found[1] or "", found[2]


def is_function(root, owner, name):
    """Whether a source defines or declares it: as `owner::name(`, in the file of `owner`, or anywhere without an owner."""
    files = [f for place in ("src/**/*.h", "src/**/*.cpp", "python/**/*.py") for f in root.glob(place)]
    called = re.compile(rf"\b{owner}::{name}\s*\(" if owner else rf"\b{name}\s*\(")
    inline = re.compile(rf"\b(?:class|struct) {owner}\b.*\b{name}\s*\(", re.S)
    texts = [f.read_text(encoding="utf-8") for f in files]
    return any(called.search(text) or (owner and inline.search(text)) for text in texts)


def problems(root):
    """`document: what it names and where that was sought`."""
    found = []
    makefile = (root / "Makefile").read_text() if (root / "Makefile").is_file() else ""
    targets = set(re.findall(r"^([\w-]+):(?!=)", makefile, re.M))
    for document in [root / "README.md", *root.glob("CONTRIBUTING.md"), *root.glob("python/README.md"), *sorted((root / "docs").glob("*.md"))]:
        text, name = document.read_text(encoding="utf-8"), document.relative_to(root).as_posix()
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            if "://" not in link and not (document.parent / link).exists():
                found.append(f"{name}: link to {link}, which does not exist")
        for owner, function in sorted(set(named_functions(text))):
            if not is_function(root, owner, function):
                found.append(f"{name}: no function {owner}{'::' if owner else ''}{function} in src/ or python/")
        for command in commands(text):
            for path in named_paths(command):
                if not list(root.glob(path.rstrip("/"))):
                    found.append(f"{name}: names {path}, which does not exist")
            found += [f"{name}: `{command}`: {p}" for p in command_problems(root, command, targets)]
    return found


def untested_rows(root, text):
    """Rows of the tables whose last column is `test in tests/` that name no test there, or one that does not exist."""
    rows, in_table = [], False
    for line in text.splitlines():
        if line.endswith("| test in `tests/` |"):
            in_table = True
        elif not line.startswith("|"):
            in_table = False
        elif in_table and not line.startswith("| ---"):
            named = re.findall(r"`([^`]+)`", line.rstrip("| ").rsplit("|", 1)[-1] if not line.endswith("| |") else "")
            if not named or not all((root / "tests" / name).is_file() for name in named):
                rows.append(line)
    return rows


def command_problems(root, command, targets):
    words = command.split()
    if words[0] == "make":
        wanted = [w for w in words[1:] if re.fullmatch(r"[a-z][\w-]*", w)]
        return [f"the Makefile has no target {w}" for w in wanted if w not in targets]
    sources = sources_of(command)
    if sources is None:
        return []
    text = "\n".join(f.read_text(encoding="utf-8") for s in sources for f in root.glob(s) if f.is_file())
    flags = set(FLAG.findall(command)) - {"--help", "--version"}
    return [f"no {flag} in {', '.join(sources)}" for flag in sorted(flags) if not re.search(rf"{flag}(?![\w-])", text)]


class Documents(unittest.TestCase):
    maxDiff = None

    def check(self, readme, **files):
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            for path, text in {"README.md": readme, **{k.replace("__", "/"): v for k, v in files.items()}}.items():
                (root / path).parent.mkdir(parents=True, exist_ok=True)
                (root / path).write_text(text)
            return problems(root)

    def test_every_path_flag_and_target_that_a_document_names_exists(self):
        found = problems(ROOT)
        self.assertFalse(found, "\n" + "\n".join(found))

    def test_every_limit_and_fault_of_security_names_the_test_that_holds_it(self):
        text = (ROOT / "docs/security.md").read_text(encoding="utf-8")
        self.assertEqual(untested_rows(ROOT, text), [])
        row = "| what | test in `tests/` |\n| --- | --- |\n| a | `serve/queue_test.cpp` |\n"
        self.assertEqual(untested_rows(ROOT, row), [])
        gone, none = "| b | `serve/queue_test.cpp`, `serve/gone_test.cpp` |", "| c | |"
        self.assertEqual(untested_rows(ROOT, f"{row}{gone}\n{none}\n"), [gone, none])

    def test_a_path_that_is_gone_is_named(self):
        self.assertEqual(self.check("see `src/engine/gone.cpp`"), ["README.md: names src/engine/gone.cpp, which does not exist"])

    def test_a_placeholder_matches_any_name_but_not_none(self):
        self.assertEqual(len(self.check("`src/policies/<arch>.cpp`")), 1)
        self.assertEqual(self.check("`src/policies/<arch>.cpp`", **{"src__policies__pi0.cpp": ""}), [])

    def test_each_path_of_a_list_in_braces_is_sought(self):
        found = self.check("`src/{engine,gone}`, `src/engine`,`src/none`", **{"src__engine__a.cpp": ""})
        self.assertEqual([f.split()[2] for f in found], ["src/gone,", "src/none,"])

    def test_a_flag_is_sought_in_the_program_that_the_command_starts_with(self):
        readme = "```\nvla run FILE --dtype f32\n```\nand `vla-convert DIR --dtype f32`"
        files = {"src__cli__run.cpp": '"--image"', "python__vla_cpp__convert__main.py": '"--dtype"'}
        self.assertEqual(len(self.check(readme, **files)), 1)

    def test_an_indented_line_of_a_block_continues_the_command_above(self):
        found = self.check("```\nvla run FILE\n        [--gone X]\n```\n", **{"src__cli__run.cpp": ""})
        self.assertIn("no --gone", found[0])

    def test_flags_of_other_programs_are_not_ours_to_check(self):
        self.assertEqual(self.check("`cmake --preset cpu`, `pip install --no-deps x`, `NAME=`"), [])

    def test_a_make_target_that_is_gone_is_named(self):
        self.assertIn("no target demo", self.check("`make demo`", Makefile="test:\n")[0])

    def test_a_function_that_is_gone_is_named_and_one_that_stands_in_a_class_is_found(self):
        source = {"src__engine__engine.h": "class Engine {\n  void act(int x);\n};\nint draw_noise(int seed);\n"}
        self.assertEqual(self.check("`Engine::act`, then `draw_noise()`", **source), [])
        self.assertEqual(len(self.check("`Engine::gone`, then `gone()`, in a `Mapping` of `x`", **source)), 2)

    def test_a_broken_link_is_named(self):
        self.assertIn("link to docs/gone.md", self.check("[text](docs/gone.md)")[0])


if __name__ == "__main__":
    unittest.main()
