#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Tries vla.cpp on the first NVIDIA GPU of this machine, and measures it. Needs NVIDIA's driver, for CUDA 12.6 or newer, and Python 3.8 or newer.

    python3 try_gpu.py OUT                            all stages
    python3 try_gpu.py OUT devices act kernels        some of them; what other calls found in OUT stays

OUT/result.json is the result, OUT/log.txt all that was said. The stages, in order:

    devices    the driver and the GPU
    act        one act of a small policy in float32, bf16, int8 and int4, beside what the CPU answered where the kit was packed, bf16 beside float32
    kernels    the tests of all kernels
    sanitizer  memcheck, racecheck, synccheck and initcheck, where compute-sanitizer is there
    cases      golden cases of every architecture: each value within 1e-4 of the reference in float32, chunks within PyTorch's own error in bf16
    families   acts of policies of their published sizes, with random weights, and what was predicted where there is a model of this GPU;
               each kernel of an act, where this Python has PyTorch
    ways       the same acts without each of the ways to lower a graph that were chosen by estimates (VLA_CUDA_WITHOUT), and with TMA or flash attention
    torch      LeRobot's own networks at the same sizes, where the Python of --torch has PyTorch and LeRobot
    products   matrix products and attention in all shapes of blocks, and cuBLAS where this Python has PyTorch
    cpu        the same acts on this machine's processor

Where devices, act or kernels fail, each call of the driver is tried by itself instead, and the other stages do not run."""

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

KIT = Path(__file__).resolve().parent
VLA, TINY = KIT / "bin/vla", KIT / "tiny/policy.gguf"
# Of the largest action: sums in another order; bf16 beside float32; codes, where what lies between products is rounded in other places.
TOLERANCE = {"float32": 1e-4, "bf16": 3e-2, "int8": 1e-1, "int4": 1e-1}
WAYS = {f"without {way}": {"VLA_CUDA_WITHOUT": way} for way in ("clusters", "adders", "halved-norms", "rotations")}  # in src/lower/cuda/cuda_ways.cpp
WAYS.update({f"with {way}": {"VLA_CUDA_WITH": way} for way in ("flash", "tma")})
MODELS = {"H100": "h100", "H200": "h200", "5090": "rtx-5090", "3060": "rtx-3060", "Orin": "orin-agx"}  # in a card's name: vla bench --model


class Failed(Exception):
    """A step without which the next ones mean nothing."""


class Visit:
    """What runs and what was found, which is written after every step, so that a visit that is cut short leaves its part."""

    def __init__(self, options):
        self.options, self.out = options, options.out.resolve()
        self.out.mkdir(parents=True, exist_ok=True)
        self.file, self.log = self.out / "result.json", open(self.out / "log.txt", "a", encoding="utf-8")
        found = json.loads(self.file.read_text()) if self.file.is_file() else {}
        packed = json.loads((KIT / "kit.json").read_text())
        self.families = options.families or packed["families"]
        self.result = {"commit": packed["commit"], "checks": {}, "families": {}, **found}
        self.result["date"] = time.strftime("%Y-%m-%d")
        if options.driver:
            self.result["driver_of_tests"] = True
        self.environment = {**os.environ, "LD_LIBRARY_PATH": self.library_path()}
        # Compiled kernels are kept, so that only the first act compiles them.
        self.environment.setdefault("CUDA_CACHE_PATH", str(self.out / "compiled"))
        if options.driver:
            self.environment["VLA_REAL_MEMORY"] = "device"

    def library_path(self):
        """Ours first; the packer's C++ run time only where this machine's is too old for the program."""
        folders = [self.options.driver, KIT / "lib", *os.environ.get("LD_LIBRARY_PATH", "").split(":")]
        driver = Path("/usr/local/nvidia/lib64")  # of containers whose linker does not know it
        folders.append(driver if (driver / "libcuda.so.1").is_file() else None)
        path = ":".join(str(folder) for folder in folders if folder)
        starts = subprocess.run([VLA, "--version"], env={**os.environ, "LD_LIBRARY_PATH": path}, capture_output=True)
        return path if starts.returncode == 0 else f"{KIT / 'runtime'}:{path}"

    def save(self):
        self.file.write_text(json.dumps(self.result, indent=1) + "\n")

    def run(self, command, limit, **environment):
        """(exit code, output, errors, seconds); a command that takes longer is ended, and its code is None."""
        command, start = [str(word) for word in command], time.monotonic()
        try:
            done = subprocess.run(command, capture_output=True, timeout=limit, env={**self.environment, **environment}, cwd=KIT)
            code, out, err = done.returncode, done.stdout, done.stderr
        except subprocess.TimeoutExpired as late:
            code, out, err = None, late.stdout or b"", (late.stderr or b"") + f"\nended after {limit} s".encode()
        out, err, seconds = out.decode(errors="replace"), err.decode(errors="replace"), time.monotonic() - start
        self.log.write(f"##### {' '.join(command)}\n{out}{err}exit code {code}, {seconds:.1f} s\n")
        self.log.flush()
        return code, out, err, seconds

    def check(self, name, passed, seconds, said=""):
        """Notes and tells what a step showed."""
        said = "" if said is None else re.sub(r"\s+", " ", said).strip()[-300:]
        self.result["checks"][name] = {"passed": passed, "seconds": round(seconds, 1), **({"said": said} if said else {})}
        self.save()
        print(f"{'ok    ' if passed else 'FAILED'}  {name}  ({seconds:.0f} s)  {said}", flush=True)
        return passed

    def step(self, name, command, limit, tell=None, **environment):
        """A command that passes where its exit code is 0. Returns its output, or None. tell: what of the output is worth telling."""
        code, out, err, seconds = self.run(command, limit, **environment)
        said = (tell(out + err) if code == 0 and tell else "") if code == 0 else (err.strip() or out.strip())
        return out if self.check(name, code == 0, seconds, said) else None

    def must(self, *arguments, **keywords):
        out = self.step(*arguments, **keywords)
        if out is None:
            raise Failed(arguments[0])
        return out


def last_json(text):
    return json.loads([line for line in text.splitlines() if line.startswith("{")][-1])


def has_torch(visit):
    """Whether the Python of --torch sees the GPU."""
    program = "import torch, sys; sys.exit(not torch.cuda.is_available())"
    return not visit.options.driver and visit.run([visit.options.torch, "-c", program], 60)[0] == 0


def devices(visit):
    listed = json.loads(visit.must("devices", [VLA, "inspect", "--devices", "--json"], 60))
    gpu = next((one for one in listed["devices"] if one["name"] == "cuda:0"), None)
    if gpu is None:
        visit.check("cuda:0", False, 0, json.dumps(listed))
        raise Failed("cuda:0")
    card, driver = gpu["description"].rsplit("; ", 1)
    visit.result.update(card=card, driver=driver, memory_bytes=gpu["memory_bytes"])
    fields = "driver_version,clocks.max.sm,clocks.max.mem,power.limit"
    if shutil.which("nvidia-smi"):
        code, out, _, _ = visit.run(["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader"], 30)
        if code == 0:
            visit.result["nvidia_smi"] = dict(zip(fields.split(","), out.splitlines()[0].split(", ")))
    visit.check("cuda:0", True, 0, gpu["description"])


def away(found, expected):
    """The largest difference, as a share of the largest expected number."""
    most = max(abs(x) for row in expected for x in row)
    return max(abs(x - y) for a, b in zip(found, expected) for x, y in zip(a, b)) / most


def act(visit):
    asked = json.loads((KIT / "tiny/act.json").read_text())
    for kernels, expected in asked["answers"].items():
        command = [VLA, "run", TINY, *asked["arguments"], "--device", "cuda", "--kernels", kernels]
        answer = last_json(visit.must(f"act in {kernels}", command, 180))
        difference = away(answer["actions"], expected)
        passed = difference <= TOLERANCE[kernels]
        if not visit.check(f"act in {kernels} beside the CPU's", passed, 0, f"{difference:.1e} of the largest action, {TOLERANCE[kernels]:.0e} allowed"):
            raise Failed(kernels)


def kernels(visit):
    visit.must("tests of kernels", [KIT / "bin/test_kernels_gpu"], 240, tell=lambda out: " ".join(re.findall(r"(?:test cases|assertions):.*", out)))


def sanitizer(visit):
    if not shutil.which("compute-sanitizer", path=f"{os.environ.get('PATH', '')}:/usr/local/cuda/bin"):
        return visit.check("compute-sanitizer", True, 0, "not on this machine: not run")
    path = f"{os.environ['PATH']}:/usr/local/cuda/bin"
    asked = json.loads((KIT / "tiny/act.json").read_text())
    whole = [VLA, "run", TINY, *asked["arguments"], "--device", "cuda", "--kernels", "bf16"]
    some = [KIT / "bin/test_kernels_gpu", "-tc=bf16 products*,attention on bf16*,codes of rows*,int8 products*"]
    for tool in ("memcheck", "racecheck", "synccheck", "initcheck"):
        command = ["compute-sanitizer", "--tool", tool, "--error-exitcode", "9", "--print-limit", "10", *(whole if tool == "memcheck" else some)]
        visit.step(f"compute-sanitizer {tool}", command, 120, PATH=path)
    return None


def golden_case(visit, case, kernels):
    """None, or why the case does not hold."""
    taps = visit.out / f"taps/{case['name'].replace('/', '.')}.{kernels}.gguf"
    pattern = "*" if kernels == "float32" else "chunk"
    command = [VLA, *case["arguments"], "--device", "cuda", "--kernels", kernels, "--tap", pattern, "--taps-out", taps]
    code, out, err, _ = visit.run(command, 300)
    if code == 0:
        tolerance = 1e-4 if kernels == "float32" else case["bf16"]
        code, out, err, _ = visit.run([VLA, "compare", case["expected"], taps, "--only", pattern, "--tolerance", repr(tolerance)], 60)
    taps.unlink() if taps.is_file() else None
    return None if code == 0 else f"{case['name']}, {kernels}: {(err.strip() or out.strip())[-200:]}"


def cases(visit):
    (visit.out / "taps").mkdir(exist_ok=True)
    packed, start = json.loads((KIT / "cases.json").read_text()), time.monotonic()
    if visit.options.driver:  # a case of each architecture
        packed = list({case["name"].split("/")[0]: case for case in packed}.values())
    jobs = [(case, kernels) for case in packed for kernels in ("float32", "bf16") if kernels == "float32" or case["bf16"]]
    with ThreadPoolExecutor(max(1, min(8, (os.cpu_count() or 2) // 2))) as pool:
        failed = [why for why in pool.map(lambda job: golden_case(visit, *job), jobs) if why]
    visit.result["cases"] = {"passed": len(jobs) - len(failed), "failed": failed}
    visit.check("golden cases", not failed, time.monotonic() - start, f"{len(jobs) - len(failed)} of {len(jobs)} hold; {'; '.join(failed)}".strip("; "))


def medians(report):
    """Milliseconds of stages, of the network and in all; what loading took."""
    return {"ms": {name: stage["p50_ms"] for name, stage in report["stages"].items()}, "load_ms": report["load_ms"], "rounds": len(report["rounds"])}


def bench(visit, name, family, options, limit, **environment):
    """vla bench of the published size; of the small policy on the driver of tests."""
    what = [TINY] if visit.options.driver else ["--arch", family, "--size", "full"]
    rounds = ["--runs", "1", "--warmup", "0"] if visit.options.driver else ["--runs", "20", "--warmup", "3"]
    out = visit.step(name, [VLA, "bench", *what, *rounds, "--json", *options], limit, **environment, tell=lambda out: f"network {last_json(out)['stages']['network']['p50_ms']:.2f} ms")
    if out is None:
        return None
    with open(visit.out / "bench.jsonl", "a", encoding="utf-8") as file:
        file.write(json.dumps({"name": name, **last_json(out)}) + "\n")
    return medians(last_json(out))


def predicted(visit, family):
    """Of a model of this card; None where there is none."""
    model = visit.options.model or next((model for part, model in MODELS.items() if part in visit.result.get("card", "")), None)
    if model is None:
        return None
    code, out, _, _ = visit.run([VLA, "bench", "--arch", family, "--size", "full", "--device", "cuda", "--model", model, "--json"], 120)
    return {"model": model, "ms": {name: stage["ms"] for name, stage in last_json(out)["stages"].items()}} if code == 0 else None


def families(visit):
    for family in visit.families:
        found = visit.result["families"].setdefault(family, {})
        found["predicted"] = predicted(visit, family)
        found["stored"] = bench(visit, f"{family}, as stored", family, ["--device", "cuda"], 150)
        if family != "bitvla":  # its products are of int8 already
            found["int8"] = bench(visit, f"{family}, int8", family, ["--device", "cuda", "--kernels", "int8"], 150)
        visit.save()
    if has_torch(visit):
        command = [visit.options.torch, KIT / "trace.py", VLA, ",".join(visit.families), visit.out]
        out = visit.step("kernel by kernel", command, 60 * len(visit.families), PYTHONPATH=str(KIT / "python"), VLA_LIBRARY=str(KIT / "bin/libvla.so.1"))
        for traced in map(json.loads, (out or "").splitlines()):
            visit.result["families"][traced.pop("family")]["traced"] = traced
    visit.save()


def ways(visit):
    for family in visit.families:
        found = visit.result["families"].setdefault(family, {}).setdefault("ways", {})
        for way, environment in WAYS.items():
            found[way] = bench(visit, f"{family}, {way}", family, ["--device", "cuda"], 150, **environment)
            visit.save()


def torch(visit):
    code, _, _, _ = visit.run([visit.options.torch, "-c", "import torch, lerobot"], 120)
    if code != 0:
        visit.check("PyTorch", True, 0, f"no PyTorch with LeRobot in {visit.options.torch}: not run")
        return
    modes, tiny = ("eager", "graph", "compiled"), []
    if visit.options.driver:
        modes, tiny = ("eager",), ["--tiny", "--rounds", "1"]
    for family in [name for name in visit.families if name in ("smolvla", "pi0", "pi05")]:
        for mode in modes:
            command = [visit.options.torch, KIT / "tools/peers/gpu.py", family, mode, *tiny]
            out = visit.step(f"{family} in PyTorch, {mode}", command, 240, tell=lambda out: f"{statistics.median(last_json(out)['ms']):.2f} ms")
            times = visit.result["families"].setdefault(family, {}).setdefault("torch", {})
            times[mode] = out and statistics.median(last_json(out)["ms"])
    visit.save()


def products(visit):
    sizes = ["1", "1", "1"] if visit.options.driver else []
    out = visit.step("products", [KIT / "bin/bench_products", *sizes], 240)
    if out is None:
        return
    (visit.out / "products.jsonl").write_text(out)
    fastest = {}
    for row in map(json.loads, out.splitlines()):
        key = row["kind"], row["rows"], row["depth"], row["columns"]
        fastest[key] = min(row, fastest.get(key, row), key=lambda one: one["us"])
    visit.result["products"] = list(fastest.values())
    out = visit.step("attention in all shapes of blocks", [KIT / "bin/bench_attention_gpu", *sizes], 120)
    visit.result["attention"] = out and [json.loads(line) for line in out.splitlines()]
    if has_torch(visit):
        sizes = json.dumps(sorted({key[1:] for key in fastest}))
        out = visit.step("products of cuBLAS", [visit.options.torch, KIT / "cublas.py", sizes], 150)
        visit.result["cublas"] = out and [json.loads(line) for line in out.splitlines()]
    visit.save()


def cpu(visit):
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        visit.result["processor"] = next((line.split(":")[1].strip() for line in file if line.startswith("model name")), "")
    for family in visit.families if visit.options.families else ("smolvla", "pi05"):
        for threads in dict.fromkeys(("2", str(os.cpu_count()))):
            found = visit.result["families"].setdefault(family, {}).setdefault("cpu", {})
            found[threads] = bench(visit, f"{family} on the CPU, {threads} threads", family, ["--threads", threads], 240)
    visit.save()


def diagnose(visit):
    """Each call of the driver by itself, and an act in other ways of loading and launching."""
    asked = json.loads((KIT / "tiny/act.json").read_text())
    command = [VLA, "run", TINY, *asked["arguments"], "--device", "cuda", "--kernels", "bf16"]
    code, out, err, _ = visit.run([sys.executable, KIT / "probe.py", *sorted((KIT / "bin/ptx").iterdir())], 180)
    print(out + err)
    visit.result["probe"] = (out + err).splitlines()
    for name, value in (("CUDA_MODULE_LOADING", "EAGER"), ("CUDA_LAUNCH_BLOCKING", "1"), ("CUDA_CACHE_DISABLE", "1")):
        visit.step(f"an act with {name}={value}", command, 120, **{name: value})
    if shutil.which("compute-sanitizer"):
        visit.step("an act, each error of the driver", ["compute-sanitizer", "--report-api-errors", "all", "--print-limit", "5", *command], 180)


STAGES = {stage.__name__: stage for stage in (devices, act, kernels, sanitizer, cases, families, ways, torch, products, cpu)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("stages", nargs="*", metavar="STAGE", help="all of them, if none is given")
    parser.add_argument("--families", type=lambda text: text.split(","), help="of the stages families and cpu: smolvla,pi05,...")
    parser.add_argument("--model", help="whose prediction stands beside: vla bench --model; default: that of the card's name, if there is one")
    parser.add_argument("--torch", default=sys.executable, metavar="PYTHON", help="one with PyTorch for CUDA; default: this one, if it has it")
    parser.add_argument("--driver", type=Path, metavar="FOLDER", help="a folder with a libcuda.so.1 of tests: sizes are small, and no time means anything")
    options = parser.parse_args()
    unknown = [stage for stage in options.stages if stage not in STAGES]
    if unknown:
        parser.error(f"{unknown[0]}: expected one of {', '.join(STAGES)}")
    visit = Visit(options)
    try:
        for stage in options.stages or STAGES:
            STAGES[stage](visit)
    except Failed:
        diagnose(visit)
    visit.save()
    failed = [name for name, one in visit.result["checks"].items() if not one["passed"]]
    print(f"{visit.file}: {len(visit.result['checks']) - len(failed)} of {len(visit.result['checks'])} checks passed" + (f"; failed: {', '.join(failed)}" if failed else ""))
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
