# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A bundle that somebody replaces, cuts or removes while a server answers with it."""

import os
import shutil

import pytest
import wire
from serve_test import Server


def written_over(path, other):
    """As `cp other path` does: the same file with other bytes."""
    path.write_bytes(other.read_bytes())


def turned(path, other):
    """The same size and other weights, as a damaged disk gives them."""
    data = bytearray(path.read_bytes())
    data[len(data) // 4 :] = bytes(byte ^ 0x55 for byte in data[len(data) // 4 :])
    with open(path, "r+b") as file:
        file.write(data)


@pytest.fixture
def bundles(golden, tmp_path):
    """The bundle that is served, and other bytes."""
    path, other = tmp_path / "policy.gguf", tmp_path / "other.gguf"
    shutil.copy(golden.bundle, path)
    other.write_bytes(golden.bundle.read_bytes()[:50_000])
    return path, other


@pytest.fixture
def server(vla, bundles):
    server = Server(vla, bundles[0], "--bind", "tcp://127.0.0.1:0", "--threads", "1")
    yield server
    server.process.kill()
    server.process.communicate()


@pytest.fixture
def peer(server):
    peer = wire.Peer(server.ready["address"])
    yield peer
    peer.close()


@pytest.mark.parametrize(
    "change", [written_over, turned, lambda path, other: os.truncate(path, 0), lambda path, other: path.unlink()]
)
def test_a_server_answers_with_the_bytes_that_it_has_loaded(golden, bundles, server, peer, change):
    def chunk(i):
        """The actions of the answer: what follows its request id up to the timings."""
        answer = peer.ask(wire.act(1, golden, seed=i))
        assert wire.kind(answer) == "chunk"
        return wire.actions(answer)

    before = [chunk(i) for i in range(3)]
    change(*bundles)
    assert [chunk(i) for i in range(3)] == before
    assert server.process.poll() is None


@pytest.mark.parametrize("change", [written_over, turned, lambda path, other: os.truncate(path, 4096)])
def test_a_row_of_the_vocabulary_that_has_changed_is_refused(golden, bundles, server, peer, change):
    """Rows of embeddings stay in the file: an instruction of other words is not answered with other bytes."""
    before = wire.actions(peer.ask(wire.act(1, golden, seed=1)))
    change(*bundles)
    refused = peer.ask(wire.act(2, golden, seed=1, text="0123456789 quick brown foxes"))
    assert wire.kind(refused) == "error"
    assert b"renaming a new file over it" in refused
    assert server.process.poll() is None
    assert wire.actions(peer.ask(wire.act(1, golden, seed=1))) == before


def test_a_file_that_is_cut_while_it_is_read_is_refused(vla, golden, tmp_path):
    """Half of it is there when the program looks at its size, and nothing but that half when it reads."""
    path = tmp_path / "policy.gguf"
    path.write_bytes(golden.bundle.read_bytes()[:-4096])
    vla(*golden.arguments(bundle=path)).refused("bad_bundle", "copy or convert it again")
