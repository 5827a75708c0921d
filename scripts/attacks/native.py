# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Attacks on the native protocol."""

import contextlib
import itertools
import threading
import time

import hostile
import hostile_images
import numpy as np
import zmq

from vla_cpp import wire

from .peers import ATTACKER, act_of, again_and_again, connect, png, request, silent, spec_of

HALF_SENT = hostile.HANDSHAKE + hostile.long_frame(30_000_000)


def half_sent(target, begin=HALF_SENT):
    """40 requests of 30 MB, of which 20 MB come, as fast as a network of 1 Gbit brings them."""

    def one():
        with connect(target, begin) as raw:
            for _ in range(20):
                raw.sendall(bytes(1_000_000))
                time.sleep(0.3)
            while raw.recv(1 << 16):
                pass

    again_and_again(*[one] * 40)


def flood(target):
    """Messages of a million frames, and of requests without end whose answers nobody reads."""
    health = request("health")

    def frames():
        with connect(target, hostile.HANDSHAKE) as raw:
            raw.sendall(b"\x01\x00" * 1_000_000)

    def unread():
        with connect(target, hostile.HANDSHAKE) as raw:
            while True:
                raw.sendall((bytes([0, len(health)]) + health) * 100)

    again_and_again(frames, frames, unread, unread)


def connections(target):
    """200 connections that say nothing, or half a greeting."""
    again_and_again(*[lambda: silent(target, b"")] * 100, *[lambda: silent(target, hostile.GREETING[:40])] * 100)


def drip(target):
    """20 peers that send requests byte by byte."""
    health = request("health")

    def one():
        with connect(target, hostile.HANDSHAKE) as raw:
            while True:
                for byte in bytes([0, len(health)]) + health:
                    raw.sendall(bytes([byte]))
                    time.sleep(0.005)

    again_and_again(*[one] * 20)


def hostile_png(target):
    """Acts with an image of 200 compressed texts that would be 8 MB each, and one of fewer rows than it announces."""
    spec = spec_of(target)
    ask_for_ever(target, [act_of(spec, png=image) for image in (png(8, 8, texts=200), png(4000, 4000, rows=1))])


def heavy_images(target):
    """Acts with the images that cost most of those that the limit on pixels admits."""
    spec, black = spec_of(target), np.zeros((1024, 1024, 3), np.uint8)
    jpeg, png = hostile_images._scans(1024, 1024, 15), hostile_images._encoded(black, "PNG")
    ask_for_ever(target, [act_of(spec, jpeg=jpeg), act_of(spec, png=png)])


def own_address(target):
    """Acts that are in order, from a program of the robot's own machine."""
    spec = spec_of(target)
    view = spec.views[0]
    ask_for_ever(target, [act_of(spec, rgb=np.zeros((view.height, view.width, 3), np.uint8))], source="127.0.0.1")


def many_addresses(target):
    """256 connections from as many addresses, whose handshakes are done, and that say nothing more."""

    def one(source):
        with hostile.connect(target.address, hostile.HANDSHAKE, source=source) as raw:
            while raw.recv(1 << 16):
                pass

    again_and_again(*[lambda n=n: one(f"127.0.{1 + n // 128}.{1 + n % 128}") for n in range(256)])


def small_refusals(target):
    """Acts of six bytes, as many as go: each is refused."""
    act = bytes([0, 6]) + b"\x08\x01\x10\x01\x2a\x00"
    again_and_again(*[lambda: pour(target, itertools.repeat(act * 1000))] * 2)


def large_refusals(target):
    """Acts of 30 MB that are all instruction."""
    message = wire.Request(protocol_version=1, request_id=7)
    message.act.text = "x" * 30_000_000
    data = message.SerializeToString()
    again_and_again(lambda: pour(target, itertools.repeat(hostile.long_frame(len(data), data, flags=2)), pause=0.5))


def pour(target, pieces, pause=0.0):
    """A connection that sends without end, and reads what comes."""
    with connect(target, hostile.HANDSHAKE) as raw:
        threading.Thread(target=drain, args=(raw,), daemon=True).start()
        for piece in pieces:
            raw.sendall(piece)
            time.sleep(pause)


def drain(raw):
    with contextlib.suppress(OSError):
        while raw.recv(1 << 16):
            pass


def ask_for_ever(target, acts, n_connection=70, source=ATTACKER):
    """Connections of one peer that ask again as soon as they are answered."""
    poller = zmq.Poller()
    for n in range(n_connection):
        s = zmq.Context.instance().socket(zmq.DEALER)
        s.linger = 0
        s.connect(target.address.replace("tcp://", f"tcp://{source}:0;"))
        s.send(acts[n % len(acts)])
        poller.register(s, zmq.POLLIN)
    for n in itertools.count():
        for s, _ in poller.poll():
            s.recv()
            s.send(acts[n % len(acts)])
