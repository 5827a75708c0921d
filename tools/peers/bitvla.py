# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BitVLA at its published size, random weights: the reference in PyTorch, in bfloat16 as its users run it, and vla in turn.

    BITVLA_REFERENCE=DIR python tools/peers/bitvla.py [--rounds 3]

DIR has `transformers/src` and `openvla-oft` of ustcwhy/BitVLA.  The reference keeps master weights and makes ternary ones of them in
every forward pass, as published.  It takes 6 GB of memory; vla takes its weights from memory too, another 2.5 GB.  In each round both
run one inference of two views and a prompt of the same length, and the ratio of a round is printed, of wall time and of the processor
time that each took, which other work on the machine changes less.
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

from peer import ROOT, STAGES, serve

TOKENS, VIEWS, PATCHES = 48, 2, 256
IMAGE, STATE, STOP = 128010, 128011, 128001


def config():
    """Of the published fine-tunes."""
    from goldens import bitvla

    tower, language = bitvla.sizes(1152, 4304, 26, 16, image_size=224), bitvla.sizes(2560, 6912, 30, 20, num_key_value_heads=5)
    found = bitvla.Checkpoint(tower, language).config()
    found["text_config"] |= {"vocab_size": 128264, "max_position_embeddings": 2048, "bos_token_id": 128000, "eos_token_id": STOP}
    return found | {"image_token_index": IMAGE, "vocab_size": 128264}


def reference(n_thread):
    import numpy as np
    import torch
    from goldens import bitvla

    bitvla.open_reference()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(n_thread)
    from bitvla import Bitvla_Config, BitVLAForActionPrediction
    from prismatic.models.action_heads import L1RegressionActionHead
    from prismatic.models.projectors import ProprioProjector
    from transformers import modeling_utils

    torch.set_default_dtype(torch.bfloat16)
    modeling_utils._init_weights = False  # each weight is drawn once, below
    model = BitVLAForActionPrediction(Bitvla_Config(**config())).eval()
    head, proprio = L1RegressionActionHead(input_dim=2560, hidden_dim=2560, action_dim=7), ProprioProjector(llm_dim=2560, proprio_dim=8)
    generator = torch.Generator().manual_seed(0)
    draw = torch.empty(1 << 22).uniform_(-0.05, 0.05, generator=generator)
    with torch.no_grad():
        for part in (model, head, proprio):
            for name, p in part.named_parameters():
                is_norm = p.ndim == 1 and name.endswith("weight")
                p.copy_(torch.ones_like(p) if is_norm else draw.repeat(p.numel() // draw.numel() + 1)[: p.numel()].view_as(p))
    torch.set_default_dtype(torch.float32)
    stats = {"action": {k: np.full(7, v) for k, v in (("min", -1.0), ("max", 1.0), ("q01", -1.0), ("q99", 1.0))}}
    stats["action"]["mask"] = [True] * 6 + [False]
    model.norm_stats = {"x": stats}
    model.set_constant(image_token_idx=IMAGE, proprio_pad_idx=STATE, ignore_idx=-100, action_token_begin_idx=STATE, stop_index=STOP)
    ids = torch.tensor([[128000, *range(100, 131), *[IMAGE] * (VIEWS * PATCHES), STATE, *range(200, 200 + TOKENS)]])
    pixels = torch.empty(1, VIEWS, 3, 224, 224).uniform_(-1, 1, generator=generator).bfloat16()

    def run():
        start, before = time.perf_counter(), time.process_time()
        with torch.inference_mode():
            model.predict_action(input_ids=ids.clone(), unnorm_key="x", proprio=np.zeros(8), proprio_projector=proprio, action_head=head,
                                 pixel_values=pixels, attention_mask=torch.ones_like(ids))
        return {"ms": 1e3 * (time.perf_counter() - start), "cpu_ms": 1e3 * (time.process_time() - before)}

    serve(run, name=f"PyTorch {torch.__version__}, bfloat16, {sum(p.numel() for p in model.parameters()):,} parameters")


class Child:
    """A program that runs once for each line on its standard input and then says so."""

    def __init__(self, command, stream):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE if stream == "stderr" else None}
        self.process = subprocess.Popen([str(c) for c in command], text=True, **pipes)
        self.stream = getattr(self.process, stream)

    def wait_for(self, start):
        for line in self.stream:
            if line.startswith(start):
                return line
        raise SystemExit(f"error: {' '.join(self.process.args)} ended early")

    def run(self, start):
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self.wait_for(start)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--reference", action="store_true", help=argparse.SUPPRESS)  # in a process of its own
    args = parser.parse_args()
    if args.reference:
        return reference(args.threads)
    theirs = Child([sys.executable, __file__, "--reference", "--threads", args.threads], "stdout")
    print(json.loads(theirs.wait_for("{"))["name"], flush=True)
    ours = Child([args.vla, "bench", "--arch", "bitvla", "--size", "full", "--paced", "--json", "--warmup", 1, "--runs", args.rounds,
                  "--threads", args.threads, "--tokens", TOKENS], "stderr")
    times = []
    for turn in range(args.rounds + 1):  # the first warms up
        ours.run(("warm-up ", "round "))
        answer = json.loads(theirs.run("{"))
        print(f"round {turn}: PyTorch {answer['ms']:.0f} ms, {answer['cpu_ms']:.0f} ms of the processor", flush=True)
        times += [answer] if turn else []
    report = json.loads(ours.process.communicate()[0].splitlines()[-1])
    rounds = [{"ms": sum(r["stages"][s] for s in STAGES), "cpu_ms": r["cores"] * r["total_ms"]} for r in report["rounds"]]
    print(f"{report['cpu']}, {args.threads} threads, kernels: {report['kernels']}")
    for what, text in (("ms", "wall time, network"), ("cpu_ms", "processor time")):
        ratios = [a[what] / b[what] for a, b in zip(times, rounds)]
        print(f"{text}: vla {statistics.median(r[what] for r in rounds):.0f} ms, PyTorch {statistics.median(t[what] for t in times):.0f} ms, "
              f"PyTorch over vla {statistics.median(ratios):.1f} ({min(ratios):.1f} to {max(ratios):.1f})")
    print(f"vla: {report['memory_bytes']['peak'] / 1e6:.0f} MB at the most")


if __name__ == "__main__":
    main()
