# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The packages for 64-bit ARM (make deb-arm64, make wheel-arm64), unpacked and run under an emulator."""

import os
import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SYSROOT = ROOT / ".cache/sysroot-arm64"
IMAGE = next((ROOT / "examples/metaworld/episodes").rglob("*.png"))
BUNDLE = ROOT / "models/metaworld-tiny.gguf"
ACT = ["--image", f"corner4={IMAGE}", "--state", "0,0.4,0.2,1", "--text", "open the faucet", "--seed", "3"]
# What a system with Python and NumPy has (python/setup.py).
SYSTEM = r"(ld-linux|lib(c|m|dl|rt|pthread|resolv|stdc\+\+|gcc_s)\.so).*"


def output(*command):
    answer = subprocess.run(list(map(str, command)), capture_output=True, text=True, env={**os.environ, "QEMU_CPU": "cortex-a76"})
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


def newest(pattern):
    found = sorted((ROOT / "out").glob(pattern), key=lambda path: path.stat().st_mtime)
    assert found, f"out/{pattern}: expected a package, found none: make deb-arm64 wheel-arm64"
    return found[-1]


@pytest.fixture(scope="module")
def deb():
    return newest("vla_*_arm64.deb")


@pytest.fixture(scope="module")
def installed(deb, tmp_path_factory):
    folder = tmp_path_factory.mktemp("deb")
    output("dpkg-deb", "-x", deb, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Its package, and a root with the libraries of the system that it relies on and no others."""
    folder = tmp_path_factory.mktemp("wheel")
    zipfile.ZipFile(newest("vla_cpp-*_aarch64.whl")).extractall(folder)
    for path in SYSROOT.glob("**/lib/aarch64-linux-gnu/*.so*"):
        if re.fullmatch(SYSTEM, path.name):
            (folder / "root/lib/aarch64-linux-gnu").mkdir(parents=True, exist_ok=True)
            shutil.copy(path, folder / "root/lib/aarch64-linux-gnu")
    shutil.copy(next(SYSROOT.glob("**/ld-linux-aarch64.so.1")), folder / "root/lib")
    return folder


def check(emulator, program):
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", output(*emulator, program, "--version"))
    assert "smolvla" in output(*emulator, program, "inspect", BUNDLE)
    assert output(*emulator, program, "run", BUNDLE, *ACT, "--threads", "2").startswith("step")


def test_the_debian_package_tells_its_architecture_and_what_it_depends_on(deb):
    assert output("dpkg-deb", "-f", deb, "Architecture").strip() == "arm64"
    depends = output("dpkg-deb", "-f", deb, "Depends")
    for package in ("libc6 (>= 2.", "libstdc++6", "libzmq5", "libprotobuf-lite"):
        assert package in depends


def test_the_debian_package_has_program_library_manual_and_unit(installed):
    for name in ("bin/vla", "lib/aarch64-linux-gnu/libvla.so.1", "include/vla/vla.h", "share/man/man1/vla.1"):
        assert (installed / "usr" / name).is_file(), name
    assert (installed / "lib/systemd/system/vla@.service").is_file()


def test_the_program_of_the_debian_package_runs_the_shipped_policy(installed):
    check(["qemu-aarch64", "-L", SYSROOT], installed / "usr/bin/vla")


def test_programs_and_libraries_may_be_loaded_with_pages_of_64_kib(installed):
    for name in ("bin/vla", "lib/aarch64-linux-gnu/libvla.so.1"):
        segments = re.findall(r"^\s+LOAD.* (0x[0-9a-f]+)$", output("readelf", "--segments", "--wide", installed / "usr" / name), re.M)
        assert segments and all(int(alignment, 16) >= 0x10000 for alignment in segments)


def test_the_wheel_is_for_the_glibc_that_its_files_need_and_carries_what_a_system_may_lack(wheel):
    name = newest("vla_cpp-*_aarch64.whl").name
    version = re.fullmatch(r"vla_cpp-[\d.]+-py3-none-manylinux_2_(\d+)_aarch64\.whl", name)
    assert version and 17 <= int(version[1]) <= 40
    carried = {path.name for path in (wheel / "vla_cpp/lib").iterdir()}
    assert {"libvla.so.1", "LICENSE"} <= carried and any(name.startswith("libzmq.so") for name in carried)


def test_the_program_of_the_wheel_runs_with_no_other_libraries(wheel):
    program = wheel / "vla_cpp/bin/vla"
    program.chmod(0o755)
    libraries = f"LD_LIBRARY_PATH={wheel / 'vla_cpp/lib'}"
    check(["qemu-aarch64", "-L", wheel / "root", "-E", libraries], program)
