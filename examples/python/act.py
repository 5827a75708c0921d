#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Asks a policy for one action chunk, at a server or in this process.

    python act.py tcp://127.0.0.1:5555 --image top=top.png --image wrist= --state 0.1,0.2,0.3 --text "open the drawer"
    python act.py smolvla.gguf --image top=top.png --state 0.1,0.2,0.3 --text "open the drawer" --seed 7

A view without a file is declared absent. Needs vla_cpp; images are sent as the files that they are.
"""
import argparse
import sys
from pathlib import Path

import numpy as np

import vla_cpp
from vla_cpp.output import whole_file


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("policy", help="tcp://HOST:PORT of vla serve, or a bundle")
    parser.add_argument("--image", action="append", default=[], metavar="VIEW=FILE", help="JPEG or PNG; without FILE: absent")
    parser.add_argument("--state", required=True, help="numbers with commas between, in the robot's units")
    parser.add_argument("--text", required=True, help="the instruction")
    parser.add_argument("--seed", type=int, help="what the noise is drawn from; drawn afresh if not given, and printed")
    parser.add_argument("--out", help="write the chunk as .npy")
    return parser.parse_args()


def main():
    args = arguments()
    images = {}
    for pair in args.image:
        view, _, file = pair.partition("=")
        images[view] = Path(file).read_bytes() if file else None
    make = vla_cpp.Client if "://" in args.policy else vla_cpp.Policy
    with make(args.policy) as policy:
        state = [float(number) for number in args.state.split(",")]
        chunk = policy.act(images=images, state=state, text=args.text, seed=args.seed)
    for note in chunk.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"{chunk.bundle.name}, seed {chunk.seed}: {len(chunk)} rows of {', '.join(chunk.names)}")
    print(np.array2string(np.asarray(chunk), precision=4, suppress_small=True))
    print(", ".join(f"{stage} {ms:.1f} ms" for stage, ms in chunk.timing.items()))
    if args.out:
        with whole_file(args.out) as file:
            np.save(file, np.asarray(chunk))


if __name__ == "__main__":
    try:
        main()
    except (vla_cpp.VlaError, OSError) as error:
        sys.exit(f"error: {error}")
