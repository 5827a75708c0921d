# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How far codes move the chunks of observations that they were not calibrated with.

    python tools/quantize_held_out.py [NAME ...] [--every 23] [--factors 24,50] [--vla build/cpu/bin/vla ...]

NAME is metaworld (the shipped policy on its recorded episodes) or a golden case of random weights, widened to matrices that become
codes (tests/cli/quantize_families_test.py); all by default.  Each is judged as it is, and with planted channels: in every norm that
only matrices read, also where it is computed at load, and in every gated MLP, channels are larger by the factors, and the columns of the matrices
smaller.  Where powers of two do not leave the float32 chunk the same to the bit, something else reads the norm; it is left as it was.

`vla serve --record` records every second observation, `vla quantize --calibrate` reads them, and the others judge: root mean square of the
difference from the float32 chunks, in percent of theirs, of all observations and, in parentheses, of the median one: where a policy is about to open or
to close a gripper, little decides much.  Columns: plain codes; for each program calibrated codes; their weights alone, in float32 arithmetic.
The runtime that acts is the engine in this process (VLA_LIBRARY).
"""
import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / folder) for folder in ("tools", "python", "tests/support", "tests/cli", "tests/client")]
EPISODES = ROOT / "examples/metaworld/episodes"
N_RANDOM = 16  # observations of a policy with random weights
READERS = {"attn_norm": ("attn_q", "attn_k", "attn_v"), "ffn_norm": ("ffn_gate", "ffn_up")}


def shipped():
    """The policy of MetaWorld and the observations of its episodes."""
    observations = []
    for folder in sorted(EPISODES.iterdir()):
        episode = json.loads((folder / "episode.json").read_text())
        for look in episode["looks"]:
            images = {episode["camera"]: (folder / look["frame"]).read_bytes()}
            observations.append(dict(images=images, state=look["state"], text=episode["sentence"], seed=7))
    return ROOT / "models/metaworld-tiny.gguf", observations


def random_policy(name, folder):
    """A widened golden case, and random frames and states for it."""
    from golden_cases import Golden
    from goldens import all_cases, cases
    from goldens.draw import Generator
    from PIL import Image
    from quantize_families_test import WIDE

    case = all_cases()[name]
    case = replace(case, checkpoint=replace(case.checkpoint, **WIDE[name]))
    cases.write_checkpoint(case, folder)
    cases.write_observation(case, folder)
    cases.write_bundle(folder)
    golden, generator, observations = Golden(str(folder)), Generator(54), []

    def drawn(numbers):
        return (np.asarray(numbers) + 0.3 * generator.normal(len(numbers))).tolist()

    for seed in range(N_RANDOM):
        images = {}
        for view, file in golden.images.items():
            width, height = Image.open(file).size if file else (0, 0)
            images[view] = cases.smooth_frame(height, width, generator) if file else None
        state = {k: drawn(v) for k, v in golden.state.items()} if isinstance(golden.state, dict) else drawn(golden.state)
        observations.append(dict(images=images, state=state, text=golden.text, seed=seed))
    return golden.bundle, observations


def chunks(bundle, observations, kernels=None):
    """Before unnormalization."""
    import vla_cpp

    class Policy(vla_cpp.Policy):
        """Returns normalized rows also where no leftover takes them."""

        def _chunk_of(self, answer, spec, *rest):
            return super()._chunk_of(answer, replace(spec, real_time_chunking="guided"), *rest)

    with Policy(bundle, kernels=kernels, threads=1) as policy:
        return np.array([policy.act(**one).normalized for one in observations])


class Planter:
    """Writes bundles like another one with larger channels."""

    def __init__(self, bundle, every):
        from vla_cpp.convert.bundle import read_bundle

        self.bundle, self.every = bundle, every
        self.content = read_bundle(str(bundle))
        self.places = {}  # name of what is multiplied -> tensors whose rows are, tensors whose columns are divided
        for name, values in self.content.tensors.items():
            block, _, norm = name.removesuffix(".weight").rpartition(".")
            if norm in READERS:
                readers = [f"{block}.{r}.weight" for r in READERS[norm] if self.columns(f"{block}.{r}.weight") == len(values)]
                if readers:
                    self.places[name] = [t for t in (name, f"{block}.{norm}.bias") if t in self.content.tensors], readers
            elif norm == "ffn_gate" and self.columns(f"{block}.ffn_down.weight"):
                up = [t for t in (f"{block}.ffn_up.weight", f"{block}.ffn_up.bias") if t in self.content.tensors]
                self.places[name] = up, [f"{block}.ffn_down.weight"]

    def columns(self, matrix):
        values = self.content.tensors.get(matrix)
        return 0 if values is None or self.content.dtypes[matrix] not in ("bf16", "f32") else values.shape[1]

    def write(self, path, places, factors):
        from bundle_keys import bundle_keys

        from vla_cpp.convert.bundle import BundleWriter, TensorInfo

        dtypes = self.content.dtypes
        by_rows, by_columns = defaultdict(lambda: 1), defaultdict(lambda: 1)
        for place in places:
            makers, readers = self.places[place]
            by = np.ones(len(self.content.tensors[makers[0]]), np.float32)
            by[:: self.every] = np.resize(np.array(factors, np.float32), len(by[:: self.every]))
            for maker in makers:
                by_rows[maker] = by_rows[maker] * (by[:, None] if self.content.tensors[maker].ndim == 2 else by)
            for reader in readers:
                by_columns[reader] = by_columns[reader] / by
        tensors = [TensorInfo(name, values.shape, dtypes[name]) for name, values in self.content.tensors.items()]
        with BundleWriter(str(path), bundle_keys(self.bundle), tensors) as out:
            for name, values in self.content.tensors.items():
                if name in by_rows or name in by_columns:
                    floats = (values.astype(np.uint32) << 16).view(np.float32) if dtypes[name] == "bf16" else values
                    floats = (floats * by_rows[name] * by_columns[name]).astype(np.float32)
                    values = (floats.view(np.uint32) >> 16).astype(np.uint16) if dtypes[name] == "bf16" else floats
                out.write(name, values)
        return path

    def find(self, path, observation):
        """The places where only matrices read.  `path`: of a bundle that may be written."""
        expected = chunks(self.bundle, [observation], "float32")

        def holds(places):
            return np.array_equal(chunks(self.write(path, places, (32, 64)), [observation], "float32"), expected)

        if holds(self.places):
            return list(self.places)
        kinds = defaultdict(list)  # blocks of a module are alike
        for place in self.places:
            kinds[tuple(part for part in place.split(".") if not part.isdigit())].append(place)
        places = [place for kind in kinds.values() if holds(kind) for place in kind]
        assert holds(places)
        return places


def record(bundle, folder, observations):
    import vla_cpp
    from server_process import SECONDS, Server

    server = Server(SimpleNamespace(bundle=bundle), "--record", folder)
    with vla_cpp.Client(server.address, timeout=SECONDS) as robot:
        for observation in observations:
            robot.act(**observation)
    assert server.stop() == 0
    return folder


def judge(bundle, work, recording, observations, expected, programs):
    """Percent of all observations and of the median one, for each dtype and column."""

    def moved(made, kernels=None):
        got = chunks(made, observations, kernels)
        squares = np.mean((got - expected) ** 2, axis=(1, 2)) / np.mean(expected**2)
        return 100 * np.sqrt(np.mean(squares)), 100 * np.sqrt(np.median(squares))

    def quantized(program, *options):
        answer = subprocess.run([program, "quantize", bundle, "-o", work / "codes.gguf", "--force", *options], capture_output=True, text=True)
        assert answer.returncode == 0, answer.stderr
        print("".join(f"      {line}\n" for line in answer.stdout.splitlines() if " over " in line), end="", flush=True)
        return work / "codes.gguf"

    for dtype in ("int8", "int4"):
        row = [moved(quantized(programs[0], "--dtype", dtype))]
        for program in programs:
            made = quantized(program, "--dtype", dtype, "--calibrate", recording)
            row += [moved(made), moved(made, "float32")]
        yield dtype, row


def main():
    from quantize_families_test import WIDE

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", default=["metaworld", *WIDE], metavar="NAME")
    parser.add_argument("--every", type=int, default=23, help="distance of planted channels")
    parser.add_argument("--factors", default="24,50")
    parser.add_argument("--vla", nargs="+", default=[os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla")], help="programs to compare")
    options = parser.parse_args()
    factors = [float(factor) for factor in options.factors.split(",")]
    for name in options.names:
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder)
            bundle, observations = shipped() if name == "metaworld" else random_policy(name, work / name)
            seen, held = observations[::2], observations[1::2]
            recording, planter = record(bundle, work / "recording", seen), Planter(bundle, options.every)
            places = planter.find(work / "planted.gguf", held[0])
            planter.write(work / "planted.gguf", places, factors)
            for what, one in (("as it is", bundle), (f"{len(places)} of {len(planter.places)} planted", work / "planted.gguf")):
                for dtype, row in judge(one, work, recording, held, chunks(one, held, "float32"), options.vla):
                    print(f"{name:<20} {what:<20} {dtype}  " + "  ".join(f"{error:6.2f} ({median:5.2f})" for error, median in row), flush=True)


if __name__ == "__main__":
    main()
