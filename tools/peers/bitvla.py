# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BitVLA at its published size, random weights: the reference in PyTorch, in bfloat16 as its users run it, and vla in turn.

    BITVLA_REFERENCE=DIR python tools/peers/bitvla.py [--rounds 3]

DIR has `transformers/src` and `openvla-oft` of ustcwhy/BitVLA.  The reference keeps master weights and makes ternary ones of them in
every forward pass, as published.  It takes 6 GB of memory; vla takes its weights from memory too, another 2.5 GB.  In each round both
run one inference of two views and a prompt of the same length, and the ratio of a round is printed, of wall time and of the processor
time that each took, which other work on the machine changes less.
"""
import argparse
import os
import sys
import time
import warnings
from pathlib import Path

import in_turn
from peer import ROOT, serve

TOKENS, VIEWS, PATCHES = 48, 2, 256
IMAGE, STATE, STOP = 128010, 128011, 128001


def config():
    """Of the published fine-tunes."""
    from goldens import bitvla

    tower, language = bitvla.sizes(1152, 4304, 26, 16, image_size=224), bitvla.sizes(2560, 6912, 30, 20, num_key_value_heads=5)
    found = bitvla.Checkpoint(tower, language).config()
    found["text_config"] |= {"vocab_size": 128264, "max_position_embeddings": 2048, "bos_token_id": 128000, "eos_token_id": STOP}
    return found | {"image_token_index": IMAGE, "vocab_size": 128264}


def reference(n_thread):
    import numpy as np
    import torch
    from goldens import bitvla

    bitvla.open_reference()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(n_thread)
    from bitvla import Bitvla_Config, BitVLAForActionPrediction
    from prismatic.models.action_heads import L1RegressionActionHead
    from prismatic.models.projectors import ProprioProjector
    from transformers import modeling_utils

    torch.set_default_dtype(torch.bfloat16)
    modeling_utils._init_weights = False  # each weight is drawn once, below
    model = BitVLAForActionPrediction(Bitvla_Config(**config())).eval()
    head, proprio = L1RegressionActionHead(input_dim=2560, hidden_dim=2560, action_dim=7), ProprioProjector(llm_dim=2560, proprio_dim=8)
    generator = torch.Generator().manual_seed(0)
    draw = torch.empty(1 << 22).uniform_(-0.05, 0.05, generator=generator)
    with torch.no_grad():
        for part in (model, head, proprio):
            for name, p in part.named_parameters():
                is_norm = p.ndim == 1 and name.endswith("weight")
                p.copy_(torch.ones_like(p) if is_norm else draw.repeat(p.numel() // draw.numel() + 1)[: p.numel()].view_as(p))
    torch.set_default_dtype(torch.float32)
    stats = {"action": {k: np.full(7, v) for k, v in (("min", -1.0), ("max", 1.0), ("q01", -1.0), ("q99", 1.0))}}
    stats["action"]["mask"] = [True] * 6 + [False]
    model.norm_stats = {"x": stats}
    model.set_constant(image_token_idx=IMAGE, proprio_pad_idx=STATE, ignore_idx=-100, action_token_begin_idx=STATE, stop_index=STOP)
    ids = torch.tensor([[128000, *range(100, 131), *[IMAGE] * (VIEWS * PATCHES), STATE, *range(200, 200 + TOKENS)]])
    pixels = torch.empty(1, VIEWS, 3, 224, 224).uniform_(-1, 1, generator=generator).bfloat16()

    def run():
        start, before = time.perf_counter(), time.process_time()
        with torch.inference_mode():
            model.predict_action(input_ids=ids.clone(), unnorm_key="x", proprio=np.zeros(8), proprio_projector=proprio, action_head=head,
                                 pixel_values=pixels, attention_mask=torch.ones_like(ids))
        return {"ms": 1e3 * (time.perf_counter() - start), "cpu_ms": 1e3 * (time.process_time() - before)}

    serve(run, name=f"PyTorch {torch.__version__}, bfloat16, {sum(p.numel() for p in model.parameters()):,} parameters")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--reference", action="store_true", help=argparse.SUPPRESS)  # in a process of its own
    args = parser.parse_args()
    if args.reference:
        return reference(args.threads)
    bench = [args.vla, "bench", "--arch", "bitvla", "--size", "full", "--tokens", TOKENS]
    in_turn.compare([sys.executable, __file__, "--reference", "--threads", args.threads], bench, args.rounds, args.threads)


if __name__ == "__main__":
    main()
