# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""torch.matmul, cuBLAS, in bf16 at the sizes that bench_products measured: a JSON object a line.

    python cublas.py '[[rows, depth, columns], ...]'

As there: random operands, 20 products in a captured graph; `us` with matrices in turn that no cache holds together, `warm_us` with one."""

import argparse
import json
import statistics

N_LAUNCH, BEYOND_CACHES = 20, 200 << 20


def microseconds(x, matrices):
    import torch

    def run():
        for i in range(N_LAUNCH):
            torch.matmul(x, matrices[i % len(matrices)].T)

    run()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    times = []
    for _ in range(6):
        first, last = torch.cuda.Event(True), torch.cuda.Event(True)
        first.record()
        graph.replay()
        last.record()
        torch.cuda.synchronize()
        times.append(1e3 * first.elapsed_time(last) / N_LAUNCH)
    return statistics.median(times[1:])


def main(sizes):
    import torch

    for rows, depth, columns in sizes:
        x = torch.randn(rows, depth, device="cuda", dtype=torch.bfloat16)
        n = min(N_LAUNCH, BEYOND_CACHES // (2 * depth * columns) + 1)
        matrices = [0.1 * torch.randn(columns, depth, device="cuda", dtype=torch.bfloat16) for _ in range(n)]
        us, warm = microseconds(x, matrices), microseconds(x, matrices[:1])
        print(json.dumps({"rows": rows, "depth": depth, "columns": columns, "us": us, "warm_us": warm}), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sizes", type=json.loads)
    main(parser.parse_args().sizes)
