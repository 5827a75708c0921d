# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""FAST's tokens to actions: the runtime gives the reference's numbers for every sequence of ids, or refuses where it fails.

    python tools/fast_tokens.py check [--random 10000] [--damaged 1000]    exit code 1 where an answer is wrong
    python tools/fast_tokens.py record    some sequences and what the reference makes of them, into tests/processor/data/action_tokens.json

Random sequences are what FAST's own tokenizer makes of random chunks, and runs of its tokens; damaged ones are these with ids replaced,
left out and put in, without prefix or stop. The reference is PI0FastPolicy's own methods on the tokenizers of tools/goldens/pi0_fast.py; the
runtime's is behind `reference_tool actions`. Needs torch, lerobot and transformers.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import types
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tools"), str(ROOT / "python")]
from goldens import pi0_fast  # noqa: E402

SKIP = 5
# Tokenizer, rows and columns of a chunk, whether the prefix is required.
SETUPS = [(pi0_fast.Fast(), 5, 7, True), (pi0_fast.Fast(), 1, 1, False), (pi0_fast.Fast(300, -150, 7.5), 16, 3, False), (pi0_fast.Fast(60, -30, 10), 50, 14, True)]
RECORDED = ROOT / "tests/processor/data/action_tokens.json"


class Reference:
    """The methods of LeRobot's policy without its network."""

    def __init__(self, fast, horizon, d_action, required, folder):
        from lerobot.policies.pi0_fast.modeling_pi0_fast import PI0FastPolicy
        from transformers import AutoProcessor, AutoTokenizer

        fast.write(folder / "actions")
        self.n_action = len(fast.vocabulary()[0])
        pi0_fast.write_tokenizer(self.n_action + SKIP, folder / "text")
        self.policy = types.SimpleNamespace(
            config=types.SimpleNamespace(validate_action_token_prefix=required, fast_skip_tokens=SKIP),
            action_tokenizer=AutoProcessor.from_pretrained(folder / "actions", trust_remote_code=True),
            _paligemma_tokenizer=AutoTokenizer.from_pretrained(folder / "text", add_eos_token=True, add_bos_token=False))
        for name in ("_paligemma_tokens_to_act_tokens", "decode_actions_with_fast", "detokenize_actions"):
            setattr(self.policy, name, getattr(PI0FastPolicy, name).__get__(self.policy))
        self.fast, self.size, self.folder = fast, (horizon, d_action), folder
        self.text = self.policy._paligemma_tokenizer
        self.prefix, self.stop = self.text.encode("Action: ", add_special_tokens=False), self.text.convert_tokens_to_ids("|")
        self.first_id = self.text.vocab_size - 1 - SKIP

    def keys(self):
        """As the converter makes them."""
        from vla_cpp.convert.action_tokens import Spoken, read_action_tokens
        from vla_cpp.convert.errors import Problems
        from vla_cpp.convert.tokenizer import read_tokenizer

        problems, n_vocab = Problems("tokenizers"), len(self.text)
        plan = read_tokenizer(str(self.folder / "text"), n_vocab, problems, [])
        spoken = Spoken(SKIP, self.policy.config.validate_action_token_prefix)
        keys = read_action_tokens(str(self.folder / "actions"), plan, n_vocab, spoken, problems)
        problems.raise_any()
        return {"lm.n_vocab": n_vocab} | {key.name: key.value for key in keys}

    def decode(self, ids):
        """None where it fails."""
        import torch

        try:
            return self.policy.detokenize_actions(torch.tensor([ids], dtype=torch.long), *self.size)[0].numpy()
        except Exception:  # noqa: BLE001 - whatever stops it is a refusal
            return None

    def random(self, r):
        """What a network says that has learned."""
        horizon, d_action = self.size
        if r.random() < 0.5:
            coefficients = [int(r.gauss(0, r.choice((0.6, 3, 20)))) for _ in range(horizon * d_action)]
            text = "".join(chr(min(max(c - self.fast.min_token, 0), self.fast.n_character - 1)) for c in coefficients)
            actions = self.policy.action_tokenizer.bpe_tokenizer(text)["input_ids"]
        else:
            actions = [r.randrange(self.n_action) for _ in range(r.randint(0, 2 * horizon * d_action))]
        return [*self.prefix, *(self.first_id - i for i in actions), self.stop]

    def damaged(self, r):
        ids = self.random(r)
        ids = ids[: r.choice((len(ids), len(ids), len(ids) - 1, r.randint(1, 4), 1))]
        for _ in range(r.randint(0, 6)):
            at, other = r.randrange(len(ids)), r.choice((r.randrange(len(self.text)), r.choice(self.prefix), self.stop, self.first_id + r.randint(1, SKIP), 0))
            what = r.choice(("replace", "insert", "prefix", "remove"))
            ids[at : at + (what in ("replace", "remove"))] = {"replace": [other], "insert": [other], "prefix": self.prefix, "remove": []}[what]
            ids = ids or [self.stop]
        return ids + [0] * r.choice((0, 0, 3))


def runtime(tool, keys, size, sequences):
    """Chunks by `reference_tool actions`, None where it refuses."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(keys, file)
        file.flush()
        items = b"".join(np.uint32(4 * len(ids)).tobytes() + np.asarray(ids, "<i4").tobytes() for ids in sequences)
        done = subprocess.run([tool, "actions", file.name, *map(str, size)], input=items, capture_output=True)
    if done.returncode:
        raise SystemExit(done.stderr.decode())
    out, chunks = done.stdout, []
    while out:
        n = int(np.frombuffer(out, "<u4", 1)[0])
        chunks.append(np.frombuffer(out, "<f4", n, 4).reshape(size) if n else None)
        out = out[4 + 4 * n :]
    assert len(chunks) == len(sequences)
    return chunks


def check(tool, kind, count, seed):
    told, worst, good = dict.fromkeys(("equal", "of these not in every bit", "refused by both", "wrong"), 0), 0.0, True
    for number, setup in enumerate(SETUPS):
        with tempfile.TemporaryDirectory() as folder:
            reference, r = Reference(*setup, Path(folder)), random.Random(f"{seed} {kind} {number}")
            sequences = [getattr(reference, kind)(r) for _ in range(count // len(SETUPS))]
            for ids, found in zip(sequences, runtime(tool, reference.keys(), reference.size, sequences)):
                expected = reference.decode(ids)
                if expected is None or found is None:
                    same = expected is None and found is None
                    told["refused by both" if same else "wrong"] += 1
                else:
                    off = np.abs(found - expected).max() / max(1, np.abs(expected).max())
                    same, worst = off < 2e-7, max(worst, off)
                    told["equal" if same else "wrong"] += 1
                    told["of these not in every bit"] += same and not np.array_equal(found, expected)
                if not same and good:
                    print(f"    {setup}: {ids}\n        reference {expected}\n        runtime {found}")
                good &= same
    print(f"{kind}: " + ", ".join(f"{n} {what}" for what, n in told.items()) + f"; largest difference {worst:.1e}", flush=True)
    return good


def record(count, seed):
    """The first setup's keys, and for each sequence the chunk as text, or null."""
    with tempfile.TemporaryDirectory() as folder:
        reference, r = Reference(*SETUPS[0], Path(folder)), random.Random(seed)
        sequences = [getattr(reference, ("random", "damaged")[i % 2])(r) for i in range(count)]
        chunks = [reference.decode(ids) for ids in sequences]
        rows = [{"ids": ids, "chunk": None if chunk is None else [float(f"{x:.9g}") for x in chunk.ravel()]} for ids, chunk in zip(sequences, chunks)]
        head = {"keys": reference.keys(), "horizon": reference.size[0], "d_action": reference.size[1]}
    lines = ",\n".join(json.dumps(row, separators=(",", ":")) for row in rows)
    RECORDED.write_text(json.dumps(head, separators=(",", ":"))[:-1] + ',"sequences":[\n' + lines + "\n]}\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("check", "record"))
    parser.add_argument("--random", type=int, default=10000)
    parser.add_argument("--damaged", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tool", type=Path, default=ROOT / "build/cpu/bin/reference_tool")
    args = parser.parse_args()
    import logging

    from goldens.recorder import open_reference

    open_reference()
    warnings.filterwarnings("ignore")
    logging.disable(logging.CRITICAL)  # the reference tells of every sequence that it cannot decode
    if args.command == "record":
        record(24, args.seed)
        return
    sys.exit(not all([check(args.tool, "random", args.random, args.seed), check(args.tool, "damaged", args.damaged, args.seed)]))


if __name__ == "__main__":
    main()
