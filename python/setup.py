# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A wheel carries libvla.so, the program `vla` and the libraries that a system may lack, so that no compiler is needed where it is
installed.

An editable install compiles nothing: it finds the library in the build of the source tree. Environment of a real one:

    VLA_BUILD_DIR   build folder to use or to make, below the source tree unless absolute (default: build/cpu where it was configured,
                    else build/wheel)
    CMAKE_ARGS      for the first configuration of it, e.g. -DVLA_NATIVE=ON for a ggml of this machine alone
    VLA_SYSROOT     where that folder is a build for 64-bit ARM, the libraries that it was built with (make wheel-arm64)
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
SYSROOT = os.environ.get("VLA_SYSROOT")
SYSTEM = re.compile(r"linux-vdso|ld-linux|lib(c|m|dl|rt|pthread|resolv|stdc\+\+|gcc_s)\.so")


def run(*command):
    print("+", shlex.join(map(str, command)), flush=True)
    subprocess.run([str(word) for word in command], check=True)


def compile_runtime(build):
    """pip hides the output of a build that takes minutes, so progress goes to the terminal itself, if there is one."""
    command = ["cmake", "--build", str(build), "--target", "vla_shared", "vla", "--parallel", str(os.cpu_count() or 1)]
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


def output(*command):
    return subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True).stdout


def loaded(*files):
    """{name: path} of the libraries that files load, those of the system left out."""
    if not SYSROOT:
        return {n: path for n, path in re.findall(r"^\s*(\S+) => (\S+)", output("ldd", *files), re.M) if not SYSTEM.match(n)}
    found, waiting = {}, list(files)
    while waiting:
        for name in re.findall(r"\(NEEDED\).*\[(.*)\]", output("readelf", "--dynamic", "--wide", waiting.pop())):
            if not SYSTEM.match(name) and name not in found:
                found[name] = next(Path(SYSROOT).glob(f"**/lib/aarch64-linux-gnu/{name}"))
                waiting.append(found[name])
    return found


def copy_licence(path, folder):
    """The licence of the Debian package that a carried library is from; other systems keep them elsewhere."""
    real = os.path.realpath(path)
    if SYSROOT:  # as the same package's library is called here
        real = "/" + os.path.relpath(real, os.path.realpath(SYSROOT)).replace("aarch64", platform.machine())
    patterns = [real, real.replace("/usr/lib/", "/lib/", 1)]
    try:
        owner = subprocess.run(["dpkg-query", "-S", *patterns], capture_output=True, text=True).stdout.split(":")[0]
    except FileNotFoundError:
        return
    text = Path("/usr/share/doc") / owner / "copyright"
    if owner and text.is_file():
        shutil.copy(text, folder / f"LICENSE-{owner}")


def build_runtime(package):
    """Builds libvla.so and vla, and installs them into lib/ and bin/ of the package, with what they need beside the library."""
    if not (ROOT / "CMakeLists.txt").is_file():
        raise SystemExit(f"{ROOT}: expected the source tree of vla.cpp around the folder python/, found none")
    configured = ROOT / "build/cpu"
    default = configured if (configured / "CMakeCache.txt").is_file() else ROOT / "build/wheel"
    build = ROOT / (os.environ.get("VLA_BUILD_DIR") or default)
    if not (build / "CMakeCache.txt").is_file():
        arguments = shlex.split(os.environ.get("CMAKE_ARGS", ""))
        run("cmake", "-S", ROOT, "-B", build, "-DCMAKE_BUILD_TYPE=Release", "-DVLA_BUILD_TESTS=OFF", *arguments)
    compile_runtime(build)
    prefix = build / "wheel_prefix"
    for component in ("library", "program"):
        run("cmake", "--install", build, "--component", component, "--prefix", prefix, "--strip")
    for folder in ("lib", "bin"):
        shutil.rmtree(package / folder, ignore_errors=True)  # of an earlier build
        (package / folder).mkdir(parents=True)
    library, programs = next(prefix.rglob(LIBRARY)), [prefix / "bin/vla", prefix / "libexec/vla/vla-door-lerobot"]
    shutil.copy(library, package / "lib")
    for program in programs:
        shutil.copy(program, package / "bin")
    for name, path in loaded(*programs, library).items():
        shutil.copy(path, package / "lib" / name)
        copy_licence(path, package / "lib")
    for notice in ("LICENSE", "LICENSES-third-party.md"):
        shutil.copy(ROOT / notice, package / "lib")


class BuildWithRuntime(build_py):
    def run(self):
        super().run()
        if not self.editable_mode:
            build_runtime(Path(self.build_lib) / "vla_cpp")


def needed_libc(package):
    """The oldest glibc 2.N of a system that has what the carried files need of its C and C++ libraries, as auditwheel tells it."""
    files = [*package.glob("lib/*.so*"), *package.glob("bin/*")]
    needs = output("readelf", "--version-info", "--wide", *files)
    c, cpp = (max(map(int, re.findall(rf"\b{name}(\d+)\b", needs))) for name in (r"GLIBC_2\.", r"GLIBCXX_3\.4\."))
    if cpp > 30:  # newer than the table: as new as here
        return int(platform.libc_ver()[1].split(".")[1])
    return max(c, 35 if cpp == 30 else 34 if cpp == 29 else 0)


class PlatformWheel(bdist_wheel):
    def get_tag(self):
        """Any Python, since ctypes loads the library."""
        package = Path(self.get_finalized_command("build_py").build_lib) / "vla_cpp"
        if platform.libc_ver()[0] != "glibc" or not (package / "bin").is_dir():  # an editable install carries nothing
            return "py3", "none", super().get_tag()[2]
        machine = "aarch64" if SYSROOT else platform.machine()
        return "py3", "none", f"manylinux_2_{needed_libc(package)}_{machine}"


class PlatformDistribution(Distribution):
    def has_ext_modules(self):
        return True


setup(cmdclass={"build_py": BuildWithRuntime, "bdist_wheel": PlatformWheel}, distclass=PlatformDistribution)
