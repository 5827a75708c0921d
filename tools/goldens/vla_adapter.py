# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""VLA-Adapter: golden cases, random fine-tunes in the authors' layout, and their own code as the reference.

The reference is in no package: VLA_ADAPTER_REFERENCE names a checkout of OpenHelix-Team/VLA-Adapter.  It needs transformers 4.40.1, tokenizers
0.19.1, timm 0.9.10, tensorflow-cpu 2.15 (their crop), numpy 1.26 and json-numpy beside torch, torchvision, gguf, safetensors and pillow.  The
transformers that they ask for is 4.40.1 with another Llama; Qwen2, and so its causal attention, is that of the release.

It runs as its users run it, get_vla_action of their evaluation with the prompt of `use_minivlm` and the crop, but for this:

* the size of images, and the literal torch.bfloat16 of its casts at inference, are those of the run.  In float32 nothing is rounded after
  head and projector were rounded as they were loaded, but the rotary tables of the Pro head are computed in bfloat16 as ever, since
  get_action_head casts its frequencies too: an angle is up to 3 away from that of float32;
* the towers are as narrow and shallow as the weights, as OpenVLA's (openvla.py);
* the head has a block for each layer of the language model: MLPResNet gets this number, for which 24 is a literal.

Other literals hold: 64 action queries, 512 rows of the task, 8 heads.  Their LIBERO and CALVIN constants are the same; what CALVIN's client
does with the gripper is cut out of evaluate_calvin.py, which imports a simulator.
"""

import ast
import importlib.machinery
import os
import random
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import bitvla, openvla
from .cases import TEXTS, Case, copy_tokenizer
from .draw import bfloat16, f32
from .files import bfloat16_bits, state_dict, write_archive, write_json
from .openvla import LM, Tower, read_options
from .parameters import decoder, linear, norm, parameter
from .parameters import statistics as random_statistics
from .recorder import Taps

REFERENCE, COMMIT = "VLA_ADAPTER_REFERENCE", "838a36d"
N_TOKEN = 376  # of the tokenizer, whose ids all have rows
N_QUERY, CHUNK = 64, 8
STATISTICS = {"libero": "libero_spatial_no_noops", "calvin": "calvin_abc_rlds"}
VIEWS = {"libero": ("image", "image2"), "calvin": ("rgb_static", "rgb_gripper")}
ROUNDED = [[0.485, 0.456, 0.406], [0.5] * 3], [[0.229, 0.224, 0.225], [0.5] * 3]  # to bfloat16: MEANS and STDS, in the published files


@dataclass(frozen=True)
class Checkpoint(openvla.Checkpoint):
    n_token: int = N_TOKEN
    d_state: int = 8
    is_pro: bool = False
    platform: str = "libero"
    step: str = "150000_"  # in the names of files; none on the hub
    prefixes: tuple = ("module.", "")  # of names in the files of the head and of the state's projector
    has_language_head: bool = True

    write_shards = bitvla.Checkpoint.write_shards

    @property
    def policy(self):
        return {"chunk_size": CHUNK, "max_action_dim": self.d_action}

    def shapes(self):
        """By the file that has them."""
        t, d, model = self.text, self.text["hidden_size"], super().shapes() | {"action_queries.weight": (N_QUERY, self.text["hidden_size"])}
        for i in range(t["num_hidden_layers"]):
            for part, n_head in (("q", t["num_attention_heads"]), ("k", t["num_key_value_heads"]), ("v", t["num_key_value_heads"])):
                model[f"{LM}layers.{i}.self_attn.{part}_proj.bias"] = (n_head * (d // t["num_attention_heads"]),)
        if not self.has_language_head:
            del model["language_model.lm_head.weight"]
        head = norm("model.layer_norm1", d * self.d_action) | linear("model.fc1", d, d * self.d_action)
        for i in range(t["num_hidden_layers"]):
            block = f"model.mlp_resnet_blocks.{i}."
            keys = ("k_self", "v_self", "k_adapter", "v_adapter", "k_task", "v_task") if self.is_pro else ("k_proj", "v_proj")
            for part in ("q_proj", *keys, "o_proj", "ffn.1"):
                head |= linear(block + part, d, d)
            head |= norm(f"{block}ffn.0", d) | {f"{block}gating_factor": (1,)} | (linear(f"{block}film_gen.0", 2 * d, d) if self.is_pro else {})
        head |= norm("model.layer_norm2", d) | linear("model.fc2", self.d_action, d)
        return {"model": model, "action_head": head, "proprio_projector": linear("fc1", d, self.d_state) | linear("fc2", d, d)}

    def value(self, file, name, shape, seed):
        """Scales of LayerScale and of the head's norms are near 1; gates are far from 0 and from 1."""
        known = name.replace("scale_factor", "norm.weight").replace("pos_embed", "position_embedding").replace("ffn.0", "norm")
        x = parameter(f"{file}.{known}", shape[1:] if shape[0] == 1 and len(shape) > 1 else shape, seed).reshape(shape)
        if name.endswith("gating_factor"):
            x = bfloat16(f32(0.5) + x)
        return x * f32(1 + 2**-10) if file == "proprio_projector" else x  # trained in float32: numbers that bfloat16 cannot hold

    def write(self, seed, folder):
        """Returns the parameter count."""
        folder, shapes = Path(folder), self.shapes()
        folder.mkdir(parents=True, exist_ok=True)
        copy_tokenizer("vla_adapter", folder)
        write_json(folder / "config.json", self.config(), indent=1)
        write_json(folder / "preprocessor_config.json", self.preprocessor(), indent=1)
        names = (STATISTICS[self.platform], *self.other_stats)
        write_json(folder / "dataset_statistics.json", {name: self.statistics(seed + i) for i, name in enumerate(names)}, indent=1)
        self.write_shards(shapes["model"], seed, folder)
        for file, prefix, bits in (("action_head", self.prefixes[0], bfloat16_bits), ("proprio_projector", self.prefixes[1], lambda x: x)):
            tensors = {prefix + name: bits(self.value(file, name, shape, seed)) for name, shape in shapes[file].items()}
            values, data = state_dict(tensors)
            write_archive(folder / f"{file}--{self.step}checkpoint.pt", values, data)
        return sum(int(np.prod(shape)) for part in shapes.values() for shape in part.values())

    def config(self):
        text = {"attention_dropout": 0.0, "bos_token_id": 0, "eos_token_id": 0, "hidden_act": "silu", "initializer_range": 0.02,
                "max_position_embeddings": 32768, "max_window_layers": 24, "model_type": "qwen2", "rms_norm_eps": 1e-6, "rope_theta": 1000000.0,
                "sliding_window": 32768, "tie_word_embeddings": not self.has_language_head, "torch_dtype": "bfloat16", "use_cache": True,
                "use_mrope": False, "use_sliding_window": False, "vocab_size": self.n_vocab}
        return super().config(0) | {"hf_llm_id": "", "llm_backbone_id": "qwen25-0_5b-extra", "norm_stats": {"elsewhere": {"action": {}}}, "pad_token_id": 0,
                                    "text_config": text | self.text}

    def preprocessor(self):
        """As published: means in full, and what they were rounded to, which holds."""
        means, stds = ROUNDED
        return super().preprocessor() | {"means": means, "stds": stds}

    def statistics(self, seed):
        """In float64, of which few are numbers of float32."""
        found = random_statistics(self.d_state, self.d_action, seed)
        out = {key: {k: (v.astype(np.float64) * 1.0000000123).tolist() for k, v in found[feature].items()}
               for key, feature in (("action", "action"), ("proprio", "observation.state"))}
        out["action"]["mask"] = [True] * 6 + [False]
        return out | {"num_transitions": 1000, "num_trajectories": 10}


FRAMES, OPTIONS = dict.fromkeys(VIEWS["libero"], (224, 224, "png")), {"platform": "libero", "plain_images": True}  # of the published size


def published(views=VIEWS["libero"], arch="vla_adapter"):
    """The size of VLA-Adapter/LIBERO-*-Pro but for the vocabulary."""
    return Checkpoint(Tower(1024, 24, 4096), Tower(1152, 27, 4304), decoder(896, 24, 14, 2, 4864), 224, is_pro=True)


def case(seed, text, checkpoint, views=(), frame=(), **options):
    """Frames of the network's size do not go through a JPEG, which then is up to the reference's client; those of another size (`frame`) do."""
    cameras, side = views or VIEWS[checkpoint.platform], checkpoint.side
    said = {"platform": checkpoint.platform, **({} if frame else {"plain_images": True}), **({"views": list(views)} if views else {}), **options}
    return Case(seed, dict.fromkeys(cameras, frame or (side, side, "jpg")), text, checkpoint, options=said)


CASES = {
    # Two cameras as published: 512 patches, so that the head's task rows are those of the image, and its action rows those of the queries.
    "vla_adapter/spatial": case(71, "Put the White Mug on the plate", Checkpoint(
        Tower(16, 2, 20), Tower(32, 2, 28), decoder(32, 2, 4, 2, 36), 224, step="")),
    # One camera and few patches: all rows are the task's, and only the state is left of the actions'. The head's other version.
    "vla_adapter/one_view": case(72, "open the middle drawer, then 1024 times 12345", Checkpoint(
        Tower(32, 3, 44), Tower(48, 4, 56), decoder(48, 3, 6, 3, 44), is_pro=True, n_shard=3, has_language_head=False), ("wrist",), (52, 36, "jpg")),
    # Three cameras of 169 patches: 5 of the queries are the task's too.
    "vla_adapter/pro": case(73, "fold the towel, 漢字 <|im_end|>", Checkpoint(
        Tower(16, 3, 36), Tower(16, 2, 24), decoder(32, 2, 2, 1, 28, rms_norm_eps=1e-5, rope_theta=10000.0), 182, is_pro=True,
        other_stats=("libero_goal_no_noops",)), ("a", "wrist_b", "wrist_c"), stats=STATISTICS["libero"]),
    # Another gripper and other cameras; the head shares its projections.
    "vla_adapter/calvin": case(74, "push the sliding door to the LEFT side", Checkpoint(
        Tower(48, 2, 60), Tower(32, 3, 36), decoder(40, 3, 5, 1, 28), 42, platform="calvin", prefixes=("", "module.")), frame=(50, 50, "png")),
}

# --- random configurations ------------------------------------------------------------------------------------------


def draw(seed):
    """A case from the seed: both heads, up to three cameras, so many patches that the rows of the task end before, at or behind the image's."""
    r = random.Random(f"vla_adapter {seed}")
    is_pro, kv = r.random() < 0.5, r.choice((1, 1, 2, 3))
    heads = kv * r.choice((1, 2, 4))
    d_model = next(heads * d_head for d_head in (8, 16, 24, 2, 4) if heads * d_head % (16 if is_pro else 8) == 0) if r.random() < 0.9 else 12 * heads
    towers = [Tower(16 * r.choice((1, 2, 3)), r.randint(2, 4), r.randint(10, 60)) for _ in range(2)]
    text = decoder(d_model, r.randint(1, 4), heads, kv, r.choice((20, 36, 50)), rms_norm_eps=r.choice((1e-6, 1e-5)),
                   rope_theta=r.choice((1e6, 1e4)))
    n_view = r.choice((1, 2, 2, 3))
    side = 14 * r.choice((1, 2, 3, 4, {1: 22, 2: 16, 3: 13}[n_view], {1: 24, 2: 17, 3: 14}[n_view]))
    others = r.choice(((), ("libero_goal_no_noops",)))
    checkpoint = Checkpoint(
        *towers, text, side, is_pro=is_pro, platform=r.choice(("libero", "calvin")), n_shard=r.choice((1, 1, 3)), step=r.choice(("", "150000_", "latest_")),
        prefixes=tuple(r.choice(("", "module.")) for _ in range(2)), has_language_head=r.random() < 0.5, other_stats=others)
    views = ("third_person", "wrist", "left_wrist")[:n_view] if n_view != 2 or r.random() < 0.5 else ()
    frame = (r.randint(12, 90), r.randint(12, 90), r.choice(("png", "png", "jpg"))) if r.random() < 0.6 else ()
    return case(seed, r.choice((*TEXTS, "", "Pick UP the <tool_call> cube<|im_start|>")), checkpoint, views, frame,
                **({"stats": STATISTICS[checkpoint.platform]} if others else {}))


DRAWN = {"vla_adapter": draw}


# --- the reference --------------------------------------------------------------------------------------------------


def open_reference():
    """Puts the reference on the path; packages whose __init__ imports what trains a policy get an empty one.  Returns the module of its evaluation."""
    if REFERENCE not in os.environ:
        raise SystemExit(f"error: {REFERENCE} is not set: give it the folder of a checkout of https://github.com/OpenHelix-Team/VLA-Adapter")
    root = Path(os.environ[REFERENCE])
    if "experiments.robot.openvla_utils" not in sys.modules:
        sys.path.insert(0, str(root))

        def package(name, **attributes):
            module = types.ModuleType(name)
            module.__spec__ = importlib.machinery.ModuleSpec(name, None, is_package=True)
            module.__path__ = [str(root / name.replace(".", "/"))]
            module.__dict__.update(attributes)
            sys.modules[name] = module

        for name in ("prismatic", "prismatic.extern", "prismatic.extern.hf", "prismatic.models", "prismatic.training", "prismatic.vla"):
            package(name)
        package("prismatic.models.film_vit_wrapper", FiLMedPrismaticVisionBackbone=object)
        from prismatic.vla.constants import NormalizationType

        package("prismatic.vla.datasets.rlds.utils.data_utils", NormalizationType=NormalizationType)
    from experiments.robot import openvla_utils

    return openvla_utils


def functions_of(file, *names):
    """Functions of a script, without running the rest of it."""
    tree, found = ast.parse(file.read_text()), {"np": np}
    tree.body = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in names]
    exec(compile(tree, str(file), "exec"), found)
    return [found[name] for name in names]


class Torch:
    """torch, where bfloat16 is the type of the run."""

    def __init__(self, kind):
        self.bfloat16 = kind

    def __getattr__(self, name):
        import torch

        return getattr(torch, name)


class Reference:
    def __init__(self, checkpoint, dtype):
        import torch

        utils = open_reference()
        from prismatic.extern.hf import modeling_prismatic, processing_prismatic
        from prismatic.extern.hf.configuration_prismatic import OpenVLAConfig
        from prismatic.models import action_heads

        kind = torch.float32 if dtype == "float32" else torch.bfloat16
        options, timm, shapes = read_options(checkpoint), modeling_prismatic.timm, openvla.sizes_of(checkpoint)
        for module in (utils, modeling_prismatic, action_heads):
            module.torch = torch
        utils.AutoImageProcessor.register(OpenVLAConfig, processing_prismatic.PrismaticImageProcessor, exist_ok=True)
        create, timm.create_model = timm.create_model, openvla.narrow(timm.create_model, shapes)
        try:
            model, info = modeling_prismatic.OpenVLAForActionPrediction.from_pretrained(checkpoint, torch_dtype=kind, output_loading_info=True)
        finally:
            timm.create_model = create
        tied = {"language_model.lm_head.weight"} if model.config.text_config.tie_word_embeddings else set()
        assert not {*info["missing_keys"]} - tied and not info["unexpected_keys"], info
        utils._load_dataset_stats(model, str(checkpoint))
        self.key, self.platform = options.get("stats") or next(iter(model.norm_stats)), options["platform"]
        files = str(checkpoint / "x")[:-2]
        self.wanted = types.SimpleNamespace(pretrained_checkpoint=files, use_l1_regression=True, center_crop=True, use_proprio=True,
                                            unnorm_key=self.key, num_open_loop_steps=CHUNK)
        head = torch.load(utils.find_checkpoint_file(files, "action_head"), weights_only=True)
        self.wanted.use_pro_version = any("k_self" in name for name in head)
        whole, n_layer = action_heads.MLPResNet, model.config.text_config.num_hidden_layers
        action_heads.MLPResNet = lambda num_blocks, **sizes: whole(num_blocks=n_layer, **sizes)
        try:
            self.head = utils.get_action_head(self.wanted, model.llm_dim).to(kind)
        finally:
            action_heads.MLPResNet = whole
        for module in self.head.modules():  # buffers stay as get_action_head casts them, and so do the tables made of them
            if isinstance(module, action_heads.RotaryPositionEmbedding):
                module.to(torch.bfloat16)
        self.proprio = utils.get_proprio_projector(self.wanted, model.llm_dim, 8).to(kind)
        self.model, self.processor = model.eval(), processing_prismatic.PrismaticProcessor.from_pretrained(checkpoint)
        utils.OPENVLA_IMAGE_SIZE = model.config.image_sizes[0]
        for module in (utils, modeling_prismatic, action_heads):
            module.torch = Torch(kind)
        self.utils, self.images, self.config = utils, processing_prismatic.TVF, types.SimpleNamespace(type="vla_adapter")
        self.unnormalize = model._unnormalize_actions
        model._unnormalize_actions = lambda actions, key: actions

    def before(self, batch):
        views = [name for name in batch if name.startswith("observation.images.")]  # the first is not the wrist's
        self.model.vision_backbone.set_num_images_in_input(len(views))
        self.wanted.num_images_in_input = len(views)
        frames = [(batch[name] * 255).round().byte().permute(1, 2, 0).numpy() for name in views]
        keys = ["full_image", *(f"wrist_{i}" for i in range(1, len(frames)))]
        return dict(zip(keys, frames, strict=True)) | {"state": batch["observation.state"].double().numpy(), "task": batch["task"]}

    def predict_action_chunk(self, batch, noise=None):
        """What their code leaves where nothing is un-normalized."""
        import torch

        observation = dict(batch)
        task = observation.pop("task")
        rows = self.utils.get_vla_action(self.wanted, self.model, self.processor, observation, task, self.head, self.proprio, use_minivlm=True)
        return torch.from_numpy(np.stack(rows))[None]

    def after(self, chunk):
        """By the reference's own un-normalization and gripper."""
        import torch

        rows, root = self.unnormalize(chunk[0].float().numpy(), self.key), Path(os.environ[REFERENCE])
        if self.platform == "calvin":  # vla_evaluation.py, DualSystemCalvinEvaluation.step
            rows[:, -1] = 1 - rows[:, -1]
            file = root / "vla-scripts/evaluate_calvin.py"
        else:
            file = root / "experiments/robot/robot_utils.py"
        normalize, invert = functions_of(file, "normalize_gripper_action", "invert_gripper_action")
        return torch.from_numpy(np.stack([invert(normalize(row, binarize=True)) for row in rows]))[None]


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16."""
    reference = Reference(Path(checkpoint), dtype)
    return reference, reference.before, reference.after


def described(checkpoint):
    return f"OpenHelix-Team/VLA-Adapter {COMMIT}"


class Recorder(Taps):
    """Listens to one run of predict_action."""

    def __init__(self, reference):
        super().__init__(1)
        self.reference, self.step, self.views, model = reference, 0, {}, reference.model
        towers, language, head = model.vision_backbone, model.language_model.model, reference.head.model
        for name, tower in (("dino", towers.featurizer), ("siglip", towers.fused_featurizer)):
            last = f"{name}.blk.{len(tower.blocks) - 2}"  # whose patches are read
            self.after(tower.blocks[-2], lambda x, last=last: self.views.setdefault(last, []).append(x))
        self.before(language.layers[0], lambda x: self.kept("prefix", x))
        for i, layer in enumerate(language.layers):
            self.after(layer, lambda x, i=i: self.kept(f"lm.blk.{i}", x))
        self.after(language.norm, lambda x: self.kept("lm.norm", x))
        self.before(reference.proprio, lambda x: self.put("state", x[0]))
        self.after(reference.proprio, lambda x: self.put("state_out", x))
        parts = {"q_proj": "attn_q", "k_self": "attn_k", "v_self": "attn_v", "k_adapter": "actions.attn_k", "v_adapter": "actions.attn_v",
                 "k_task": "task.attn_k", "v_task": "task.attn_v", "o_proj": "attn_out", "ffn.0": "norm", "ffn.1": "linear"}
        for i, block in enumerate(head.mlp_resnet_blocks):
            self.after(block, lambda x, i=i: self.put(f"head.blk.{i}", x[0]))
            for module, name in parts.items() if i == 0 else ():
                if module in dict(block.named_modules()):
                    self.after(block.get_submodule(module), lambda x, name=name: self.put(f"head.blk.0.{name}", x[0]))
        self.after(head.layer_norm2, lambda x: self.at_step("head.out_norm", x))
        self.after(head.fc2, lambda x: self.at_step("head.out", x))
        prepare = model._prepare_input_for_action_prediction

        def prepared(ids, mask):
            self.put("tokens", ids[0])
            return prepare(ids, mask)

        model._prepare_input_for_action_prediction = prepared

    def kept(self, name, x):
        """Without the last query and the token that stops, which nothing reads."""
        self.put(name, x[0][:-2])

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        to_tensor, seen = self.reference.images.to_tensor, []

        def noted(image):
            seen.append(to_tensor(image))
            return seen[-1]

        self.reference.images.to_tensor = noted
        try:
            with torch.inference_mode():
                self.put("chunk", self.reference.predict_action_chunk(batch)[0])
        finally:
            self.reference.images.to_tensor = to_tensor
        self.put("pixels", torch.stack(seen[::2]))  # the same for both towers
        for name, x in self.views.items():
            self.put(name, torch.cat(x))
        self.put("step.0.x", torch.from_numpy(self.taps["chunk"]))
        return self.taps
