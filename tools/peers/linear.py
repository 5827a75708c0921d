# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Matrix products of vla's kernels and of PyTorch's library in turn, beside the peak of the machine.

    python tools/peers/linear.py [--kernels avx512] [--rounds 5] [--threads 1] [--bench build/cpu/bin/bench_linear]

In each round bench_linear measures its shapes, and then torch.mm the same ones: in float32 (MKL, where PyTorch has it), or
in bfloat16 beside avx512_bf16 and amx (oneDNN).  The table has the median of the rounds; a ratio is taken within a round.
A library may choose its code by the processor's vendor.
"""
import argparse
import re
import statistics
import subprocess
import time
from pathlib import Path

from peer import ROOT

LINE = re.compile(r"^\S+ +bf16 +(\d+) x +(\d+) x +(\d+) +([\d.]+) G/s +[\d.]+ % of +([\d.]+)(?!.*rounded)")
REPEATS = 9  # of torch.mm, of which the best counts, as in bench_linear


def ours(args):
    """{(rows, d_in, d_out): (G/s, peak in G/s)}"""
    command = [args.bench, args.threads, 1, args.kernels]
    out = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=True).stdout
    found = {tuple(int(m[i]) for i in (1, 2, 3)): (float(m[4]), float(m[5])) for m in map(LINE.match, out.splitlines()) if m}
    if not found:
        raise SystemExit(f"error: {' '.join(map(str, command))} measured nothing: this machine lacks {args.kernels}")
    return found


def theirs(shape, dtype):
    import torch

    n_row, d_in, d_out = shape
    x, w, y = torch.randn(n_row, d_in).to(dtype), torch.randn(d_out, d_in).to(dtype), torch.empty(n_row, d_out, dtype=dtype)
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        torch.mm(x, w.t(), out=y)
        times.append(time.perf_counter() - start)
    return 2e-9 * n_row * d_in * d_out / min(times)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernels", default="avx512", choices=("avx2", "avx512", "avx512_bf16", "amx"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--bench", type=Path, default=ROOT / "build/cpu/bin/bench_linear")
    args = parser.parse_args()
    import torch

    torch.set_num_threads(args.threads)
    dtype = torch.bfloat16 if args.kernels in ("avx512_bf16", "amx") else torch.float32
    rounds = []
    for i in range(args.rounds):
        rounds.append({shape: (*rate, theirs(shape, dtype)) for shape, rate in ours(args).items()})
        print(f"round {i + 1}/{args.rounds}", flush=True)
    library = re.search(r"Math Kernel Library Version (\S+?)-", torch.__config__.show())
    print(f"\ntorch {torch.__version__}, {dtype}, MKL {library[1] if library else 'absent'}, {args.threads} thread(s)\n")
    print(f"| rows x d_in x d_out | `{args.kernels}`, of the peak | torch.mm, of the peak | vla over torch.mm |")
    print("| --- | ---: | ---: | ---: |")
    for shape in rounds[0]:
        rates = [r[shape] for r in rounds]
        own, other = (100 * statistics.median(rate[i] / rate[1] for rate in rates) for i in (0, 2))
        print(f"| {' x '.join(map(str, shape))} | {own:.0f} % | {other:.0f} % | {statistics.median(r[0] / r[2] for r in rates):.2f} |")


if __name__ == "__main__":
    main()
