# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What is installed: the header, the library and what it shows, and the ways in which other projects find it."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest
from commands import ROOT, run
from golden_cases import Golden

HEADER = ROOT / "include/vla/vla.h"
STRICT = ["-Wall", "-Wextra", "-pedantic", "-Werror"]


def floats(text):
    return np.array([line.split() for line in text.splitlines()], np.float32)


def test_the_header_is_c99_and_cpp_without_a_warning(tmp_path):
    (tmp_path / "alone.c").write_text("#include <vla/vla.h>\n")
    for compiler, *language in (["cc", "-std=c99"], ["cc", "-std=c17"], ["c++", "-x", "c++", "-std=c++11"]):
        run(compiler, *language, *STRICT, "-fsyntax-only", f"-I{ROOT}/include", tmp_path / "alone.c")


def test_exactly_the_functions_of_the_header_are_exported(build):
    declared = set(re.findall(r"^VLA_API .*?\b(vla_\w+)\(", HEADER.read_text(), re.M))
    lines = run("nm", "--dynamic", "--defined-only", build / "lib/libvla.so").splitlines()
    assert len(declared) > 10 and {line.split()[-1] for line in lines} == declared


def test_the_library_of_the_loop_exports_its_namespace_alone(build):
    lines = run("nm", "--dynamic", "--defined-only", "--demangle", build / "lib/libvla-control.so").splitlines()
    names = [re.sub(r"^[0-9a-f]+ \w (typeinfo (name )?for |vtable for )?", "", line) for line in lines]
    assert any(name.startswith("vla::control::ChunkLoop::step") for name in names)
    assert [name for name in names if not name.startswith("vla::control::")] == []


def test_ggml_and_our_own_rooms_are_inside_the_library_and_its_name_has_the_version(build):
    dynamic = run("readelf", "--dynamic", "--wide", build / "lib/libvla.so")
    version = re.search(r"#define VLA_ABI_VERSION (\d+)", HEADER.read_text())[1]
    assert f"soname: [libvla.so.{version}]" in dynamic
    assert not re.search(r"NEEDED.*(ggml|vla)", dynamic)


def test_an_installation_has_these_files_and_no_others(prefix, build):
    files = {path.relative_to(prefix).as_posix() for path in prefix.rglob("*") if not path.is_dir()}
    assert files == {
        "bin/vla", "libexec/vla/vla-door-lerobot", "include/vla/vla.h", "lib/libvla.so", "lib/libvla.so.1", "lib/pkgconfig/vla.pc",
        "include/vla/control.h", "lib/libvla-control.so.0.1", "lib/libvla-control.so.0.1.0",
        *(f"lib/cmake/vla/{f}.cmake" for f in ("vlaConfig", "vlaConfigVersion", "vlaTargets", "vlaTargets-release")),
        "share/doc/vla/LICENSE", "share/doc/vla/LICENSES-third-party.md", "share/vla/vla.proto",
        "share/man/man1/vla.1", "share/bash-completion/completions/vla",
        *(f"lib/{library.name}" for library in build.glob("lib/libvla-*.so")),  # where the build has other devices
    }  # fmt: skip
    assert (
        run(prefix / "bin/vla", "--version").strip()
        == run("pkg-config", "--modversion", prefix / "lib/pkgconfig/vla.pc").strip()
    )


@pytest.mark.parametrize("case", ["two_views", "absent_view"])
def test_an_outside_project_finds_the_package_and_gets_the_bytes_of_vla_run(
    prefix, tmp_path, case, chunk_of_run, example_arguments
):
    """tests/capi/outside is copied away, so that nothing of this tree is found by accident; it builds both examples."""
    shutil.copytree(ROOT / "tests/capi/outside", tmp_path / "outside")
    for example in ("c/act.c", "cpp/act.cpp", "cpp/controller.cpp"):
        shutil.copy(ROOT / "examples" / example, tmp_path / "outside")
    moved = shutil.copytree(prefix, tmp_path / "moved", symlinks=True)  # an installation may be moved
    run("cmake", "-S", tmp_path / "outside", "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={moved}")
    run("cmake", "--build", tmp_path / "build")
    golden = Golden(case)
    expected = chunk_of_run(golden, seed=5)
    for program in ("act_c", "act_cpp"):
        got = floats(run(tmp_path / "build" / program, *example_arguments(golden, 5)))
        assert got.tobytes() == expected.tobytes()
    told = subprocess.run([tmp_path / "build/controller"], capture_output=True, text=True)
    assert told.returncode == 2 and "controller ADDRESS LIMITS TEXT SECONDS VIEW=FILE" in told.stderr


def test_a_later_minor_version_is_not_taken_for_this_one(prefix, tmp_path):
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(o C)\nfind_package(vla 0.99 QUIET)\n"
        'if(vla_FOUND)\n  message(FATAL_ERROR "found")\nendif()\n'
    )
    run("cmake", "-S", tmp_path, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={prefix}")


def test_pkg_config_tells_the_flags_with_which_the_c_example_builds_and_runs(
    prefix, tmp_path, golden, chunk_of_run, example_arguments
):
    environment = {**os.environ, "PKG_CONFIG_PATH": str(prefix / "lib/pkgconfig")}
    flags = run("pkg-config", "--cflags", "--libs", "vla", env=environment).split()
    run("cc", "-std=c99", *STRICT, ROOT / "examples/c/act.c", *flags, "-o", tmp_path / "act")
    environment = {**os.environ, "LD_LIBRARY_PATH": str(prefix / "lib")}
    got = floats(run(tmp_path / "act", *example_arguments(golden, 9), env=environment))
    assert got.tobytes() == chunk_of_run(golden, seed=9).tobytes()
