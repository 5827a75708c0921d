#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The figures of `vla serve` under load, as rows of a Markdown table.

scripts/serve_load.py overhead     one client, two raw views of 256 x 256: what server and network add to the engine
scripts/serve_load.py protocols    the same act through each protocol that the server speaks, by turns, as their clients in Python make it
scripts/serve_load.py jpeg         the same with JPEG files, and libjpeg-turbo's own time for them
scripts/serve_load.py many         64 clients, 100,000 acts: lost and crossed answers, fairness, resident memory
scripts/serve_load.py busy         the shipped policy with default threads: processor time while idle, and one client's
                                   acts alone and beside four busy loops

The server runs on this machine, but for `busy` with a bundle of random weights; its engine takes about a millisecond,
so that what is measured is not hidden. Needs build/cpu/bin/vla and build/cpu/bin/load_tool. Fails where an answer is lost, wrong, or
another one's. docs/performance.md says what the rows mean.
"""

import argparse
import importlib.util
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tools"), str(ROOT / "tests/client")]
from busy_loops import busy_loops  # noqa: E402
from goldens.build import make  # noqa: E402

SIDE = 256
WARM = 3  # tenths of the acts of `many`, until the allocator holds what 64 clients need at the worst moment


@contextmanager
def serving(options, *more):
    """(address, process) of a server of its own."""
    threads = ["--threads", options.threads] if options.threads else []
    command = [options.vla, "serve", options.bundle, "--bind", "tcp://127.0.0.1:0", *threads, *more]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        yield re.search(r"address='?([^\s']+)", line)[1], process
    finally:
        process.terminate()
        process.communicate()


def run_tool(options, address, *arguments):
    """What tests/serve/load_tool.cpp reports."""
    requests = ["--requests", str(options.requests)]
    result = subprocess.run([options.tool, address, *requests, *map(str, arguments)], stdout=subprocess.PIPE, text=True)
    if not result.stdout:
        sys.exit(result.returncode or 1)
    return {**json.loads(result.stdout), "flawless": result.returncode == 0}


def image(seed):
    """Something like a photograph: smooth shapes, edges and a little noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    waves = [np.sin(2 * np.pi * (a * x + b * y + c)) for a, b, c in rng.uniform(-4, 4, (3, 3))]
    image = 128 + 60 * np.stack(waves, -1) + 50 * ((x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.1)[..., None]
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def jpeg(seed):
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image(seed)).save(data, "JPEG", quality=90)
    return data.getvalue()


def acts(options, address):
    """(milliseconds, answer) of the package's own client, numpy in and numpy out, for one act after the other."""
    import vla_cpp

    with vla_cpp.Client(address, timeout=60) as client:
        images = {view.name: image(i) for i, view in enumerate(client.spec.views)}
        state = {s.name: np.full(s.width, 0.1, np.float32) for s in client.spec.states}
        for i in range(options.requests):
            start = time.perf_counter()
            chunk = client.act(images=images, state=state, text="open the drawer", seed=i)
            yield 1e3 * (time.perf_counter() - start), chunk


def quantiles(milliseconds):
    p50, p99 = np.quantile(milliseconds, [0.5, 0.99])
    return {"p50": p50, "p99": p99}


def python_client(options, address):
    """Round trip minus engine time."""
    milliseconds = [ms - sum(chunk.timing.values()) for ms, chunk in acts(options, address)]
    return {"overhead_ms": quantiles(milliseconds), "requests": options.requests, "flawless": True}


def overhead(options):
    with serving(options) as (address, _):
        tool, package = run_tool(options, address, "--side", SIDE), python_client(options, address)
    rows = [
        ("round trip minus engine, C++ client", spread(tool["overhead_ms"]), "p50 0.5, p99 2"),
        ("of that, until the engine takes the act up", spread(tool["queue_ms"]), ""),
        ("round trip minus engine, Python client", spread(package["overhead_ms"]), ""),
        ("the server's copy of the frames, part of the engine time", spread(tool["decode_ms"]), ""),
    ]
    return {"cpp": tool, "python": package}, rows


def openpi_client(stack, address, scene, text):
    import msgpack
    from drop_in import openpi_array, unpack
    from websockets.sync.client import connect

    socket = stack.enter_context(connect(address, compression=None, max_size=None))
    socket.recv()

    def act():
        socket.send(msgpack.packb({**scene, "prompt": text}, default=openpi_array))
        return unpack(socket.recv())["actions"]

    return act


def gr00t_client(stack, address, scene, text):
    import zmq
    from drop_in import numpy_array, pack, unpack

    socket = stack.enter_context(stack.enter_context(zmq.Context()).socket(zmq.REQ))
    socket.connect(address)
    observation = {("state." if key == "state" else "video.") + key: value[None, None] for key, value in scene.items()}

    def act():
        data = {"observation": {**observation, "annotation.task": [text]}, "options": None}
        socket.send(pack({"endpoint": "get_action", "data": data}, numpy_array))
        return next(iter(unpack(socket.recv())[0].values()))

    return act


def lerobot_client(stack, address, scene, text):
    import lerobot_pickles
    from lerobot_calls import Robot

    robot = stack.enter_context(Robot(address))
    motors = {f"motor_{i}": x for i, x in enumerate(scene["state"].tolist())}
    cameras = {key: frame for key, frame in scene.items() if key != "state"}
    robot.begin(lerobot_pickles.setup_of(motors, cameras))
    seen = {**motors, **cameras, "task": text}
    data = lerobot_pickles.dumps(lerobot_pickles.TimedObservation(0.0, 0, seen, True))

    def act():
        robot.observe(data)
        return robot.actions()

    return act


def has_grpc():
    """Whether this Python can be a client of LeRobot's protocol."""
    return importlib.util.find_spec("grpc") is not None


def protocols(options):
    import vla_cpp
    from vla_cpp.observation import robot_of

    kinds = [("openpi", openpi_client, 0.5), ("gr00t", gr00t_client, 0.5)]
    kinds += [("lerobot", lerobot_client, 1.0)] if has_grpc() else []
    with vla_cpp.Policy(str(options.bundle), threads=1) as policy:
        spec = robot_of(policy.spec, None)
    names = {one.name.rpartition(".")[2]: one.name for one in (*spec.views, *spec.states)}
    more = [part for name, *_ in kinds for part in ("--" + name, "127.0.0.1:0")]
    more += [part for key, name in names.items() for part in ("--map", f"{key}={name}")]
    state = np.full(spec.states[0].width, 0.1, np.float32)
    scene = {key: state if key == "state" else image(i) for i, key in enumerate(names)}
    text, took = "open the drawer", {}
    with serving(options, *more) as (addresses, _), ExitStack() as stack:
        native, *others = addresses.split(",")
        client = stack.enter_context(vla_cpp.Client(native, timeout=60))
        images = {name: scene[key] for key, name in names.items() if key != "state"}
        acts = {"native": lambda: client.act(images=images, state={names["state"]: scene["state"]}, text=text)}
        for (name, make_client, _), address in zip(kinds, others):
            acts[name] = make_client(stack, address.removeprefix("gr00t+"), scene, text)
        for _ in range(options.requests):
            for name, act in acts.items():
                start = time.perf_counter()
                act()
                took.setdefault(name, []).append(1e3 * (time.perf_counter() - start))
    more = {name: float(np.median(took[name]) - np.median(took["native"])) for name, *_ in kinds}
    rows = [("native, round trip", spread(quantiles(took["native"])), "")]
    rows += [(f"{name}, p50 beyond that", f"{more[name]:+.3f} ms", f"{bar:g}") for name, _, bar in kinds]
    rows += [("load of the machine in the last minute", f"{os.getloadavg()[0]:.1f}", "")]
    return {"protocols": {**more, "flawless": True}}, rows


def jpegs(options):
    with tempfile.TemporaryDirectory() as folder, serving(options) as (address, _):
        files = [Path(folder) / f"{i}.jpg" for i in range(2)]
        sizes = [file.write_bytes(jpeg(i)) for i, file in enumerate(files)]
        tool = run_tool(options, address, "--jpeg", *files)
    ratio = tool["decode_ms"]["p50"] / tool["plain_jpeg_ms"]["p50"]
    rows = [
        ("round trip minus engine, JPEG views of " + " and ".join(f"{s / 1024:.0f} KiB" for s in sizes),
         spread(tool["overhead_ms"]), ""),
        ("decode stage of the server, both views", spread(tool["decode_ms"]), ""),
        ("libjpeg-turbo alone, both files", spread(tool["plain_jpeg_ms"]), ""),
        ("decode stage over libjpeg-turbo, p50", f"{ratio:.2f}", "about 1"),
    ]  # fmt: skip
    return {"jpeg": tool, "ratio": ratio}, rows


def many(options):
    with serving(options) as (address, process):
        load = ["--clients", options.clients, "--side", options.side, "--pid", process.pid]
        tool = run_tool(options, address, *load)
    served, memory = tool["served"], tool["resident_mb"]
    growth = memory[-1] / memory[WARM - 1] - 1
    rows = [
        ("answers", f"{tool['answers']} of {tool['requests']}", "all"),
        ("crossed, with an error, unasked", f"{tool['crossed']}, {tool['errors']}, {tool['unasked']}", "0, 0, 0"),
        ("acts per second", f"{tool['per_second']:.0f}", ""),
        ("acts of the client served least and most", f"{served['least']}, {served['most']}", "within 2x"),
        ("resident MiB after each tenth", ", ".join(f"{mib:.1f}" for mib in memory), ""),
        (f"growth of resident memory after {WARM} tenths", f"{100 * growth:.2f} %", "under 2 %"),
    ]  # fmt: skip
    return {"many": tool, "growth": growth}, rows


def processor_seconds(pid):
    """Of all threads of a process, in user and system mode."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def round_trips(options, address):
    """Of one client that acts ten times a second, as a robot does."""
    milliseconds = []
    for ms, _ in acts(options, address):
        milliseconds.append(ms)
        time.sleep(max(0, 0.1 - 1e-3 * ms))
    return quantiles(milliseconds)


def busy(options):
    with serving(options) as (address, process):
        round_trips(options, address)
        before = processor_seconds(process.pid)
        time.sleep(10)
        idle = processor_seconds(process.pid) - before
        alone = round_trips(options, address)
        with busy_loops(4):
            beside = round_trips(options, address)
    ratio = {q: beside[q] / alone[q] for q in alone}
    rows = [
        ("processor time of the idle server in 10 s", f"{idle:.2f} s", "0"),
        ("round trip alone", spread(alone), ""),
        ("round trip beside four busy loops", spread(beside), ""),
        ("the same over alone", f"p50 {ratio['p50']:.2f}, p99 {ratio['p99']:.2f}", "p50 2, p99 5"),
    ]
    return {"busy": {"idle": idle, "alone": alone, "beside": beside, "flawless": True}}, rows


def spread(figures):
    return f"p50 {figures['p50']:.3f}, p99 {figures['p99']:.3f} ms"


FIGURES = {"overhead": (overhead, 2000), "protocols": (protocols, 500), "jpeg": (jpegs, 2000), "many": (many, 100_000), "busy": (busy, 100)}


def parse():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    binaries = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
    parser.add_argument("figure", choices=FIGURES)
    parser.add_argument("--bundle", type=Path, help="default: that of a golden case, of `busy` the shipped policy")
    parser.add_argument("--vla", type=Path, default=binaries)
    parser.add_argument("--tool", type=Path, default=os.environ.get("VLA_LOAD_TOOL", binaries.with_name("load_tool")))
    parser.add_argument("--threads", type=int, help="of the engine; default: 1, of `busy` the server's own")
    parser.add_argument("--clients", type=int, default=64, help="of `many`; default: 64")
    parser.add_argument("--side", type=int, default=64, help="of the raw frames of `many`; default: 64 pixels")
    parser.add_argument("--requests", type=int, help="default: 100,000 of `many`, 100 of `busy`, 500 of `protocols`, 2,000 else")
    parser.add_argument("--json", action="store_true")
    return parser.parse_args()


def main():
    options = parse()
    if options.figure == "busy":
        options.bundle = options.bundle or ROOT / "models/metaworld-tiny.gguf"
    else:
        options.bundle = options.bundle or make() / "smolvla/two_views/bundle.gguf"
        options.threads = options.threads or 1
    measure, requests = FIGURES[options.figure]
    options.requests = options.requests or requests
    report, rows = measure(options)
    if options.json:
        print(json.dumps(report))
    else:
        print("| | measured | to reach |\n| --- | --- | --- |")
        print("\n".join(f"| {' | '.join(row)} |" for row in rows))
    return 0 if all(part["flawless"] for part in report.values() if isinstance(part, dict)) else 1


if __name__ == "__main__":
    sys.exit(main())
