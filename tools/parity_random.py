# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random configurations, by the reference and by the runtime: what the golden cases do not happen to contain.

    python tools/parity_random.py ARCH FIRST LAST [--bf16 | --stored] [--vla build/cpu/bin/vla] [--keep DIR]

A seed draws everything: depths, heads, widths, patches, grid and table, views, frames, absent views, text, normalization, solver,
attention mode (of smolvla), relative actions (of pi0, pi05 and GR00T), poses and moments (of GR00T).  Its checkpoint is run by LeRobot's class, converted by vla-convert and run by vla; every block must agree.
A configuration that the reference cannot run must be refused, with a reason, by vla-convert or by vla.  Ends with exit
code 1 if a block differs by more than 1e-4 of its largest magnitude, or if only one side answers.

bitvla: a code that rounding moves changes all that follows, so that each part is run on the reference's own input (vla run --inject).
Products must agree within 1e-6, other parts within 1e-5; whole blocks, inside of which a code may move, by their root mean square.

With --bf16 the weights are float32 numbers that bfloat16 rounds and the bundle is in bf16: its actions, or the logits of its first token, must not lie further from
the reference's in float32 than those of the reference in the dtypes of a published file.  With --stored the checkpoint has the dtypes
of a published file, so has the bundle (vla-convert --dtype stored), and the runtime chooses its kernels: the same must hold.

With --leftover the chunk goes on from rows of a previous one (real-time chunking), whose number, delay and guidance the seed draws too;
the runtime is the engine in this process (VLA_LIBRARY).
"""
import argparse
import contextlib
import io
import json
import random
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from goldens import bitvla, cases, families, recorder, rtc
from parity_full import ROOT, distance, run_vla

TOLERANCE = 1e-4  # of the largest magnitude of a block, as the golden tests
# Configuration -> its draw of a case by a seed.
DRAWN = {name: draw for module in families().values() for name, draw in module.DRAWN.items()}
# Of what a part of BitVLA reads: names of values that the reference records. A whole block starts from the one before.
INPUTS = [(r"(.*)\.attn_[qkv]", r"\1.attn_norm"), (r"(lm\..*)\.attn_out", r"\1.attn_sub_norm"), (r"(.*)\.ffn_(up|gate)", r"\1.ffn_norm"),
          (r"(lm\..*)\.ffn_down", r"\1.ffn_sub_norm"), (r"lm\.blk\.0(\.attn_norm)?", "prefix"), (r"vision\.patch_embed", "pixels"),
          (r"state_out", "state"), (r"step\.0\.head\.in", "step.0.head.in_norm"), (r"step\.0\.head\.blk\.0", "step.0.head.in"),
          (r"step\.0\.head\.out", "step.0.head.out_norm")]
PRODUCT = re.compile(r"(vision|lm)\.blk\.0\.(attn_[qkv]|ffn_(up|gate|down))|lm\.blk\.0\.attn_out")
BLOCK = re.compile(r"(vision|lm)\.blk\.\d+")


def input_of(name, taps):
    before = re.fullmatch(r"(.*\.blk\.)(\d+)", name)
    if before and before[2] != "0":
        return before[1] + str(int(before[2]) - 1)
    last = {"connector_down": "vision.blk.", "lm.norm": "lm.blk.", "step.0.head.out_norm": "step.0.head.blk."}.get(name)
    if last:
        return max((n for n in taps if re.fullmatch(re.escape(last) + r"\d+", n)), key=lambda n: int(n.rpartition(".")[2]))
    return next((re.sub(pattern, found, name) for pattern, found in INPUTS if re.fullmatch(pattern, name)), None)


def compare_bitvla(seed, vla, folder):
    case, spelling = DRAWN["bitvla"](seed)
    bitvla.MARGIN = -1.0  # parts are compared, each on its own input
    expected, stopped = run_reference(case, folder)
    config = folder / "checkpoint" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "model_type": spelling}))
    got, refused = run_runtime(vla, folder, "bf16")
    if expected is None or got is None:
        return expected is None and got is None, f"reference: {stopped or 'runs'}; {refused or 'the runtime runs'}"
    parts = {}
    for name in expected:
        if found := input_of(name, expected):
            parts.setdefault(found, []).append(name)
    far = {"product": (0.0, "none"), "part": (0.0, "none"), "block": (0.0, "none")}
    for given, names in parts.items():
        recorder.write_taps(folder / "inject.gguf", {given: expected[given]}, "vla-taps")
        taps = run_vla(vla, folder, folder / "bundle.gguf", ",".join(names), folder / "taps.gguf", 1, folder / "inject.gguf")[0]
        for name in names:
            kind = "product" if PRODUCT.fullmatch(name) else "block" if BLOCK.fullmatch(name) else "part"
            ours, theirs = taps[name].ravel().astype(float), expected[name].ravel().astype(float)
            off = np.sqrt(((ours - theirs) ** 2).mean() / (theirs**2).mean()) if kind == "block" else distance(ours, theirs)[1]
            far[kind] = max(far[kind], (float(off), name))
    agree = far["product"][0] <= 1e-6 and far["part"][0] <= 1e-5 and far["block"][0] <= 2e-2
    end = distance(got["chunk"].ravel(), expected["chunk"].ravel())[1]
    text = ", ".join(f"{kind} {off:.1e} at {name}" for kind, (off, name) in far.items())
    return agree, f"{sum(map(len, parts.values()))} parts, worst {text}; chunk end to end {end:.1e} ({spelling}, {case.checkpoint.prefixes})"


def add_low_bits(file, seed):
    """Moves every weight by up to half a percent, to float32 numbers such as training leaves."""
    import torch
    from safetensors.torch import load_file, save_file

    generator = torch.Generator().manual_seed(seed)
    tensors = {n: t.float() * (1 + 0.01 * (torch.rand(t.shape, generator=generator) - 0.5)) for n, t in load_file(file).items()}
    save_file(tensors, file, metadata={"format": "pt"})


def run_reference(case, folder, low_bits=False):
    """(taps, None), or (None, why the reference stops)."""
    cases.write_checkpoint(case, folder)
    cases.write_observation(case, folder)
    if low_bits:
        add_low_bits(folder / "checkpoint" / "model.safetensors", case.seed)
    try:
        return recorder.run_case(folder), None
    except (RuntimeError, ValueError, AssertionError, IndexError) as error:
        return None, f"{type(error).__name__} {error}".splitlines()[0][:90]


def run_runtime(vla, folder, dtype="f32", kernels="float32"):
    """(taps, None), or (None, who refuses and why)."""
    message = io.StringIO()
    try:
        with contextlib.redirect_stderr(message):
            cases.write_bundle(folder, dtype=dtype)
    except SystemExit as stopped:
        return None, f"vla-convert ({stopped.code}): {message.getvalue().strip()[:200]}"
    try:
        return run_vla(vla, folder, folder / "bundle.gguf", "*", folder / "taps.gguf", threads=1, kernels=kernels)[0], None
    except subprocess.CalledProcessError as error:
        if error.returncode < 0:  # a signal is a crash, not a refusal
            raise
        return None, f"vla ({error.returncode})"


def judge(expected, got):
    """(whether they agree, worst block and its distance)."""
    shared = [n for n, x in expected.items() if n in got and np.abs(x).max() > 0]
    misshapen = [n for n in shared if got[n].size != expected[n].size]
    if misshapen or not {"actions", "prefix"} <= set(shared):
        return False, f"shapes differ at {', '.join(misshapen) or 'too few blocks'}"
    far = {n: distance(got[n].ravel(), expected[n].ravel())[1] for n in shared}
    worst = max(far, key=far.get)
    return far[worst] <= TOLERANCE, f"actions {far['actions']:.1e}, worst of {len(far)} blocks {far[worst]:.1e} at {worst}"


def judge_rounding(expected, got, published):
    """By the actions, or by the logits of the first token: a token is another one or the same, and one that is another changes those behind it."""
    what = "logits" if "logits" in expected else "actions"
    ours, theirs = (distance(run[what].ravel(), expected[what].ravel())[1] for run in (got, published))
    return ours <= theirs, f"{what} {ours:.1e}, of the reference in published dtypes {theirs:.1e}"


def compare(arch, seed, vla, folder, dtype):
    """`dtype` of the bundle: f32, or bf16 or stored to compare what rounding costs."""
    if arch == "bitvla":
        return compare_bitvla(seed, vla, folder)
    with contextlib.redirect_stdout(io.StringIO()):  # the reference tells how many layers it keeps
        drawn = DRAWN[arch](seed)
        expected, stopped = run_reference(drawn, folder, low_bits=dtype == "bf16")
        published = recorder.run_case(folder, "published") if dtype != "f32" and expected else None
    got, refused = run_runtime(vla, folder, dtype, kernels="" if dtype == "stored" else "float32")
    if expected is None or got is None:
        return expected is None and got is None, f"reference: {stopped or 'runs'}; {refused or 'the runtime runs'}"
    return judge_rounding(expected, got, published) if published else judge(expected, got)


def compare_leftover(arch, seed, folder):
    """The chunk of a guided policy."""
    import vla_cpp

    with contextlib.redirect_stdout(io.StringIO()):
        expected, stopped = run_reference(DRAWN[arch](seed), folder)
    if expected is None:
        return True, f"reference: {stopped}"
    cases.write_bundle(folder, dtype="f32")
    horizon, d_action = expected["chunk"].shape
    r, draw_rows = random.Random(seed), np.random.default_rng(seed)
    n_row = r.randint(1, horizon)
    delay, schedule, guidance = r.randint(0, n_row), r.choice(rtc.SCHEDULES), r.choice((0.5, 1.0, 5.0, 10.0))
    rows = draw_rows.normal(0, 0.5, (n_row, d_action)).astype(np.float32)
    if (folder / "checkpoint/norm_stats.json").is_file():
        return True, "the authors' server of Evo-1 has no real-time chunking"
    with contextlib.redirect_stdout(io.StringIO()):
        wanted = rtc.chunk_of(folder, rows, schedule, delay, guidance)
    seen = json.loads((folder / "observation.json").read_text())
    images = {view: file and (folder / file).read_bytes() for view, file in seen["images"].items()}
    with vla_cpp.Policy(folder / "bundle.gguf", kernels="float32", threads=1) as policy:
        if not policy.spec.real_time_chunking:
            return True, "relative actions: the runtime refuses real-time chunking"
        named = {state.name.removeprefix("observation."): seen["state"] for state in policy.spec.states}
        state = seen["state"] if isinstance(seen["state"], dict) else named
        chunk = policy.act(images=images, state=state, text=seen["text"], noise=np.load(folder / "noise.npy"),
                           leftover=vla_cpp.Leftover(rows, delay, schedule, guidance)).normalized
    far, moved = (np.abs(x - wanted).max() / np.abs(wanted).max() for x in (chunk, expected["chunk"]))
    return far <= TOLERANCE, f"{n_row} of {horizon} rows, delay {delay}, {schedule}, at most {guidance}: {far:.1e}; moved by {moved:.1e}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arch", choices=DRAWN)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    costs = parser.add_mutually_exclusive_group()
    costs.add_argument("--bf16", action="store_const", const="bf16", dest="dtype", default="f32", help="what rounding the weights costs, instead of every block")
    costs.add_argument("--stored", action="store_const", const="stored", dest="dtype", help="what rounding activations costs, with weights as published")
    costs.add_argument("--leftover", action="store_true", help="real-time chunking (smolvla, pi0, pi05, evo1)")
    parser.add_argument("--keep", type=Path, help="folder for the cases, instead of one that is removed")
    args = parser.parse_args()
    if args.arch != "bitvla":
        recorder.open_reference()
    warnings.filterwarnings("ignore")
    n_wrong = 0
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(args.first, args.last + 1):
            folder = (args.keep or Path(scratch)) / str(seed)
            folder.mkdir(parents=True)
            agree, what = compare_leftover(args.arch, seed, folder) if args.leftover else compare(args.arch, seed, args.vla, folder, args.dtype)
            n_wrong += not agree
            print(f"seed {seed}: {'agree' if agree else 'DIFFER'}; {what}", flush=True)
    print(f"{args.last - args.first + 1 - n_wrong} of {args.last - args.first + 1} seeds agree")
    sys.exit(1 if n_wrong else 0)


if __name__ == "__main__":
    main()
