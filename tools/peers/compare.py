#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""SmolVLA on this CPU by several programs in turn: ratios that survive a machine whose speed moves.

    python tools/peers/compare.py --checkpoint DIR --bundle FILE [--peers torch-f32,openvino-f32] [--rounds 9]

DIR is a checkpoint in the hub layout with the backbone's files under vlm/ (tools/parity_full.py writes a random one of
the published size), FILE the bundle that vla-convert made of it.  Every program is a process of its own that loads once
and then waits: in each round all of them run one inference of the same shape, one after the other, in an order that
turns from round to round.  Only ratios within a round are compared; the table gives their median.  What the host does
before and after the network is left out for all.  Beside them stands the machine's multiply-add peak, measured before
and after each of vla's own runs.

Peers: torch-f32, torch-bf16 (the published dtypes), torch-f32-compiled, torch-bf16-compiled, openvino-f32,
openvino-bf16, openvino-default, openvino-int8.  They need torch and lerobot, openvino, and nncf for int8, in the environment that runs
this script.
With --ggml-bench PROGRAM --ggml-weights FILE the benchmark program of another ggml runtime takes part
(https://github.com/VinRobotics/vla.cpp, target vla-bench); it times itself, in a process for each round.
"""
import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from peer import ROOT, STAGES
from busy_loops import busy_loops  # isort: skip

HERE = Path(__file__).resolve().parent
TORCH = {"torch-f32": ["--dtype", "float32"], "torch-bf16": ["--dtype", "published"],
         "torch-f32-compiled": ["--dtype", "float32", "--compile"], "torch-bf16-compiled": ["--dtype", "published", "--compile"]}
OPENVINO = {f"openvino-{hint}": ["--hint", hint] for hint in ("f32", "bf16", "default", "int8")}


class PythonPeer:
    """A child that answers each line with the milliseconds of one inference."""

    def __init__(self, name, args):
        script = "torch_peer.py" if name in TORCH else "openvino_peer.py"
        shape = ["--views", args.views, "--tokens", args.tokens, "--threads", args.threads]
        folder = [] if name in TORCH else ["--folder", args.openvino_folder]
        command = [sys.executable, HERE / script, args.checkpoint, *(TORCH | OPENVINO)[name], *shape, *folder]
        environment = {**os.environ, "OMP_NUM_THREADS": str(args.threads), "PYTHONDONTWRITEBYTECODE": "1"}
        self.process = subprocess.Popen([str(c) for c in command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                                        env=environment)
        self.name = self.answer()["name"]

    def answer(self):
        for line in self.process.stdout:
            if line.startswith("{"):  # libraries also print
                return json.loads(line)
        raise SystemExit(f"error: {' '.join(self.process.args)} ended without an answer")

    def run(self):
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self.answer()

    def end(self):
        self.process.stdin.close()
        self.process.wait()


class Vla:
    """vla bench, a round at a time; its times and peaks are in the report that it prints at the end."""

    def __init__(self, args):
        command = [args.vla, "bench", args.bundle, "--paced", "--json", "--warmup", 1, "--runs", args.rounds, "--threads", args.threads,
                   "--views", args.views, "--tokens", args.tokens, *(["--kernels", args.kernels] if args.kernels else [])]
        self.process = subprocess.Popen([str(c) for c in command], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                        stderr=subprocess.PIPE, text=True)
        self.name, self.report = "vla", None

    def run(self):
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        for line in self.process.stderr:
            if line.startswith(("warm-up ", "round ")):
                return {}
        raise SystemExit(f"error: {' '.join(self.process.args)} ended early")

    def end(self):
        out, err = self.process.communicate()
        if self.process.returncode:
            raise SystemExit(err)
        self.report = json.loads(out.splitlines()[-1])
        self.name = f"vla, {self.report['conditions']['weights']} bundle, kernels: {self.report['kernels']}"

    def rounds(self):
        return [{s: r["stages"][s] for s in STAGES} for r in self.report["rounds"]]


class GgmlRuntime:
    """Another runtime's own benchmark; it tells the vision tower apart from everything else."""

    def __init__(self, args):
        self.command = [args.ggml_bench, "--ckpt", args.ggml_weights, "--images", args.views, "--size", args.size, "--tokens", args.tokens,
                        "--warmup", 1, "--reps", 1]
        self.environment = {**os.environ, "OMP_NUM_THREADS": str(args.threads)}
        self.name = f"ggml runtime ({Path(args.ggml_bench).name})"

    def run(self):
        out = subprocess.run([str(c) for c in self.command], capture_output=True, text=True, check=True, env=self.environment).stdout
        found = re.search(r"min ([\d.]+) ms .* vision ([\d.]+) ms", out)
        return {"vision": float(found[2]), "rest": float(found[1]) - float(found[2])}

    def end(self):
        pass


def median(values):
    return statistics.median(values)


def print_table(args, vla, results):
    """results: {name: [{stage: ms}, one for each round]}."""
    report, ours = vla.report, vla.rounds()
    peaks = [r["peak_gflops"] for r in report["rounds"]]
    gflop = report["stages"]["network"]["gflop"]
    print(f"{report['cpu']}, {args.threads} threads; {args.views} views, {args.tokens} tokens, {report['conditions']['steps']} steps, batch 1; "
          f"{len(ours)} interleaved rounds beside {args.busy} busy processes. Peak {report['peak_name']}: {median(peaks):.0f} GFLOP/s (median of rounds, "
          f"{min(peaks):.0f} to {max(peaks):.0f}); {gflop:.4g} GFLOP counted for vla.\n")
    print("| program | network, ms: median (fastest) | vision | prefix | steps | its time over vla's, median of rounds | vision | prefix | steps | of the peak |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, rounds in {vla.name: ours, **results}.items():
        totals = [sum(r.values()) for r in rounds]
        cells = [f"{median(totals):.0f} ({min(totals):.0f})"]
        cells += [f"{median(r[s] for r in rounds):.0f}" if s in rounds[0] else "" for s in STAGES]
        cells += [f"**{median(t / sum(o.values()) for t, o in zip(totals, ours)):.2f}**"]
        cells += [f"{median(r[s] / o[s] for r, o in zip(rounds, ours)):.2f}" if s in rounds[0] else "" for s in STAGES]
        cells += [f"{100 * median(gflop / t * 1e3 / max(p, median(peaks)) for t, p in zip(totals, peaks)):.0f} %"]
        print(f"| {name} | " + " | ".join(cells) + " |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--bundle", type=Path, required=True)
    parser.add_argument("--peers", default="torch-f32,openvino-f32", help="names from the list above, separated by commas")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--tokens", type=int, default=48)
    parser.add_argument("--size", type=int, default=512, help="side of the pictures, for the ggml runtime")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--busy", type=int, default=0, help="endless loops beside every program, as a robot's other work")
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--kernels", default="", help="as vla bench takes them")
    parser.add_argument("--openvino-folder", type=Path, default=Path(tempfile.gettempdir()) / "openvino_smolvla",
                        help="where the converted models are kept for later runs (2 GB)")
    parser.add_argument("--ggml-bench", type=Path)
    parser.add_argument("--ggml-weights", type=Path)
    args = parser.parse_args()
    names = [name for name in args.peers.split(",") if name]
    unknown = [name for name in names if name not in TORCH | OPENVINO]
    if unknown:
        parser.error(f"--peers: {', '.join(unknown)} is none of {', '.join(TORCH | OPENVINO)}")
    if (args.ggml_bench is None) != (args.ggml_weights is None):
        parser.error("--ggml-bench and --ggml-weights go together")
    peers = [PythonPeer(name, args) for name in names] + ([GgmlRuntime(args)] if args.ggml_bench else [])
    vla = Vla(args)
    everyone, results = [vla, *peers], {peer: [] for peer in peers}
    with busy_loops(args.busy):
        for turn in range(args.rounds + 1):  # the first warms up
            shift = turn % len(everyone)
            for peer in everyone[shift:] + everyone[:shift]:
                time.sleep(0.5)  # threads of the one before may spin for a while before they sleep
                stages = peer.run()
                if turn and peer is not vla:
                    results[peer].append(stages)
            print(f"round {turn}/{args.rounds}", file=sys.stderr, flush=True)
    for peer in everyone:
        peer.end()
    print_table(args, vla, {peer.name: rounds for peer, rounds in results.items()})


if __name__ == "__main__":
    main()
