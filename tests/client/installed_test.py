# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What is told to who installed a wheel: nothing of a source tree that is not there."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import vla_cpp

PACKAGE = Path(vla_cpp.__file__).parent
METADATA = """\
Metadata-Version: 2.1
Name: vla-cpp
Version: 0.1.0
Requires-Dist: numpy>=1.21
Requires-Dist: rich<16,>=12; extra == "eval"
Requires-Dist: gguf<1,>=0.10; extra == "convert"
"""
CALLS = {
    "vla_cpp.Policy('x.gguf')": "install the wheel again",
    "vla_cpp.eval.serving.find_vla('')": "name it with --vla FILE",
    "print(vla_cpp.installed.extra_hint('convert'))": "pip install 'gguf<1,>=0.10'\n",
    "print(vla_cpp.installed.extra_hint('eval'))": "pip install 'rich<16,>=12'\n",
}


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with the package alone, without its library, as pip leaves it."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(PACKAGE, folder / "vla_cpp", ignore=shutil.ignore_patterns("lib", "__pycache__"))
    (folder / "vla_cpp-0.1.0.dist-info").mkdir()
    (folder / "vla_cpp-0.1.0.dist-info/METADATA").write_text(METADATA)
    return folder


@pytest.mark.parametrize("call", CALLS)
def test_a_hint_names_what_who_installed_a_wheel_has(installed, call):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("VLA_")} | {"PYTHONPATH": str(installed), "PATH": ""}
    code = "import vla_cpp, vla_cpp.installed, vla_cpp.eval.serving; " + call
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    told = answer.stdout + answer.stderr.strip().splitlines()[-1] if answer.stderr else answer.stdout
    assert CALLS[call] in told and "./python" not in told and "build/cpu" not in told, answer.stderr
