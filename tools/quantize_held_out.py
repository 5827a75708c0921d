# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How far codes move the chunks of observations that they were not calibrated with.

    python tools/quantize_held_out.py [NAME ...] [--packages DIR] [--dtypes int8 int4] [--every 23] [--factors 24,50] [--vla build/cpu/bin/vla ...]

NAME is metaworld (the shipped policy on its recorded episodes), a golden case of random weights, widened to matrices that become
codes (tests/cli/quantize_families_test.py), or, with --packages, one with trained parts (tools/trained_parts.py); the first two by default.  Each is judged as it is, and with planted channels: in every norm that
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
import re
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
import trained_parts  # noqa: E402

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
    """A widened golden case."""
    from goldens import all_cases, cases
    from quantize_families_test import WIDE

    case = all_cases()[name]
    case = replace(case, checkpoint=replace(case.checkpoint, **WIDE[name]))
    cases.write_checkpoint(case, folder)
    cases.write_observation(case, folder)
    cases.write_bundle(folder)
    return folder / "bundle.gguf", random_observations(folder)


def trained_policy(name, folder, packages, program):
    """A policy with trained parts, and with a far channel in a random vision tower."""
    from vla_cpp.convert.bundle import read_bundle

    trained_parts.write_random(name, folder)
    bundle, content = folder / "bundle.gguf", read_bundle(str(folder / "bundle.gguf"))
    changed = trained_parts.trained_tensors(name, packages, content)
    if "vision.patch_embed.bias" not in changed:
        last = max(int(tensor.split(".")[2]) for tensor in content.tensors if tensor.startswith("vision.blk."))
        tokens = next(iter(blocks_of(program, folder, bundle, f"vision.blk.{last}").values()))
        changed |= trained_parts.with_far_channel(content, tokens.reshape(-1, tokens.shape[-1]))
    return write_like(bundle, content, folder / "trained.gguf", changed), random_observations(folder)


def random_observations(folder):
    """Frames and states for a case."""
    from golden_cases import Golden
    from goldens import cases
    from goldens.draw import Generator
    from PIL import Image

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
    return observations


def blocks_of(program, folder, bundle, pattern="*", kernels="float32"):
    """What the prefix's blocks return for the case's own observation."""
    from golden_cases import Golden, tensors

    arguments = Golden(str(folder)).arguments(bundle, options=("--tap", pattern, "--taps-out", folder / "taps.gguf", *(("--kernels", kernels) if kernels else ())))
    answer = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    return {path: values for path, values in tensors(folder / "taps.gguf").items() if re.fullmatch(r"(?!step\.).*\.blk\.\d+", path)}


def print_blocks(program, folder, bundle, made):
    """Percent by which the last block of each module is moved, and the one that is moved most."""
    expected, got = blocks_of(program, folder, bundle), blocks_of(program, folder, made, kernels=None)
    error = {path: 100 * np.sqrt(np.mean((got[path] - x) ** 2) / np.mean(x**2)) for path, x in expected.items()}
    last = {path.rsplit(".", 1)[0]: path for path in sorted(error, key=lambda path: int(path.rsplit(".", 1)[1]))}
    worst = max(error, key=error.get)
    print("      " + ", ".join(f"{path} {error[path]:.2f} %" for path in (*last.values(), worst)), flush=True)


def as_floats(values, dtype):
    return (values.astype(np.uint32) << 16).view(np.float32) if dtype == "bf16" else values


def write_like(bundle, content, path, changed):
    """A bundle with other values of some tensors, in its dtypes.  changed: {tensor: float32}."""
    from bundle_keys import bundle_keys

    from vla_cpp.convert.bundle import BundleWriter, TensorInfo

    dtypes = content.dtypes

    def stored(name, values):
        if name not in changed:
            return values
        floats = np.ascontiguousarray(changed[name], np.float32)
        if dtypes[name] == "f32":
            return floats
        bits = floats.view(np.uint32).astype(np.uint64)
        return ((bits + 0x7FFF + (bits >> 16 & 1)) >> 16).astype(np.uint16)

    tensors = [TensorInfo(name, values.shape, dtypes[name]) for name, values in content.tensors.items()]
    with BundleWriter(str(path), bundle_keys(bundle), tensors) as out:
        for name, values in content.tensors.items():
            out.write(name, stored(name, values))
    return path


def chunks(bundle, observations, kernels=None):
    """Before unnormalization."""
    import vla_cpp

    class Policy(vla_cpp.Policy):
        """Returns normalized rows also where no leftover takes them."""

        def _chunk_of(self, answer, spec, *rest):
            return super()._chunk_of(answer, replace(spec, real_time_chunking="guided"), *rest)

    with Policy(bundle, kernels=kernels, threads=1) as policy:
        return np.array([policy.act(**one).normalized for one in observations])


def has_bf16(bundle):
    """Whether this machine multiplies bf16."""
    import vla_cpp

    try:
        vla_cpp.Policy(bundle, kernels="bf16").close()
    except vla_cpp.errors.DeviceError as error:
        print(f"      not in bf16: {error}", flush=True)
        return False
    return True


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
        dtypes, values = self.content.dtypes, self.content.tensors
        by_rows, by_columns = defaultdict(lambda: 1), defaultdict(lambda: 1)
        for place in places:
            makers, readers = self.places[place]
            by = np.ones(len(values[makers[0]]), np.float32)
            by[:: self.every] = np.resize(np.array(factors, np.float32), len(by[:: self.every]))
            for maker in makers:
                by_rows[maker] = by_rows[maker] * (by[:, None] if values[maker].ndim == 2 else by)
            for reader in readers:
                by_columns[reader] = by_columns[reader] / by
        changed = {}
        for name in {*by_rows, *by_columns}:
            floats = as_floats(values[name], dtypes[name])
            changed[name] = (floats * by_rows[name] * by_columns[name]).astype(np.float32)
        return write_like(self.bundle, self.content, path, changed)

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
    from server_process import SECONDS, Server

    import vla_cpp

    server = Server(SimpleNamespace(bundle=bundle), "--record", folder)
    with vla_cpp.Client(server.address, timeout=SECONDS) as robot:
        for observation in observations:
            robot.act(**observation)
    assert server.stop() == 0
    return folder


def percent_moved(got, expected):
    """Root mean square of the difference, in percent of that of `expected`: over all observations, and the median one's.  Both (observation, row, column)."""
    squares = np.mean((got - expected) ** 2, axis=(1, 2)) / np.mean(expected**2)
    return 100 * np.sqrt(np.mean(squares)), 100 * np.sqrt(np.median(squares))


def judge(bundle, work, recording, observations, expected, programs, dtypes, has_blocks):
    """Percent of all observations and of the median one, for each dtype and column."""

    def moved(made, kernels=None):
        return percent_moved(chunks(made, observations, kernels), expected)

    def quantized(program, *options):
        answer = subprocess.run([program, "quantize", bundle, "-o", work / "codes.gguf", "--force", *options], capture_output=True, text=True)
        assert answer.returncode == 0, answer.stderr
        print("".join(f"      {line}\n" for line in answer.stdout.splitlines() if " over " in line), end="", flush=True)
        return work / "codes.gguf"

    if has_blocks and has_bf16(bundle):
        yield "bf16", [moved(bundle, "bf16")]
    for dtype in dtypes:
        row = [moved(quantized(programs[0], "--dtype", dtype))]
        if has_blocks:
            print_blocks(programs[0], work, bundle, work / "codes.gguf")
        for program in programs:
            made = quantized(program, "--dtype", dtype, "--calibrate", recording)
            row += [moved(made), moved(made, "float32")]
            if has_blocks:
                print_blocks(program, work, bundle, made)
        yield dtype, row


def main():
    from quantize_families_test import WIDE

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", default=["metaworld", *WIDE], metavar="NAME")
    parser.add_argument("--packages", help="folder of the packages that tools/trained_parts.py names")
    parser.add_argument("--every", type=int, default=23, help="distance of planted channels")
    parser.add_argument("--factors", default="24,50")
    parser.add_argument("--dtypes", nargs="+", default=["int8", "int4"])
    parser.add_argument("--vla", nargs="+", default=[os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla")], help="programs to compare")
    options = parser.parse_args()
    factors = [float(factor) for factor in options.factors.split(",")]
    for name in options.names:
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder)
            is_trained = name in trained_parts.SIZES
            if is_trained:
                bundle, observations = trained_policy(name, work, options.packages, options.vla[0])
            else:
                bundle, observations = shipped() if name == "metaworld" else random_policy(name, work)
            seen, held = observations[::2], observations[1::2]
            recording, planter = record(bundle, work / "recording", seen), Planter(bundle, options.every)
            places = planter.find(work / "planted.gguf", held[0])
            planter.write(work / "planted.gguf", places, factors)
            cases = {"as it is": bundle, f"{len(places)} of {len(planter.places)} planted": work / "planted.gguf"}
            for what, one in cases.items():
                for dtype, row in judge(one, work, recording, held, chunks(one, held, "float32"), options.vla, options.dtypes, is_trained):
                    print(f"{name:<20} {what:<28} {dtype}  " + "  ".join(f"{error:6.2f} ({median:5.2f})" for error, median in row), flush=True)


if __name__ == "__main__":
    main()
