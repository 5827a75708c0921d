# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What collecting demonstrations takes (examples/*/collect.py): the chunks of an episode, its file, and simulators in processes of their own."""

from __future__ import annotations

import multiprocessing
import os
import queue
from typing import Any, Callable, Dict, Iterator, Sequence, Tuple

import numpy as np

from ..output import whole_file


def chunks(actions: Sequence[np.ndarray], every: int, horizon: int) -> Tuple[np.ndarray, np.ndarray]:
    """Actions (d,) of an episode -> (n, horizon, d) the chunk at every kept step, and (n, horizon) where it is not beyond the end.

    Beyond the end the last action is repeated.
    """
    steps = np.arange(0, len(actions), every)[:, None] + np.arange(horizon)
    return np.stack(actions)[np.minimum(steps, len(actions) - 1)], steps < len(actions)


def write(path: str, arrays: Dict[str, Any]) -> None:
    """An .npz file that is there whole or not at all."""
    with whole_file(path) as file:
        np.savez(file, **arrays)


def reports(work: Callable, arguments: Sequence[Tuple], count: int) -> Iterator[Any]:
    """Runs a process for each tuple of `arguments` and yields the `count` reports that they put into the queue, in the order in which they come.

    work  takes its arguments and the queue, and ends with `leave`
    Errors: SystemExit where all processes ended before they reported everything.
    """
    context = multiprocessing.get_context("spawn")
    done = context.Queue()
    workers = [context.Process(target=work, args=(*given, done), daemon=True) for given in arguments]
    for worker in workers:
        worker.start()
    while count:
        try:
            report = done.get(timeout=5)
        except queue.Empty:
            if not any(worker.is_alive() for worker in workers):
                raise SystemExit("the simulator processes stopped early; their error is above. Run the same command to continue.") from None
            continue
        count -= 1
        yield report


def leave(done: Any) -> None:
    """Ends this process of a simulator, once the queue has what was put into it."""
    done.close()
    done.join_thread()
    os._exit(0)  # MuJoCo's destructors print errors at a normal exit
