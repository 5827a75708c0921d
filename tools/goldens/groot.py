# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T as LeRobot saves it, `type: groot`: random checkpoints, and LeRobot's own classes as the reference.

N1.5 is in its releases up to 0.5.1, N1.7 in those from 0.6 on, so that the two take environments of their own: N1.5 was recorded with 0.4.4
and transformers 4.57.6.  config.json has the policy's settings; the network's sizes are those of base/, the policy that was fine-tuned.
States and actions are one vector each, normalized by the statistics of a data set, which a step of each pipeline has in a file.
"""

import contextlib
import functools
import importlib.metadata
import json
import random
import shutil
import tempfile
import types
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import numpy as np

from . import gr00t, gr00t_n1_5, gr00t_n1_7
from . import lerobot_layout as layout
from .cases import TEXTS, Case, backbone_folder
from .draw import bfloat16
from .files import bfloat16_bits, write_json, write_safetensors, write_stream
from .gr00t import Robot, head
from .gr00t_n1_6 import text
from .parameters import linear, norm, statistics
from .recorder import given_noise

PREFIX, REPO = "_groot_model.", "lerobot/eagle2hg-processor-groot-n1p5"
OPTIONS = {"base": "checkpoint/base"}
STATE, ACTION = "observation.state", "action"
# Of the template of Eagle 2.5: numbered places of images, which the processor fills.
TEMPLATE = (
    "{% set n = namespace(image=0) %}{% for message in messages %}{% if loop.first and message['role'] != 'system' %}"
    "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n{% endif %}<|im_start|>{{ message['role'] }}\n"
    "{% if message['content'] is string %}{{ message['content'] }}{% else %}{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}{% set n.image = n.image + 1 %}<image-{{ n.image }}>{% else %}{{ part['text'] }}{% endif %}{% endfor %}{% endif %}"
    "<|im_end|>\n{% endfor %}{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}")
# Fields of GrootConfig that no inference reads.
TRAINING = {"tune_llm": False, "tune_visual": False, "tune_projector": True, "tune_diffusion_model": True, "lora_rank": 0, "lora_alpha": 16,
            "lora_dropout": 0.1, "lora_full_model": False, "optimizer_lr": 1e-4, "optimizer_betas": [0.95, 0.999], "optimizer_eps": 1e-8,
            "optimizer_weight_decay": 1e-5, "warmup_ratio": 0.05, "use_bf16": True, "video_backend": "decord", "balance_dataset_weights": True,
            "balance_trajectory_weights": True, "dataset_paths": None, "output_dir": "./tmp/gr00t", "save_steps": 1000, "max_steps": 10000,
            "batch_size": 32, "dataloader_num_workers": 8, "report_to": "wandb", "resume": False}
MAPPING_N1_5 = {"new_embodiment": 2, "oxe_droid": 0, "gr1": 1}


@dataclass(frozen=True)
class Saved:
    """A policy of LeRobot.  A release adds own(), fields of its config.json, and steps(), of its pipelines."""

    base: object  # the Checkpoint of the authors' layout whose network it is, with `embeddings`, the names of the tied tables
    sizes: dict  # view -> (height, width)
    d_state: int
    d_action: int
    config: dict = field(default_factory=dict)  # other fields of config.json
    zero_spread: tuple = ()
    stored_head: bool = True  # of the tied tables the file has the language head's

    @property
    def policy(self):
        return {"chunk_size": self.base.head["action_horizon"], "max_action_dim": self.base.head["max_action_dim"]}

    def shapes(self):
        head, table = self.base.embeddings
        out = self.base.backbone_shapes() | self.base.head_shapes()
        return {head if self.stored_head and name == table else name: shape for name, shape in out.items()}

    def value(self, name, shape, seed):
        head, table = self.base.embeddings
        return self.base.value(table if name == head else name, shape, seed)

    def write(self, seed, folder):
        """Returns the parameter count."""
        folder = Path(folder)
        n = self.base.write(seed, folder / "base")
        shutil.rmtree(folder / "vlm", ignore_errors=True)
        (folder / "base/vlm").rename(folder / "vlm")
        for file in sorted((folder / "base").rglob("*")):
            if file.is_file() and file.name != "config.json":
                file.unlink()
        shapes = self.shapes()
        alias = {PREFIX + self.base.embeddings[1]: PREFIX + self.base.embeddings[0]} if self.stored_head else {}
        write_stream(folder / "model.safetensors", {PREFIX + name: ("BF16", shape) for name, shape in sorted(shapes.items())},
                     lambda name: bfloat16_bits(bfloat16(self.value(name[len(PREFIX):], shapes[name[len(PREFIX):]], seed))), {"format": "pt"} | alias)
        shown, actions = layout.features(self.sizes, self.d_state, self.d_action)
        common = {key: value for key, value in layout.COMMON.items() if key != "pretrained_revision"}  # which is younger than N1.5
        write_json(folder / "config.json", common | TRAINING | {
            "type": "groot", "input_features": shown, "output_features": actions, "embodiment_tag": "new_embodiment",
            "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}} | self.own() | self.config, indent=2)
        self.write_pipelines(folder, seed)
        return n

    def write_pipelines(self, folder, seed):
        numbers = statistics(self.d_state, self.d_action, seed, self.zero_spread)
        numbers = {f"{feature}.{name}": np.asarray(x, "<f4") for feature, table in numbers.items() for name, x in sorted(table.items())}
        for kind, steps in zip(("pre", "post"), self.steps(seed)):
            name, out = f"policy_{kind}processor", []
            for i, (step, config) in enumerate(steps):
                out.append({"registry_name": step, "config": config})
                if step in WITH_STATISTICS:
                    out[-1]["state_file"] = f"{name}_step_{i}_{step}.safetensors"
                    write_safetensors(folder / out[-1]["state_file"], numbers)
            write_json(folder / f"{name}.json", {"name": name, "steps": out}, indent=2)


WITH_STATISTICS = ("groot_pack_inputs_v3", "groot_action_unpack_unnormalize_v1", "groot_n1_7_pack_inputs_v1", "groot_action_unpack_unnormalize_v2")


@dataclass(frozen=True)
class Base15(gr00t_n1_5.Checkpoint):
    """With the tower's pooling head, which nothing reads and LeRobot's class has, and with all files of the processor."""

    embeddings = tuple(gr00t_n1_5.ROOT + "language_model." + name for name in ("lm_head.weight", "model.embed_tokens.weight"))

    def backbone_shapes(self):
        d, at = self.vision["hidden_size"], gr00t_n1_5.ROOT + "vision_model.vision_model.head."
        out = {at + "probe": (1, 1, d), at + "attention.in_proj_weight": (3 * d, d), at + "attention.in_proj_bias": (3 * d,)}
        out |= linear(at + "attention.out_proj", d, d) | norm(at + "layernorm", d)
        out |= linear(at + "mlp.fc1", self.vision["intermediate_size"], d) | linear(at + "mlp.fc2", d, self.vision["intermediate_size"])
        return super().backbone_shapes() | out

    def write_backbone(self, folder):
        super().write_backbone(folder)
        side = self.vision["image_size"]
        maps = {"AutoProcessor": "processing_eagle2_5_vl.Eagle25VLProcessor",
                "AutoImageProcessor": "image_processing_eagle2_5_vl_fast.Eagle25VLImageProcessorFast"}
        write_json(folder / "preprocessor_config.json", {
            "auto_map": maps, "crop_size": None, "do_center_crop": None, "do_convert_rgb": True, "do_normalize": True, "do_pad": False,
            "do_rescale": True, "do_resize": False, "image_mean": [0.5] * 3, "image_std": [0.5] * 3, "max_dynamic_tiles": 12, "min_dynamic_tiles": 1,
            "image_processor_type": "Eagle25VLImageProcessorFast", "pad_during_tiling": False, "processor_class": "Eagle25VLProcessor",
            "resample": 3, "rescale_factor": 1 / 255, "size": {"height": side, "width": side}, "tokens_per_tile": 256, "use_thumbnail": True}, indent=1)
        write_json(folder / "processor_config.json", {
            "auto_map": maps, "image_end_token": "</img>", "image_placeholder": "image", "image_start_token": "<img>", "image_token": "<IMG_CONTEXT>",
            "processor_class": "Eagle25VLProcessor", "tokens_per_tile": (side // self.vision["patch_size"]) ** 2, "video_placeholder": "video",
            "video_token": "<IMG_CONTEXT>", "vision_feature_select_strategy": None}, indent=1)
        write_json(folder / "chat_template.json", {"chat_template": TEMPLATE}, indent=1)


@dataclass(frozen=True)
class Saved15(Saved):
    pack: dict = field(default_factory=dict)  # other fields of the steps
    unpack: dict = field(default_factory=dict)

    def own(self):
        return {"chunk_size": 50, "n_action_steps": 50, "max_state_dim": self.base.head["max_state_dim"], "image_size": [224, 224],
                "max_action_dim": self.base.head["max_action_dim"], "base_model_path": "nvidia/GR00T-N1.5-3B", "tokenizer_assets_repo": REPO}

    def steps(self, seed):
        pack = {"state_horizon": 1, "action_horizon": 16, "max_state_dim": self.base.head["max_state_dim"],
                "max_action_dim": self.base.head["max_action_dim"], "language_key": "task", "formalize_language": False,
                "embodiment_tag": "new_embodiment", "embodiment_mapping": MAPPING_N1_5, "normalize_min_max": True} | self.pack
        unpack = {"env_action_dim": self.d_action, "normalize_min_max": True} | self.unpack
        own = {"tokenizer_assets_repo": REPO}
        return ([layout.rename({}), layout.BATCH, ("groot_pack_inputs_v3", pack), ("groot_eagle_encode_v3", own), ("groot_eagle_collate_v3", own),
                 layout.device()], [("groot_action_unpack_unnormalize_v1", unpack), layout.device()])


def n1_5(sizes, d_state, d_action, vision, text, head, **more):
    """sizes: of the cameras."""
    robot = Robot(tuple(sizes), {"state": d_state}, {"action": d_action}, head["action_horizon"])
    own = {key: more.pop(key) for key in ("n_future", "faint") if key in more}
    head = head | {"diffusion_model_cfg": head["diffusion_model_cfg"] | {"cross_attention_dim": text["hidden_size"]}}
    base = Base15("new_embodiment", 2, robot, vision, text, head, gr00t_n1_5.camera(32, 32), **own)
    return Saved15(base, sizes, d_state, d_action, **more)


@dataclass(frozen=True)
class Base17(gr00t_n1_7.Checkpoint):
    embeddings = ("backbone.model.lm_head.weight", "backbone.model.model.language_model.embed_tokens.weight")


@dataclass(frozen=True)
class Saved17(Saved):
    pack: dict = field(default_factory=dict)  # other fields of the steps
    encode: dict = field(default_factory=dict)
    unpack: dict = field(default_factory=dict)

    def own(self):
        return {"chunk_size": 40, "n_action_steps": 40, "max_state_dim": self.base.head["max_state_dim"], "max_action_dim": self.base.head["max_action_dim"],
                "base_model_path": "nvidia/GR00T-N1.7-3B", "action_decode_transform": None, "use_relative_actions": False, "relative_exclude_joints": [],
                "tune_vlln": True, "tune_top_llm_layers": 0, "num_inference_timesteps": None, "rtc_ramp_rate": None, "use_flash_attention": False,
                "model_params_fp32": True, "image_size": [256, 256], "tokenizer_assets_repo": None, "pretrained_revision": None}

    def steps(self, seed):
        pack = {"state_horizon": 1, "action_horizon": 40, "valid_action_horizon": 40, "video_horizon": None,
                "max_state_dim": self.base.head["max_state_dim"], "max_action_dim": self.base.head["max_action_dim"], "language_key": "task",
                "formalize_language": True, "embodiment_tag": "new_embodiment", "embodiment_mapping": {"libero_sim": 0, "new_embodiment": 1},
                "normalize_min_max": True, "state_dropout_prob": 0.0, "clip_outliers": True, "use_percentiles": False, "video_modality_keys": None,
                "raw_stats": None, "modality_config": None} | self.pack
        side = self.base.side
        encode = {"model_name": gr00t_n1_7.HUB_NAME, "image_crop_size": [side - 3] * 2, "image_target_size": [side] * 2, "shortest_image_edge": None,
                  "crop_fraction": None, "use_albumentations": False, "letter_box_transform": False, "device": "cpu"} | self.encode
        unpack = {"env_action_dim": self.d_action, "normalize_min_max": True, "clip_normalized_action": True, "libero_gripper_action": False,
                  "libero_gripper_binarize": True} | self.unpack
        return ([layout.rename({}), layout.BATCH, ("groot_n1_7_pack_inputs_v1", pack), ("groot_n1_7_vlm_encode_v1", encode), layout.device()],
                [("groot_action_unpack_unnormalize_v2", unpack), layout.device()])


@dataclass(frozen=True)
class SavedKeys(Saved17):
    """By GR00T's statistics, key by key."""

    @property
    def states(self):
        return self.base.robot.states

    def steps(self, seed):
        (before, after), robot = super().steps(seed), self.base.robot
        own = {"raw_stats": self.base.statistics(seed)[self.base.tag], "modality_config": gr00t.modalities(robot)}
        dict(before)["groot_n1_7_pack_inputs_v1"].update(own | {"video_modality_keys": list(robot.views), "video_horizon": 1})
        decode = own | {"env_action_dim": self.d_action, "use_percentiles": False, "use_relative_action": bool(robot.relative), "action_decode_transform": None}
        return before, [("groot_n1_7_action_decode_v1", decode), *after[1:]]


def n1_7_keys(sizes, robot, *parts, **more):
    plain = n1_7(sizes, sum(robot.states.values()), sum(robot.actions.values()), *parts, **more)
    return SavedKeys(**vars(plain) | {"base": replace(plain.base, robot=robot)})


def n1_7(sizes, d_state, d_action, vision, text, head, side, **more):
    robot = Robot(tuple(sizes), {"state": d_state}, {"action": d_action}, head["action_horizon"])
    image = {"image_target_size": [side] * 2, "image_crop_size": [side - 3] * 2}
    base = Base17("new_embodiment", 1, robot, vision, text, head, image, side, faint=more.pop("faint", False))
    return Saved17(base, sizes, d_state, d_action, **more)


def frames(sizes, suffix="png"):
    return {view: (*size, suffix) for view, size in sizes.items()}


WRIST, SIDE = {"wrist": (30, 40), "front": (30, 40)}, {"side": (33, 50), "front": (33, 50)}
CASES = {
    # Cameras that the policy sorts, shrunk in height and width by different factors; a text that a list of Python prints between other quotes;
    # numbers beyond their ranges, which nothing clips, one that never moved.
    "groot/n1_5": Case(91, frames(WRIST), "put the robot's cup\\bowl down", n1_5(
        WRIST, 6, 5, gr00t_n1_5.vision(24, 2, 3, 40, 28), text(40, 4, 4, 1, 16, 48), head(3, (4, 4, 8), (2, 5, 8), 18, 9, 8, 6),
        zero_spread=(2,)), state=(0.5, -2.25, 0.1, 4.0, 0.03125, -3.5), options=OPTIONS),
    # Frames that become squares, of which an odd rest is cut off; numbers beyond their ranges, which are clipped; five of eight rows, whose last
    # number has LIBERO's sign.
    "groot/n1_7": Case(92, frames(SIDE), "Close the bottom DRAWER, don't stop!", n1_7(
        SIDE, 8, 7, gr00t_n1_7.vision(24, 5, 3, 44, 5, (0, 2, 3)), gr00t_n1_7.text(40, 6, 6, 2, 12, 56, (2, 2, 2)),
        head(4, (4, 4, 9), (1, 5, 8), 20, 14, 11, 8), 32, config={"action_decode_transform": "libero", "n_action_steps": 5}, zero_spread=(1,)),
        state=(0.5, 0.25, 0.1, 4.0, 0.03125, -3.5, 1.0, -0.5), options=OPTIONS),
}


# --- random configurations -------------------------------------------------------------------------------------------


def draw_n1_5(r, sizes, d_state, d_action, tower, text_sizes, head, more):
    vision = gr00t_n1_5.vision(*tower, 14 * r.choice((1, 2, 3)), r.choice((7, 14)))
    return n1_5(sizes, d_state, d_action, vision, text(*text_sizes), head, n_future=r.randint(1, 6), **more)


def draw_n1_7(r, sizes, d_state, d_action, tower, text_sizes, head, more):
    side, deepstack = 8 * r.choice((2, 3, 4)), sorted(r.sample(range(tower[1]), 3))
    sections = {8: (2, 1, 1), 12: (2, 2, 2), 16: (4, 2, 2)}[text_sizes[4]]
    vision, text = gr00t_n1_7.vision(*tower, r.randint(3, 7), deepstack), gr00t_n1_7.text(*text_sizes, sections)
    edge, albumentations = r.choice((None, side, side + r.randint(-4, 9))), r.random() < 0.2
    crop = {"image_crop_size": [side - r.randint(0, 9)] * 2} if r.random() < 0.6 else {"image_crop_size": None, "crop_fraction": r.choice((0.8, 0.95, 1.0))}
    size = r.randint(12, 70)
    more |= {"encode": crop | {"shortest_image_edge": edge, "use_albumentations": albumentations, "letter_box_transform": r.random() < 0.3},
             "pack": {"clip_outliers": r.random() < 0.8, "formalize_language": r.random() < 0.8,
                      "video_modality_keys": r.sample(list(sizes), len(sizes)) if r.random() < 0.2 else None},
             "unpack": {"clip_normalized_action": r.random() < 0.8},
             "config": {"action_decode_transform": r.choice((None, None, "libero")), "n_action_steps": r.choice((40, 40, 3))}}
    return n1_7({view: (size, size) for view in sizes} if albumentations else sizes, d_state, d_action, vision, text, head, side, **more)


def draw_n1_7_keys(r, sizes, d_state, d_action, tower, text_sizes, head, more):
    """The same by GR00T's statistics: a gripper at either end, an arm that may be relative, of which the state has as many numbers."""
    drawn = draw_n1_7(r, sizes, d_state, d_action, tower, text_sizes, head | {"max_state_dim": 20, "max_action_dim": 20}, more)
    keys = {"arm": d_action, "gripper": 1} if r.random() < 0.5 else {"gripper": 1, "arm": d_action}
    more = {name: value for name, value in vars(drawn).items() if name in ("config", "stored_head", "encode")}
    more["pack"] = {"clip_outliers": drawn.pack["clip_outliers"], "formalize_language": drawn.pack["formalize_language"]}
    robot = Robot(tuple(sizes), {"rest": 2} | keys, keys, r.randint(1, head["action_horizon"]), {"arm": None} if r.random() < 0.5 else {})
    return n1_7_keys(drawn.sizes, robot, drawn.base.vision, drawn.base.text, drawn.base.head, drawn.base.side, **more)


RELEASES = {"n1_5": draw_n1_5, "n1_7": draw_n1_7, "n1_7_keys": draw_n1_7_keys}  # release -> what a random configuration has of its own


def draw(release, seed):
    """A case whose every size comes from the seed, by the statistics of a data set; frames are squeezed, and texts printed as a list."""
    r = random.Random(f"groot {release} {seed}")
    heads, kv, d_head = r.choice(((4, 2, 8), (3, 1, 12), (6, 3, 8), (5, 5, 8), (2, 2, 16)))
    vl_heads = r.choice((2, 3, 4))
    d_model, kept, vision_heads = vl_heads * 2 * r.choice((4, 5, 6)), r.choice((4, 5)), r.choice((1, 2, 3))
    d_state, d_action, size = r.randint(1, 14), r.randint(1, 14), (r.randint(12, 90), r.randint(12, 90))
    sizes = {view: size for view in r.sample(("front", "wrist", "cam_high", "Top", "hand", "left_wrist"), r.randint(1, 3))}
    vl = r.choice((1, 2, 3)), vl_heads, d_model // vl_heads
    last = head(kept, (r.randint(2, 7), r.choice((2, 3, 4)), 2 * r.choice((3, 4, 5))), vl, 2 * r.randint(4, 12), d_state + r.randint(0, 4),
                d_action + r.randint(0, 4), r.randint(1, 9), num_inference_timesteps=r.choice((1, 2, 4, 5)))
    tower = vision_heads * 4 * r.choice((2, 3, 4)), r.randint(3, 5), vision_heads, 2 * r.randint(8, 20)
    text_sizes = d_model, kept + r.randint(0, 2), heads, kv, d_head, r.choice((32, 50))
    more = {"zero_spread": (0,) if r.random() < 0.3 else (), "stored_head": r.random() < 0.5}
    drawn = RELEASES[release](r, sizes, d_state, d_action, tower, text_sizes, last, more)
    words = r.choice((*TEXTS, "the robot's \"cup\" \\ here", 'a "cup"', "a\u200bb\x7f\u00ad", "", "word " * 20))
    return Case(seed, frames(drawn.sizes, r.choice(("png", "png", "jpg"))), words, drawn, options=OPTIONS)


DRAWN = {f"groot_{release}": functools.partial(draw, release) for release in RELEASES}


# --- the reference ---------------------------------------------------------------------------------------------------


def described(checkpoint):
    import diffusers

    return f"lerobot.policies.groot.GrootPolicy of LeRobot {importlib.metadata.version('lerobot')}, diffusers {diffusers.__version__}"


@contextlib.contextmanager
def eagle_from(folder, repo):
    """LeRobot finds the backbone's config, code and processor in its cache, and the sizes of the network in base/ without weights."""
    import transformers
    from lerobot.policies.groot import groot_n1, processor_groot

    def without_weights(cls, **_):
        config = groot_n1.GR00TN15Config(**json.loads((folder.parent / "base/config.json").read_text()))
        return groot_n1.GR00TN15(config, local_model_path="").float()

    with tempfile.TemporaryDirectory() as cache, contextlib.ExitStack() as patches:
        for name in {repo, groot_n1.DEFAULT_TOKENIZER_ASSETS_REPO}:
            shutil.copytree(folder, Path(cache) / name, dirs_exist_ok=True)
            shutil.copytree(groot_n1.DEFAULT_VENDOR_EAGLE_PATH, Path(cache) / name, dirs_exist_ok=True)
            config = json.loads((folder / "config.json").read_text())
            maps = {"AutoConfig": "configuration_eagle2_5_vl.Eagle25VLConfig", "AutoModel": "modeling_eagle2_5_vl.Eagle25VLForConditionalGeneration"}
            write_json(Path(cache) / name / "config.json", config | {"auto_map": maps, "_attn_implementation": "eager"})
        for module in (groot_n1, processor_groot):
            patches.enter_context(mock.patch.object(module, "HF_LEROBOT_HOME", Path(cache)))
        patches.enter_context(mock.patch.object(groot_n1, "ensure_eagle_cache_ready", lambda *_: None))
        patches.enter_context(mock.patch.object(groot_n1.GR00TN15, "from_pretrained", classmethod(without_weights)))
        # The backbone demands flash-attention in its constructor; every tower here runs PyTorch's own attention.
        eager = lambda self, *args, **kwargs: "eager"  # noqa: E731
        patches.enter_context(mock.patch.object(transformers.PreTrainedModel, "_check_and_adjust_attn_implementation", eager))
        yield


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16."""
    is_eagle = (Path(checkpoint) / "vlm/processor_config.json").exists()
    return (load_n1_5 if is_eagle else load_n1_7)(Path(checkpoint), dtype)


@contextlib.contextmanager
def qwen_from(folder):
    """The sizes of the network are those of base/, without weights."""
    from lerobot.policies.groot import groot_n1_7

    def without_weights(cls, **given):
        kwargs = {name: given[name] for name in ("num_inference_timesteps", "rtc_ramp_rate") if name in given}
        config = groot_n1_7.GR00TN17Config(**json.loads((folder.parent / "base/config.json").read_text()) | kwargs)
        return groot_n1_7.GR00TN17(config, load_backbone_weights=False).float()

    with gr00t_n1_7.backbone_from(folder), mock.patch.object(groot_n1_7.GR00TN17, "from_pretrained", classmethod(without_weights)):
        yield


def load_n1_7(checkpoint, dtype):
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.groot.modeling_groot import GrootPolicy

    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.use_bf16, config.device = False, "cpu"
    with qwen_from(backbone_folder(checkpoint)):
        policy = GrootPolicy.from_pretrained(checkpoint, config=config).eval().to(torch.bfloat16 if dtype == "published" else torch.float32)
        before, after = make_pre_post_processors(config, str(checkpoint))
        for step in before.steps:
            getattr(step, "proc", None)  # built on first use
    robot = getattr(after.steps[0], "modality_config", None)
    return Reference17(policy, len(robot["action"]["delta_indices"]) if robot else None), before, after


def load_n1_5(checkpoint, dtype):
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.groot.modeling_groot import GrootPolicy

    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.use_bf16, config.device = False, "cpu"
    with eagle_from(backbone_folder(checkpoint), config.tokenizer_assets_repo):
        policy = GrootPolicy.from_pretrained(checkpoint, config=config).eval().to(torch.bfloat16 if dtype == "published" else torch.float32)
        policy._groot_model.compute_dtype = "bfloat16" if dtype == "published" else "float32"
        before, after = make_pre_post_processors(config, str(checkpoint))
        for step in before.steps:
            getattr(step, "proc", None)  # built on first use

    def row_by_row(chunk):
        """LeRobot hands the actions of a chunk over one by one."""
        return torch.stack([after(chunk[:, i].clone()) for i in range(chunk.shape[1])], 1)

    return Reference15(policy), before, row_by_row


class Reference15:
    """LeRobot's policy, with the noise given to it."""

    def __init__(self, policy):
        self.config, self.policy, self.model = types.SimpleNamespace(type="groot"), policy, policy._groot_model

    def predict_action_chunk(self, batch, noise):
        with given_noise(noise):
            return self.policy.predict_action_chunk(dict(batch)).float()


class Reference17(Reference15):
    """The same of N1.7, with the rows that its last step keeps."""

    def __init__(self, policy, n_row):
        super().__init__(policy)
        self.n_row = n_row

    def predict_action_chunk(self, batch, noise):
        return super().predict_action_chunk(batch, noise)[:, : self.n_row]


def Recorder(reference):
    return gr00t_n1_7.Recorder(reference) if isinstance(reference, Reference17) else Recorder15(reference)


class Recorder15(gr00t_n1_5.Recorder):
    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        self.put("tokens", batch["eagle_input_ids"][0])
        self.put("pixels", batch["eagle_pixel_values"])
        self.image = torch.zeros(batch["eagle_input_ids"].shape[1], dtype=torch.bool)  # all rows are looked at
        self.n_front = 1 + self.reference.model.action_head.future_tokens.num_embeddings
        get_action = self.reference.model.get_action

        def keep_whole(*args, **kwargs):
            out = get_action(*args, **kwargs)
            self.put(f"step.{self.step}.x", out["action_pred"][0])
            return out

        with mock.patch.object(self.reference.model, "get_action", keep_whole):
            self.put("chunk", self.reference.predict_action_chunk(batch, noise)[0])
        return self.taps
