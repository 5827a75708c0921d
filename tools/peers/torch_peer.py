# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's SmolVLA in PyTorch, one timed inference for each line on standard input.  Run by compare.py."""
import argparse
import time

from peer import load, observation, serve


class Timed:
    """A method in whose place this stands, with the wall time that its calls take together."""

    def __init__(self, owner, name, compiled):
        import torch

        method = getattr(owner, name)
        self.call, self.ms = torch.compile(method) if compiled else method, 0.0
        setattr(owner, name, self)

    def __call__(self, *args, **kwargs):
        start = time.perf_counter()
        try:
            return self.call(*args, **kwargs)
        finally:
            self.ms += 1e3 * (time.perf_counter() - start)


def main():
    import torch

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint")
    parser.add_argument("--dtype", choices=("float32", "published"), required=True)
    parser.add_argument("--compile", action="store_true", help="torch.compile for the tower, the prefix and a step")
    parser.add_argument("--views", type=int, required=True)
    parser.add_argument("--tokens", type=int, required=True)
    parser.add_argument("--threads", type=int, required=True)
    args = parser.parse_args()
    model = load(args.checkpoint, args.dtype, args.threads)
    inputs = observation(model.config, args.views, args.tokens)
    images = [torch.from_numpy(image[None]) for image in inputs["images"]]
    present = [torch.ones(1, dtype=torch.bool)] * args.views
    tokens, state, noise = (torch.from_numpy(inputs[name]) for name in ("tokens", "state", "noise"))
    backbone = model.vlm_with_expert
    if args.compile:  # the steps call it with a cache and run inside the compiled step
        plain, compiled = backbone.forward, torch.compile(backbone.forward)
        backbone.forward = lambda **k: (compiled if k["past_key_values"] is None else plain)(**k)
    vision, steps = Timed(backbone, "embed_image", args.compile), Timed(model, "denoise_step", args.compile)

    def run():
        vision.ms = steps.ms = 0.0
        start = time.perf_counter()
        with torch.inference_mode():
            model.sample_actions(images, present, tokens, torch.ones_like(tokens, dtype=torch.bool), state, noise=noise.clone())
        total = 1e3 * (time.perf_counter() - start)
        return {"vision": vision.ms, "prefix": total - vision.ms - steps.ms, "steps": steps.ms}

    serve(run, name=f"PyTorch {torch.__version__} {'compiled' if args.compile else 'eager'}, {args.dtype} dtypes")


if __name__ == "__main__":
    main()
