# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""BitVLA: golden cases, random checkpoints in the authors' layout, and their own code as the reference.

The reference is in no package: BITVLA_REFERENCE names a folder with `transformers/src` and `openvla-oft` of ustcwhy/BitVLA.  It runs as
its users run it, in float32 but for two things: a product of ternary and 8-bit numbers is an exact sum of whole numbers, and the factor
of a ternary matrix is rounded to bfloat16, as it is in the published bfloat16.  That is what an integer kernel computes.

One code that is rounded the other way moves the whole chunk, and sums in another order are enough for it.  The seeds of these cases were
chosen so that every code is far from where it changes: `Recorder` asserts it.
"""

import importlib.machinery
import os
import random
import sys
import types
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .cases import Case, copy_tokenizer
from .draw import bfloat16, f32
from .files import bfloat16_bits, write_archive, write_json, write_stream, state_dict
from .parameters import decoder_layer, linear, mlp_resnet, parameter, rms_norm, siglip
from .parameters import statistics as random_statistics
from .recorder import Taps

REFERENCE = "BITVLA_REFERENCE"
N_TOKEN, IMAGE_TOKEN, STATE_TOKEN, STOP_TOKEN = 392, 386, 387, 377  # of the tokenizer
STATISTICS, STEP, PATCH, CHUNK = "libero_spatial_no_noops", 10000, 14, 8
MARGIN = 1e-4  # of a code from where it changes, in codes
TOWER, LM = "vision_tower.vision_model.", "language_model.model."


@dataclass(frozen=True)
class Checkpoint:
    vision: dict  # hidden_size, intermediate_size, num_hidden_layers, num_attention_heads, image_size
    text: dict  # and num_key_value_heads
    d_state: int = 8
    d_action: int = 7
    zero_spread: tuple = ()
    policy: dict = field(default_factory=lambda: {"chunk_size": CHUNK, "max_action_dim": 7})
    n_shard: int = 3
    prefixes: tuple = ("module.", "")  # of names in the files of the head and of the state's projector

    def shapes(self):
        """By the file that has them."""
        v, t = self.vision, self.text
        d, d_model, n_head = v["hidden_size"], t["hidden_size"], t["num_attention_heads"]
        model = siglip(TOWER, d, v["intermediate_size"], v["num_hidden_layers"], PATCH, (v["image_size"] // PATCH) ** 2)
        model |= linear("multi_modal_projector.linear_1", d_model, d) | linear("multi_modal_projector.linear_2", d_model, d_model)
        model |= {f"{LM}embed_tokens.weight": (N_TOKEN, d_model)} | rms_norm(f"{LM}norm", d_model)
        for i in range(t["num_hidden_layers"]):
            at = f"{LM}layers.{i}."
            model |= decoder_layer(at, d_model, t["intermediate_size"], n_head, t["num_key_value_heads"], d_model // n_head)
            model |= rms_norm(f"{at}self_attn.attn_sub_norm", d_model) | rms_norm(f"{at}mlp.ffn_sub_norm", t["intermediate_size"])
        return {"model": model, "action_head": mlp_resnet("model.", d_model * self.d_action, d_model, self.d_action),
                "proprio_projector": linear("fc1", d_model, self.d_state) | linear("fc2", d_model, d_model)}

    def value(self, file, name, shape, seed):
        x = parameter(f"{file}.{name}", shape, seed)
        if len(shape) == 1 and name.endswith("weight") and "norm" not in name:  # those of norms in a list
            x = bfloat16(x + 1)
        if name.endswith("layers.0.self_attn.v_proj.weight"):  # |W| is 1/32, 2/32 or 3/32 with mean 2/32: a quarter rounds from a half
            x = np.where(x < 0, f32(-1), f32(1)) * np.resize(f32([1, 2, 3, 2]), shape) / f32(32)
        return x * f32(1 + 2**-10) if file == "proprio_projector" else x  # trained in float32: numbers that bfloat16 cannot hold

    def write(self, seed, folder):
        """Returns the parameter count."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        copy_tokenizer("bitvla", folder)
        side, shapes = self.vision["image_size"], self.shapes()
        write_json(folder / "config.json", self.config(), indent=1)
        write_json(folder / "preprocessor_config.json", {
            "do_convert_rgb": None, "do_normalize": True, "do_rescale": True, "do_resize": True, "image_mean": [0.5] * 3,
            "image_processor_type": "SiglipImageProcessor", "image_std": [0.5] * 3, "processor_class": "LlavaProcessor", "resample": 3,
            "rescale_factor": 1 / 255, "size": {"height": side, "width": side}}, indent=1)
        write_json(folder / "processor_config.json", {
            "image_token": "<|image_pad|>", "num_additional_image_tokens": 0, "patch_size": PATCH, "processor_class": "LlavaProcessor",
            "vision_feature_select_strategy": "full"}, indent=1)
        write_json(folder / "dataset_statistics.json", {STATISTICS: self.statistics(seed)}, indent=1)
        self.write_shards(shapes["model"], seed, folder)
        for file, prefix, bits in (("action_head", self.prefixes[0], bfloat16_bits), ("proprio_projector", self.prefixes[1], lambda x: x)):
            tensors = {prefix + name: bits(self.value(file, name, shape, seed)) for name, shape in shapes[file].items()}
            values, data = state_dict(tensors)
            write_archive(folder / f"{file}--{STEP}_checkpoint.pt", values, data)
        return sum(int(np.prod(shape)) for part in shapes.values() for shape in part.values())

    def write_shards(self, shapes, seed, folder):
        names = sorted(shapes)
        if self.n_shard == 1:
            files = {"model.safetensors": names}
        else:
            files = {f"model-{i + 1:05}-of-{self.n_shard:05}.safetensors": names[i :: self.n_shard] for i in range(self.n_shard)}
            write_json(folder / "model.safetensors.index.json",
                       {"metadata": {}, "weight_map": {name: file for file, part in files.items() for name in part}})
        for file, part in files.items():
            write_stream(folder / file, {name: ("BF16", shapes[name]) for name in part},
                         lambda name: bfloat16_bits(self.value("model", name, shapes[name], seed)), {"format": "pt"})

    def config(self):
        vision = {"model_type": "siglip_vision_model", "hidden_act": "gelu_pytorch_tanh", "layer_norm_eps": 1e-6, "num_channels": 3,
                  "patch_size": PATCH, "attention_dropout": 0.0, "vision_use_head": False, "vit_weight_bits": 1, "vit_act_bits": 8,
                  "vit_weight_quant_method": "absmean", "vit_act_quant_method": "absmax_per_token", "_attn_implementation_autoset": True}
        text = {"model_type": "BitNet", "rms_norm_eps": 1e-5, "rope_theta": 500000.0, "vocab_size": N_TOKEN, "bos_token_id": 376,
                "eos_token_id": STOP_TOKEN, "max_position_embeddings": 512, "_attn_implementation_autoset": True}
        return {"architectures": ["BitVLAForActionPrediction"], "model_type": "bitvla", "vocab_size": N_TOKEN, "norm_stats": {},
                "image_token_index": IMAGE_TOKEN, "vision_feature_layer": -1, "vision_feature_select_strategy": "full",
                "projector_hidden_act": "gelu", "multimodal_projector_bias": True, "n_action_bins": 256, "torch_dtype": "bfloat16",
                "image_seq_length": (self.vision["image_size"] // PATCH) ** 2, "text_config": text | self.text,
                "vision_config": vision | self.vision}

    def statistics(self, seed):
        """In float64, of which few are numbers of float32."""
        found = random_statistics(self.d_state, self.d_action, seed)
        out = {key: {k: (v.astype(np.float64) * 1.0000000123).tolist() for k, v in found[feature].items()}
               for key, feature in (("action", "action"), ("proprio", "observation.state"))}
        out["action"]["mask"] = [True] * 6 + [False]
        return out | {"num_transitions": 1000, "num_trajectories": 10}


def case(seed, cameras, text, checkpoint, **options):
    """The reference is called behind its client, which is where images go through a JPEG."""
    frames = {camera: (side, side, "png") for camera in cameras for side in [checkpoint.vision["image_size"]]}
    return Case(seed, frames, text, checkpoint, options={"plain_images": True, **options})


def sizes(d, d_ff, n_layer, n_head, **others):
    return {"hidden_size": d, "intermediate_size": d_ff, "num_hidden_layers": n_layer, "num_attention_heads": n_head} | others


MICRO = Checkpoint(sizes(32, 48, 1, 2, image_size=28), sizes(32, 48, 1, 4, num_key_value_heads=1))
ONE_VIEW = Checkpoint(sizes(24, 40, 1, 3, image_size=42), sizes(40, 56, 1, 5, num_key_value_heads=5), n_shard=1)
TWO_LAYERS = Checkpoint(sizes(16, 24, 2, 2, image_size=28), sizes(24, 28, 2, 6, num_key_value_heads=2))
CASES = {
    "bitvla/micro": case(23, ("image", "image2"), "Put the white mug on the plate", MICRO),
    "bitvla/one_view": case(14, ("wrist",), "open the middle drawer, then 1024 times 12345", ONE_VIEW, views=["wrist"]),
    "bitvla/two_layers": case(18, ("image", "image2"), "fold the towel", TWO_LAYERS),
}

# --- random configurations ------------------------------------------------------------------------------------------


def draw(seed):
    """(case, spelling of the model's type): micro and tiny sizes, one view or two, files of one process and of several."""
    r = random.Random(seed)

    def tower(n_head, d_head, **others):
        return sizes(n_head * d_head, 4 * r.choice((6, 7, 12, 17, 68, 92)), r.randint(1, 3), n_head, **others)

    vision = tower(r.choice((1, 2, 3, 6)), r.choice((4, 8, 12, 24)), image_size=14 * r.choice((1, 2, 3, 4)))
    kv = r.choice((1, 2, 3))
    text = tower(kv * r.choice((1, 2, 4)), r.choice((4, 8, 16)), num_key_value_heads=kv)
    prefixes = tuple(r.choice(("", "module.")) for _ in range(2))
    checkpoint = Checkpoint(vision, text, n_shard=r.choice((1, 2, 3)), prefixes=prefixes)
    cameras = r.choice((("image", "image2"), ("wrist",)))
    options = {} if len(cameras) == 2 else {"views": list(cameras)}
    words = r.choice(("open the drawer", "Put the WHITE mug on the plate", "don't 12345 stop!", "naïve café 漢字", "a", "word " * 20))
    return case(seed, cameras, words, checkpoint, **options), r.choice(("bitvla", "openvla"))


DRAWN = {"bitvla": draw}


# --- the reference --------------------------------------------------------------------------------------------------


def open_reference():
    """Puts the reference on the path.  Packages whose __init__ imports what trains a policy get an empty one; nothing else changes."""
    if REFERENCE not in os.environ:
        raise SystemExit(f"error: {REFERENCE} is not set: give it the folder of a checkout of https://github.com/ustcwhy/BitVLA")
    root = Path(os.environ[REFERENCE])
    oft = root / "openvla-oft"
    if "bitvla" in sys.modules:
        return
    sys.path[:0] = [str(root / "transformers/src"), str(oft), str(oft / "bitvla")]

    def package(name, **attributes):
        module = types.ModuleType(name)
        module.__spec__ = importlib.machinery.ModuleSpec(name, None, is_package=True)
        module.__path__ = [str(oft / name.replace(".", "/"))]
        module.__dict__.update(attributes)
        sys.modules[name] = module

    for name in ("prismatic", "prismatic.models", "prismatic.vla", "prismatic.training", "prismatic.extern", "prismatic.extern.hf",
                 "diffusers", "diffusers.schedulers"):
        package(name)
    package("diffusers.schedulers.scheduling_ddim", DDIMScheduler=object)
    package("json_numpy", patch=lambda: None)
    for name, classes in {"configuration_prismatic": ["OpenVLAConfig"], "modeling_prismatic": ["OpenVLAForActionPrediction"],
                          "processing_prismatic": ["PrismaticImageProcessor", "PrismaticProcessor"]}.items():
        package("prismatic.extern.hf." + name, **dict.fromkeys(classes, object))
    package("prismatic.models.film_vit_wrapper", FiLMedPrismaticVisionBackbone=object)
    from prismatic.vla.constants import NormalizationType

    package("prismatic.vla.datasets.rlds.utils.data_utils", NormalizationType=NormalizationType)


def quantized(x, weight):
    """Codes and scales of both operands by the reference's formulas."""
    s = 127 / x.float().abs().max(dim=-1, keepdim=True).values.clamp_(min=1e-5)
    w = weight.float()
    inverse = 1.0 / w.abs().mean().clamp_(min=1e-5)
    return s, (x.float() * s).round().clamp(-128, 127), inverse, (w * inverse).round().clamp(-1, 1)


class Reference:
    def __init__(self, checkpoint, dtype):
        import torch

        open_reference()
        from bitvla import BitVLAForActionPrediction
        from experiments.robot import bitnet_utils, openvla_utils
        from transformers import LlavaProcessor

        self.exact, self.margin = dtype == "float32", 1.0
        kind = torch.float32 if self.exact else torch.bfloat16
        self.config = types.SimpleNamespace(type="bitvla")
        model, info = BitVLAForActionPrediction.from_pretrained(checkpoint, torch_dtype=kind, output_loading_info=True)
        unread = ("post_layernorm.weight", "post_layernorm.bias")
        assert not info["missing_keys"] and all(name.endswith(unread) for name in info["unexpected_keys"]), info
        openvla_utils._load_dataset_stats(model, str(checkpoint))
        model.set_constant(image_token_idx=IMAGE_TOKEN, proprio_pad_idx=STATE_TOKEN, ignore_idx=-100, action_token_begin_idx=STATE_TOKEN,
                           stop_index=STOP_TOKEN)
        wanted = types.SimpleNamespace(pretrained_checkpoint=str(checkpoint), use_l1_regression=True, use_diffusion=False)
        d_model = model.config.text_config.hidden_size
        self.head = openvla_utils.get_action_head(wanted, d_model).to(kind)
        self.proprio = openvla_utils.get_proprio_projector(wanted, d_model, 8).to(kind)
        self.model, self.processor = model.eval(), LlavaProcessor.from_pretrained(checkpoint)
        # The size of images is a literal there.
        bitnet_utils.BITNET_VLA_IMAGE_SIZE = openvla_utils.OPENVLA_IMAGE_SIZE = model.config.vision_config.image_size

    def exact_product(self, module, x):
        s, q, inverse, t = quantized(x, module.weight)
        self.margin = min(self.margin, ((x.float() * s - q).abs() - 0.5).abs().min().item())
        y = (q.double() @ t.double().T).float() * ((1 / inverse).bfloat16().float() / s)
        return y if module.bias is None else y + module.bias

    def before(self, batch):
        views = sorted(name for name in batch if name.startswith("observation.images."))  # the first is not the wrist's
        frames = [(batch[name] * 255).round().byte().permute(1, 2, 0).numpy() for name in views]
        keys = ["full_image", *(f"wrist_{i}" for i in range(1, len(frames)))]
        return dict(zip(keys, frames, strict=True)) | {"state": batch["observation.state"].double().numpy(), "task": batch["task"]}

    def run(self, batch):
        """Actions of the robot, before what its client does with the gripper."""
        from experiments.robot.bitnet_utils import get_bitnet_vla_action
        from transformers.models.llava import modeling_bitnet
        from transformers.models.siglip import modeling_siglip

        observation = dict(batch)
        task, n_view = observation.pop("task"), len(observation) - 1
        wanted = types.SimpleNamespace(num_images_in_input=n_view, center_crop=True, use_proprio=True, unnorm_key=STATISTICS,
                                       num_open_loop_steps=CHUNK)
        kinds = [(module.BitLinear, module.BitLinear.forward) for module in (modeling_bitnet, modeling_siglip)]
        for kind, _ in kinds if self.exact else []:
            kind.forward = lambda module, x: self.exact_product(module, x)
        actions = get_bitnet_vla_action(wanted, self.model, self.processor, observation, task, self.head, self.proprio)
        for kind, forward in kinds:
            kind.forward = forward
        return np.stack(actions)

    def after(self, chunk):
        """By the reference's own un-normalization and gripper."""
        import torch
        from experiments.robot.robot_utils import invert_gripper_action, normalize_gripper_action

        rows = self.model._unnormalize_actions(chunk[0].float().numpy(), STATISTICS)
        rows = np.stack([invert_gripper_action(normalize_gripper_action(row, binarize=True)) for row in rows])
        return torch.from_numpy(rows)[None]


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16."""
    reference = Reference(Path(checkpoint), dtype)
    return reference, reference.before, reference.after


def described(checkpoint):
    return "ustcwhy/BitVLA 3738a94, products of whole numbers, factors in bfloat16"


class Recorder(Taps):
    def __init__(self, reference):
        super().__init__(1)
        self.reference, self.step, model = reference, 0, reference.model
        tower, language, head = model.vision_tower.vision_model, model.language_model.model, reference.head.model
        self.before(tower.embeddings, lambda x: self.put("pixels", x))
        self.after(tower.embeddings.patch_embedding, lambda x: self.put("vision.patch_embed", x.flatten(2).transpose(1, 2)))
        for i, block in enumerate(tower.encoder.layers):
            self.after(block, lambda x, i=i: self.put(f"vision.blk.{i}", x))
            if i == 0:
                self.inner(block, f"vision.blk.{i}.", {
                    "layer_norm1": "attn_norm", "self_attn.q_proj": "attn_q", "self_attn.k_proj": "attn_k", "self_attn.v_proj": "attn_v",
                    "self_attn.out_proj": "attn_out", "layer_norm2": "ffn_norm", "mlp.fc1": "ffn_up", "mlp.fc2": "ffn_down"})
        self.after(model.multi_modal_projector, lambda x: self.put("connector_down", x))
        self.before(reference.proprio, lambda x: self.put("state", x[0]))
        self.after(reference.proprio, lambda x: self.put("state_out", x))
        self.before(language.layers[0], lambda x: self.put("prefix", x[0]))
        for i, layer in enumerate(language.layers):
            self.after(layer, lambda x, i=i: self.put(f"lm.blk.{i}", x[0]))
            if i == 0:
                self.inner(layer, f"lm.blk.{i}.", {
                    "input_layernorm": "attn_norm", "self_attn.q_proj": "attn_q", "self_attn.k_proj": "attn_k",
                    "self_attn.v_proj": "attn_v", "self_attn.attn_sub_norm": "attn_sub_norm", "self_attn.o_proj": "attn_out",
                    "post_attention_layernorm": "ffn_norm", "mlp.gate_proj": "ffn_gate", "mlp.up_proj": "ffn_up",
                    "mlp.ffn_sub_norm": "ffn_sub_norm", "mlp.down_proj": "ffn_down"})
        self.after(language.norm, lambda x: self.put("lm.norm", x[0]))
        self.after(head.layer_norm1, lambda x: self.at_step("head.in_norm", x))
        self.after(head.fc1, lambda x: self.at_step("head.in", x))
        for i, block in enumerate(head.mlp_resnet_blocks):
            self.after(block, lambda x, i=i: self.at_step(f"head.blk.{i}", x))
        self.after(head.layer_norm2, lambda x: self.at_step("head.out_norm", x))
        self.after(head.fc2, lambda x: self.at_step("head.out", x))
        prepare = model._prepare_input_for_action_prediction

        def prepared(ids, mask):
            self.put("tokens", ids[0])
            return prepare(ids, mask)

        model._prepare_input_for_action_prediction = prepared

    def inner(self, block, path, names):
        for module, name in names.items():
            self.after(block.get_submodule(module), lambda x, name=name: self.put(path + name, x if path[0] == "v" else x[0]))

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        with torch.inference_mode():
            actions = self.reference.run(batch)
        chunk = torch.from_numpy(self.taps["step.0.head.out"])
        assert np.array_equal(actions, self.reference.model._unnormalize_actions(chunk.numpy(), STATISTICS))
        assert not self.reference.exact or self.reference.margin > MARGIN, self.reference.margin
        self.put("step.0.x", chunk)
        self.put("chunk", chunk)
        return self.taps
