# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's SmolVLA in OpenVINO, one timed inference for each line on standard input.  Run by compare.py.

The network is traced from PyTorch as three models: the tower over all views as one batch, the prefix up to its keys and
values, one step.  The first run writes them to --folder; later runs read them.  --hint int8 takes what NNCF quantizes
them to after training, calibrated on other observations of the same kind.  Before the first turn the chunk is compared
with PyTorch's float32, so that a fast answer is also the right one.
"""
import argparse
import gc
from pathlib import Path

import numpy as np
from peer import Laps, load, observation, serve

PARTS = ("vision", "prefix", "step")
N_CALIBRATION = 3  # observations, of all steps


def grow(layer, keys, values, *_, **__):
    """DynamicLayer.update without its first concatenation, to a tensor of no shape, which cannot be converted."""
    import torch

    old = getattr(layer, "keys", None), getattr(layer, "values", None)
    layer.keys, layer.values = (n if o is None else torch.cat([o, n], dim=-2) for o, n in zip(old, (keys, values)))
    layer.is_initialized, layer.dtype, layer.device = True, keys.dtype, keys.device
    return layer.keys, layer.values


def parts(model, inputs):
    """{name: (module, example inputs)} in the order in which they run."""
    import torch
    from lerobot.policies.common.vla_utils import make_att_2d_masks
    from transformers import DynamicCache

    both = model.vlm_with_expert
    backbone = both.get_vlm_model()
    n_view, n_text = len(inputs["images"]), inputs["tokens"].shape[1]
    d_model = both.config.text_config.hidden_size

    class Vision(torch.nn.Module):
        def forward(self, images):
            tower = backbone.vision_model
            # A whole grid reads the table row by row, which the reference finds by buckets that cannot be traced.
            x = tower.embeddings.patch_embedding(images).flatten(2).transpose(1, 2) + tower.embeddings.position_embedding.weight
            for block in tower.encoder.layers:
                x = block(x, None)
                x = x[0] if isinstance(x, tuple) else x
            return backbone.connector(tower.post_layernorm(x)).reshape(1, -1, d_model) * d_model**0.5

    class Prefix(torch.nn.Module):
        def forward(self, image_tokens, tokens, state):
            text = both.embed_language_tokens(tokens) * d_model**0.5
            x = torch.cat([image_tokens, text, model.state_proj(state)[:, None]], dim=1)
            n = x.shape[1]
            mask = make_att_2d_masks(torch.ones(1, n, dtype=torch.bool), torch.tensor([[0] * (n - 1) + [1]]))
            _, cache = both.forward(attention_mask=mask, position_ids=torch.arange(n)[None], past_key_values=None,
                                    inputs_embeds=[x, None], use_cache=True)
            return torch.stack([torch.stack([layer.keys, layer.values]) for layer in cache.layers])

    class Step(torch.nn.Module):
        def forward(self, x, t, cached):
            cache = DynamicCache()
            for i in range(cached.shape[0]):
                cache.update(cached[i, 0], cached[i, 1], i)
            n = image_tokens.shape[1] + n_text + 1
            return model.denoise_step(prefix_pad_masks=torch.ones(1, n, dtype=torch.bool), past_key_values=cache, x_t=x, timestep=t)

    images, tokens, state, noise = (torch.from_numpy(inputs[n]) for n in ("images", "tokens", "state", "noise"))
    image_tokens = Vision()(images)
    assert image_tokens.shape[1] % n_view == 0
    examples = (images,), (image_tokens, tokens, state), (noise, torch.ones(1), Prefix()(image_tokens, tokens, state))
    return {name: (module, example) for name, module, example in zip(PARTS, (Vision(), Prefix(), Step()), examples)}


def convert(model, inputs, folder):
    import openvino
    import torch

    folder.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        for name, (module, example) in parts(model, inputs).items():
            traced = torch.jit.trace(module.eval(), example, check_trace=False)
            converted = openvino.convert_model(traced, example_input=example, input=[tuple(x.shape) for x in example])
            openvino.save_model(converted, folder / f"{name}.xml", compress_to_fp16=False)


class Network:
    """The three models as OpenVINO runs them on this CPU."""

    def __init__(self, folder, n_step, options):
        import openvino

        core = openvino.Core()
        self.n_step = n_step
        self.vision, self.prefix, self.step = (core.compile_model(folder / f"{name}.xml", "CPU", options).create_infer_request() for name in PARTS)

    def infer(self, inputs, watch=lambda *_: None):
        """Milliseconds by stage, and the chunk.  watch(part, inputs) sees what each model is given."""
        import openvino

        laps = Laps()

        def run(part, *given):
            watch(part, given)
            return getattr(self, part).infer(list(given))[0]

        image_tokens = run("vision", inputs["images"])
        laps.lap("vision")
        cached = openvino.Tensor(run("prefix", image_tokens, inputs["tokens"], inputs["state"]))
        laps.lap("prefix")
        x = inputs["noise"].copy()
        for k in range(self.n_step):
            x = x - run("step", x, np.array([1 - k / self.n_step], np.float32), cached) / self.n_step
        laps.lap("steps")
        return laps.stages, x


def quantize(folder, to, n_step, observations):
    """NNCF's quantization after training, as its guide has it for transformers."""
    import nncf
    import openvino

    seen = {name: [] for name in PARTS}
    network = Network(folder, n_step, {"INFERENCE_PRECISION_HINT": "f32"})
    for inputs in observations:
        network.infer(inputs, lambda part, given: seen[part].append([np.array(getattr(x, "data", x)) for x in given]))
    del network
    to.mkdir(exist_ok=True)
    for name in PARTS:
        data = nncf.Dataset(seen.pop(name))
        model = nncf.quantize(openvino.Core().read_model(folder / f"{name}.xml"), data, model_type=nncf.ModelType.TRANSFORMER,
                              preset=nncf.QuantizationPreset.MIXED, subset_size=data.get_length())
        openvino.save_model(model, to / f"{name}.xml", compress_to_fp16=False)


def are_in(folder):
    return all((folder / f"{name}.bin").exists() for name in PARTS)


def main():
    import openvino
    import torch

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint")
    parser.add_argument("--folder", type=Path, required=True, help="where the three models are kept")
    parser.add_argument("--hint", choices=("f32", "bf16", "default", "int8"), required=True, help="precision that OpenVINO is asked for")
    parser.add_argument("--views", type=int, required=True)
    parser.add_argument("--tokens", type=int, required=True)
    parser.add_argument("--threads", type=int, required=True)
    args = parser.parse_args()
    model = load(args.checkpoint, "float32", args.threads)
    config = model.config
    inputs = observation(config, args.views, args.tokens)
    images, tokens, state, noise = (torch.from_numpy(inputs[n]) for n in ("images", "tokens", "state", "noise"))
    with torch.inference_mode():
        expected = model.sample_actions(list(images[:, None]), [torch.ones(1, dtype=torch.bool)] * args.views, tokens,
                                        torch.ones_like(tokens, dtype=torch.bool), state, noise=noise.clone()).numpy()
    folder = args.folder / f"{args.views}_views_{args.tokens}_tokens"
    if not are_in(folder):
        from transformers.cache_utils import DynamicLayer

        DynamicLayer.update = grow
        convert(model, inputs, folder)
    del model
    gc.collect()
    options = {"INFERENCE_NUM_THREADS": args.threads, "PERFORMANCE_HINT": "LATENCY"}
    if args.hint == "int8":
        if not are_in(folder / "int8"):
            others = [observation(config, args.views, args.tokens, seed) for seed in range(1, 1 + N_CALIBRATION)]
            quantize(folder, folder / "int8", config.num_steps, others)
        folder /= "int8"
    elif args.hint != "default":
        options["INFERENCE_PRECISION_HINT"] = args.hint
    network = Network(folder, config.num_steps, options)
    off = np.abs(network.infer(inputs)[1] - expected).max() / np.abs(expected).max()
    serve(lambda: network.infer(inputs)[0],
          name=f"OpenVINO {openvino.__version__.split('-')[0]}, {args.hint} precision; chunk within {off:.0e} of PyTorch float32")


if __name__ == "__main__":
    main()
