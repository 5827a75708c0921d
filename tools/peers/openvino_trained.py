#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How far codes move the chunks of SmolVLA with trained parts: vla, PyTorch's bf16, and NNCF in OpenVINO.

    python tools/peers/openvino_trained.py --packages PACKAGES [--name smolvla/vit] [--vla build/cpu/bin/vla]

NAME and PACKAGES are those of tools/trained_parts.py. Half of the observations calibrate vla's codes and nncf.quantize, the other half
judge. The table has the root mean square by which chunks differ from PyTorch's in float32, in percent of theirs, of all observations and of the
median one. NNCF's compress_weights rounds weights alone and uses no data.

Needs torch, lerobot, gguf, openvino, nncf, pyzmq and protobuf, in the environment that runs this script. VLA_LIBRARY: the runtime.
"""
import argparse
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / folder) for folder in ("tools", "tools/peers")]
import quantize_held_out as held_out
import trained_parts
from openvino_peer import Network, convert, grow, quantize
from openvino_weights import WEIGHTS, compress

def source_names(checkpoint):
    """{tensor of the bundle: what the checkpoint calls it}."""
    from goldens.cases import backbone_folder

    from vla_cpp.convert import archs
    from vla_cpp.convert.archs.smolvla.config import read_sizes
    from vla_cpp.convert.archs.smolvla.mapping import weights
    from vla_cpp.convert.checkpoint import open_checkpoint
    from vla_cpp.convert.errors import Problems

    options = archs.Options(backbone=str(backbone_folder(checkpoint)))
    sizes = read_sizes(open_checkpoint(str(checkpoint), archs.told_by_files(), ""), options, Problems(""))
    return {row.target: row.source for row in weights(sizes)}


def torch_policy(folder, changed, dtype):
    """(policy, preprocessor) of the case, with other values of some tensors. changed: {tensor of the bundle: float32}."""
    import torch
    from goldens import recorder

    policy, before, _ = recorder.load(folder / "checkpoint", dtype)
    parameters, sources = dict(policy.named_parameters()), source_names(folder / "checkpoint")
    with torch.no_grad():
        for tensor, values in changed.items():
            parameter = parameters[sources[tensor]]
            parameter.copy_(torch.from_numpy(np.ascontiguousarray(values)).reshape(parameter.shape))
    return policy.requires_grad_(False), before


def torch_answers(policy, before, observations):
    """(chunks, and of each observation what the network is given: images, tokens, state, noise)."""
    import torch

    given, sample = [], policy.model.sample_actions

    def listen(images, present, tokens, mask, state, noise):
        inputs = {"images": torch.cat(images), "tokens": tokens[mask][None], "state": state, "noise": noise}
        given.append({name: value.float().numpy() if value.is_floating_point() else value.numpy() for name, value in inputs.items()})
        return sample(images, present, tokens, mask, state, noise=noise)

    policy.model.sample_actions, chunks = listen, []
    with torch.inference_mode():
        for one in observations:
            batch = {"task": one["text"], "observation.state": torch.tensor(one["state"], dtype=torch.float32)}
            for view, pixels in one["images"].items():
                batch[f"observation.images.{view}"] = torch.from_numpy(pixels.copy()).permute(2, 0, 1).float().div(255)
            chunks.append(policy.predict_action_chunk(before(batch), noise=torch.from_numpy(one["noise"])[None])[0].float().numpy())
    policy.model.sample_actions = sample
    return np.array(chunks), given


def openvino_rows(policy, given, seen, work):
    """(name, chunks) of what NNCF makes of the network. given: of each observation; seen: those that calibrate."""
    from transformers.cache_utils import DynamicLayer

    n_step = policy.config.num_steps
    DynamicLayer.update = grow
    convert(policy.model, given[0], work / "float32")

    def judged(folder):
        network = Network(folder, n_step, {"INFERENCE_PRECISION_HINT": "f32"})
        return np.array([network.infer(one)[1][0] for one in given])

    yield "OpenVINO, float32", judged(work / "float32")
    for name, how in WEIGHTS.items():
        compress(work / "float32", work / name, **how)
        yield f"NNCF, weights {name}", judged(work / name)
    quantize(work / "float32", work / "int8", n_step, seen)
    yield "NNCF, weights and activations int8, calibrated", judged(work / "int8")


def vla_rows(program, bundle, observations, seen, work):
    yield "vla, float32", held_out.chunks(bundle, observations, "float32")
    yield "vla, bf16", held_out.chunks(bundle, observations, "bf16")
    recording = held_out.record(bundle, work / "recording", seen)
    for dtype in ("int8", "int4"):
        for what, options in (("", ()), (", calibrated", ("--calibrate", recording))):
            made = work / "codes.gguf"
            subprocess.run([program, "quantize", bundle, "-o", made, "--force", "--dtype", dtype, *options], check=True, stdout=subprocess.DEVNULL)
            yield f"vla, {dtype}{what}", held_out.chunks(made, observations)


def print_row(name, chunks, expected):
    """chunks, expected: (observation, row, column); columns beyond the robot's are left out."""
    error, median = held_out.percent_moved(chunks[..., : expected.shape[2]], expected)
    print(f"| {name} | {error:.3g} % | {median:.3g} % |", flush=True)


def main():
    from goldens import recorder
    from vla_cpp.convert.bundle import read_bundle

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", default="smolvla/smollm2", choices=[name for name in trained_parts.SIZES if name.startswith("smolvla/")])
    parser.add_argument("--packages", required=True, help="folder of the package")
    parser.add_argument("--vla", default=ROOT / "build/cpu/bin/vla")
    args = parser.parse_args()
    recorder.open_reference()
    warnings.filterwarnings("ignore")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        bundle, observations = held_out.trained_policy(args.name, work, args.packages, args.vla)
        for seed, one in enumerate(observations):
            del one["seed"]
            one["noise"] = np.random.default_rng(seed).standard_normal((50, 32)).astype(np.float32)
        written, drawn = read_bundle(str(bundle)), read_bundle(str(work / "bundle.gguf"))
        changed = {name: held_out.as_floats(values, written.dtypes[name]) for name, values in written.tensors.items()
                   if not np.array_equal(values, drawn.tensors[name])}
        seen, judging = observations[::2], observations[1::2]
        policy, before = torch_policy(work, changed, "float32")
        expected, given = torch_answers(policy, before, judging)
        print("| program | chunks move by | median observation |\n| --- | --- | --- |")
        print_row("PyTorch, bf16", torch_answers(*torch_policy(work, changed, "published"), judging)[0], expected)
        for name, chunks in vla_rows(args.vla, bundle, judging, seen, work):
            print_row(name, chunks, expected)
        for name, chunks in openvino_rows(policy, given, torch_answers(policy, before, seen)[1], work):
            print_row(name, chunks, expected)


if __name__ == "__main__":
    main()
