# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""openpi's own PyTorch code and the runtime, from the same random checkpoint: every variant that vla-convert knows.

    python tools/parity_openpi.py [--vla build/cpu/bin/vla] [--seed N] [VARIANT ...]

Runs in an environment with openpi's checkout on the path, transformers 4.53.2 with openpi's transformers_replace copied over it, jax,
flax and sentencepiece, beside torch, gguf and tokenizers.  A variant's checkpoint has tiny towers, openpi's names, statistics that
openpi writes, and a SentencePiece model of Gemma's kind; openpi's training configuration of that name makes the policy.  The first
observation lies within the statistics, the second beyond every range: joints outside the quantiles, ALOHA's grippers further closed
and open than an arm of their length can be.
Ends with exit code 1 if an action differs by more than 1e-4 of the largest.
"""
import argparse
import dataclasses
import io
import json
import subprocess
import sys
import tempfile
import types
from pathlib import Path
from unittest import mock

for name in ("orbax", "orbax.checkpoint", "orbax.checkpoint.future", "tensorstore", "openpi.training.checkpoints"):
    sys.modules[name] = mock.MagicMock()  # they read JAX's checkpoints, and bring a second copy of abseil
import jax  # noqa: E402, F401  before torch, for the same reason
import numpy as np  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tools")]
from goldens import pi, recorder  # noqa: E402
from goldens.cases import smooth_frame  # noqa: E402
from goldens.draw import Generator  # noqa: E402
from goldens.train_tokenizer import TASKS  # noqa: E402
from vla_cpp.convert.archs.pi0.layouts import VARIANTS  # noqa: E402

LM, EXPERT = pi.gemma(40, 3, 8, 1, 8, 72), pi.gemma(32, 3, 8, 1, 8, 48)
VISION = pi.tower(36, 2, 3, 52)
N_VOCAB = 400
TEXTS = ("pick up the red_cube \n and place it in the basket", " stack 12 blocks, naïvely! ")


def sentencepiece_model():
    """A BPE of Gemma's kind: bytes, single digits, runs of newlines and blanks as symbols of their own."""
    import sentencepiece

    model, runs = io.BytesIO(), ["\n", "\n\n", "▁▁", "▁▁▁"]
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter([f"Task: {t}, State: 0 12 255 -1;\nAction: " for t in TASKS]), model_writer=model, vocab_size=N_VOCAB,
        model_type="bpe", byte_fallback=True, normalization_rule_name="identity", add_dummy_prefix=False, split_digits=True,
        remove_extra_whitespaces=False, allow_whitespace_only_pieces=True, pad_id=0, eos_id=1, bos_id=2, unk_id=3, pad_piece="<pad>",
        eos_piece="<eos>", bos_piece="<bos>", unk_piece="<unk>", user_defined_symbols=["<mask>", *runs], minloglevel=2)
    return model.getvalue()


def shrink(folder):
    """From here on openpi builds tiny towers, in float32, and finds its tokenizer in `folder`."""
    import openpi.models.gemma
    import openpi.models.tokenizer
    from openpi.models_pytorch import gemma_pytorch
    from openpi.training.config import DataConfigFactory

    sizes = {"gemma_2b": LM, "gemma_300m": EXPERT}
    backbone, expert = gemma_pytorch.PaliGemmaForConditionalGeneration, gemma_pytorch.GemmaForCausalLM
    openpi.models.gemma.get_config = lambda variant: openpi.models.gemma.Config(**sizes[variant])

    def small_backbone(config):
        for key, value in VISION.items():
            setattr(config.vision_config, key, value)
        config.vision_config.projection_dim = config.projection_dim = LM["width"]
        config.text_config.vocab_size = config._vocab_size = N_VOCAB
        config.image_token_index, config.pad_token_id, config.text_config.pad_token_id = N_VOCAB - 1, 0, 0
        return backbone(config)

    def small_expert(config):
        config.vocab_size, config.pad_token_id = N_VOCAB, 0
        return expert(config)

    gemma_pytorch.PaliGemmaForConditionalGeneration, gemma_pytorch.GemmaForCausalLM = small_backbone, small_expert
    download = types.SimpleNamespace(maybe_download=lambda *args, **kwargs: folder / "paligemma_tokenizer.model")
    openpi.models.tokenizer.download = download
    DataConfigFactory._load_norm_stats = lambda *args: None  # of the configuration; a policy has those of its checkpoint


def statistics(rng, width):
    from openpi.shared.normalize import NormStats

    mean, std = rng.normal(0.3, 0.3, width), rng.uniform(0.1, 0.6, width)
    return NormStats(mean=mean, std=std, q01=mean - 2.3 * std, q99=mean + 2.2 * std)


def write_checkpoint(config, variant, folder, seed):
    """What openpi saves: model.safetensors, assets/, and the config.json of its converter."""
    import torch
    from openpi.models_pytorch.pi0_pytorch import PI0Pytorch
    from openpi.shared import normalize
    from safetensors.torch import save_model

    torch.manual_seed(seed)
    model = PI0Pytorch(config.model)
    with torch.no_grad():
        for name, p in model.named_parameters():
            p.copy_(torch.from_numpy(pi.Checkpoint.value(name, tuple(p.shape), seed)))
    folder.mkdir()
    save_model(model, str(folder / "model.safetensors"))
    rng = np.random.default_rng(seed)
    n_state, n_action = sum(width for _, width in variant.robot.states), variant.robot.n_action
    padded = 32 if seed % 2 else 0  # openpi's published statistics are padded, those of a user are not
    stats = {"state": statistics(rng, padded or n_state), "actions": statistics(rng, padded or n_action)}
    normalize.save(folder / "assets" / variant.asset, stats)
    (folder / "config.json").write_text(json.dumps({
        "action_dim": config.model.action_dim, "action_horizon": config.model.action_horizon, "paligemma_variant": "gemma_2b",
        "action_expert_variant": "gemma_300m", "precision": "float32"}))
    dims = {"gemma_2b": LM, "gemma_300m": EXPERT, "vision": VISION, "vocab_size": N_VOCAB}
    (folder / "dims.json").write_text(json.dumps(dims))
    return stats


def observe(variant, stats, rng, edge, folder):
    """(openpi's observation, arguments of `vla run`) of one moment; at the edge the state leaves every range."""
    from PIL import Image

    robot, data, arguments, images = variant.robot, {}, [], {}
    aloha = len(robot.views) == 3
    for i, (view, alias, optional) in enumerate(robot.views):
        if edge and optional and i == 2:
            arguments += ["--image", f"{view}="]
            continue
        frame = smooth_frame(60 + 164 * (i == 0), 96 + 128 * (i == 0), Generator(int(rng.integers(1 << 30))))
        Image.fromarray(frame).save(folder / f"{view}.png")
        arguments += ["--image", f"{view}={folder / view}.png"]
        if aloha:
            images[view] = frame.transpose(2, 0, 1)
        else:
            data[alias] = frame
    n_state = sum(width for _, width in robot.states)
    mean, std = (np.asarray(x)[:n_state] for x in (stats["state"].mean, stats["state"].std))
    state = mean + std * (rng.choice((-9.0, 9.0), n_state) if edge else rng.normal(0, 1, n_state))
    if aloha:
        state[[6, 13]] = (-0.4, 2.0) if edge else rng.uniform(0.0, 1.0, 2)  # 0 is closed, 1 is open
    state = state.astype(np.float32)
    parts = np.split(state, np.cumsum([width for _, width in robot.states])[:-1])
    for (name, _), part in zip(robot.states, parts):
        arguments += ["--state", f"{name}=" + ",".join(map(repr, part.tolist()))]
    if aloha:
        data |= {"images": images, "state": state}
    elif len(parts) == 1:
        data["observation/state"] = state
    else:
        data |= {f"observation/{name}": part for (name, _), part in zip(robot.states, parts)}
    return data | {"prompt": TEXTS[edge]}, [*arguments, "--text", TEXTS[edge]]


def run_vla(vla, bundle, arguments, noise, folder):
    np.save(folder / "noise.npy", noise)
    command = [vla, "run", bundle, *arguments, "--noise", folder / "noise.npy", "--out", folder / "actions.npy"]
    subprocess.run([str(c) for c in command], check=True, stdout=subprocess.DEVNULL)
    return np.load(folder / "actions.npy")


def relative(got, expected):
    return np.abs(got - expected).max() / np.abs(expected).max()


def compare(name, vla, folder, seed):
    """[(distance of the runtime, distance of openpi in its published dtypes)] of the two observations."""
    from openpi.models_pytorch.gemma_pytorch import PaliGemmaWithExpertModel
    from openpi.policies.policy_config import create_trained_policy
    from openpi.training.config import get_config
    from vla_cpp.convert import cli

    variant, config = VARIANTS[name], get_config(name)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, dtype="float32", pytorch_compile_mode=None))
    checkpoint, bundle = folder / "checkpoint", folder / "bundle.gguf"
    stats = write_checkpoint(config, variant, checkpoint, seed)
    code = cli.main([str(checkpoint), "--backbone", str(folder.parent), "--variant", name, "-o", str(bundle), "--dtype", "f32", "--quiet"])
    if code:
        raise SystemExit(code)
    policies = [create_trained_policy(config, checkpoint, norm_stats=stats, pytorch_device="cpu")]
    with mock.patch.object(PaliGemmaWithExpertModel, "to_bfloat16_for_selected_params", lambda *args: None):
        policies.append(create_trained_policy(config, checkpoint, norm_stats=stats, pytorch_device="cpu"))
    rng, found = np.random.default_rng(seed + 1), []
    for edge in (0, 1):
        data, arguments = observe(variant, stats, rng, edge, folder)
        noise = rng.standard_normal((config.model.action_horizon, config.model.action_dim)).astype(np.float32)
        copies = [{**data, **({"state": data["state"].copy()} if "state" in data else {})} for _ in policies]
        published, expected = (p.infer(d, noise=noise)["actions"] for p, d in zip(policies, copies))
        found.append((relative(run_vla(vla, bundle, arguments, noise, folder), expected), relative(published, expected)))
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variant", nargs="*", default=sorted(VARIANTS), help="those of vla-convert; all, if none is named")
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    recorder.open_reference()
    worst = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        scratch = Path(scratch)
        (scratch / "paligemma_tokenizer.model").write_bytes(sentencepiece_model())
        shrink(scratch)
        print("| variant | actions | beyond every range | openpi in bfloat16 |\n| --- | --- | --- | --- |")
        for name in args.variant:
            folder = scratch / name
            folder.mkdir()
            (inside, bf16), (beyond, _) = compare(name, args.vla.resolve(), folder, args.seed)
            print(f"| `{name}` | {inside:.1e} | {beyond:.1e} | {bf16:.1e} |", flush=True)
            worst = max(worst, inside, beyond)
    sys.exit(not worst <= 1e-4)


if __name__ == "__main__":
    main()
