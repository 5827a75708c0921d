# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.6: golden cases, random checkpoints in the authors' layout, and a reference put together from packages.

No package holds the authors' model.  The reference is SigLIP 2 and Qwen3 of transformers, the connector of torch, and the action head of
LeRobot's N1.7 without its self-attention over the features, by the authors' names of tensors.  Images go through LeRobot's copy of the
authors' transform and Pillow; numbers are normalized as the authors' processor does it, in double precision.
"""

import functools
import json
import re
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import gr00t
from .cases import LIBERO_FRAMES, backbone_folder, copy_tokenizer
from .draw import bfloat16
from .files import write_json
from .gr00t import POSE, HeadTaps, Robot, case, embodiment, head
from .parameters import decoder, linear, norm, siglip, tower
from .recorder import given_noise
from .train_tokenizer import EAGLE

N_MERGE = 60
TOKENS = {name: 256 + N_MERGE + i for i, name in enumerate(EAGLE)}
N_VOCAB = max(TOKENS.values()) + 1 + 3  # the embedding has rows behind the last token
ROOT = "backbone.model."
CONFIG = {
    "model_dtype": "bfloat16", "model_name": "nvidia/Eagle-Block2A-2B-v2", "backbone_model_type": "eagle", "model_revision": None,
    "tune_top_llm_layers": 4, "tune_llm": False, "tune_visual": False, "reproject_vision": False, "use_flash_attention": True,
    "load_bf16": True, "collator_overwrite_image_inputs": False, "eagle_collator": True, "backbone_trainable_params_fp32": True,
    "random_rotation_angle": None, "color_jitter_params": None, "use_albumentations_transforms": True, "formalize_language": True,
    "apply_sincos_state_encoding": False, "add_pos_embed": True, "attn_dropout": 0.2, "use_vlln": True, "use_alternate_vl_dit": True,
    "attend_text_every_n_blocks": 2, "num_inference_timesteps": 4, "noise_beta_alpha": 1.5, "noise_beta_beta": 1.0, "noise_s": 0.999,
    "num_timestep_buckets": 1000, "tune_projector": True, "tune_diffusion_model": True, "tune_vlln": True, "state_dropout_prob": 0.0,
    "state_additive_noise_scale": 0.0, "model_type": "Gr00tN1d6", "architectures": ["Gr00tN1d6"], "torch_dtype": "bfloat16"}


@dataclass(frozen=True)
class Checkpoint(gr00t.Checkpoint):
    CONFIG = CONFIG
    PROCESSOR_CLASS = "Gr00tN1d6Processor"
    N_VOCAB = N_VOCAB

    def backbone_shapes(self):
        v, t, at = self.vision, self.text, ROOT + "vision_model.vision_model."
        d, d_model, patch = v["hidden_size"], t["hidden_size"], v["patch_size"]
        out = siglip(at, d, v["intermediate_size"], v["num_hidden_layers"], patch, v["num_patches"])
        out[f"{at}embeddings.patch_embedding.weight"] = (d, 3 * patch**2)
        out |= {f"{at}head.probe": (1, 1, d), f"{at}head.attention.in_proj_weight": (3 * d, d), f"{at}head.attention.in_proj_bias": (3 * d,)}
        out |= linear(f"{at}head.attention.out_proj", d, d) | norm(f"{at}head.layernorm", d)
        out |= linear(f"{at}head.mlp.fc1", v["intermediate_size"], d) | linear(f"{at}head.mlp.fc2", d, v["intermediate_size"])
        out |= norm(f"{ROOT}mlp1.0", 4 * d) | linear(f"{ROOT}mlp1.1", d_model, 4 * d) | linear(f"{ROOT}mlp1.3", d_model, d_model)
        return out | self.language_shapes(ROOT + "language_model.model.")

    def value(self, name, shape, seed):
        x = super().value(name, shape, seed)
        return bfloat16(x + 1) if name == f"{ROOT}mlp1.0.weight" else x  # a norm by another name

    def write_backbone(self, folder):
        """The folder of the authors' code that holds the backbone's config, tokenizer and image processor."""
        copy_tokenizer("eagle", folder)
        vision = {"model_type": "siglip2_vision_model", "num_channels": 3, "hidden_act": "gelu_pytorch_tanh", "layer_norm_eps": 1e-6,
                  "window_size": 14, "full_attention_indexes": [1], "use_rope": False, "use_windows_attn": False} | self.vision
        write_json(folder / "config.json", {
            "architectures": ["Eagle3_VLForConditionalGeneration"], "model_type": "eagle_3_vl", "downsample_ratio": 0.5,
            "image_token_index": TOKENS["<IMG_CONTEXT>"], "mlp_connector_layers": 2, "select_layer": -1, "use_pixel_shuffle": True,
            "dynamic_image_size": False, "text_config": text_config(self.text), "vision_config": vision}, indent=2)
        write_json(folder / "preprocessor_config.json", {
            "image_processor_type": "Eagle3_VLImageProcessorFast", "do_resize": False, "do_rescale": True, "do_normalize": True,
            "image_mean": [0.5] * 3, "image_std": [0.5] * 3, "rescale_factor": 1 / 255}, indent=2)


def text_config(text):
    return {"architectures": ["Qwen3ForCausalLM"], "model_type": "qwen3", "vocab_size": N_VOCAB,
            "max_position_embeddings": 1024, "rope_theta": 1000000, "rope_scaling": None, "rms_norm_eps": 1e-6, "attention_bias": False,
            "tie_word_embeddings": True, "hidden_act": "silu", "bos_token_id": TOKENS["<|endoftext|>"],
            "eos_token_id": TOKENS["<|im_end|>"], "use_sliding_window": False} | text


# --- cases -----------------------------------------------------------------------------------------------------------


def vision(d, layers, heads, ff, side, patch=4):
    """side: of the square table of positions."""
    return tower(d, layers, heads, ff, num_patches=side**2, patch_size=patch)


def text(d, layers, heads, kv, d_head, ff):
    return decoder(d, layers, heads, kv, ff, d_head)


LETTERBOX = {"options": {"letterbox": True}}

CASES = {
    # Two cameras of different shapes, padded to squares, resized twice; a table of positions that grows; five of seven rows.
    "gr00t_n1_6/libero": case(61, {"image": (30, 42, "png"), "wrist_image": (38, 38, "png")}, "Open the middle drawer, please.", Checkpoint(
        "libero_panda", 2, Robot(("image", "wrist_image"), POSE | {"gripper": 2}, POSE | {"gripper": 1}, 5),
        vision(24, 3, 3, 40, 5), text(40, 5, 6, 2, 12, 56), head(3, (6, 4, 9), None, 20, 14, 11, 7),
        {"shortest_image_edge": 34, "crop_fraction": 0.95}), **LETTERBOX),
    # One oblong camera whose aspect is kept; a table of positions that shrinks along one side; percentiles, with numbers beyond them
    # and one that never moved; one key-value head; text blocks every third time; five steps.
    "gr00t_n1_6/aspect": case(62, {"front": (30, 60, "png")}, "push the plate slowly", Checkpoint(
        "oxe_widowx", 1, Robot(("front",), {"pose": 4, "pad": 1, "gripper": 1}, {"gripper": 1, "pose": 4}, 6, zero_spread=(2,)),
        vision(20, 2, 2, 36, 12), text(36, 4, 4, 1, 16, 48),
        head(4, (7, 3, 8), None, 18, 9, 7, 6, num_inference_timesteps=5, attend_text_every_n_blocks=3),
        {"shortest_image_edge": 32, "crop_fraction": 0.9}, percentiles=True),
        state=(0.5, -2.25, 0.1, 4.0, 0.03125, -3.5), options={"camera_size": "60x30"}),
    # Joints relative to the state; three cameras; the sizes that processor_config.json may state instead of an edge and a fraction.
    "gr00t_n1_6/relative": case(63, {"ego_view": (36, 36, "png"), "left": (36, 36, "png"), "right": (36, 36, "jpg")},
        "stack the green block on the yellow block", Checkpoint(
        "unitree_g1", 1, Robot(
            ("ego_view", "left", "right"), {"gripper": 1, "right_arm_joints": 4, "left_arm": 3, "waist": 2},
            {"gripper": 1, "right_arm": 4, "left_arm": 3}, 7, {"right_arm": "right_arm_joints", "left_arm": None}),
        vision(24, 2, 2, 40, 6), text(40, 3, 5, 5, 8, 52), head(3, (6, 5, 6), None, 22, 12, 10, 9),
        {"image_target_size": [26, 26], "image_crop_size": [22, 22]})),
    # Numbers so small that every eps shows; a frame that is enlarged; two words.
    "gr00t_n1_6/faint": case(64, {"camera": (12, 12, "png")}, "Go on", Checkpoint(
        "oxe_google", 1, Robot(("camera",), {"x": 1, "hand": 3}, {"x": 1, "hand": 2}, 3),
        vision(16, 2, 2, 24, 3), text(24, 4, 3, 1, 8, 32), head(3, (5, 2, 10), None, 14, 6, 5, 4),
        {"shortest_image_edge": 16, "crop_fraction": 0.9}, faint=True)),
    # Every way in which a key may be normalized, in one robot: ranges, percentiles apart, means and deviations, sines and cosines; poses
    # by rotation vectors relative to the state, with one range for all rows.
    "gr00t_n1_6/mixed": case(65, {"camera": (16, 16, "png")}, "wipe the table", Checkpoint(
        "behavior_r1_pro", 2, Robot(
            ("camera",), {"arm": 3, "hand": 2, "wrist_pose": 6, "base": 2}, {"base": 2, "hand_pose": 6, "hand": 2, "arm": 3}, 3,
            {"hand_pose": "wrist_pose", "arm": None}, poses={"hand_pose": "XYZ_ROTVEC"}, mean_std=("hand",), sin_cos=("arm",)),
        vision(16, 2, 2, 24, 3), text(24, 4, 3, 1, 8, 32), head(3, (5, 2, 10), None, 14, 18, 14, 4),
        {"shortest_image_edge": 16, "crop_fraction": 0.9})),
    # States of three moments, each a token of its own; joints relative to the newest.
    "gr00t_n1_6/history": case(66, {"camera": (16, 16, "png")}, "wipe the table", Checkpoint(
        "unitree_g1", 1, Robot(("camera",), {"hand": 1, "arm": 3}, {"arm": 3, "hand": 1}, 3, {"arm": None}, state_moments=(-4, -1, 0)),
        vision(16, 2, 2, 24, 3), text(24, 4, 3, 1, 8, 32), head(3, (5, 2, 10), None, 14, 6, 5, 4),
        {"shortest_image_edge": 16, "crop_fraction": 0.9})),
}


OPTIONS = {"embodiment": "libero_panda"}
FRAMES = LIBERO_FRAMES


def published(views, arch="gr00t_n1_6"):
    """The published size: 3.0 G parameters."""
    return gr00t.published(
        Checkpoint, views, "libero_panda", 2, vision(1152, 27, 16, 4304, 16, 14), text(2048, 28, 16, 8, 128, 6144) | {"vocab_size": 151680},
        head(16, (32, 32, 48), None, 1024, 128, 128, 50), {"shortest_image_edge": 256, "crop_fraction": 0.95})


# --- random configurations -------------------------------------------------------------------------------------------


def draw_release(r, robot, tower, text_sizes, head, side, crop, camera):
    parts = vision(*tower, r.randint(3, 9)), text(*text_sizes)
    image = {"shortest_image_edge": side + r.randint(-3, 3), "crop_fraction": crop}
    return Checkpoint("robot", 1, robot, *parts, head, image, percentiles=r.random() < 0.5)


DRAWN = {"gr00t_n1_6": functools.partial(gr00t.draw, "gr00t_n1_6", draw_release)}


# --- the reference ---------------------------------------------------------------------------------------------------


def described(checkpoint):
    import cv2
    import diffusers

    return (f"transformers Siglip2VisionModel and Qwen3ForCausalLM, LeRobot's GR00TN17ActionHead, embodiment {embodiment(checkpoint)}, "
            f"diffusers {diffusers.__version__}, cv2 {cv2.__version__}")


def network(checkpoint):
    """The modules by the authors' names, with the checkpoint's weights."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17ActionHead, GR00TN17Config
    from torch import nn
    from transformers import Qwen3Config, Qwen3ForCausalLM, Siglip2VisionConfig, Siglip2VisionModel

    config, eagle = (json.loads(p.read_text()) for p in (checkpoint / "config.json", backbone_folder(checkpoint) / "config.json"))
    names = ("hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads", "num_patches", "patch_size", "layer_norm_eps",
             "hidden_act", "num_channels")
    tower = Siglip2VisionConfig(**{k: eagle["vision_config"][k] for k in names}, attn_implementation="eager")
    language = {k: v for k, v in eagle["text_config"].items() if k not in ("architectures", "model_type")}
    language = Qwen3Config(**language | {"num_hidden_layers": config["select_layer"]}, attn_implementation="eager")
    wide, d = 4 * tower.hidden_size, language.hidden_size
    whole, inner = nn.Module(), nn.Module()
    whole.backbone, whole.action_head = nn.Module(), GR00TN17ActionHead(GR00TN17Config(**config))
    whole.backbone.model = inner
    inner.vision_model, inner.language_model = Siglip2VisionModel(tower), Qwen3ForCausalLM(language)
    inner.mlp1 = nn.Sequential(nn.LayerNorm(wide), nn.Linear(wide, d), nn.GELU(), nn.Linear(d, d))
    whole.load_state_dict(gr00t.stored_weights(checkpoint, ROOT), strict=True)
    return whole.float().eval(), config, eagle["image_token_index"]


class Reference:
    def __init__(self, checkpoint, dtype):
        import torch
        from transformers import PreTrainedTokenizerFast

        self.config = types.SimpleNamespace(type="gr00t_n1_6")
        self.model, self.head, self.image_token = network(checkpoint)
        self.robot = RobotNumbers(checkpoint)
        self.tokenizer = PreTrainedTokenizerFast(tokenizer_file=str(backbone_folder(checkpoint) / "tokenizer.json"))
        self.dtype = torch.float32
        self.patch = self.model.backbone.model.vision_model.config.patch_size
        if dtype == "published":
            self.dtype = torch.bfloat16
            self.model.to(torch.bfloat16)

    def before(self, batch):
        """What the processor makes of an observation."""
        import torch
        from PIL import Image

        images = []
        for view in self.robot.views:
            frame = (batch[f"observation.images.{view}"] * 255).round().byte().permute(1, 2, 0).numpy()
            image = self.robot.transform(frame)
            sides = [whole_tokens(n, 2 * self.patch) for n in image.shape[:2]]
            image = np.asarray(Image.fromarray(image).resize((sides[1], sides[0])))  # bicubic
            images.append((torch.from_numpy(image.copy()).permute(2, 0, 1).float() - 127.5) / 127.5)
        text = re.sub(r"[^\w\s]", "", batch["task"].lower())
        places = "".join(f"<image {i + 1}><img>{'<IMG_CONTEXT>' * (x[0].numel() // (2 * self.patch) ** 2)}</img>" for i, x in enumerate(images))
        prompt = f"<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n{text}{places}<|im_end|>\n"
        rows = self.robot.moments(batch["observation.state"].numpy())
        state = np.stack([self.robot.normalized(row, self.head["max_state_dim"]) for row in rows])
        return {"ids": torch.tensor([self.tokenizer(prompt)["input_ids"]]), "images": images, "state": torch.from_numpy(state)[None]}

    def features(self, ids, images):
        """images: (3, height, width) each; every one is seen alone."""
        import torch
        from torch.nn.functional import pixel_unshuffle

        model, squares = self.model.backbone.model, []
        for x in images:
            rows, columns = (n // self.patch for n in x.shape[1:])
            patches = x.unflatten(1, (rows, -1)).unflatten(3, (columns, -1)).permute(1, 3, 2, 4, 0).reshape(1, rows * columns, -1)
            seen = model.vision_model(patches.to(self.dtype), torch.ones(1, rows * columns, dtype=torch.long), torch.tensor([[rows, columns]]))
            grid = seen.last_hidden_state[0].T.reshape(1, -1, rows, columns)
            squares.append(pixel_unshuffle(grid, 2).flatten(2).transpose(1, 2)[0])
        embedded = model.language_model.model.embed_tokens(ids).clone()
        embedded[ids == self.image_token] = model.mlp1(torch.stack(squares)).flatten(0, 1)
        return model.language_model.model(inputs_embeds=embedded).last_hidden_state

    def predict_action_chunk(self, batch, noise):
        import torch
        from transformers import BatchFeature

        with given_noise(noise):
            seen = BatchFeature({"backbone_features": self.features(batch["ids"], batch["images"]),
                                 "backbone_attention_mask": torch.ones_like(batch["ids"], dtype=torch.bool),
                                 "image_mask": batch["ids"] == self.image_token})
            asked = BatchFeature({"state": batch["state"].to(self.dtype), "embodiment_id": torch.tensor([self.robot.index])})
            head = self.model.action_head  # whose own get_action() takes one moment of the state
            context, tokens = head.process_backbone_output(seen).backbone_features, head.state_encoder(asked.state, asked.embodiment_id)
            return head.get_action_with_features(context, tokens, asked.embodiment_id, seen, asked)["action_pred"]


def whole_tokens(side, unit):
    """The side that smart_resize makes of one, where areas are within its limits."""
    return max(unit, round(side / unit) * unit)


class RobotNumbers:
    """One robot of a checkpoint: its cameras, and its numbers in the processor's arithmetic."""

    def __init__(self, checkpoint):
        options = json.loads((checkpoint.parent / "convert.json").read_text())
        tag = options["embodiment"]
        self.settings = json.loads((checkpoint / "processor_config.json").read_text())["processor_kwargs"]
        self.statistics = json.loads((checkpoint / "statistics.json").read_text())[tag]
        self.index = json.loads((checkpoint / "embodiment_id.json").read_text())[tag]
        self.robot, self.letterbox = self.settings["modality_configs"][tag], options.get("letterbox", False)
        self.views, self.rows = self.robot["video"]["modality_keys"], len(self.robot["action"]["delta_indices"])
        self.d_action = sum(len(self.statistics["action"][key]["min"]) for key in self.robot["action"]["modality_keys"])

    def moments(self, state):
        """A row for each, the oldest first."""
        return state.reshape(len(self.robot["state"]["delta_indices"]), -1)

    def transform(self, frame):
        from lerobot.policies.groot.processor_groot import _transform_n1_7_image_for_vlm_albumentations as transform

        settings = {k: self.settings[k] for k in ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction")}
        if settings["image_target_size"] is None:
            settings["image_target_size"] = [settings["shortest_image_edge"]] * 2
        return transform(frame, letter_box_transform=self.letterbox, **settings)

    def parts(self, kind, numbers):
        """(key, statistics, whether by mean and deviation, the key's part of the numbers' last axis)."""
        at, config = 0, self.robot[kind]
        for key in config["modality_keys"]:
            table = {name: np.asarray(v) for name, v in self.statistics[kind][key].items()}
            n = table["min"].shape[-1]
            yield key, table, key in (config["mean_std_embedding_keys"] or ()), numbers[..., at : at + n]
            at += n

    def limits(self, table):
        return (table["q01"], table["q99"]) if self.settings["use_percentiles"] else (table["min"], table["max"])

    def normalized(self, state, width):
        out = []
        for key, table, by_deviation, x in self.parts("state", state):
            if self.settings["apply_sincos_state_encoding"] and key in (self.robot["state"]["sin_cos_embedding_keys"] or ()):
                out += [np.sin(x), np.cos(x)]
            elif by_deviation:
                out.append(np.where(table["std"] == 0, x, (x - table["mean"]) / np.where(table["std"] == 0, 1, table["std"])))
            else:
                low, high = self.limits(table)
                same = np.isclose(low, high)
                y = 2 * ((x - low) / np.where(same, 1, high - low)).astype(np.float32) - 1
                out.append(np.where(same, 0, np.clip(y, -1, 1) if self.settings["clip_outliers"] else y))
        out = np.concatenate(out).astype(np.float32)
        return np.pad(out, (0, width - out.size))

    def actions(self, chunk, state):
        """The robot's part of a chunk, and the state before its normalization -> what the robot does."""
        out = []
        states = {key: x for key, _, _, x in self.parts("state", self.moments(state)[-1])}
        configs = self.robot["action"]["action_configs"]
        for (key, table, by_deviation, x), how in zip(self.parts("action", chunk), configs, strict=True):
            relative = self.settings["use_relative_action"] and how["rep"] == "RELATIVE"
            low, high = self.limits(table)
            if relative:  # statistics of its own, which are never percentiles
                table = {name: np.asarray(v) for name, v in self.statistics["relative_action"][key].items()}
                low, high = table["min"], table["max"]
            if by_deviation:
                y = np.where(table["std"] == 0, x, x * table["std"] + table["mean"])
            else:
                y = (np.clip(x, -1, 1) + 1) / 2 * (high - low) + low
            if relative:
                reference = states[how["state_key"] or key]
                y = y + reference if how["type"] == "NON_EEF" else composed(reference, y)
            out.append(y)
        return np.concatenate(out, -1).astype(np.float32)


def composed(reference, poses):
    """Poses by rotation vectors, as seen from where the reference pose is."""
    from scipy.spatial.transform import Rotation

    turn, turns = Rotation.from_rotvec(reference[3:]), Rotation.from_rotvec(poses[:, 3:])
    return np.concatenate([turn.apply(poses[:, :3]) + reference[:3], (turn * turns).as_rotvec()], -1)


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16, noise included, as the authors' policy has it."""
    import torch

    reference, raw = Reference(Path(checkpoint), dtype), {}

    def before(batch):
        raw["state"] = batch["observation.state"].numpy()
        return reference.before(batch)

    def after(chunk):
        return torch.from_numpy(reference.robot.actions(chunk[0, : reference.robot.rows].numpy(), raw["state"]))[None]

    return reference, before, after


class Recorder(HeadTaps):
    def __init__(self, reference):
        self.reference, model = reference, reference.model
        super().__init__(model.action_head.num_inference_timesteps)
        self.views, inner = {}, model.backbone.model
        tower, language = inner.vision_model.vision_model, inner.language_model.model
        self.per_view("vision.patch_embed", tower.embeddings.patch_embedding)
        for i, block in enumerate(tower.encoder.layers):
            self.per_view(f"vision.blk.{i}", block)
        self.per_view("vision.post_norm", tower.post_layernorm)
        self.after(inner.mlp1, lambda x: self.put("connector", x))
        self.normed_language(language)
        self.action_head(model.action_head)

    def per_view(self, name, module):
        self.after(module, lambda x: self.views.setdefault(name, []).append(x.reshape(-1, x.shape[-1])))

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        self.put("tokens", batch["ids"][0])
        self.put("pixels", torch.stack(batch["images"]))
        self.image, self.n_front = batch["ids"][0] == self.reference.image_token, batch["state"].shape[1]
        chunk, robot = self.reference.predict_action_chunk(batch, noise)[0], self.reference.robot
        self.put(f"step.{self.step}.x", chunk)
        self.put("chunk", chunk[: robot.rows, : robot.d_action])  # what the robot gets of it
        for name, seen in self.views.items():
            self.put(name, torch.stack(seen))
        return self.taps
