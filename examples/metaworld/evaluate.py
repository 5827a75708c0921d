# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Closed loop: the policy drives the simulated robot on layouts it has never seen, and we count.

    python evaluate.py --checkpoint checkpoint --episodes 50 --out evaluation.json           # PyTorch
    python evaluate.py --bundle policy.gguf --vla vla --episodes 50 --out evaluation_cpp.json    # the C++ runtime
    python evaluate.py --expert --episodes 50 --swapped 0                                             # the scripted experts

Each episode: look, predict 16 actions, execute 8, look again, until the task is solved or 150 steps are over.  Episode
e has the layout of seed 900000 + e and a fixed noise for each chunk, so two runtimes start from the same numbers.

The faucet is also run with the other sentence ("close the faucet" in the scene of faucet-open, and the reverse).  Both
scenes look alike: a policy that follows the sentence must now do the opposite of what the scene's own task asks.
"""
import argparse
import json
import math
import multiprocessing
import os
import queue
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Tuple

import numpy as np

from sim import EXECUTE, LIMIT, TASKS, UNSEEN, Scene, noise

OTHER = {"faucet-open": "faucet-close", "faucet-close": "faucet-open"}
TURNED = 1.2  # radians of the handle that count as done when the scene itself does not ask for it
Policy = Callable[[np.ndarray, np.ndarray, str, np.ndarray], np.ndarray]  # frame, state, sentence, noise -> chunk (16, 4)


def wilson(k: int, n: int) -> Tuple[float, float]:
    """95 % interval of a success rate from k of n."""
    z = 1.959964
    centre, spread = k + z * z / 2, z * math.sqrt(k * (n - k) / n + z * z / 4) if n else 0.0
    return ((centre - spread) / (n + z * z), (centre + spread) / (n + z * z)) if n else (0.0, 1.0)


def pytorch(checkpoint: str) -> Policy:
    """The reference: LeRobot's class in float32, one thread."""
    import reference
    import torch

    torch.set_num_threads(1)
    policy, before, after = reference.load(checkpoint)
    return lambda frame, state, text, draw: reference.predict(policy, before, after, frame, state, text, draw)


def cpp(vla: str, bundle: str) -> Policy:
    """The C++ runtime: one call of `vla run` per chunk, one thread (the episodes side by side use the cores)."""
    from PIL import Image

    import runtime

    folder = Path(tempfile.mkdtemp(prefix="vla-evaluate-"))

    def predict(frame: np.ndarray, state: np.ndarray, text: str, draw: np.ndarray) -> np.ndarray:
        Image.fromarray(frame).save(folder / "frame.png", compress_level=1)
        np.save(folder / "noise.npy", draw)
        return runtime.run(vla, bundle, folder / "frame.png", state, text, folder / "noise.npy", threads=1)["actions"]

    return predict


def episode(scene: Scene, policy: Optional[Policy], seed: int, text: str) -> Dict[str, Any]:
    """One closed-loop run: whether the scene's own task was solved, after how many steps, how far the faucet was turned.
    Without a policy the scripted expert drives, looking anew at every step."""
    scene.reset(seed)
    sign = -1 if text == TASKS["faucet-close"] else 1
    swapped, seconds, solved, step = text != TASKS[scene.task], [], False, 0
    while step < LIMIT and not solved:
        frame = scene.frame() if policy else np.zeros(0, np.uint8)
        begin = time.perf_counter()
        chunk = policy(frame, scene.state(), text, noise(seed, step // EXECUTE)) if policy else scene.expert()[None]
        seconds.append(time.perf_counter() - begin)
        for action in chunk[:EXECUTE]:
            solved, step = scene.step(action), step + 1
            if solved or step == LIMIT or (swapped and sign * scene.turned() > TURNED):
                break
        if swapped and sign * scene.turned() > TURNED:
            break
    return {"task": scene.task, "seed": seed, "sentence": text, "solved": solved, "steps": step, "turned": round(scene.turned(), 3),
            "obeyed": sign * scene.turned() > TURNED if swapped else solved, "ms": 1e3 * float(np.median(seconds))}


def work(jobs: List[Tuple[str, int, str]], checkpoint: str, vla: str, bundle: str, done: Any) -> None:
    """One process: runs its episodes (task, seed, sentence)."""
    policy = cpp(vla, bundle) if bundle else pytorch(checkpoint) if checkpoint else None
    scenes: Dict[str, Scene] = {}
    for task, seed, text in jobs:
        scenes[task] = scenes.get(task) or Scene(task)
        done.put(episode(scenes[task], policy, seed, text))
    done.close()
    done.join_thread()
    os._exit(0)  # the renderer's destructors print errors at a normal exit


def rate(rows: List[Dict[str, Any]], key: str) -> Dict[str, Any]:
    k, n = sum(bool(r[key]) for r in rows), len(rows)
    low, high = wilson(k, n)
    return {"successes": k, "episodes": n, "rate": round(k / max(n, 1), 4), "wilson95": [round(low, 4), round(high, 4)]}


def main() -> int:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--checkpoint", default="", metavar="DIR", help="evaluate this checkpoint of train.py with PyTorch")
    ap.add_argument("--bundle", default="", metavar="FILE", help="evaluate this bundle with the C++ runtime instead")
    ap.add_argument("--expert", action="store_true", help="evaluate the scripted experts instead, which know where the object is")
    ap.add_argument("--vla", default="vla", help="the C++ runtime (default: vla from the PATH)")
    ap.add_argument("--episodes", type=int, default=50, help="per task (default 50)")
    ap.add_argument("--swapped", type=int, default=20, help="per faucet task, with the other sentence (default 20)")
    ap.add_argument("--processes", type=int, default=2, help="episodes side by side (default 2)")
    ap.add_argument("--out", type=Path, metavar="FILE", help="write every episode and the summary as JSON")
    a = ap.parse_args()
    if bool(a.checkpoint) + bool(a.bundle) + a.expert != 1:
        ap.error("give one of --checkpoint DIR (PyTorch), --bundle FILE (C++) and --expert")
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.table import Table

    jobs = [(t, UNSEEN + e, TASKS[t]) for e in range(a.episodes) for t in TASKS]
    jobs += [(t, UNSEEN + e, TASKS[OTHER[t]]) for e in range(a.swapped) for t in OTHER]
    rows: List[Dict[str, Any]] = []
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()) as bar:
        row = bar.add_task("episodes", total=len(jobs))
        context = multiprocessing.get_context("spawn")
        done = context.Queue()
        workers = [context.Process(target=work, args=(jobs[i :: a.processes], a.checkpoint, a.vla, a.bundle, done), daemon=True)
                   for i in range(a.processes)]
        for w in workers:
            w.start()
        while len(rows) < len(jobs):
            try:
                rows.append(done.get(timeout=5))
            except queue.Empty:
                if not any(w.is_alive() for w in workers):
                    raise SystemExit("the processes stopped early; their error is above")
                continue
            solved = sum(r["obeyed"] for r in rows)
            bar.update(row, advance=1, description=f"episodes ({solved}/{len(rows)} did what the sentence says)")
    rows.sort(key=lambda r: (r["sentence"] != TASKS[r["task"]], r["task"], r["seed"]))

    plain = [r for r in rows if r["sentence"] == TASKS[r["task"]]]
    swapped = [r for r in rows if r["sentence"] != TASKS[r["task"]]]
    summary: Dict[str, Any] = {t: rate([r for r in plain if r["task"] == t], "solved") for t in TASKS}
    summary["all"] = rate(plain, "solved")
    if swapped:
        summary["other sentence: did what the sentence says"] = rate(swapped, "obeyed")
        summary["other sentence: did what the scene's task asks"] = rate(swapped, "solved")
    table = Table("task", "solved", "95 % interval")
    for name, s in summary.items():
        table.add_row(name, f"{s['successes']}/{s['episodes']}", f"{100 * s['wilson95'][0]:.0f} to {100 * s['wilson95'][1]:.0f} %")
    Console().print(table)
    if not a.expert:
        ms = np.median([r["ms"] for r in rows])
        print(f"median time of one prediction: {ms:.0f} ms" + (", start of the process and loading included" if a.bundle else ""))
    if a.out:
        head = {"runtime": "vla run" if a.bundle else "PyTorch float32" if a.checkpoint else "scripted expert", "limit_steps": LIMIT, "execute": EXECUTE, "summary": summary}
        a.out.write_text(json.dumps({**head, "episodes": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
