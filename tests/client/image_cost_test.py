# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What hostile images cost a server: little, or they are refused before they are decoded."""

import os

import pytest
import wire
from golden_cases import Golden
from hostile_images import files, sizes
from server_process import Server

pytestmark = pytest.mark.alone

MOST_SECONDS = 0.4  # of the processor: 0.2 s on a quiet machine, whose cores share nothing
REFUSED_SECONDS = 0.1  # most of it is the receipt of 33 MB
FAMILIES = "gr00t_n1_6/libero", "bitvla/one_view"  # images of any size; the first averages, the second filters


@pytest.fixture(scope="module")
def images():
    made = {name: (b"\x1a" if name.endswith(".jpg") else b"\x22", file) for name, file in files().items()}
    return made | {f"{w} x {h}": (b"\x12", wire.rgb(w, h)) for w, h in sizes()}


@pytest.fixture(params=FAMILIES)
def case(request):
    return Golden(request.param)


def seconds_of(process):
    """Processor time of all threads."""
    folder = f"/proc/{process.pid}/task"
    return sum(int(open(f"{folder}/{task}/schedstat").read().split()[0]) for task in os.listdir(folder)) / 1e9


def test_each_hostile_image_costs_little_or_is_refused(case, images):
    server = Server(case)
    peer = wire.Peer(server.address)
    answers = set()
    try:
        for name, image in images.items():
            request = wire.act(1, case, seed=1, image=image)
            seconds = []
            for _ in range(2):
                start = seconds_of(server.process)
                answer = wire.kind(peer.ask(request))
                seconds.append(seconds_of(server.process) - start)
            print(f"{name:28s} {len(image[1]):9d} bytes {1e3 * min(seconds):6.1f} ms {answer}")
            answers.add(answer)
            assert min(seconds) < (MOST_SECONDS if answer == "chunk" else REFUSED_SECONDS), name
    finally:
        peer.close()
        assert server.stop() == 0
    assert answers == {"chunk", "error"}


def test_images_are_refused_together_before_any_is_decoded(images):
    """One alone is an image like any other."""
    case = Golden("smolvla/two_views")
    server = Server(case)
    peer = wire.Peer(server.address)
    image = images["noise_1900.png"]
    try:
        alone = wire.act(1, case, seed=1, image=image)
        assert wire.kind(peer.ask(alone)) == "chunk"
        start = seconds_of(server.process)
        both = peer.ask(wire.act(2, case, seed=1, image=image, n_image=2))
        assert wire.kind(both) == "error" and b"an image that costs at most" in both
        assert seconds_of(server.process) - start < REFUSED_SECONDS
    finally:
        peer.close()
        assert server.stop() == 0
