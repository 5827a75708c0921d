# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`make check` finds the program of a C++ test."""

import importlib.util
import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def loaded():
    spec = importlib.util.spec_from_file_location("check", ROOT / "scripts/check.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_source_with_precompiled_headers_of_another_target_belongs_to_its_own_program(tmp_path):
    check = loaded()
    check.BUILD = tmp_path
    sources = {name: ROOT / f"tests/{name}" for name in ("graph/work_test.cpp", "engine/golden_test.cpp")}

    def entry(name, program):
        headers = "-Winvalid-pch -include /build/tests/CMakeFiles/vla_test_headers.dir/cmake_pch.hxx"
        output = f"tests/CMakeFiles/{program}.dir/{name}.o"
        return {"directory": "/build", "file": str(sources[name]), "command": f"c++ {headers} -o {output} -c {sources[name]}"}

    commands = [
        entry("graph/work_test.cpp", "test_graph"),
        entry("engine/golden_test.cpp", "test_engine"),
        entry("engine/golden_test.cpp", "test_amx_machine"),
    ]
    (tmp_path / "compile_commands.json").write_text(json.dumps(commands))
    assert check.programs() == {sources["graph/work_test.cpp"]: "test_graph", sources["engine/golden_test.cpp"]: "test_engine"}


def test_a_source_of_a_group_belongs_to_the_groups_program(tmp_path):
    check = loaded()
    check.BUILD = tmp_path
    group = tmp_path / "tests/CMakeFiles/test_graph.dir/Unity/unity_0_cxx.cxx"
    group.parent.mkdir(parents=True)
    group.write_text(f'/* generated */\n\n#include "{ROOT}/tests/graph/work_test.cpp"\n\n#include "{ROOT}/tests/graph/other_test.cpp"\n')
    command = f"c++ -o tests/CMakeFiles/test_graph.dir/Unity/unity_0_cxx.cxx.o -c {group}"
    (tmp_path / "compile_commands.json").write_text(json.dumps([{"directory": str(tmp_path), "file": str(group), "command": command}]))
    assert check.programs() == {ROOT / f"tests/graph/{name}_test.cpp": "test_graph" for name in ("work", "other")}


def test_a_name_finds_files_and_tests():
    check = loaded()
    assert list(check.find("graph/work")) == [ROOT / "tests/graph/work_test.cpp"]
    name = re.search(r'TEST_CASE\("([^"]+)"', (ROOT / "tests/graph/work_test.cpp").read_text())[1]
    assert check.find(name)[ROOT / "tests/graph/work_test.cpp"] == [name]
