#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""SmolVLA rounded by NNCF and run by OpenVINO, beside vla's int8 and int4: error and time on the same observation.

    python tools/parity_full.py --case DIR
    python tools/peers/openvino_weights.py --case DIR [--rounds 5]

DIR is what tools/parity_full.py leaves: a checkpoint, an observation, noise and bundle.gguf. PyTorch computes the chunk in float32 and is
converted to OpenVINO as openvino_peer.py does it; NNCF then rounds weights alone (compress_weights), or weights and activations (quantize,
calibrated on other observations of the same kind). Models are kept in DIR/openvino for later runs. Every program is a process that loads
once; in each round all run one inference, one after the other. The table has the root mean square by which each chunk misses PyTorch's,
of PyTorch's own, and the median milliseconds. All programs are in memory together; --only takes some of them.

Needs torch, lerobot, gguf, openvino and nncf, in the environment that runs this script.
"""
import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from in_turn import Child
from openvino_peer import N_CALIBRATION, PARTS, Network, are_in, convert, grow, quantize
from peer import ROOT, STAGES, serve

WEIGHTS = {"int8_sym": {"mode": "INT8_SYM"}, "int8_asym": {"mode": "INT8_ASYM"},
           "int4_sym_64": {"mode": "INT4_SYM", "ratio": 1.0, "group_size": 64},
           "int4_sym_128": {"mode": "INT4_SYM", "ratio": 1.0, "group_size": 128}}
OPENVINO = {"float32": "float32", "int8": "int8 by nncf.quantize"} | {name: f"weights {name}" for name in WEIGHTS}
KERNELS = ("float32", "int8", "int4")


def other_batch(batch, seed):
    """An observation of the same kind: smooth frames of the same sizes, another state, the same instruction."""
    import torch
    from goldens.cases import smooth_frame
    from goldens.draw import Generator

    draw, other = Generator(seed), dict(batch)
    for name, value in batch.items():
        if name.startswith("observation.images."):
            other[name] = torch.from_numpy(smooth_frame(*value.shape[1:], draw)).permute(2, 0, 1).float().div(255)
        elif name == "observation.state":
            other[name] = torch.from_numpy(0.4 * draw.normal(*value.shape))
    return other


def convert_policy(case, folder, threads):
    """PyTorch's network as three models in float32, what it reads of the case and of other observations, and the chunk that it answers."""
    import torch
    from goldens import recorder
    from transformers.cache_utils import DynamicLayer

    recorder.open_reference()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(threads)
    policy, before, _ = recorder.load(case / "checkpoint", "float32")
    model = policy.model.requires_grad_(False)
    seen, sample = [], model.sample_actions

    def listen(images, present, tokens, mask, state, noise):
        given = {"images": torch.cat(images), "tokens": tokens[mask][None], "state": state, "noise": noise}
        seen.append({name: value.numpy() for name, value in given.items()})
        return sample(images, present, tokens, mask, state, noise=noise) if len(seen) == 1 else noise

    model.sample_actions = listen
    batch, noise = recorder.read_observation(case), torch.from_numpy(np.load(case / "noise.npy"))[None]
    with torch.inference_mode():
        chunk = policy.predict_action_chunk(before(batch), noise=noise)[0].numpy()
        for seed in range(1, 1 + N_CALIBRATION):
            policy.predict_action_chunk(before(other_batch(batch, seed)), noise=torch.randn(noise.shape))
    folder.mkdir(exist_ok=True)
    for i, inputs in enumerate(seen):
        np.savez(folder / f"observation{i}.npz", **inputs)
    np.savez(folder / "answer.npz", chunk=chunk, n_step=policy.config.num_steps)
    DynamicLayer.update = grow
    convert(model, seen[0], folder / "float32")


def read_observation(folder, i):
    return dict(np.load(folder / f"observation{i}.npz"))


def round_models(folder, name):
    """What NNCF makes of the models."""
    if name in WEIGHTS:
        return compress(folder / "float32", folder / name, **WEIGHTS[name])
    others = [read_observation(folder, i) for i in range(1, 1 + N_CALIBRATION)]
    return quantize(folder / "float32", folder / name, int(np.load(folder / "answer.npz")["n_step"]), others)


def compress(folder, to, mode, **more):
    import nncf
    import openvino

    to.mkdir(exist_ok=True)
    if "group_size" in more:  # rows that are no whole groups get smaller ones; else NNCF leaves them in float32
        adjust = nncf.GroupSizeFallbackMode.ADJUST
        more["advanced_parameters"] = nncf.AdvancedCompressionParameters(group_size_fallback_mode=adjust, min_adjusted_group_size=16)
    for part in PARTS:
        model = nncf.compress_weights(openvino.Core().read_model(folder / f"{part}.xml"), mode=nncf.CompressWeightsMode[mode], **more)
        openvino.save_model(model, to / f"{part}.xml", compress_to_fp16=False)


def error_of(chunk, expected):
    """Root mean square of the difference, of that of `expected`; the robot's columns alone, which PyTorch returns."""
    got = chunk.reshape(len(expected), -1)[:, : expected.shape[1]]
    return float(np.sqrt(np.mean((got - expected) ** 2) / np.mean(expected**2)))


def answer(folder, name, threads):
    """One timed inference of a model for each line on standard input."""
    import openvino

    inputs, torchs = read_observation(folder, 0), np.load(folder / "answer.npz")
    network = Network(folder / name, int(torchs["n_step"]), {"INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY"})
    error = error_of(network.infer(inputs)[1], torchs["chunk"])
    size = sum((folder / name / f"{part}.bin").stat().st_size for part in PARTS)
    serve(lambda: network.infer(inputs)[0], name=f"OpenVINO {openvino.__version__.split('-')[0]}, {OPENVINO[name]}", error=error, size=size)


class OpenVino(Child):
    def __init__(self, command):
        super().__init__(command, "stdout")
        self.about, self.times = json.loads(self.wait_for("{")), []

    def turn(self):
        self.times.append(json.loads(self.run("{")))

    def end(self):
        self.process.communicate()


class Vla(Child):
    def __init__(self, args, kernels, folder):
        from parity_full import run_vla

        inputs, bundle = read_observation(folder, 0), args.case / "bundle.gguf"
        taps, _, _ = run_vla(args.vla, args.case, bundle, "chunk", folder / "taps.gguf", args.threads, kernels=kernels)
        super().__init__([args.vla, "bench", bundle, "--kernels", kernels, "--views", len(inputs["images"]), "--tokens", inputs["tokens"].shape[1],
                          "--threads", args.threads, "--paced", "--json", "--warmup", 1, "--runs", args.rounds], "stderr")
        self.about = {"name": f"vla, `--kernels {kernels}`", "error": error_of(taps["chunk"], np.load(folder / "answer.npz")["chunk"])}

    def turn(self):
        self.run(("warm-up ", "round "))

    def end(self):
        report = json.loads(self.process.communicate()[0].splitlines()[-1])
        self.times = [None, *({stage: r["stages"][stage] for stage in STAGES} for r in report["rounds"])]


def print_table(programs, base):
    """Times of the first turn warm up. base: the program that the others' times are compared with, round by round."""
    print("| program | chunk's error | weights, MB | vision, ms | prefix | steps | prefix and steps over vla's int8 | |\n| --- |" + " ---: |" * 7)
    for program in programs:
        rounds, ratios = program.times[1:], []
        for stage in ("prefix", "steps"):
            ratios.append(statistics.median(r[stage] / b[stage] for r, b in zip(rounds, base.times[1:])))
        cells = [program.about["name"], f"{100 * program.about['error']:.2g} %", f"{program.about['size'] / 1e6:.0f}" if "size" in program.about else ""]
        cells += [f"{statistics.median(r[stage] for r in rounds):.0f}" for stage in STAGES] + [f"{ratio:.2f}" for ratio in ratios]
        print("| " + " | ".join(cells) + " |")


def run_part(args, folder, part, name=None):
    if part == "convert":
        return convert_policy(args.case, folder, args.threads)
    return round_models(folder, name) if part == "round" else answer(folder, name, args.threads)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", default=",".join(OPENVINO), help="OpenVINO's models that take part, separated by commas (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--part", nargs="+", help=argparse.SUPPRESS)  # in a process of its own
    args = parser.parse_args()
    args.case = args.case.resolve()
    folder = args.case / "openvino"
    if args.part:
        return run_part(args, folder, *args.part)
    names = args.only.split(",")
    if not set(names) <= set(OPENVINO):
        parser.error(f"--only: expected names from {', '.join(OPENVINO)}, found {args.only}")
    again = [sys.executable, str(__file__), "--case", str(args.case), "--threads", str(args.threads), "--part"]
    if not are_in(folder / "float32"):
        subprocess.run([*again, "convert"], check=True)
    for name in names:
        if not are_in(folder / name):
            subprocess.run([*again, "round", name], check=True)
    ours = {kernels: Vla(args, kernels, folder) for kernels in KERNELS}
    programs = [*(OpenVino([*again, "answer", name]) for name in names), *ours.values()]
    for turn in range(args.rounds + 1):
        shift = turn % len(programs)
        for program in programs[shift:] + programs[:shift]:
            time.sleep(0.5)  # threads of the one before may spin for a while before they sleep
            program.turn()
        print(f"round {turn}/{args.rounds}", file=sys.stderr, flush=True)
    for program in programs:
        program.end()
    print_table(programs, ours["int8"])


if __name__ == "__main__":
    main()
