# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Two programs that run one inference each in turn: a PyTorch reference that answers by peer.serve, and `vla bench --paced`."""
import json
import statistics
import subprocess

from peer import STAGES


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


def compare(reference, bench, rounds, threads):
    """Prints ratios of wall time and of processor time, round by round.  reference, bench: command lines; the latter without rounds."""
    theirs = Child(reference, "stdout")
    print(json.loads(theirs.wait_for("{"))["name"], flush=True)
    ours = Child([*bench, "--paced", "--json", "--warmup", 1, "--runs", rounds, "--threads", threads], "stderr")
    times = []
    for turn in range(rounds + 1):  # the first warms up
        ours.run(("warm-up ", "round "))
        answer = json.loads(theirs.run("{"))
        print(f"round {turn}: PyTorch {answer['ms']:.0f} ms, {answer['cpu_ms']:.0f} ms of the processor", flush=True)
        times += [answer] if turn else []
    report = json.loads(ours.process.communicate()[0].splitlines()[-1])
    rounds = [{"ms": sum(r["stages"][s] for s in STAGES), "cpu_ms": r["cores"] * r["total_ms"]} for r in report["rounds"]]
    print(f"{report['cpu']}, {threads} threads, kernels: {report['kernels']}")
    for what, text in (("ms", "wall time, network"), ("cpu_ms", "processor time")):
        ratios = [a[what] / b[what] for a, b in zip(times, rounds)]
        print(f"{text}: vla {statistics.median(r[what] for r in rounds):.0f} ms, PyTorch {statistics.median(t[what] for t in times):.0f} ms, "
              f"PyTorch over vla {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")
    print(f"vla: {report['memory_bytes']['peak'] / 1e6:.0f} MB at the most")
