#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LoRA adapters against PEFT: what vla-convert makes of base and adapter, and of the policy that merge_and_unload gives.

    python tests/reference/compare_adapters.py     needs torch and peft; exit code 1 where a tensor is farther away than 1e-6 of its largest number
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tools"), str(ROOT / "tests/convert")]

import torch  # noqa: E402
from peft import LoraConfig, get_peft_model  # noqa: E402

from goldens import act, xvla  # noqa: E402
from tiny import Tiny  # noqa: E402
from tiny_pi import TinyPi  # noqa: E402
from vla_cpp.convert import Options, convert_checkpoint, read_bundle  # noqa: E402
from vla_cpp.convert.safetensors_file import read_safetensors  # noqa: E402

BOUND = 1e-6
TINY = r".*(q_proj|v_proj|gate_proj|state_proj|action_in_proj|action_out_proj|embed_tokens|patch_embedding)"
KINDS = {
    "plain": dict(r=4, lora_alpha=8),
    "rslora": dict(r=4, lora_alpha=6, use_rslora=True),
    "patterns": dict(r=3, lora_alpha=5, rank_pattern={"q_proj": 2, r".*layers\.1\..*v_proj": 5}, alpha_pattern={"state_proj": 9}),
    "bias": dict(r=2, lora_alpha=4, bias="all"),
}


def module_of(tensors):
    """A module with these parameters: linear layers, convolutions, tables of tokens, and bare ones."""
    root = torch.nn.Module()
    owners = {}
    for name in tensors:
        owners.setdefault(name.rpartition(".")[0], []).append(name)
    for path, names in sorted(owners.items()):
        weight = tensors.get(path + ".weight")
        bias = path + ".bias" in tensors
        if weight is not None and weight.ndim == 4:
            own = torch.nn.Conv2d(weight.shape[1], weight.shape[0], weight.shape[2], bias=bias)
        elif weight is not None and weight.ndim == 2 and path.endswith("embed_tokens"):
            own = torch.nn.Embedding(*weight.shape)
        elif weight is not None and weight.ndim == 2:
            own = torch.nn.Linear(weight.shape[1], weight.shape[0], bias=bias)
        else:
            own = torch.nn.Module()
        for name in names:
            setattr(own, name.rpartition(".")[2], torch.nn.Parameter(torch.tensor(tensors[name]), requires_grad=False))
        place = root
        *parents, last = path.split(".")
        for part in parents:
            if not hasattr(place, part):
                place.add_module(part, torch.nn.Module())
            place = getattr(place, part)
        if hasattr(place, last):
            for child_name, child in getattr(place, last).named_children():
                own.add_module(child_name, child)
        place.add_module(last, own)
    return root


def stored(folder):
    found = {}
    for name, entry in read_safetensors(str(folder / "model.safetensors")).entries.items():
        found[name] = np.concatenate([*entry.chunks()]).reshape(entry.shape)
    return found


def families(folder):
    Tiny().save(folder / "smolvla")
    TinyPi("pi0").save(folder / "pi0")
    TinyPi("pi05").save(folder / "pi05")
    cases = {"act": next(iter(act.CASES.values())), "xvla": next(iter(xvla.CASES.values()))}
    for name, case in cases.items():
        case.checkpoint.write(case.seed, folder / name)
    targets = {"act": r".*(linear1|linear2|action_head|encoder_img_feat_input_proj)", "xvla": r".*(fc1|fc2|qkv|vlm_proj)"}
    for name in ("smolvla", "pi0", "pi05", "act", "xvla"):
        yield name, folder / name, targets.get(name, TINY)


def backbone(folder):
    return next((str(folder / name) for name in ("vlm", "tokenizer") if (folder / name).is_dir()), "")


def compare(name, base, targets, kind, config, folder):
    tensors = stored(base)
    model = module_of(tensors)
    own = {"modules_to_save": ["action_out_proj"]} if kind == "patterns" and "model.action_out_proj.weight" in tensors else {}
    if own:
        targets = targets.replace("|action_out_proj", "")
    peft = get_peft_model(model, LoraConfig(target_modules=targets, init_lora_weights=False, **config, **own))
    generator = torch.Generator().manual_seed(1)
    for parameter_name, parameter in peft.named_parameters():
        if "lora_" in parameter_name or "modules_to_save" in parameter_name or (kind == "bias" and parameter_name.endswith(".bias")):
            parameter.data = torch.randn(parameter.shape, generator=generator) * 0.3
    adapter = folder / "adapter"
    shutil.copytree(base, adapter)
    (adapter / "model.safetensors").unlink()
    peft.save_pretrained(str(adapter), save_embedding_layers=False)
    stated = json.loads((adapter / "adapter_config.json").read_text())
    (adapter / "adapter_config.json").write_text(json.dumps({**stated, "base_model_name_or_path": str(base)}))
    merged = folder / "merged"
    shutil.copytree(base, merged)
    from safetensors.torch import save_file

    state = peft.merge_and_unload().state_dict()
    assert set(state) == set(tensors), sorted(set(state) ^ set(tensors))[:4]
    save_file({key: value.contiguous().clone() for key, value in state.items()}, str(merged / "model.safetensors"))
    changed = sum(not np.array_equal(state[key].numpy(), tensors[key]) for key in tensors)
    bundles = []
    for source in (adapter, merged):
        convert_checkpoint(str(source), str(folder / "out.gguf"), Options(backbone=backbone(base), vla="none", dtype="f32"), force=True)
        bundles.append(read_bundle(str(folder / "out.gguf")).tensors)
    got, wanted = bundles
    assert got.keys() == wanted.keys()
    away = max(np.abs(got[key] - wanted[key]).max() / max(np.abs(wanted[key]).max(), 1e-30) for key in wanted)
    print(f"{name:8} {kind:9} {changed:3} tensors changed, {away:.2e} away")
    return changed > 0 and away <= BOUND


def main():
    passed = True
    with tempfile.TemporaryDirectory() as root:
        for name, base, targets in families(Path(root)):
            for kind, config in KINDS.items():
                folder = Path(root) / f"{name}-{kind}"
                folder.mkdir()
                passed &= compare(name, base, targets, kind, config, folder)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
