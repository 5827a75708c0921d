# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""pip install ./python: a wheel that carries the library and needs numpy alone, and no compiler where it runs."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from commands import ROOT, run

PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
ACT = """
import json, sys
import numpy as np
import vla_cpp
bundle, state, text, out, images = sys.argv[1], *map(json.loads, sys.argv[2:])
images = {name: file and open(file, "rb").read() for name, file in images.items()}
with vla_cpp.Policy(bundle, threads=2) as policy:
    np.save(out, np.asarray(policy.act(images=images, state=state, text=text, seed=4)))
loaded = {line.split()[-1] for line in open("/proc/self/maps") if ".so" in line}
print(json.dumps({"loaded": sorted(loaded), "modules": sorted(sys.modules), "package": vla_cpp.__file__}))
"""


@pytest.fixture(scope="module")
def wheel(build, tmp_path_factory):
    """Built in a copy, because setuptools leaves folders in the tree that it builds."""
    folder = tmp_path_factory.mktemp("wheel")
    python = folder / "tree/python"
    ignored = shutil.ignore_patterns("build", "dist", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT / "python", python, ignore=ignored)
    for name in ("CMakeLists.txt", "LICENSE", "LICENSES-third-party.md"):
        shutil.copy(ROOT / name, folder / "tree")
    environment = {**os.environ, "VLA_BUILD_DIR": str(build)}
    run(*PIP, "wheel", "--no-deps", "--no-build-isolation", python, "-w", folder, env=environment)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def bare(wheel, tmp_path_factory):
    """The python of a new environment that has this wheel and numpy."""
    folder = tmp_path_factory.mktemp("bare")
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    packages = next(folder.glob("lib/python*/site-packages"))
    run(*PIP, "install", "--no-index", "--no-deps", "--target", packages, wheel)
    installed = Path(np.__file__).parents[1]
    for package in installed.glob("numpy*"):
        (packages / package.name).symlink_to(package)
    return folder / "bin/python"


def test_the_wheel_is_for_any_python_3_of_this_platform_and_carries_the_library_with_its_licences(wheel):
    assert re.fullmatch(r"vla_cpp-[\d.]+-py3-none-(many)?linux\w*\.whl", wheel.name)
    names = zipfile.ZipFile(wheel).namelist()
    carried = {name.split("/")[-1] for name in names if name.startswith("vla_cpp/lib/")}
    assert "vla_cpp/bin/vla" in names
    assert {"libvla.so.1", "LICENSE", "LICENSES-third-party.md"} <= carried
    assert "vla_cpp/py.typed" in names
    libraries = {name for name in carried if ".so" in name} - {"libvla.so.1"}
    assert not any(re.match(r"lib(c|m|stdc\+\+|gcc_s)\.so", name) for name in libraries)
    if shutil.which("dpkg-query"):
        owners = {
            subprocess.run(["dpkg-query", "-S", f"*/{name}"], capture_output=True, text=True).stdout.split(":")[0] for name in libraries
        }
        assert {name.removeprefix("LICENSE-") for name in carried if name.startswith("LICENSE-")} == owners


def test_in_an_environment_with_numpy_alone_and_no_programs_act_gives_the_bytes_of_vla_run(
    bare, golden, chunk_of_run, tmp_path
):
    images = {view: file and str(file) for view, file in golden.images.items()}
    arguments = [golden.state, golden.text, str(tmp_path / "got.npy"), images]
    command = [bare, "-c", ACT, golden.bundle, *map(json.dumps, arguments)]
    environment = {"PATH": str(tmp_path), "OMP_NUM_THREADS": "2"}
    told = json.loads(run(*command, env=environment, cwd=tmp_path))
    assert np.load(tmp_path / "got.npy").tobytes() == chunk_of_run(golden, seed=4).tobytes()
    assert not {"torch", "zmq", "google.protobuf", "gguf"} & set(told["modules"])
    ours = Path(told["package"]).parent / "lib"
    loaded = {Path(path) for path in told["loaded"] if (ours / Path(path).name).is_file()}
    assert {path.name for path in loaded if path.parent != ours} <= {"libz.so.1"}  # Python has loaded one of that name before
    assert {"libvla.so.1", "libfmt.so.9"} <= {path.name for path in loaded} or shutil.which("dpkg-query") is None


def test_the_program_runs_on_the_libraries_beside_it(bare, tmp_path):
    packages = next(bare.parents[1].glob("lib/python*/site-packages"))
    version = run(bare, "-m", "vla_cpp.program", "--version", env={"PATH": str(tmp_path)}, cwd=tmp_path)
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", version)
    found = dict(re.findall(r"^\s*(\S+) => (\S+)", run("ldd", packages / "vla_cpp/bin/vla"), re.M))
    ours = packages / "vla_cpp/lib"
    assert "libzmq.so.5" in found and all(Path(found[p.name]).resolve() == p for p in ours.iterdir() if p.name in found)
    told = json.loads(run(bare, "-m", "vla_cpp.program", "doctor", "--json", env={"PATH": str(tmp_path)}, cwd=tmp_path))
    assert told["build"]["server"] and told["machine"]["cores"] > 0


def test_an_editable_install_compiles_nothing(tmp_path):
    tree = tmp_path / "tree/python"
    shutil.copytree(ROOT / "python", tree, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    code = f"from setuptools.build_meta import build_editable; build_editable({str(tmp_path)!r})"
    run(sys.executable, "-c", code, cwd=tree, env={**os.environ, "PATH": str(tmp_path)})  # no cmake to be found
    assert len(list(tmp_path.glob("*.whl"))) == 1 and not list(tree.rglob("*.so*"))


def test_a_relative_build_folder_is_one_of_the_source_tree(tmp_path):
    """pip runs setup.py in the folder of the package."""
    tree, programs, called = tmp_path / "tree", tmp_path / "bin", tmp_path / "called"
    shutil.copytree(ROOT / "python", tree / "python", ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    (tree / "build/wheel").mkdir(parents=True)
    (tree / "build/wheel/CMakeCache.txt").touch()
    shutil.copy(ROOT / "CMakeLists.txt", tree)
    programs.mkdir()
    (programs / "cmake").write_text(f'#!/bin/sh\necho "$@" >> {called}\nexit 1\n')
    (programs / "cmake").chmod(0o755)
    environment = {**os.environ, "VLA_BUILD_DIR": "build/wheel", "PATH": f"{programs}:{os.environ['PATH']}"}
    command = [*PIP, "wheel", "--no-deps", "--no-build-isolation", tree / "python", "-w", tmp_path]
    subprocess.run([str(word) for word in command], capture_output=True, env=environment)
    assert called.read_text().startswith(f"--build {tree}/build/wheel ")


def test_without_the_source_tree_around_it_the_package_says_so(tmp_path):
    shutil.copytree(ROOT / "python", tmp_path / "python", ignore=shutil.ignore_patterns("build", "*.egg-info"))
    command = [*PIP, "wheel", "--no-deps", "--no-build-isolation", tmp_path / "python", "-w", tmp_path]
    result = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    assert result.returncode != 0 and "expected the source tree of vla.cpp" in result.stdout + result.stderr
