# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Where the time of an act goes, kernel by kernel: a JSON object a line for each family.

    python trace.py VLA FAMILY[,FAMILY,...] OUT

Acts of random weights at the published size run in this process, back to back, then once under PyTorch's profiler (CUPTI), which sees
every kernel of the process, those of a graph one by one. It makes graphs somewhat slower: times of kernels are true, gaps between them
are upper bounds. OUT/kernels.jsonl gets every kernel: begin and duration in microseconds, name, grid, registers, blocks an SM."""

import argparse
import collections
import json
import os
import statistics
import subprocess
import threading
import time
from pathlib import Path


class RandomBundle:
    """The bundle of vla bench, a file in memory that others may open while bench waits for a line before its first round. It is being made
    from the beginning, beside others."""

    def __init__(self, vla, family):
        command = [vla, "bench", "--arch", family, "--size", "full", "--device", "cuda", "--runs", "1", "--warmup", "0", "--paced", "--json"]
        pipe = subprocess.PIPE
        self.bench = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)

    def path(self):
        said = []
        for line in self.bench.stderr:
            said.append(line)
            if "solver steps" in line:  # all is loaded
                threading.Thread(target=self.bench.stderr.read, daemon=True).start()
                files = Path(f"/proc/{self.bench.pid}/fd").iterdir()
                return next(str(file) for file in files if "random bundle" in os.readlink(file))
        raise RuntimeError("".join(said[-3:]))

    def close(self):
        self.bench.kill()
        self.bench.wait()


def observation(spec):
    """Frames of noise, a state and a sentence for any policy."""
    import numpy as np

    draw = np.random.default_rng(0)
    images = {view.name: draw.integers(0, 256, (224, 224, 3), dtype=np.uint8) for view in spec.views}
    states = {state.name: draw.standard_normal(state.width).astype(np.float32).tolist() for state in spec.states}
    state = states if len(states) > 1 else next(iter(states.values()), [])
    return {"images": images, "state": state, "text": "put the red cube into the basket, then close the lid", "seed": 1}


def traced(act, out):
    """(begin, duration, name, details) of every kernel of an act."""
    import torch
    from torch.profiler import ProfilerActivity, profile

    torch.zeros(1, device="cuda")
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        act()
        torch.cuda.synchronize()
    file = out / "trace.json"
    profiler.export_chrome_trace(str(file))
    events = json.loads(file.read_text())["traceEvents"]
    file.unlink()
    return sorted(((e["ts"], e["dur"], e["name"], e.get("args", {})) for e in events if e.get("cat") == "kernel"), key=lambda one: one[:3])


def summary(kernels):
    """Of intervals that may overlap, as forked streams do: how long any of them ran, and what lies between."""
    end, busy, times = kernels[0][0], 0.0, collections.defaultdict(list)
    for begin, us, name, _ in kernels:
        busy += max(0.0, begin + us - max(end, begin))
        end = max(end, begin + us)
        times[name].append(us)
    span = end - kernels[0][0]
    rows = [{"kernel": name, "n": len(us), "ms": sum(us) / 1e3, "median_us": statistics.median(us), "least_us": min(us), "most_us": max(us)} for name, us in times.items()]
    return {"n": len(kernels), "busy_ms": busy / 1e3, "span_ms": span / 1e3, "gap_us": (span - busy) / len(kernels), "kernels": sorted(rows, key=lambda row: -row["ms"])}


def trace(bundle, family, out):
    """What acts take, and every kernel of one."""
    import vla_cpp

    with vla_cpp.Policy(bundle.path(), device="cuda") as policy:
        seen, walls = observation(policy.spec), []
        for _ in range(30):
            start = time.perf_counter()
            policy.act(**seen)
            walls.append(1e3 * (time.perf_counter() - start))
        found = {"family": family, "first_act_ms": walls[0], "act_ms": statistics.median(walls[3:]), "least_act_ms": min(walls[3:])}
        kernels = traced(lambda: policy.act(**seen), out)
    if kernels:
        found.update(summary(kernels))
        lines = [[round(begin - kernels[0][0], 2), us, name, args.get("grid"), args.get("registers per thread"), args.get("blocks per SM")] for begin, us, name, args in kernels]
        with open(out / "kernels.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps({"family": family, "kernels": lines}) + "\n")
    print(json.dumps(found), flush=True)


def main(vla, families, out):
    bundles = {family: RandomBundle(vla, family) for family in families.split(",")}
    try:
        for family, bundle in bundles.items():
            trace(bundle, family, out)
            bundle.close()
    finally:
        for bundle in bundles.values():
            bundle.close()
    os._exit(0)  # PyTorch's profiler and our library, both with libraries of their own, do not always part in peace


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, kind in (("vla", str), ("families", str), ("out", Path)):
        parser.add_argument(name, type=kind)
    main(**vars(parser.parse_args()))
