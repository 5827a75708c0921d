# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A server whose policy is on a device prepares the next act while the device computes."""

import json
import threading

import numpy as np
from conftest import DEVICE, address

N_ACT = 6


def acts(server_address, golden, seed, answers):
    import vla_cpp

    with vla_cpp.Client(server_address, timeout=20) as client:
        images = {view: file.read_bytes() for view, file in golden.images.items()}
        for _ in range(N_ACT):
            chunk = client.act(images=images, state=golden.state, text=golden.text, seed=seed)
            answers.append((chunk.actions.astype(np.float32), chunk.timing))


def test_one_act_is_prepared_while_the_one_before_is_computed_and_answers_stay_with_their_clients(fake, serve, golden, tmp_path):
    trace = tmp_path / "trace.json"
    server = serve("--trace", trace, takes_ms=10)  # for each stage and step
    where, answers = address(server), {seed: [] for seed in (1, 2, 3)}
    threads = [threading.Thread(target=acts, args=(where, golden, *item)) for item in answers.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    server.terminate()
    server.communicate(timeout=20)
    for seed, found in answers.items():
        arguments = golden.arguments(options=["--json", *DEVICE, "--seed", seed])
        i = arguments.index("--noise")
        alone = fake.program()(*arguments[:i], *arguments[i + 2 :]).json()
        assert len(found) == N_ACT
        for actions, timing in found:
            assert np.array_equal(actions, np.array(alone["actions"], np.float32))
            assert list(timing)[:4] == ["decode", "preprocess", "tokenize", "wait"], timing

    slices = [e for e in json.loads(trace.read_text()) if e["ph"] == "X"]
    prepared, computed = ([(e["ts"], e["ts"] + e["dur"]) for e in slices if e["name"] == name] for name in ("prepare", "act"))
    assert len(prepared) == len(computed) == 3 * N_ACT
    beside = [any(begin < from_ and to < end for begin, end in computed) for from_, to in prepared]
    assert sum(beside) > len(beside) // 2  # the first act of each client, and of all, may find the device idle
    for track in (prepared, computed):  # one at a time
        track.sort()
        assert all(end <= begin for (_, end), (begin, _) in zip(track, track[1:]))
