#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Records what the package openpi-server 0.1.0 says, byte for byte, as data/openpi_server.json; openpi_bytes_test.py compares ours.

record_openpi_server.py data/openpi_server.json    # in an environment with openpi-server, openpi-client and numpy
"""

import json
import socket
import sys
import threading
import time
from pathlib import Path

from hostile import UPGRADE, websocket_frame

# What a client sends after the greeting, by name; each on a connection of its own. The policy's answer to {} is an exception.
AFTER_GREETING = {
    "an observation without keys": websocket_frame(0x82, b"\x80"),
    "no msgpack": websocket_frame(0x82, b"\xc1"),
    "a text message": websocket_frame(0x81, b"hello"),
    "an empty message": websocket_frame(0x82, b""),
    "a ping": websocket_frame(0x89, b"here?"),
    "a close": websocket_frame(0x88, b"\x03\xe8"),
    "a close with a reason": websocket_frame(0x88, b"\x03\xe8bye"),
    "a close without a code": websocket_frame(0x88, b""),
    "a reserved opcode": websocket_frame(0x83, b""),
    "a reserved bit": websocket_frame(0xC2, b"\x80"),
    "a frame without a mask": websocket_frame(0x82, b"\x80", is_masked=False),
    "a continuation of nothing": websocket_frame(0x80, b"\x80"),
    "text that is not UTF-8": websocket_frame(0x81, b"\xff"),
}
REQUESTS = {
    "health": b"GET /healthz HTTP/1.1\r\nHost: robot\r\n\r\n",
    "another path": UPGRADE.replace(b" / ", b" /v1/any "),
}


def all_of(raw, seconds=2.0):
    """Everything until the peer ends the connection, or says nothing for so long."""
    raw.settimeout(seconds)
    came = b""
    try:
        while part := raw.recv(1 << 16):
            came += part
    except (TimeoutError, ConnectionResetError):
        pass
    return came


def split(data):
    """Frames of a server -> first byte and payload of each."""
    frames = []
    while data:
        size, at = data[1], 2
        if size >= 126:
            at += 2 if size == 126 else 8
            size = int.from_bytes(data[2:at], "big")
        frames.append((data[0], data[at : at + size]))
        data = data[at + size :]
    return frames


def request(port, text):
    """Head and body of the answer to an HTTP request, and what follows an upgrade."""
    with socket.create_connection(("127.0.0.1", port), 20) as raw:
        raw.sendall(text)
        head, _, rest = all_of(raw, 0.5).partition(b"\r\n\r\n")
    return head.decode().split("\r\n"), rest


def after_greeting(port, *messages):
    """The frames that come after the greeting."""
    with socket.create_connection(("127.0.0.1", port), 20) as raw:
        raw.sendall(UPGRADE)
        time.sleep(0.2)
        [raw.sendall(message) for message in messages]
        return split(all_of(raw, 0.5).partition(b"\r\n\r\n")[2])[1:]


def main(path):
    import numpy as np
    from openpi_server import WebsocketPolicyServer

    class Policy:
        def infer(self, observation):
            observation["state"]
            rows = np.arange(6, dtype=np.float32).reshape(2, 3)
            return {"actions": rows, "policy_timing": {"infer_ms": 1.5}}

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    metadata = {"action_horizon": 2, "control_hz": 10.0, "action_names": ["a", "b"]}
    server = WebsocketPolicyServer(Policy(), "127.0.0.1", port, metadata)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    time.sleep(1)
    told = {"requests": {}, "greeting": "", "answers": [], "after greeting": {}}
    for name, text in REQUESTS.items():
        head, rest = request(port, text)
        told["requests"][name] = {"head": head, "rest": rest.hex() if name == "health" else ""}
    told["greeting"] = split(request(port, UPGRADE)[1])[0][1].hex()
    good = websocket_frame(0x82, b"\x81\xa5state\x01")
    told["answers"] = [payload.hex() for _, payload in after_greeting(port, good, good)]
    for name, message in AFTER_GREETING.items():
        frames = after_greeting(port, message)
        told["after greeting"][name] = [[first, "" if first == 0x81 else payload.hex()] for first, payload in frames]
    Path(path).write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
