# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the reference computes, block by block, for one golden case.

A case is a folder with `checkpoint/`, `observation.json`, its frames and `noise.npy`.  The result is `expected.gguf`: LeRobot's own
class in float32 on one thread, every tap in torch's row-major shape.  Only rows that carry something appear: padded text and absent
views are dropped everywhere, since a runtime need not represent them.

Needs torch, lerobot and gguf; importing this module does not.
"""

import contextlib
import importlib.machinery
import importlib.metadata
import json
import os
import re
import sys
from pathlib import Path

import numpy as np

from . import family

PACKAGES = ("lerobot", "transformers", "torch", "tensorflow_cpu", "tokenizers", "pillow", "numpy")


# --- making the reference importable -----------------------------------------------------------------------------


def python_311(source: str) -> str:
    """Source of lerobot with the generics syntax of Python 3.12 spelt as 3.11 reads it; nothing else changes."""
    names: set[str] = set()

    def with_base(m):
        mine = [n.split(":")[0].strip() for n in m["parameters"].split(",")]
        names.update(mine)
        bases = [b for b in ((m["bases"] or "").strip("()"),) if b] + [f"Generic[{', '.join(mine)}]"]
        return f"{m['indent']}class {m['name']}({', '.join(bases)}):"

    def plain(m):
        names.update(n.split(":")[0].strip() for n in m["parameters"].split(","))
        return f"{m['indent']}def {m['name']}("

    source = re.sub(r"^(\s*)type (\w+) = ", r"\1\2 = ", source, flags=re.M)
    head = r"^(?P<indent> *){} (?P<name>\w+)\[(?P<parameters>[^\]]+)\]"
    source = re.sub(head.format("class") + r"(?P<bases>\([^)]*\))?:", with_base, source, flags=re.M)
    source = re.sub(head.format("def") + r"\(", plain, source, flags=re.M)
    if names:
        variables = "".join(f"{n} = TypeVar('{n}'); " for n in sorted(names))
        line = f"from typing import Generic, TypeVar; {variables}"
        source = re.sub(r"^(?=import |from (?!__future__))", line, source, count=1, flags=re.M)
    return source


def open_reference():
    """Makes lerobot importable from package registries alone: offline, on Python 3.11, beside a torch without CUDA."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # a missing file fails at once instead of being sought on a hub
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    import torch
    from transformers.utils import logging

    logging.set_verbosity_error()  # a configuration of the authors' own model type is read as transformers' on purpose
    # torchvision's compiled part may be built for CUDA and absent; its Python part describes operators of it on import.
    register = torch.library.register_fake

    def skip_torchvision(op, *args, **kwargs):
        return (lambda f: f) if str(op).startswith("torchvision::") else register(op, *args, **kwargs)

    torch.library.register_fake = skip_torchvision
    if sys.version_info < (3, 12):
        loader = importlib.machinery.SourceFileLoader
        compile_source = loader.source_to_code

        def source_to_code(self, data, path, **options):
            if f"{os.sep}lerobot{os.sep}" in str(path) and isinstance(data, bytes):
                data = python_311(data.decode()).encode()
            return compile_source(self, data, path, **options)

        loader.source_to_code = source_to_code


def versions() -> str:
    found = {d.name.lower(): d.version for d in reversed([*importlib.metadata.distributions()]) if d.name}  # the first one is imported
    return ", ".join(f"{name} {found[name]}" for name in PACKAGES if name in found)


# --- the reference, run on one case -------------------------------------------------------------------------------


def config_type(checkpoint) -> str:
    """The architecture: LeRobot's config.json names it as its type, authors' files state a model_type; Evo-1's nothing, TurboVLA's have none."""
    from vla_cpp.convert.archs import authors
    from vla_cpp.convert.checkpoint import of_model_type

    if not (Path(checkpoint) / "config.json").is_file():
        return next(arch for arch, layout in authors().items() if not layout.has_config and layout.tells(str(checkpoint)))
    config = json.loads((Path(checkpoint) / "config.json").read_text())
    return config.get("type") or of_model_type(config, str(checkpoint), authors()) or "evo1"


def described(checkpoint) -> str:
    """What computed the numbers, in the words of its module."""
    arch = config_type(checkpoint)
    module = family(arch)
    return module.described(checkpoint) if hasattr(module, "described") else module.NAMES[arch]


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor) of a checkpoint folder; dtype: float32 or published."""
    return family(config_type(checkpoint)).load(checkpoint, dtype)


def recorder(policy):
    return family(policy.config.type).Recorder(policy)


def read_observation(case):
    """The raw batch of a case: frames as RGB (3, height, width) in [0, 1], state, instruction."""
    import torch
    from PIL import Image

    observation = json.loads((case / "observation.json").read_text())
    state = observation["state"]
    if isinstance(state, dict):  # several features, in the order in which the network sees them
        state = [x for part in state.values() for x in part]
    batch = {"task": observation["text"], "observation.state": torch.tensor(state, dtype=torch.float32)}
    for view, file in observation["images"].items():
        if file is not None:
            pixels = np.asarray(Image.open(case / file).convert("RGB"))
            batch[f"observation.images.{view}"] = torch.from_numpy(pixels.copy()).permute(2, 0, 1).float().div(255)
    return batch


@contextlib.contextmanager
def given_noise(noise):
    """Of a reference that draws its start itself: inside, what it draws is `noise`, and no gradients are kept."""
    import torch

    draw, torch.randn = torch.randn, lambda *sizes, size=None, dtype, device: noise.reshape(size or sizes).to(dtype)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.randn = draw


class Taps:
    """What hooks on modules and functions put down, by name."""

    def __init__(self, n_step):
        self.n_step, self.step, self.taps = n_step, -1, {}

    def put(self, name, x):
        self.taps[name] = x.detach().float().numpy().copy()

    def rows(self, name, x):
        self.put(name, x[0][self.valid])

    def at_step(self, name, x):
        if self.step in (0, self.n_step - 1):
            self.put(f"step.{self.step}.{name}", x[0])

    def before(self, module, take):
        module.register_forward_pre_hook(lambda m, args, kw: take([*args, *kw.values()][0].clone()), with_kwargs=True)

    def after(self, module, take):
        module.register_forward_hook(lambda m, args, out: take((out[0] if isinstance(out, tuple) else out).clone()))

    def stepwise(self, module, name):
        self.after(module, lambda x: self.at_step(name, x))


class ChunkRecorder(Taps):
    """Listens to one run of `predict_action_chunk` of a policy with embed_prefix and denoise_step."""

    def __init__(self, policy, n_step):
        super().__init__(n_step)
        self.policy, self.views = policy, {}
        self.embed_prefix, policy.model.embed_prefix = policy.model.embed_prefix, self.on_prefix
        self.denoise_step, policy.model.denoise_step = policy.model.denoise_step, self.on_step

    def per_view(self, module, name, shape=lambda x: x):
        self.after(module, lambda x: self.views.setdefault(name, []).append(shape(x)))

    def vision_tower(self, vision):
        """Hooks on a tower of the SigLIP family."""
        self.per_view(vision.embeddings.patch_embedding, "vision.patch_embed", lambda x: x.flatten(2).transpose(1, 2))
        for i, block in enumerate(vision.encoder.layers):
            self.per_view(block, f"vision.blk.{i}")
        self.per_view(vision.post_layernorm, "vision.post_norm")
        self.before(vision.embeddings, lambda x: self.views.setdefault("pixels", []).append(x))

    def language_layers(self, layers):
        for i, layer in enumerate(list(layers)[1:]):  # what enters a layer is what the one before it left
            self.before(layer.input_layernorm, lambda x, i=i: self.rows(f"lm.blk.{i}", x))

    def expert_layers(self, expert):
        norms = [layer.input_layernorm for layer in list(expert.layers)[1:]] + [expert.norm]
        for j, norm in enumerate(norms):
            self.before(norm, lambda x, j=j: self.at_step(f"expert.blk.{j}", x))
        self.stepwise(expert.norm, "expert.norm")

    def on_prefix(self, images, image_masks, *args, **kwargs):
        embedded, pad_masks, att_masks = self.embed_prefix(images, image_masks, *args, **kwargs)
        self.valid, self.present = pad_masks[0], [bool(m[0]) for m in image_masks]
        self.rows("prefix", embedded)
        return embedded, pad_masks, att_masks

    def on_step(self, x_t, past_key_values, **kwargs):
        import torch

        self.step += 1
        if self.step == 0:
            for i, layer in enumerate(past_key_values.layers):
                self.rows(f"lm.blk.{i}.k", layer.keys.transpose(1, 2))
                self.rows(f"lm.blk.{i}.v", layer.values.transpose(1, 2))
        else:
            self.put(f"step.{self.step - 1}.x", x_t[0])
        velocity = self.denoise_step(x_t=x_t, past_key_values=past_key_values, **kwargs)
        assert torch.isfinite(velocity).all()
        return velocity

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        model = self.policy.model
        sample = model.sample_actions

        def keep_whole(*args, **kwargs):
            x = sample(*args, **kwargs)
            self.put(f"step.{self.step}.x", x[0])
            return x

        model.sample_actions = keep_whole
        with torch.inference_mode():
            self.put("chunk", self.policy.predict_action_chunk(dict(batch), noise=noise)[0])
        for name, seen in self.views.items():
            self.put(name, torch.cat([x for x, here in zip(seen, self.present, strict=True) if here]))
        tokens = batch["observation.language.tokens"][0]
        self.put("tokens", tokens[batch["observation.language.attention_mask"][0].bool()])
        return self.taps


def network_order(name):
    """Sort key: inputs, vision, prefix, language layers with keys and values before their output, steps, result."""
    stages = ("pixels", "tokens", "state", "position_ids", "vision", "dino", "siglip", "deepstack", "connector", "connector_down", "projector", "projector_down", "prefix", "encoder", "lm",
              "vl", "vlm_in", "aux_in", "state_in", "state_out", "expert", "head", "dit", "logits", "step", "tokens_out", "chunk")
    parts = name.split(".")
    stage = stages.index(parts[0]) if parts[0] in stages else len(stages)
    i = next((int(p) for p in parts if p.isdigit()), 1000 if name in ("vision.post_norm", "lm.norm") else -1)
    return stage, i, parts[-1] not in ("k", "v") if parts[0] == "lm" else 0


def run_case(case, dtype="float32"):
    """Taps and un-normalized actions of a case."""
    import torch

    torch.set_num_threads(1)  # another number of threads sums in another order
    policy, before, after = load(case / "checkpoint", dtype)
    noise = torch.from_numpy(np.load(case / "noise.npy"))[None]
    taps = recorder(policy).run(before(read_observation(case)), noise)
    taps = {name: taps[name] for name in sorted(taps, key=network_order)}
    taps["actions"] = after(torch.from_numpy(taps["chunk"])[None]).float().numpy()[0]
    return taps


def write_taps(file, taps, kind="golden", **keys):
    """A GGUF file of float32 tensors. keys: text, whole numbers or float64 numbers; a dot in a name is written __."""
    import gguf

    writer = gguf.GGUFWriter(str(file), kind)
    for name, value in keys.items():
        add = {str: writer.add_string, int: writer.add_uint32, float: writer.add_float64}[type(value)]
        add(name.replace("__", "."), value)
    for name, values in taps.items():
        writer.add_tensor(name, np.ascontiguousarray(values, dtype=np.float32))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def read_taps(file):
    """What `write_taps` or `vla run --taps-out` wrote."""
    import gguf

    return {t.name: np.array(t.data) for t in gguf.GGUFReader(str(file)).tensors}


# Cases of which every tap is kept: one of each family, and all of BitVLA, whose parts are compared on the reference's own inputs.
EVERY_TAP = {"act/pre_norm", "bitvla/micro", "bitvla/one_view", "bitvla/two_layers", "diffusion/ddim", "evo1/two_views", "gr00t_n1_5/percentiles",
             "gr00t_n1_6/aspect", "gr00t_n1_7/percentiles", "openvla/bridge", "openvla_oft/libero", "pi0/absent_view", "pi05/long_text", "pi0_fast/stops", "smolvla/long_text",
             "turbovla/long_text", "turbovla_authors/two_views", "vla_adapter/one_view", "vla_jepa/three_views", "xvla/two_arms"}


def outline(taps):
    """Without what is inside of a block, whose result shows it, and without pixels, which the embedding of patches shows."""
    return {name: values for name, values in taps.items() if name != "pixels" and not re.search(r"\bblk\.\d+\.", name)}


def write_expected(folder, name, seed, out):
    """Writes `expected.gguf` of the named case, whose checkpoint is in `folder`, into the folder `out`; returns what went into it."""
    taps = run_case(folder)
    if name not in EVERY_TAP:
        taps = outline(taps)
    published = run_case(folder, "published")
    taps |= {f"{name}.bf16": published[name] for name in ("position_ids", "chunk") if name in taps}
    reference = f"{described(folder / 'checkpoint')}, float32, CPU, 1 thread"
    write_taps(out / "expected.gguf", taps, golden__arch=config_type(folder / "checkpoint"), golden__case=folder.name,
               golden__reference=reference, golden__versions=versions(), golden__seed=seed)
    return taps
