#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Packs what tries vla.cpp on a GPU elsewhere into one archive: programs, their libraries, tests of kernels, golden cases and a small policy.

    .venv/bin/python scripts/gpu_kit/pack.py [--build build/cpu] [--out out] [--small | --smallest]     # make gpu-kit

There, on a machine with NVIDIA's driver and Python: python3 -m tarfile -e vla-gpu-kit.tar.xz && python3 vla-gpu-kit/try_gpu.py RESULT"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "tools"), str(ROOT / "tests/cli")]

NAME, MOST = "vla-gpu-kit", 48 << 20  # bytes of the archive; what takes it elsewhere may have a limit of 64 MiB
LARGE = 4 << 20  # bytes of a bundle
SCRIPTS = ("try_gpu.py", "trace.py", "cublas.py", "probe.py")
# Of the C library, which every machine has with its loader; and the run time of C++, which an old machine lacks.
OF_THE_SYSTEM = re.compile(r"(libc|libm|libdl|libpthread|librt|libresolv|ld-linux[^/]*|libcuda)\.so")
RUNTIME = ("libstdc++.so.6", "libgcc_s.so.1")
TINY = ROOT / "models/metaworld-tiny.gguf"


def run(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"error: {' '.join(map(str, command))}: {done.stderr.strip()}")
    return done.stdout


def copy_programs(build, kit):
    """Programs without symbols, libraries that they are linked to, and what runs them and PyTorch from Python."""
    for folder in ("bin/ptx", "lib", "runtime"):
        (kit / folder).mkdir(parents=True)
    images = sorted((build / "src/cuda/ptx").iterdir())  # PTX and machine code
    programs = [build / "bin" / name for name in ("vla", "bench_products", "bench_attention_gpu", "test_kernels_gpu")]
    files = [*programs, build / "lib/libvla.so.1", build / "lib/libvla-cuda.so"]
    for file in files:
        if not file.is_file():
            sys.exit(f"error: {file}: expected what make cuda builds, found nothing")
        if file.name not in ("vla", "libvla.so.1"):
            inside = file.read_bytes()
            for image in images:
                if image.read_bytes() not in inside:
                    sys.exit(f"error: {file}: expected {image.name} of this build inside, found none or another; make cuda again")
        shutil.copy(file, kit / "bin" / file.name)
        run("strip", "--strip-unneeded", kit / "bin" / file.name)
    for file in files:
        for library in re.findall(r"=> (/\S+)", run("ldd", file)):
            name = Path(library).name
            if not OF_THE_SYSTEM.match(name):
                shutil.copy(library, kit / ("runtime" if name in RUNTIME else "lib") / name)
    for image in images:
        shutil.copy(image, kit / "bin/ptx")  # among programs that have the same bytes, which xz then finds
    for folder in ("python/vla_cpp", "tools/goldens", "tests/golden/tokenizers/smolvla"):
        shutil.copytree(ROOT / folder, kit / folder, ignore=shutil.ignore_patterns("__pycache__", "eval", "export"))
    (kit / "tools/peers").mkdir()
    for program in ("gpu.py", "peer.py"):
        shutil.copy(ROOT / "tools/peers" / program, kit / "tools/peers")


def copy_tiny(vla, kit):
    """The shipped policy, an observation of it, and what the CPU answers here."""
    frame = ROOT / "examples/metaworld/episodes/faucet-open/step_00.png"
    (kit / "tiny").mkdir()
    shutil.copy(TINY, kit / "tiny/policy.gguf")
    shutil.copy(frame, kit / "tiny/frame.png")
    asked = lambda image: ["--image", f"corner4={image}", "--state", "0.0045,0.4003,0.1957,1", "--text", "open the faucet", "--seed", "1", "--json"]  # noqa: E731
    answer = lambda kernels: json.loads(run(vla, "run", TINY, *asked(frame), "--kernels", kernels).splitlines()[-1])["actions"]  # noqa: E731
    answers = {kernels: answer(kernels) for kernels in ("float32", "int8", "int4")}
    answers["bf16"] = answers["float32"]  # not every CPU multiplies bf16
    (kit / "tiny/act.json").write_text(json.dumps({"arguments": asked("tiny/frame.png"), "answers": answers}))


def chosen_cases(is_small, is_smallest=False):
    """All golden cases, but of those with a large bundle (ACT's, whose vision tower has one size) the smallest of an architecture, or none.
    The smallest kit has the smallest case alone of any architecture, and none with a large bundle."""
    from golden_cases import NAMES, Golden

    by_size = sorted(NAMES, key=lambda name: Golden(name).bundle.stat().st_size)
    is_large = {name: Golden(name).bundle.stat().st_size > LARGE for name in NAMES}
    first = {name.split("/")[0]: name for name in reversed(by_size)}
    if is_smallest:
        return [name for name in NAMES if not is_large[name] and name in first.values()]
    return [name for name in NAMES if not is_large[name] or (not is_small and name in first.values())]


def copy_cases(kit, names):
    """Golden cases as command lines, with how far PyTorch's bf16 is from float32 there."""
    import numpy as np
    from golden_cases import Golden, tensors

    packed = []
    for name in names:
        case, inside = Golden(name), f"cases/{name}"
        for file in {case.bundle, case.noise, case.expected, *filter(None, case.images.values())}:
            copy = kit / inside / file.relative_to(case.folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, copy)
        arguments = [str(word).replace(str(case.folder), inside) for word in case.arguments()]
        expected = tensors(case.expected)
        bf16 = None
        if "chunk.bf16" in expected:
            bf16 = float(np.abs(expected["chunk.bf16"] - expected["chunk"]).max() / np.abs(expected["chunk"]).max())
        packed.append({"name": name, "arguments": arguments, "expected": f"{inside}/{case.expected.name}", "bf16": bf16})
    (kit / "cases.json").write_text(json.dumps(packed, indent=1))


def copy_scripts(kit):
    """What runs the programs, and which commit and families they are of."""
    import model_tables

    for script in SCRIPTS:
        shutil.copy(HERE / script, kit)
    describe = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
    commit = subprocess.run(describe, capture_output=True, text=True).stdout.strip() or "of a tree without git"
    (kit / "kit.json").write_text(json.dumps({"commit": commit, "families": model_tables.registered(ROOT)}))


def owned_by_nobody(entry):
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    return entry


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build", type=Path, default=ROOT / "build/cpu")
    parser.add_argument("--out", type=Path, default=ROOT / "out")
    parser.add_argument("--small", action="store_true", help="without ACT's golden case, 12 MiB less")
    parser.add_argument("--smallest", action="store_true", help="with one golden case of each other architecture, 28 MiB less")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        kit = Path(folder) / NAME
        kit.mkdir()
        copy_programs(options.build, kit)
        copy_tiny(options.build / "bin/vla", kit)
        copy_cases(kit, chosen_cases(options.small, options.smallest))
        copy_scripts(kit)
        options.out.mkdir(parents=True, exist_ok=True)
        archive = options.out / f"{NAME}.tar.xz"
        with tarfile.open(archive, "w:xz", preset=9) as tar:  # whose window is larger than two programs, as all have the same kernels
            tar.add(kit, arcname=NAME, filter=owned_by_nobody)
    size = archive.stat().st_size
    print(f"{archive}: {size / (1 << 20):.1f} MiB")
    if size > MOST:
        sys.exit(f"error: {archive}: expected at most {MOST >> 20} MiB")


if __name__ == "__main__":
    main()
