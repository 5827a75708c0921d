# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""One inference at full size, by PyTorch and by the runtime, from the same checkpoint, frames and noise.

    python tools/parity_full.py --case DIR [--arch pi0] [--vla build/cpu/bin/vla] [--blocks] [--threads N]

DIR is a case as tools/goldens/recorder.py describes it: checkpoint/, observation.json, frames, noise.npy.  Where it has no
checkpoint, one of the published size with random weights is written, for two cameras: smolvla 450 M parameters, 0.9 GB of
disk; pi0 and pi05 3.5 G parameters, 14 GB of disk with the bundle and 20 GB of memory while PyTorch runs in float32; evo1 775 M
parameters in the authors' layout, the third slot of the prompt empty; gr00t_n1_5, gr00t_n1_6 and gr00t_n1_7 about 3 G parameters,
12 GB of disk with the bundle and 14 GB of memory.
Every program runs in a process of its own: PyTorch in float32, PyTorch in the dtypes of the published file, vla-convert,
vla in float32 and with the kernels that it chooses here.  The table that is printed goes to docs/models.md; the memory of vla is that of its answer, with --blocks of every
block beside it.  Times are of one cold inference beside other work: no benchmark.
"""
import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tools")]
from goldens import cases, families, family, recorder  # noqa: E402

SEED = 0
FRAMES = {"camera1": (480, 640, "png"), "camera2": (480, 480, "png")}


def write_case(case, arch):
    """The published size with random weights, two smooth frames, a state, noise."""
    module = family(arch)
    frames, options = getattr(module, "FRAMES", FRAMES), getattr(module, "OPTIONS", {})
    text = getattr(module, "INSTRUCTION", "pick up the red cube and place it in the basket")
    views = {view: frame[:2] for view, frame in frames.items()}
    described = cases.Case(SEED, frames, text, module.published(views, arch), options=options)
    cases.write_observation(described, case)
    print(f"{cases.write_checkpoint(described, case):,} random parameters")


def run_torch(case, dtype, blocks, threads):
    """What the child process does: one inference, its time, its taps into DIR/torch_<dtype>.npz."""
    import torch

    recorder.open_reference()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(threads)
    policy, before, after = recorder.load(case / "checkpoint", dtype)
    noise, batch = torch.from_numpy(np.load(case / "noise.npy"))[None], before(recorder.read_observation(case))
    listener = recorder.recorder(policy) if blocks else None
    start = time.perf_counter()
    with torch.inference_mode():
        chunk = None if blocks else policy.predict_action_chunk(dict(batch), noise=noise)[0].float().numpy()
    taps = listener.run(batch, noise) if blocks else {"chunk": chunk}
    seconds = time.perf_counter() - start
    taps["actions"] = after(torch.from_numpy(taps["chunk"])[None]).float().numpy()[0]
    np.savez(case / f"torch_{dtype}.npz", seconds=seconds, versions=recorder.versions(), **taps)


def child(command):
    """(standard output, peak resident bytes) of a program; CalledProcessError when it fails."""
    process = subprocess.Popen([str(c) for c in command], stdout=subprocess.PIPE, text=True)
    out = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise subprocess.CalledProcessError(os.waitstatus_to_exitcode(status), [str(c) for c in command])
    return out, usage.ru_maxrss * 1024


def run_vla(vla, case, bundle, pattern, taps_file, threads, inject=None, kernels="float32"):
    """(taps that match the pattern and the actions, milliseconds by stage, peak bytes) of `vla run` on a case.  `inject`: a file of
    values that it goes on from; `kernels`: none for the runtime's choice."""
    observation = json.loads((case / "observation.json").read_text())
    command = [vla, "run", bundle, "--json", "--threads", threads, "--noise", case / "noise.npy"]
    command += ["--kernels", kernels] if kernels else []
    for view, file in observation["images"].items():
        command += ["--image", f"{view}={case / file if file else ''}"]
    states = observation["state"]
    for name, numbers in (states if isinstance(states, dict) else {"state": states}).items():
        command += ["--state", f"{name}={','.join(map(repr, numbers))}"]
    command += ["--text", observation["text"], "--tap", pattern, "--taps-out", taps_file]
    command += ["--inject", inject] if inject else []
    out, peak = child(command)
    answer = json.loads(out.splitlines()[-1])
    taps = recorder.read_taps(taps_file)
    timing = {k: v for k, v in answer["timing_ms"].items() if k not in ("load", "decode")}
    taps["actions"] = np.array(answer["actions"], dtype=np.float32)
    return taps, timing, peak


def distance(got, expected):
    """(largest difference, relative to the largest magnitude, cosine)."""
    a, b = got.astype(np.float64).ravel(), expected.astype(np.float64).ravel()
    largest = np.abs(a - b).max()
    return largest, largest / np.abs(b).max(), a @ b / np.sqrt((a @ a) * (b @ b))


def shared_part(got, expected):
    """The rows and columns of both: a reference may return the robot's part of a chunk alone."""
    n_row, n_column = np.minimum(got.shape, expected.shape)
    return got[:n_row, :n_column], expected[:n_row, :n_column]


def print_table(reference, rows):
    """rows: name -> (chunk, actions, seconds, peak bytes)."""
    print("\n| run | chunk: max abs | relative | cosine | actions: relative | inference, s | peak memory, GB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, (chunk, actions, seconds, peak) in rows.items():
        largest, relative, cosine = distance(*shared_part(chunk, reference["chunk"]))
        moved = distance(*shared_part(actions, reference["actions"]))[1]
        print(f"| {name} | {largest:.1e} | {relative:.1e} | {cosine:.9f} | {moved:.1e} | {seconds:.1f} | {peak / 1e9:.2f} |")


def print_blocks(reference, taps):
    """Relative distance of every block that both sides recorded, the worst of each stage first."""
    shared = [name for name in reference.files if name in taps and reference[name].ndim and name != "actions"]
    relative = {n: distance(taps[n].ravel(), reference[n].ravel())[1] for n in shared}
    print(f"\n{len(shared)} blocks; largest relative distance by stage:")
    for stage in dict.fromkeys(n.split(".")[0] for n in shared):
        worst = max((n for n in shared if n.split(".")[0] == stage), key=relative.get)
        print(f"  {stage}: {relative[worst]:.1e} at {worst}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, required=True, help="folder of the case; written where it has no checkpoint")
    parser.add_argument("--arch", default="smolvla", choices=sorted(a for a in families() if hasattr(family(a), "published")), help="of the checkpoint that is written")
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--dtype", default="bf16", choices=("f32", "bf16", "f16", "stored"), help="storage of the bundle's matrices")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--blocks", action="store_true", help="also compare every block; costs memory and time")
    parser.add_argument("--only", help=argparse.SUPPRESS)  # one part, in a process of its own
    args = parser.parse_args()
    case = args.case.resolve()
    if args.only == "write":
        return write_case(case, args.arch)
    if args.only:
        return run_torch(case, args.only, args.blocks and args.only == "float32", args.threads)
    again = [sys.executable, __file__, "--case", case, "--threads", args.threads, *(["--blocks"] if args.blocks else [])]
    if not (case / "checkpoint").is_dir():
        child([*again, "--arch", args.arch, "--only", "write"])
    peaks = {dtype: child([*again, "--only", dtype])[1] for dtype in ("float32", "published")}
    torch_runs = {dtype: np.load(case / f"torch_{dtype}.npz") for dtype in peaks}
    reference = torch_runs["float32"]
    checkpoint, bundle = case / "checkpoint", case / "bundle.gguf"
    backbone = cases.backbone_folder(checkpoint)
    convert = [sys.executable, "-m", "vla_cpp.convert.cli", checkpoint, *(["--backbone", backbone] if backbone else []), "-o", bundle]
    os.environ["PYTHONPATH"] = str(ROOT / "python")
    start = time.perf_counter()
    _, convert_peak = child([*convert, "--dtype", args.dtype, "--force", *cases.conversion_options(case)])
    convert_seconds = time.perf_counter() - start
    rows = {f"PyTorch {d}": (r["chunk"], r["actions"], float(r["seconds"]), peaks[d]) for d, r in torch_runs.items()}
    for kernels in (None, "float32"):
        pattern = "*" if args.blocks and kernels else "chunk"
        taps, timing, peak = run_vla(args.vla, case, bundle, pattern, case / "taps.gguf", args.threads, kernels=kernels)
        chunk = taps["chunk"].reshape(reference["chunk"].shape[0], -1)[:, : reference["chunk"].shape[1]]
        name = f"vla, {args.dtype} bundle, {kernels or 'its choice of'} kernels"
        rows[name] = (chunk, taps["actions"], sum(timing.values()) / 1e3, peak)
    print_table(reference, rows)
    print(f"\nvla-convert: {convert_seconds:.0f} s, peak {convert_peak / 1e9:.2f} GB, bundle {bundle.stat().st_size / 1e9:.2f} GB")
    print("vla stages, ms: " + ", ".join(f"{k} {v:.0f}" for k, v in timing.items()))
    print(f"{reference['versions']}; {args.threads} threads; one cold inference each, beside other work: no benchmark")
    if args.blocks:
        print_blocks(reference, taps)


if __name__ == "__main__":
    main()
