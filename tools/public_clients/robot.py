# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The robot of an episode, for a program that has a public client and little else: it asks the program that started it over a pipe.

A message is a line of JSON, and the bytes of one array after it.
"""
import json
import os
import sys

import numpy as np


def send(file, array=None, **head):
    if array is not None:
        head.update(dtype=array.dtype.str, shape=array.shape)
    file.write(json.dumps(head).encode() + b"\n" + (b"" if array is None else np.ascontiguousarray(array).tobytes()))
    file.flush()


def receive(file):
    """(head, array or None); (None, None) at the end."""
    line = file.readline()
    if not line:
        return None, None
    head = json.loads(line)
    if "dtype" not in head:
        return head, None
    dtype, shape = np.dtype(head["dtype"]), head["shape"]
    return head, np.frombuffer(file.read(dtype.itemsize * int(np.prod(shape))), dtype).reshape(shape)


class Robot:
    """over: whether the episode has ended."""

    def __init__(self):
        self._out = os.fdopen(os.dup(1), "wb")  # clients print
        os.dup2(2, 1)
        self._in, self.over = sys.stdin.buffer, False

    def _ask(self, array=None, **head):
        send(self._out, array, **head)
        return receive(self._in)

    def observe(self):
        """Frame uint8 (height, width, 3) RGB, state float32 and instruction."""
        head, frame = self._ask(kind="observe")
        return frame, np.array(head["state"], np.float32), head["text"]

    def step(self, action):
        head, _ = self._ask(np.asarray(action, np.float32), kind="step")
        self.over = head["over"]

    def show(self, chunk):
        """Tells the whole chunk that the client gave."""
        self._ask(np.asarray(chunk), kind="chunk")
