# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Compares the C++ tokenizer with the Hugging Face `tokenizers` package on fuzzed and multilingual strings.

    cmake --build --preset cpu --target reference_tool
    python tests/reference/compare_tokenizer.py build/cpu/bin/reference_tool [tokenizer.json ...] [--count 100000] [--seed 0]

Runs the tokenizers of tokenizer_zoo.py and any tokenizer.json named, `--count` strings each, and every single code point.
Stops with exit code 1 at the first difference, showing the string.
"""

import argparse
import json
import random
import struct
import subprocess
import tempfile

from bundle_tokenizer import keys_of
from tokenizer_zoo import SENTENCES, ZOO, fuzz_string
from tokenizers import Tokenizer

BATCH = 2000


class Runtime:
    def __init__(self, tool: str, tokenizer: Tokenizer):
        self.keys = tempfile.NamedTemporaryFile("w", suffix=".json")
        json.dump(keys_of(tokenizer), self.keys)
        self.keys.flush()
        self.process = subprocess.Popen([tool, "tokenize", self.keys.name], stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def encode(self, text: str) -> list[int]:
        data = text.encode()
        self.process.stdin.write(struct.pack("<I", len(data)) + data)
        self.process.stdin.flush()
        (count,) = struct.unpack("<I", self.process.stdout.read(4))
        return list(struct.unpack(f"<{count}i", self.process.stdout.read(4 * count)))


def compare(name: str, tokenizer: Tokenizer, tool: str, strings) -> int:
    runtime, compared, batch = Runtime(tool, tokenizer), 0, []

    def check():
        nonlocal compared
        for text, expected in zip(batch, tokenizer.encode_batch(batch)):
            found = runtime.encode(text)
            if found != expected.ids:
                raise SystemExit(f"{name}: {text!r}\n  reference {expected.ids}\n  runtime   {found}")
        compared += len(batch)
        batch.clear()

    for text in strings:
        batch.append(text)
        if len(batch) == BATCH:
            check()
    check()
    return compared


def strings_for(tokenizer: Tokenizer, count: int, seed: int):
    rng = random.Random(seed)
    added = [token["content"] for token in json.loads(tokenizer.to_str())["added_tokens"]]
    yield from SENTENCES
    yield "\n".join(SENTENCES)
    for c in range(0x110000):
        if not 0xD800 <= c <= 0xDFFF and (c < 0x3400 or c % 7 == seed % 7):
            yield "a" + chr(c) + " 1" + chr(c)
    for _ in range(count):
        yield fuzz_string(rng, added)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("tool")
    parser.add_argument("tokenizers", nargs="*")
    parser.add_argument("--count", type=int, default=100000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    all_tokenizers = {name: make() for name, make in ZOO.items()}
    all_tokenizers.update({path: Tokenizer.from_file(path) for path in args.tokenizers})
    total = 0
    for name, tokenizer in all_tokenizers.items():
        tokenizer.no_truncation()
        compared = compare(name, tokenizer, args.tool, strings_for(tokenizer, args.count, args.seed))
        total += compared
        print(f"{name}: {compared} strings, all equal", flush=True)
    print(f"{total} strings in all")


main()
