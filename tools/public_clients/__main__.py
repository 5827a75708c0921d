# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Public robot clients, unmodified, at `vla serve`: an episode on recorded frames and episodes in MetaWorld for each.

    python tools/public_clients --vla build/cpu/bin/vla openpi=/venv/openpi/bin/python openpi-broker=/venv/openpi/bin/python:/src/openpi-client/src \\
        gr00t-n1.5=/venv/gr00t/bin/python:/src/n1.5 gr00t-n1.6=... gr00t-n1.7=... lerobot=/venv/lerobot/bin/python

A client is NAME=PYTHON[:FOLDER], an interpreter that has it and the folder of its sources, if it is not installed; NAME@WORD tells
two of a kind apart. What runs this has vla_cpp, and MetaWorld for the episodes in the simulator (examples/metaworld/requirements-sim.txt).

Each client drives the robot itself, by chunks of which it executes eight rows. The server records what it was asked, and with which
seed. Then the native client plays the same episode with these seeds, and `vla run` each of its looks: equal means that every action
that the robot executed, every whole chunk that the client gave and the episode's end are the same, bit for bit.
Ends with exit code 1 if something differs.
"""
import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python")]
import robot  # noqa: E402
import vla_cpp  # noqa: E402
from vla_cpp.recording import Recording, acts_of  # noqa: E402

HERE, BUNDLE, RECORDED = Path(__file__).parent, ROOT / "models/metaworld-tiny.gguf", ROOT / "examples/metaworld/episodes"
VIEW, STATE, ROWS, SECONDS = "observation.images.corner4", "observation.state", 8, 120
MAP = ["observation/image=corner4", "observation/state=observation.state", "prompt=text"]
FRONTS = {"openpi": ("--openpi", "ws://"), "gr00t": ("--gr00t", "gr00t+tcp://"), "lerobot": ("--lerobot", "grpc://")}


class Recorded:
    """A recorded episode, which goes on whatever the robot does: a look for each eight rows."""

    def __init__(self, folder, n_skipped):
        import PIL.Image

        self._episode = json.loads((folder / "episode.json").read_text())
        self._frames = [np.asarray(PIL.Image.open(folder / look["frame"])) for look in self._episode["looks"]]
        self._skipped, self.text = n_skipped, self._episode["sentence"]

    def begin(self):
        self.n_step = 0

    def observe(self):
        look = min(max(0, self.n_step - self._skipped) // ROWS, len(self._frames) - 1)
        return self._frames[look], np.array(self._episode["looks"][look]["state"], np.float32)

    def step(self, action):
        """Whether the episode is over."""
        self.n_step += 1
        return self.n_step == ROWS * len(self._frames) + self._skipped

    def result(self):
        return f"{len(self._frames)} looks"


class Simulated:
    """An episode in MetaWorld."""

    def __init__(self, task, seed):
        from vla_cpp.eval.environments.metaworld import LIMIT, MetaWorld

        self._scene, self._seed, self._limit = MetaWorld(task), seed, LIMIT
        self.text = self._scene.instruction()

    def begin(self):
        self._scene.reset(self._seed)
        self.n_step, self._frame, self.solved = 0, None, False

    def observe(self):
        if self._frame is None:  # a client may look again before it acts
            self._frame = self._scene.frame()
        return self._frame, self._scene.state()

    def step(self, action):
        self.n_step, self._frame, self.solved = self.n_step + 1, None, self._scene.step(action)
        return self.solved or self.n_step == self._limit

    def result(self):
        return f"{'solved' if self.solved else 'not solved'} in {self.n_step}"


@contextlib.contextmanager
def serving(vla, *options):
    command = [vla, "serve", BUNDLE, "--bind", "tcp://127.0.0.1:0", *options]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    line = process.stdout.readline()
    try:
        if not line.startswith("ready "):
            raise SystemExit(process.stderr.read())
        yield re.search(r"address='?([^\s']+)", line)[1].split(",")
    finally:
        process.terminate()
        process.wait()


def drive(command, environment, folder, episode):
    """Lets a client drive, which may write into a folder: every action that it executed, every whole chunk that it showed."""
    episode.begin()
    actions, chunks = [], []
    pipes = {name: subprocess.PIPE for name in ("stdin", "stdout", "stderr")}
    client = subprocess.Popen(command, env=environment, cwd=folder, **pipes)
    over = False
    while True:
        head, array = robot.receive(client.stdout)
        if head is None:
            break
        if head["kind"] == "observe":
            frame, state = episode.observe()
            robot.send(client.stdin, frame, state=state.tolist(), text=episode.text)
            continue
        if head["kind"] == "step":
            actions.append(array)
            over = episode.step(array)
        else:
            chunks.append(array)
        robot.send(client.stdin, over=over)
    errors = client.stderr.read().decode()
    if client.wait(SECONDS) != 0 or not over:
        raise SystemExit(f"{' '.join(command)}: {errors}")
    return np.array(actions), chunks


def run_vla(vla, frame, state, text, seed, folder):
    np.save(folder / "frame.npy", frame)
    command = [vla, "run", BUNDLE, "--image", f"corner4={folder / 'frame.npy'}", "--state", ",".join(map(repr, state.tolist())), "--text", text]
    command += ["--seed", seed, "--out", folder / "chunk.npy"]
    subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL)
    return np.load(folder / "chunk.npy")


def play_again(vla, native, episode, seeds, n_skipped, folder):
    """The episode by the native client: the actions that are executed, and every chunk, which is that of `vla run` too."""
    episode.begin()
    actions, chunks, over = [], [], False
    while not over and len(chunks) < len(seeds):
        frame, state = episode.observe()
        seed = seeds[len(chunks)]
        chunk = native.act(images={VIEW: frame}, state={STATE: state}, text=episode.text, seed=seed).actions
        if run_vla(vla, frame, state, episode.text, seed, folder).tobytes() != chunk.tobytes():
            raise SystemExit("the native client has another chunk than `vla run`")
        first = n_skipped if chunks else 0
        chunks.append(chunk)
        for action in chunk[first : ROWS + n_skipped]:
            actions.append(action)
            over = episode.step(action)
            if over:
                break
    return np.array(actions), chunks


def compare(vla, name, python, source, episode, native, folder):
    """(whether all is equal, chunks, result of the client, of the native client)"""
    kind, n_skipped = re.split("[-@]", name)[0], int(name.startswith("lerobot"))
    option, scheme = FRONTS[kind]
    options = [option, "127.0.0.1:0", "--record", folder / "record"]
    options += [part for line in MAP for part in ("--map", line)] if kind == "openpi" else []
    options += ["--gr00t-n1-5"] if "n1.5" in name else []
    paths = [str(HERE), *([source] if source else []), *([str(ROOT / "python")] if kind == "lerobot" else [])]
    with serving(vla, *options) as addresses:
        address = next(a for a in addresses if a.startswith(scheme)).removeprefix(scheme)
        command = [python, str(HERE / f"{kind}_robot.py"), address, str(ROWS)]
        command += ["broker"] if "broker" in name else ["n1.5"] if "n1.5" in name else []
        actions, shown = drive(command, {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, folder, episode)
    result = episode.result()
    seeds = [act.answer.seed for act in acts_of(Recording(folder / "record"))]
    again, chunks = play_again(vla, native, episode, seeds, n_skipped, folder)
    is_equal = again.tobytes() == actions.tobytes() and episode.result() == result
    is_equal = is_equal and all(a.astype(np.float32).tobytes() == b.tobytes() for a, b in zip(shown, chunks))
    return is_equal, len(chunks), result, episode.result()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("client", nargs="+", help="NAME=PYTHON[:FOLDER]")
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--task", action="append", help="of MetaWorld; default: the four that the policy knows")
    parser.add_argument("--seed", type=int, default=910000, help="of the simulator's scenes")
    parser.add_argument("--recorded", action="store_true", help="recorded frames only, without a simulator")
    args = parser.parse_args()
    tasks, n_wrong = args.task or sorted(p.name for p in RECORDED.iterdir()), 0
    print("| client | episode | client | native client | chunks, all equal to `vla run`'s |\n| --- | --- | --- | --- | --- |", flush=True)
    with tempfile.TemporaryDirectory() as scratch, serving(args.vla) as addresses, vla_cpp.Client(addresses[0]) as native:
        scenes = {} if args.recorded else {task: Simulated(task, args.seed) for task in tasks}
        for client in args.client:
            name, _, where = client.partition("=")
            python, _, source = where.partition(":")
            source = source and str(Path(source).resolve())
            n_skipped = int(name.startswith("lerobot"))
            episodes = {"recorded": Recorded(RECORDED / tasks[0], n_skipped), **scenes}
            for label, episode in episodes.items():
                folder = Path(scratch) / f"{name}-{label}"
                folder.mkdir()
                is_equal, n_chunk, result, expected = compare(args.vla, name, python, source, episode, native, folder)
                n_wrong += not is_equal
                print(f"| {name} | {label} | {result} | {expected} | {n_chunk}{'' if is_equal else ' **differ**'} |", flush=True)
    sys.stdout.flush()
    os._exit(1 if n_wrong else 0)  # MuJoCo's destructors print errors at a normal exit


if __name__ == "__main__":
    main()
