# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""OpenVLA-OFT: golden cases, random checkpoints in the authors' layout, and their own code as the reference.

The reference is in no package: OPENVLA_OFT_REFERENCE names a checkout of moojink/openvla-oft.  It needs tensorflow-cpu 2.15.1, diffusers 0.32.2,
peft 0.11.1, accelerate, json-numpy and requests beside what openvla.py needs, and in the place of transformers 4.40.1 its authors' fork
(moojink/transformers-openvla-oft bc339d9), which is that release with another modeling_llama.py: queries of LlamaSdpaAttention see every key.

It runs as its users run it: frames go through the clients of their LIBERO and ALOHA evaluations (JPEG, Lanczos; a case of plain images has frames of the network's size), then get_vla_action crops them
and runs predict_action with head and projectors as their loaders open them; FiLM is put in by their _apply_film_to_vla, with its LoRA apart.  What
differs is what openvla.py tells, the size of images, 224 in their code, and the constants of a robot, which a case states.  In float32 what their
loaders round to bfloat16 is rounded, and then computed in float32.
"""

import importlib
import inspect
import json
import random
import re
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import openvla
from .cases import TEXTS, Case
from .draw import bfloat16, f32
from .files import bfloat16_bits, state_dict, write_archive, write_json
from .openvla import DINO, SIGLIP, Tower, read_options
from .parameters import decoder, linear, mlp_resnet, parameter
from .parameters import statistics as random_statistics
from .recorder import Taps, given_noise

REFERENCE, COMMIT = "OPENVLA_OFT_REFERENCE", "213c5ff"
STEP, STATISTICS = 150000, "libero_spatial_no_noops"
PLATFORMS = {"libero": (8, "bounds_q99"), "aloha": (25, "bounds"), "bridge": (5, "bounds_q99")}


@dataclass(frozen=True)
class Checkpoint(openvla.Checkpoint):
    d_state: int = 8
    platform: str = "libero"  # or rows of a chunk and a normalization, as --platform takes them
    rank: int = 0  # of the LoRA of towers with FiLM; 0: there is none
    exact: bool = False  # bfloat16 holds the sums of weights and LoRA
    steps: tuple = ()  # of training and of inference, of a diffusion head
    prefix: str = "module."  # of names in the files beside the language model

    @property
    def constants(self):
        """Rows of a chunk, normalization."""
        if self.platform in PLATFORMS:
            return PLATFORMS[self.platform]
        rows, norm = self.platform.split(",")
        return int(rows), norm

    @property
    def policy(self):
        return {"chunk_size": self.constants[0], "max_action_dim": self.d_action}

    def parts(self):
        """{file: {name: shape}} beside the language model."""
        d = self.text["hidden_size"]
        at = "noise_predictor.mlp_resnet." if self.steps else "model."
        out = {"action_head": mlp_resnet(at, d * self.d_action, d, self.d_action)}
        if self.d_state:
            out["proprio_projector"] = linear("fc1", d, self.d_state) | linear("fc2", d, d)
        if self.steps:
            out["noisy_action_projector"] = linear("fc1", d, 1) | linear("fc2", d, d)
        if self.rank:
            out["vision_backbone"] = self.film()
        return out

    def film(self):
        """Of FiLMedPrismaticVisionBackbone with the LoRA that peft puts before it into linear layers, and into convolutions called like one."""
        out, d_text = {}, self.text["hidden_size"]
        for name, shape in self.shapes().items():
            if not name.startswith((DINO, SIGLIP)):
                continue
            wrapped = re.sub(r"(\.blocks\.\d+)\.", r"\1.block.", name)
            module, kind = wrapped.rsplit(".", 1)
            is_linear = re.search(r"\.(qkv|q|kv|proj|fc1|fc2)$", module)
            out[f"{module}.base_layer.{kind}" if is_linear else wrapped] = shape
            if is_linear and kind == "weight":
                out |= {f"{module}.lora_A.default.weight": (self.rank, *shape[1:]), f"{module}.lora_B.default.weight": (shape[0], self.rank) + (1, 1) * (len(shape) == 4)}
        for at, tower in ((DINO, self.dino), (SIGLIP, self.siglip)):
            for i in range(tower.depth):
                out |= linear(f"{at}blocks.{i}.scale", tower.d, d_text) | linear(f"{at}blocks.{i}.shift", tower.d, d_text)
        return out

    def part_value(self, part, name, shape, seed):
        """Numbers that were trained in float32 are none of bfloat16."""
        if part == "vision_backbone" and not re.search(r"lora_|\.(scale|shift)\.", name):
            x = self.value(f"film.{name.replace('.base_layer', '')}", shape, seed)
            return np.rint(x * f32(64)) / f32(64) if self.exact and "base_layer.weight" in name else x
        x = parameter(f"{part}.{name}", shape, seed)
        if self.exact and "lora_A" in name:
            return np.rint(x * f32(32)) / f32(32)
        if self.exact and "lora_B" in name:  # 1 or -1 in every row
            here = np.arange(shape[0])[:, None] % self.rank == np.arange(self.rank)
            return np.where(here.reshape(shape), np.sign(x), f32(0))
        if len(shape) == 1 and name.endswith("weight") and "norm" not in name:  # those of norms in a list
            x = bfloat16(x + f32(1))
        if part == "noisy_action_projector" and name == "fc2.weight":
            x /= f32(4)  # or rounding grows from step to step
        return x * f32(1 + 2**-10)

    def write(self, seed, folder):
        """Returns the parameter count."""
        count = super().write(seed, folder)
        write_json(Path(folder) / "dataset_statistics.json", self.statistics(seed), indent=1)
        for part, shapes in self.parts().items():
            prefix = "" if part == "vision_backbone" else self.prefix
            is_bf16 = {name: part == "vision_backbone" and not re.search(r"lora_|\.(scale|shift)\.", name) for name in shapes}
            tensors = {prefix + name: (bfloat16_bits if is_bf16[name] else f32)(self.part_value(part, name, shape, seed)) for name, shape in shapes.items()}
            if part == "vision_backbone":
                tensors = {"vision_backbone." + name.removeprefix("vision_backbone."): x for name, x in tensors.items()}
            write_archive(Path(folder) / f"{part}--{STEP}_checkpoint.pt", *state_dict(tensors))
            count += sum(int(np.prod(shape)) for shape in shapes.values())
        return count

    def config(self, seed):
        return super().config(seed) | {"norm_stats": {"elsewhere": {"action": {}}}}

    def statistics(self, seed):
        """By data set, in float64, of which few are numbers of float32."""

        def entry(seed):
            found = random_statistics(self.d_state, self.d_action, seed)
            out = {key: {k: (v.astype(np.float64) * 1.0000000123).tolist() for k, v in found[feature].items()}
                   for key, feature in (("action", "action"), ("proprio", "observation.state"))}
            if self.unmasked is not None:
                out["action"]["mask"] = [i not in self.unmasked for i in range(self.d_action)]
            return out | {"num_trajectories": 10, "num_transitions": 1000}

        return {name: entry(seed + i) for i, name in enumerate((STATISTICS, *self.other_stats))}


FRAMES, OPTIONS = {"image": (256, 256, "png"), "image2": (256, 256, "png")}, {"platform": "libero", "views": ["image", "image2"]}  # of the published size


def published(views=("image", "image2"), arch="openvla_oft"):
    """The size of openvla-7b-oft-finetuned-libero-*, with fewer tokens, as openvla.py has it."""
    return Checkpoint(Tower(1024, 24, 4096), Tower(1152, 27, 4304), decoder(4096, 32, 32, 32, 11008), 224, n_token=29760)


def case(seed, frames, text, checkpoint, **options):
    options |= {"platform": checkpoint.platform, "views": list(frames)}
    if checkpoint.steps:
        options["diffusion_steps"] = ",".join(map(str, checkpoint.steps))
    return Case(seed, frames, text, checkpoint, options=options)


CASES = {
    # As published but smaller: two cameras, a state, a gripper.
    "openvla_oft/libero": case(75, {"image": (48, 64, "png"), "image2": (40, 40, "png")}, "Put the White mug on the plate", Checkpoint(
        Tower(32, 3, 44), Tower(48, 3, 56), decoder(32, 2, 4, 2, 44))),
    # Three cameras of another aspect, two arms, other bounds, two data sets, shards, files of one process.
    "openvla_oft/aloha": case(72, {"cam_high": (48, 64, "png"), "cam_left_wrist": (36, 48, "jpg"), "cam_right_wrist": (30, 40, "png")},
        "fold the shirt, then 漢字", Checkpoint(
            Tower(16, 2, 20), Tower(32, 2, 36), decoder(24, 2, 2, 1, 28, rms_norm_eps=1e-5), d_action=14, d_state=14, platform="aloha", n_shard=3,
            unmasked=None, other_stats=("aloha_fold",), prefix=""), stats=STATISTICS),
    # FiLM with LoRA apart, one camera, no state, frames that no JPEG touches.
    "openvla_oft/film": case(73, {"top": (42, 42, "png")}, "open the drawer", Checkpoint(
        Tower(32, 3, 36), Tower(16, 4, 28), decoder(40, 2, 5, 5, 36, rope_theta=5000.0), side=42, d_action=4, d_state=0, platform="5,bounds", rank=32, exact=True,
        unmasked=(3,)), plain_images=True),
    # A diffusion head, in fewer steps than were trained.
    "openvla_oft/diffusion": case(74, {"image": (32, 32, "png"), "image2": (32, 32, "png")}, "pick up the block", Checkpoint(
        Tower(16, 2, 24), Tower(16, 3, 20), decoder(32, 2, 4, 4, 40), d_action=7, d_state=7, platform="bridge", steps=(50, 4))),
}

# --- random configurations ------------------------------------------------------------------------------------------


def draw(seed):
    """A case from the seed: OpenVLA's sizes, cameras, platforms and others, states, FiLM with LoRA, diffusion, files of one process and of several."""
    r = random.Random(f"openvla_oft {seed}")
    kv, d_head = r.choice((1, 2, 3)), r.choice((4, 6, 8, 16))
    heads = kv * r.choice((1, 2, 3))
    towers = [Tower(16 * r.choice((1, 2, 3, 4)), r.randint(2, 4), r.randint(10, 70)) for _ in range(2)]
    text = decoder(heads * d_head, r.randint(1, 4), heads, kv, r.choice((20, 36, 50)), rms_norm_eps=r.choice((1e-6, 1e-5)),
                   rope_theta=r.choice((10000.0, 500.0)))
    platform = r.choice((*PLATFORMS, *(f"{r.randint(1, 12)},{norm}" for norm in ("bounds", "bounds_q99"))))
    known = {"libero": (7, 8), "aloha": (14, 14), "bridge": (7, 7)}
    d_action, d_state = known.get(platform, (r.randint(1, 9), r.randint(1, 9)))
    side, views, plain = 14 * r.choice((1, 2, 2, 3)), [f"cam{i}" for i in range(r.randint(1, 3))], platform != "aloha" and r.random() < 0.3
    train = r.choice((50, 50, 7, 100))
    checkpoint = Checkpoint(
        *towers, text, side, d_action, n_shard=r.choice((1, 3)), other_stats=r.choice(((), ("other",))),
        unmasked=r.choice((None, (), (d_action - 1,), tuple(i for i in range(d_action) if r.random() < 0.4))), d_state=r.choice((d_state, d_state, 0)),
        platform=platform, rank=r.choice((0, 0, 4, 20, 32)), steps=r.choice(((), (), (train, r.randint(1, min(train, 5))))), prefix=r.choice(("", "module.")))
    frames = {view: (side, side, "png") if plain else (r.randint(10, 90), r.randint(10, 90), r.choice(("png", "png", "jpg"))) for view in views}
    options = {"plain_images": True} if plain else {}
    return case(seed, frames, r.choice((*TEXTS, "", "Pick UP the <s> cube</s> \u2581", "<PAD>")), checkpoint,
                **options, **({"stats": STATISTICS} if checkpoint.other_stats else {}))


DRAWN = {"openvla_oft": draw}


# --- the reference --------------------------------------------------------------------------------------------------


def open_reference():
    """Puts the reference on the path.  Returns the modules of its evaluation and of its ALOHA client."""
    from transformers.models.llama import modeling_llama

    assert "is_causal=False" in inspect.getsource(modeling_llama.LlamaSdpaAttention), "transformers is not the authors' fork"
    data = ["prismatic.vla.datasets", "prismatic.vla.datasets.rlds", "prismatic.vla.datasets.rlds.utils", "prismatic.vla.datasets.rlds.utils.data_utils"]
    for name in (*data, "experiments.robot.aloha.real_env"):  # a loader of data sets, and a robot
        sys.modules.setdefault(name, types.ModuleType(name))
    sys.modules[data[-1]].NormalizationType = sys.modules["experiments.robot.aloha.real_env"].make_real_env = None
    utils = openvla.open_reference(REFERENCE, "moojink/openvla-oft", ("prismatic.models", "prismatic.vla", "prismatic.training"))
    from experiments.robot.aloha import aloha_utils

    return utils, aloha_utils


def state_constants(rows, norm, d_action, side):
    """In every module that has its own copy of them."""
    from prismatic.vla.constants import NormalizationType

    stated = {"NUM_ACTIONS_CHUNK": rows, "ACTION_DIM": d_action, "ACTION_PROPRIO_NORMALIZATION_TYPE": NormalizationType(norm),
              "NormalizationType": NormalizationType, "OPENVLA_IMAGE_SIZE": side}
    for name in ("prismatic.vla.constants", "prismatic.training.train_utils", "prismatic.models.action_heads", "prismatic.extern.hf.modeling_prismatic",
                 "experiments.robot.openvla_utils"):
        module = importlib.import_module(name)
        module.__dict__.update({key: value for key, value in stated.items() if hasattr(module, key)})


class Reference:
    def __init__(self, checkpoint, dtype):
        import torch

        self.utils, self.client = open_reference()
        from prismatic.extern.hf import processing_prismatic
        from prismatic.extern.hf.configuration_prismatic import OpenVLAConfig

        said = read_options(checkpoint)
        config = json.loads((checkpoint / "config.json").read_text())
        steps = [int(n) for n in said.get("diffusion_steps", "50,50").split(",")]
        parts = {name.name.split("--")[0]: name for name in checkpoint.glob("*--*_checkpoint.pt")}
        head = torch.load(parts["action_head"], weights_only=True)
        d_action, denoises = next(len(x) for name, x in head.items() if name.endswith("fc2.weight")), "noisy_action_projector" in parts
        rows, norm = PLATFORMS[said["platform"]] if said["platform"] in PLATFORMS else said["platform"].split(",")
        self.platform, self.plain, self.side = said["platform"], said.get("plain_images", False), config["image_sizes"][0]
        self.utils.torch = torch
        state_constants(int(rows), norm, d_action, self.side)
        kind = torch.float32 if dtype == "float32" else torch.bfloat16
        self.utils.AutoImageProcessor.register(OpenVLAConfig, processing_prismatic.PrismaticImageProcessor, exist_ok=True)
        model = openvla.opened(checkpoint, kind)
        self.wanted = wanted = types.SimpleNamespace(
            pretrained_checkpoint=str(checkpoint), use_l1_regression=not denoises, use_diffusion=denoises, num_diffusion_steps_train=steps[0],
            num_diffusion_steps_inference=steps[1], use_film="vision_backbone" in parts, use_proprio="proprio_projector" in parts, center_crop=True,
            num_images_in_input=len(said["views"]), unnorm_key=said.get("stats") or next(iter(model.norm_stats)))
        if wanted.use_film:
            wanted.lora_rank = next(len(x) for name, x in torch.load(parts["vision_backbone"], weights_only=True).items() if "lora_A" in name)
            model = self.utils._apply_film_to_vla(model, wanted)
            model.vision_backbone.to(kind)
        model.vision_backbone.set_num_images_in_input(wanted.num_images_in_input)
        self.model, self.processor = model.eval(), processing_prismatic.PrismaticProcessor.from_pretrained(checkpoint)
        d = model.llm_dim
        self.head = self.utils.get_action_head(wanted, d).to(kind)
        self.proprio = self.noisy = None
        if wanted.use_proprio:
            width = next(x.shape[1] for name, x in torch.load(parts["proprio_projector"], weights_only=True).items() if name.endswith("fc1.weight"))
            self.proprio = self.utils.get_proprio_projector(wanted, d, width).to(kind)
        if denoises:
            self.noisy = self.utils.get_noisy_action_projector(wanted, d).to(kind)
        self.utils.torch = types.SimpleNamespace(**{**vars(torch), "bfloat16": kind})  # to which they round pixels
        self.images, self.order = processing_prismatic.TVF, said["views"]
        self.config = types.SimpleNamespace(type="openvla_oft")

    def before(self, batch):
        """What a client of theirs sends."""
        frames = [(batch[f"observation.images.{view}"] * 255).round().byte().permute(1, 2, 0).numpy() for view in self.order]
        if self.platform == "aloha":
            frames = [self.client.resize_image_for_preprocessing(frame) for frame in frames]
        if not self.plain:
            frames = [self.utils.resize_image_for_policy(frame, self.side) for frame in frames]
        keys = ["full_image", *(f"wrist_image_{i}" for i in range(1, len(frames)))]
        return dict(zip(keys, frames, strict=True)) | {"state": batch["observation.state"].double().numpy(), "task": batch["task"]}

    def predict_action_chunk(self, batch, noise):
        """What their code leaves before it un-normalizes."""
        import torch

        observation = dict(batch)
        task, seen, model = observation.pop("task"), [], self.model
        undo = model._unnormalize_actions
        model._unnormalize_actions = lambda actions, key: seen.append(actions) or undo(actions, key)
        try:
            with given_noise(noise[0]):
                self.utils.get_vla_action(self.wanted, model, self.processor, observation, task, self.head, self.proprio, self.noisy, self.wanted.use_film)
        finally:
            model._unnormalize_actions = undo
        return torch.from_numpy(seen[0])[None]

    def after(self, chunk):
        """By the reference's own un-normalization, and gripper of LIBERO."""
        import torch
        from experiments.robot.robot_utils import invert_gripper_action, normalize_gripper_action

        rows = self.model._unnormalize_actions(chunk[0].float().numpy(), self.wanted.unnorm_key)
        if self.platform == "libero":
            rows = np.stack([invert_gripper_action(normalize_gripper_action(row, binarize=True)) for row in rows])
        return torch.from_numpy(rows)[None]


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16."""
    reference = Reference(Path(checkpoint), dtype)
    return reference, reference.before, reference.after


def described(checkpoint):
    return f"moojink/openvla-oft {COMMIT} with its fork of transformers"


class Recorder(Taps):
    """Listens to one run of predict_action: one pass of the language model, or one for each step of DDIM."""

    def __init__(self, reference):
        scheduler = getattr(reference.head, "noise_scheduler", None)
        super().__init__(scheduler.num_inference_steps if scheduler else 1)
        self.step = -1 if scheduler else 0
        self.reference, self.views, model = reference, {}, reference.model
        towers, language = model.vision_backbone, model.language_model.model
        towers = getattr(towers, "vision_backbone", towers)
        for name, tower in (("dino", towers.featurizer), ("siglip", towers.fused_featurizer)):
            for i in {0, len(tower.blocks) - 2}:
                self.after(tower.blocks[i], lambda x, name=f"{name}.blk.{i}": self.views.setdefault(name, []).append(x))
        self.after(model.projector, lambda x: self.put("projector_down", x.reshape(len(reference.order), -1, x.shape[-1])))
        if reference.proprio:
            self.before(reference.proprio, lambda x: self.put("state", x[0]))
            self.after(reference.proprio, lambda x: self.put("state_out", x))
        self.before(language.layers[0], self.on_sequence)
        for i in {0, len(language.layers) - 1}:
            self.after(language.layers[i], lambda x, i=i: self.seen(f"lm.blk.{i}", x))
        self.after(language.norm, lambda x: self.seen("lm.norm", x))
        head = reference.head.noise_predictor.mlp_resnet if scheduler else reference.head.model
        for module, name in ((head.layer_norm1, "in_norm"), (head.fc1, "in"), (head.layer_norm2, "out_norm"), (head.fc2, "out")):
            self.stepwise(module, f"head.{name}")
        for i, block in enumerate(head.mlp_resnet_blocks):
            self.stepwise(block, f"head.blk.{i}")
        self.scheduler = scheduler
        if scheduler:
            self.before(reference.noisy, lambda x: self.on_step())
            self.stepwise(reference.noisy, "noise_out")
            step = scheduler.step

            def stepped(*args, **kwargs):
                out = step(*args, **kwargs)
                self.put(f"step.{self.step}.x", out.prev_sample[0])
                return out

            scheduler.step = stepped
        prepare = model._prepare_input_for_action_prediction

        def prepared(ids, mask):
            self.put("tokens", ids[0])
            return prepare(ids, mask)

        model._prepare_input_for_action_prediction = prepared

    def on_step(self):
        self.step += 1

    def on_sequence(self, x):
        """What all steps of DDIM share ends in front of the time."""
        if not self.scheduler:
            self.put("prefix", x[0])
            return
        vision = self.reference.model.vision_backbone
        n_seen = 1 + vision.get_num_patches() * vision.get_num_images_in_input() + (self.reference.proprio is not None)
        self.put("prefix", x[0][:n_seen])
        self.at_step("sequence", x)

    def seen(self, name, x):
        self.at_step(name, x) if self.scheduler else self.put(name, x[0])

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        to_tensor, pixels = self.reference.images.to_tensor, []

        def seen(image):
            pixels.append(to_tensor(image))
            return pixels[-1]

        self.reference.images.to_tensor = seen
        try:
            self.put("chunk", self.reference.predict_action_chunk(batch, noise)[0])
        finally:
            self.reference.images.to_tensor = to_tensor
        self.put("pixels", torch.stack(pixels[::2]))  # one of each tower
        for name, parts in self.views.items():
            self.put(name, torch.cat(parts))
        if not self.scheduler:
            self.put("step.0.x", torch.from_numpy(self.taps["chunk"]))
        return self.taps
