# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Attacks on the HTTP of metrics and page, and on the socket of orders."""

import socket
import time
from urllib.parse import urlsplit

from .peers import ATTACKER, again_and_again

LONG = b"GET /metrics HTTP/1.1\r\nHost: robot\r\nX-Long: " + b"x" * 1000


def http(address, data, pause=0.0, reads=True):
    """A connection that sends the bytes one by one, or at once, and waits for the end."""
    host = urlsplit(address)
    with socket.create_connection((host.hostname, host.port), timeout=20, source_address=(ATTACKER, 0)) as raw:
        for piece in [data[i : i + 1] for i in range(len(data))] if pause else [data]:
            raw.sendall(piece)
            time.sleep(pause)
        while reads and raw.recv(1 << 16):
            pass


def drip_http(target):
    """60 HTTP requests that come a byte at a time, and take the page a byte at a time."""
    again_and_again(*[lambda: http(target.metrics, LONG, 0.01, reads=False)] * 60)


def many_http(target):
    """Requests that are whole, silent, endless or no HTTP, as many as go."""
    get = b"GET /metrics HTTP/1.1\r\nHost: robot\r\n\r\n"
    again_and_again(
        *[lambda: http(target.metrics, get)] * 4,
        *[lambda: http(target.metrics, b"")] * 100,
        *[lambda: http(target.metrics, b"x" * (1 << 20))] * 4,
        *[lambda: http(target.metrics, get * 1000)] * 4,
    )


def page_http(target):
    """The same at the page, with another token than its own."""
    get = b"GET /acts?token=0&after=0 HTTP/1.1\r\nHost: robot\r\n\r\n"
    again_and_again(
        *[lambda: http(target.page, get)] * 4,
        *[lambda: http(target.page, LONG, 0.01, reads=False)] * 60,
        *[lambda: http(target.page, b"POST /record?token=0 HTTP/1.1\r\nContent-Length: 1000000000\r\n\r\n" + b"x" * (1 << 20))] * 4,
    )


def orders(target):
    """Orders that drip, never end, are no orders, and connections of 50 peers that say nothing. They come from the server's own user."""

    def one(data, pause=0.0):
        with socket.socket(socket.AF_UNIX) as raw:
            raw.connect(target.control)
            for piece in [data[i : i + 1] for i in range(len(data))] if pause else [data]:
                raw.sendall(piece)
                time.sleep(pause)
            raw.settimeout(20)
            while raw.recv(4096):
                pass

    again_and_again(
        lambda: one(b'{"do": "' + b"x" * 1000, 0.2),
        lambda: one(b"x" * (1 << 20)),
        lambda: one(b"[" * 60_000 + b"\n"),
        lambda: one(b'{"do": "load", "policy": "p", "bundle": "hub:' + b"x" * 60_000 + b'"}\n'),
        *[lambda: one(b"")] * 50,
    )
