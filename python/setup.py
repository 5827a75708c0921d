# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A wheel carries libvla.so and the libraries that a system may lack, so that no compiler is needed where it is installed.

An editable install compiles nothing: it finds the library in the build of the source tree. Environment of a real one:

    VLA_BUILD_DIR   build folder to use or to make, below the source tree unless absolute (default: build/cpu where it was configured,
                    else build/wheel)
    CMAKE_ARGS      for the first configuration of it, e.g. -DVLA_NATIVE=ON for a ggml of this machine alone
"""

import os
import platform
import re
import shlex
import shutil
import subprocess
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = "libvla.so.1"
# Part of every system with Python and NumPy; a second copy would conflict.
SYSTEM = re.compile(r"linux-vdso|ld-linux|lib(c|m|dl|rt|pthread|stdc\+\+|gcc_s)\.so")


def run(*command):
    print("+", shlex.join(map(str, command)), flush=True)
    subprocess.run([str(word) for word in command], check=True)


def compile_library(build):
    """pip hides the output of a build that takes minutes, so progress goes to the terminal itself, if there is one."""
    command = ["cmake", "--build", str(build), "--target", "vla_shared", "--parallel", str(os.cpu_count() or 1)]
    print("+", shlex.join(command), flush=True)
    try:
        terminal = open("/dev/tty", "w")
    except OSError:
        terminal = open(os.devnull, "w")
    with terminal, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            print(line, end="")
            done = re.match(r"\[\s*(\d+(?:/\d+|%))\]", line)
            if done:
                print(f"\r  compiling the C++ runtime: {done[1]} ", end="", file=terminal, flush=True)
        print("\r" + " " * 50, end="\r", file=terminal)
    if process.returncode:
        raise SystemExit("the C++ runtime could not be compiled: pip install -v shows why")


def copy_licence(path, folder):
    """The licence of the Debian package that a carried library is from; other systems keep them elsewhere."""
    real = os.path.realpath(path)
    patterns = [real, real.replace("/usr/lib/", "/lib/", 1)]
    try:
        owner = subprocess.run(["dpkg-query", "-S", *patterns], capture_output=True, text=True).stdout.split(":")[0]
    except FileNotFoundError:
        return
    text = Path("/usr/share/doc") / owner / "copyright"
    if owner and text.is_file():
        shutil.copy(text, folder / f"LICENSE-{owner}")


def build_library(folder):
    """Builds libvla.so and installs it into `folder`, with what it needs beside it."""
    if not (ROOT / "CMakeLists.txt").is_file():
        raise SystemExit(f"{ROOT}: expected the source tree of vla.cpp around the folder python/, found none")
    configured = ROOT / "build/cpu"
    default = configured if (configured / "CMakeCache.txt").is_file() else ROOT / "build/wheel"
    build = ROOT / (os.environ.get("VLA_BUILD_DIR") or default)
    if not (build / "CMakeCache.txt").is_file():
        arguments = shlex.split(os.environ.get("CMAKE_ARGS", ""))
        run("cmake", "-S", ROOT, "-B", build, "-DCMAKE_BUILD_TYPE=Release", "-DVLA_BUILD_TESTS=OFF",
            "-DVLA_BUILD_SERVER=OFF", *arguments)
    compile_library(build)
    run("cmake", "--install", build, "--component", "library", "--prefix", build / "wheel_prefix")
    folder.mkdir(parents=True, exist_ok=True)
    library = next((build / "wheel_prefix").rglob(LIBRARY))
    shutil.copy(library, folder)
    listing = subprocess.run(["ldd", str(library)], check=True, capture_output=True, text=True).stdout
    for name, path in re.findall(r"^\s*(\S+) => (\S+)", listing, re.M):
        if not SYSTEM.match(name):
            shutil.copy(path, folder / name)
            copy_licence(path, folder)
    for notice in ("LICENSE", "LICENSES-third-party.md"):
        shutil.copy(ROOT / notice, folder)


class BuildWithLibrary(build_py):
    def run(self):
        super().run()
        if not self.editable_mode:
            build_library(Path(self.build_lib) / "vla_cpp" / "lib")


class PlatformWheel(bdist_wheel):
    def get_tag(self):
        """Any Python, since ctypes loads the library; systems whose C library is as new as this one's."""
        libc, version = platform.libc_ver()
        system = f"manylinux_{version.replace('.', '_')}_{platform.machine()}"
        return "py3", "none", system if libc == "glibc" else super().get_tag()[2]


class PlatformDistribution(Distribution):
    def has_ext_modules(self):
        return True


setup(cmdclass={"build_py": BuildWithLibrary, "bdist_wheel": PlatformWheel}, distclass=PlatformDistribution)
