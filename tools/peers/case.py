# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The reference of a case in PyTorch, without its processor, and vla in turn.

    python tools/peers/case.py --case DIR [--rounds 5] [--dtype published] [--kernels default] [--compile]

DIR is what tools/parity_full.py leaves: checkpoint/, frames, an observation, noise.npy and bundle.gguf.  vla runs as many views and as
many tokens of text.  In each round both run one inference, and the ratio of a round is printed, of wall time and of the processor time
that each took, which other work on the machine changes less.
"""
import argparse
import json
import os
import sys
import time
import warnings
from pathlib import Path

import in_turn
from peer import ROOT, serve


def reference(case, dtype, n_thread, compiled):
    import numpy as np
    import torch
    from goldens import recorder

    recorder.open_reference()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(n_thread)
    policy, before, _ = recorder.load(case / "checkpoint", dtype)
    predict = policy.predict_action_chunk
    if compiled == "all":
        predict = torch.compile(predict)
    elif compiled:
        policy.get_submodule(compiled).compile()
    noise, batch = torch.from_numpy(np.load(case / "noise.npy"))[None], before(recorder.read_observation(case))

    def run():
        start, at_work = time.perf_counter(), time.process_time()
        with torch.inference_mode():
            predict(dict(batch), noise=noise.clone())
        return {"ms": 1e3 * (time.perf_counter() - start), "cpu_ms": 1e3 * (time.process_time() - at_work)}

    serve(run, name=f"PyTorch {torch.__version__}{' compiled' if compiled else ''}, {dtype}, {recorder.described(case / 'checkpoint')}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tokens", type=int, default=32, help="of text; of a policy that reads none 0")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--dtype", default="float32", choices=("float32", "published"), help="PyTorch's; published: the file's own")
    parser.add_argument("--compile", nargs="?", const="all", metavar="MODULE",
                        help="torch.compile for the whole of it, or for a module where a hundred steps in one graph take too long: diffusion.unet")
    parser.add_argument("--kernels", default="float32", help="as vla bench takes them; default: its own choice")
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--reference", action="store_true", help=argparse.SUPPRESS)  # in a process of its own
    args = parser.parse_args()
    case = args.case.resolve()
    if args.reference:
        return reference(case, args.dtype, args.threads, args.compile)
    views = json.loads((case / "observation.json").read_text())["images"]
    bench = [args.vla, "bench", case / "bundle.gguf", "--views", len(views)]
    bench += ["--tokens", args.tokens] if args.tokens else []
    bench += [] if args.kernels == "default" else ["--kernels", args.kernels]
    peer = [sys.executable, __file__, "--case", case, "--dtype", args.dtype, "--threads", args.threads, "--reference"]
    peer += ["--compile", args.compile] if args.compile else []
    in_turn.compare(peer, bench, args.rounds, args.threads)


if __name__ == "__main__":
    main()
