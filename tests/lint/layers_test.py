#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Includes point down only: reads the #include lines under src/ and names every pair that does not. 
    python3 tests/lint/layers_test.py
"""
import re
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GRAPH = {"base", "bundle", "graph"}
NETWORK = {"nn", "modules", "policies"}
# What each library may include besides itself. Policies and modules record operations and know neither devices nor the
# host side.
MAY_INCLUDE = {
    "base": set(),
    "bundle": {"base"},
    "graph": {"base", "bundle"},
    "kernels": {"base", "bundle"},
    "ggml": GRAPH | {"lower"},  # its host folder: matrices on their way from the file
    "vulkan": GRAPH | {"ggml"},  # compiled into a library of its own, as is the next
    "cuda": GRAPH | {"ggml"},
    "lower": GRAPH | {"kernels", "cuda"},
    "devices": GRAPH | {"kernels", "lower", "ggml"},
    "nn": GRAPH,
    "processor": {"base", "bundle"},
    "modules": GRAPH | {"nn"},
    "policies": GRAPH | {"nn", "modules"},
    "engine": GRAPH | NETWORK | {"devices", "processor"},
    "quantize": GRAPH | NETWORK | {"kernels", "lower", "devices", "processor", "engine"},
    "bench": GRAPH | NETWORK | {"kernels", "devices", "processor", "engine"},
    "net": {"base"},
    "zmtp": {"base", "net"},
    "wire": {"base"},
    "control": {"base", "wire"},  # a library of its own
    "observe": {"base", "engine", "net", "wire"},
    "serve": {"engine", "processor", "bundle", "base", "net", "zmtp", "wire", "observe"},
    "door": {"base", "net", "wire", "serve"},  # the process that a front end has of its own
    "capi": {"engine", "policies", "processor", "bundle", "base"},
    "cli": {"engine", "policies", "processor", "bundle", "base", "serve", "observe", "zmtp", "wire", "bench", "quantize"},  # front ends that the program opens
}
# Libraries that belong to some libraries: no other sees their headers, not through any number of ours either. The engine's taps are a
# GGUF file of tensors.
EXTERNAL = [
    (re.compile(r"gguf\.h"), {"bundle", "engine"}),
    (re.compile(r"ggml(-.*)?\.h"), {"ggml", "vulkan", "cuda"}),
    (re.compile(r"vulkan/.*"), {"vulkan"}),
    (re.compile(r"cuda_runtime_api\.h|cublas_v2\.h"), {"cuda"}),
    (re.compile(r"CLI/.*"), {"cli"}),
    (re.compile(r"nlohmann/.*"), {"processor", "cli", "observe", "serve", "bench", "control"}),
    (re.compile(r"jpeglib\.h"), {"processor"}),
    (re.compile(r"utf8proc\.h"), {"processor"}),
    (re.compile(r"png\.h"), {"processor", "bench"}),
    (re.compile(r"google/protobuf/.*"), {"wire", "observe", "serve"}),
    (re.compile(r"nghttp2/.*"), {"door"}),
    (re.compile(r"prometheus/.*"), {"observe", "cli"}),  # cli keeps the metrics
    (re.compile(r"zmq\.h(pp)?"), {"observe", "zmtp", "control"}),  # of a client; keys in Z85
    (re.compile(r"boost/.*"), {"net", "zmtp", "observe", "serve", "door"}),
    (re.compile(r"msgpack\.hpp"), {"serve"}),
    (re.compile(r"sodium\.h"), {"zmtp"}),
]
# Files of lower beside the folder of a machine hold for every machine, but for the one that chooses.
EVERY_MACHINE = re.compile(r"lower/(ops/)?(?!arithmetic)\w+\.(h|cpp)")
INCLUDE = re.compile(r'^\s*#\s*include\s*(?:"([^"]+)"|<([^>]+)>)', re.M)


def external_problem(folder, header):
    """Why `folder` may not include <header>, or None."""
    for pattern, libraries in EXTERNAL:
        if pattern.fullmatch(header):
            return None if folder in libraries else f"belongs to {', '.join(sorted(libraries))}"
    return None


def includes(file):
    """(header in quotes or empty, header in angle brackets or empty) of each #include."""
    return INCLUDE.findall(file.read_text(encoding="utf-8"))


def reached(src, header, known):
    """{header of a library: the header of ours that includes it} of all that including src/<header> shows."""
    if header not in known:
        known[header] = {}  # while it is looked at: headers that include each other end here
        for quoted, angled in includes(src / header) if (src / header).is_file() else ():
            known[header].update(dict.fromkeys(reached(src, quoted, known), quoted) if quoted else {angled: header})
    return known[header]


def problems(src):
    """`file: includes "x": reason` for every include that points up, or shows a library of another library."""
    found, known = [], {}
    for file in sorted(p for p in src.rglob("*") if p.suffix in (".h", ".cpp", ".inc", ".cu", ".cuh")):
        name = file.relative_to(src).as_posix()
        folder = name.split("/")[0]
        if folder not in MAY_INCLUDE:
            found.append(f"{name}: is in no library; libraries are {', '.join(MAY_INCLUDE)}")
            continue
        for quoted, angled in includes(file):
            header = quoted or angled
            other = header.split("/")[0]
            reason = external_problem(folder, header)
            if other in MAY_INCLUDE and other != folder and other not in MAY_INCLUDE[folder]:
                reason = f"{folder} may include {', '.join(sorted(MAY_INCLUDE[folder])) or 'only itself'}"
            elif EVERY_MACHINE.fullmatch(name) and header.startswith(("kernels/", "ggml/", "cuda/", "lower/cpu/", "lower/cuda/")):
                reason = "holds for every machine"
            elif quoted and other not in MAY_INCLUDE:
                reason = reason or "is named by no library; write the path from src/"
            for library, through in reached(src, quoted, known).items() if quoted and not reason else ():
                if problem := external_problem(folder, library):
                    reason = f"shows <{library}> through {through}, which {problem}"
            if reason:
                found.append(f'{name}: includes "{header}": {reason}')
    return found


class Layers(unittest.TestCase):
    maxDiff = None

    def check(self, files):
        with tempfile.TemporaryDirectory() as folder:
            for name, text in files.items():
                (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
                (Path(folder) / name).write_text(text)
            return problems(Path(folder))

    def test_every_include_under_src_points_down(self):
        self.assertTrue(list((ROOT / "src").rglob("*.cpp")), "no sources found: is this the repository?")
        found = problems(ROOT / "src")
        self.assertFalse(found, "\n" + "\n".join(found))

    def test_an_include_of_a_higher_library_is_named_with_its_file(self):
        found = self.check({"nn/linear.cpp": '#include "engine/engine.h"\n#include "graph/graph.h"\n'})
        self.assertEqual(len(found), 1)
        self.assertIn('nn/linear.cpp: includes "engine/engine.h"', found[0])

    def test_processor_and_nn_never_meet(self):
        self.assertEqual(len(self.check({"processor/a.h": '#include "nn/b.h"\n', "nn/b.h": '#include "processor/a.h"\n'})), 2)

    def test_a_policy_that_includes_ggml_or_a_kernel_is_refused(self):
        self.assertEqual(len(self.check({"policies/p.cpp": '#include <ggml.h>\n#include "kernels/gelu.h"\n'})), 2)

    def test_a_pass_for_every_machine_that_includes_a_kernel_is_refused(self):
        text = '#include "kernels/executor.h"\n#include "lower/cpu/emit.h"\n'
        found = self.check({"lower/fuse.cpp": text, "lower/cpu/emit.cpp": text, "lower/arithmetic.cpp": text})
        self.assertEqual(["lower/fuse.cpp"] * 2, [problem.split(":")[0] for problem in found])

    def test_ggml_is_not_seen_through_headers_of_ours_either(self):
        files = {
            "ggml/memory.h": "#include <ggml.h>\n",
            "ggml/device.h": '#include "ggml/memory.h"\n',
            "devices/open.cpp": '#include "ggml/device.h"\n',
            "vulkan/library.cpp": '#include "ggml/device.h"\n',
        }
        [found] = self.check(files)
        self.assertIn('devices/open.cpp: includes "ggml/device.h": shows <ggml.h>', found)

    def test_a_folder_that_is_no_library_is_refused(self):
        self.assertIn("is in no library", self.check({"utils/misc.h": "\n"})[0])


if __name__ == "__main__":
    unittest.main()
