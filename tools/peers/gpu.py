# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's network of a family at its published size on a GPU: one JSON object with the milliseconds of each act.

    python tools/peers/gpu.py smolvla|pi0|pi05 eager|graph|compiled|tuned [--rounds 30]

Weights are random and made on the device, in the dtypes that are published; images, tokens and noise are there already.  graph: eager,
captured in one CUDA graph; compiled: torch.compile of prefix and step, then the whole act in one graph; tuned: that with max-autotune.
`from_eager` is how far its answer is from the eager one, of the largest number.  --tiny: the sizes of a golden case on the CPU, eager
alone, to try the program.
"""
import argparse
import json
import tempfile
import time
import warnings
from pathlib import Path

from peer import ROOT  # noqa: F401  which makes the goldens importable

MODES = {"eager": None, "graph": None, "compiled": "default", "tuned": "max-autotune-no-cudagraphs"}
VIEWS = {"camera1": (480, 640), "camera2": (480, 480)}
N_TOKEN = 48


def fill(policy, device):
    """Norms of one, biases of zero, matrices that keep activations finite."""
    import torch

    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            parameter.data = parameter.data.to(device)
            if parameter.ndim > 1:
                parameter.uniform_(-0.04, 0.04)
            else:
                parameter.fill_(float(name.endswith("weight")))
    return policy.to(device).eval()


def construct(family_name, checkpoint, config, folder):
    """LeRobot's policy of a configuration, without weights of a hub."""
    from goldens import family

    if family_name != "smolvla":
        return family(family_name).construct(config, checkpoint.dims())
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    checkpoint.write_backbone(folder / "vlm")
    config.vlm_model_name, config.load_vlm_weights = str(folder / "vlm"), False
    return SmolVLAPolicy(config)


def build(family_name, device, tiny):
    """(model, arguments of its sample_actions)."""
    import torch
    from goldens import all_cases, family, recorder
    from goldens.files import write_json

    recorder.open_reference()
    import lerobot.policies.factory  # noqa: F401  which registers them
    from lerobot.configs import PreTrainedConfig

    module = family(family_name)
    checkpoint = all_cases()[f"{family_name}/two_views"].checkpoint if tiny else module.published(VIEWS, family_name)
    with tempfile.TemporaryDirectory() as folder:
        write_json(Path(folder) / "config.json", checkpoint.config)
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = device
        if family_name != "smolvla":
            config.dtype = "float32" if tiny else "bfloat16"
        with torch.device(device):
            policy = fill(construct(family_name, checkpoint, config, Path(folder)), device)
    if family_name == "smolvla" and not tiny:
        module.published_dtypes(policy)
    return policy.model, inputs(family_name, config, device)


def inputs(family_name, config, device):
    import torch

    draw = torch.Generator(device).manual_seed(0)
    width, height = config.resize_imgs_with_padding if family_name == "smolvla" else config.image_resolution
    images = [torch.rand(1, 3, height, width, device=device, generator=draw) * 2 - 1 for _ in VIEWS]
    seen = [torch.ones(1, dtype=torch.bool, device=device) for _ in VIEWS]
    tokens = torch.randint(3, 200, (1, N_TOKEN), device=device, generator=draw)
    noise = torch.randn(1, config.chunk_size, config.max_action_dim, device=device, generator=draw)
    state = [] if family_name == "pi05" else [torch.randn(1, config.max_state_dim, device=device, generator=draw)]
    return (images, seen, tokens, torch.ones_like(tokens, dtype=torch.bool), *state), noise


def keep_small_tensors():
    """torch.tensor of numbers copies from the host and waits, which no capture allows: each is made once."""
    import torch

    make, kept = torch.tensor, {}

    def tensor(data, *args, dtype=None, device=None, **kwargs):
        if args or kwargs or not isinstance(data, (int, float, bool, list, tuple)):
            return make(data, *args, dtype=dtype, device=device, **kwargs)
        key = repr(data), dtype, str(device)
        if key not in kept:
            kept[key] = make(data, dtype=dtype, device=device)
        return kept[key]

    torch.tensor = tensor


def compile_parts(model, how):
    import torch

    torch._dynamo.config.cache_size_limit = 64
    inner = getattr(model, "vlm_with_expert", None) or model.paligemma_with_expert
    for owner, name in ((model, "embed_prefix"), (model, "denoise_step"), (inner, "forward")):
        setattr(owner, name, torch.compile(getattr(owner, name), mode=how, dynamic=False))


def captured(run):
    """(graph, what it computes) of an act."""
    import torch

    keep_small_tensors()
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            run()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = run()
    return graph, result


def measure(run, mode, n_round, wait):
    """(milliseconds of each act, the last answer)."""
    if mode == "eager":
        act = run
    else:
        graph, result = captured(run)
        act = lambda: (graph.replay(), result)[1]  # noqa: E731
    times = []
    for _ in range(n_round + 3):
        wait()
        start = time.perf_counter()
        answer = act()
        wait()
        times.append(1e3 * (time.perf_counter() - start))
    return times[3:], answer


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family", choices=("smolvla", "pi0", "pi05"))
    parser.add_argument("mode", choices=MODES)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    if args.tiny and args.mode != "eager":
        parser.error("--tiny: expected mode eager")
    import torch

    warnings.filterwarnings("ignore")
    device = "cpu" if args.tiny else "cuda"
    model, (arguments, noise) = build(args.family, device, args.tiny)
    wait = (lambda: None) if args.tiny else torch.cuda.synchronize
    with torch.no_grad() if MODES[args.mode] else torch.inference_mode():
        run = lambda: model.sample_actions(*arguments, noise=noise)  # noqa: E731
        reference = run().float()
        if args.mode != "eager":  # what the network makes on the CPU and copies, which no capture allows, is made on the device
            torch.set_default_device(device)
        if MODES[args.mode]:
            compile_parts(model, MODES[args.mode])
        times, answer = measure(run, args.mode, args.rounds, wait)
        away = float((answer.float() - reference).abs().max() / reference.abs().max())
    print(json.dumps({"name": f"PyTorch {torch.__version__} {args.mode}", "ms": times, "from_eager": away}))


if __name__ == "__main__":
    main()
