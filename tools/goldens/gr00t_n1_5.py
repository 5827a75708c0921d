# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.5: golden cases, random checkpoints in the authors' layout, and a reference put together from packages.

LeRobot had the model up to 0.5 and dropped it.  The reference is SigLIP and Qwen3 of transformers and the parts of LeRobot's N1.7 head
that it shares with N1.5, by the authors' names of tensors; the future tokens and the solver's loop stand here.  Images are resized by
torchvision in float32 and numbers normalized as the authors' transforms do it.
"""

import functools
import json
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import gr00t
from .cases import LIBERO_FRAMES, backbone_folder, copy_tokenizer
from .files import write_json
from .gr00t import POSE, HeadTaps, Robot, case, embodiment, head
from .gr00t_n1_6 import N_VOCAB, TOKENS, text, text_config
from .parameters import linear, siglip, tower

ROOT = "backbone.eagle_model."
INDEX = 1  # of the robot among those of the weights
MODES = {"min_max": ("min", "max"), "q99": ("q01", "q99"), "mean_std": ("mean", "std")}
UNSCALED = {"binary": lambda x: (x > 0.5).astype(np.float32), "sin_cos": lambda x: np.concatenate([np.sin(x), np.cos(x)]), None: lambda x: x}


@dataclass(frozen=True)
class Checkpoint(gr00t.Checkpoint):
    """head: as N1.7's, taken apart when it is written; image: the size of a camera, the crop, the modes of states and actions."""

    CONFIG = {"model_name": "", "backbone_model_type": "eagle"}
    N_VOCAB = N_VOCAB
    n_future: int = 3

    @property
    def policy(self):
        return super().policy | {"chunk_size": self.robot.rows}

    def backbone_shapes(self):
        v, d_model = self.vision, self.text["hidden_size"]
        n_position = (v["image_size"] // v["patch_size"]) ** 2
        out = siglip(ROOT + "vision_model.vision_model.", v["hidden_size"], v["intermediate_size"], v["num_hidden_layers"],
                     v["patch_size"], n_position)
        out |= linear(f"{ROOT}mlp1.0", d_model, v["hidden_size"])
        return out | self.language_shapes(ROOT + "language_model.model.")

    def head_shapes(self):
        return super().head_shapes() | {"action_head.future_tokens.weight": (self.n_future, self.head["input_embedding_dim"])}

    def write(self, seed, folder):
        n = super().write(seed, folder)
        for name in ("processor_config", "statistics", "embodiment_id"):
            (Path(folder) / f"{name}.json").unlink()
        h = {k: v for k, v in self.head.items() if k not in ("select_layer", "max_action_dim")}
        h |= {"action_dim": self.head["max_action_dim"], "num_target_vision_tokens": self.n_future, "use_vlln": True, "add_pos_embed": True,
              "backbone_embedding_dim": self.text["hidden_size"], "num_timestep_buckets": 1000, "noise_s": 0.999}
        write_json(Path(folder) / "config.json", {
            "architectures": ["GR00T_N1_5"], "model_type": "gr00t_n1_5", "action_dim": h["action_dim"],
            "action_horizon": h["action_horizon"], "hidden_size": self.text["hidden_size"], "compute_dtype": "bfloat16",
            "torch_dtype": "bfloat16", "action_head_cfg": h | {"num_inference_timesteps": h.get("num_inference_timesteps", 4)},
            "backbone_cfg": {"select_layer": self.head["select_layer"], "project_to_dim": None, "reproject_vision": False,
                             "tune_llm": False, "tune_visual": True, "use_flash_attention": True, "load_bf16": False,
                             "eagle_path": "NVEagle/eagle_er-qwen3_1_7B-Siglip2_400M_stage1_5_128gpu_er_v7_1mlp_nops"}}, indent=1)
        width, height = self.image["camera"]
        view = {"resolution": [width, height], "channels": 3, "fps": 20.0}
        robots = {tag: {"statistics": {k: part[k] for k in ("state", "action")}, "embodiment_tag": tag,
                        "modalities": {"video": {name: view for name in self.robots[tag][1].views}, "state": {}, "action": {}}}
                  for tag, part in self.statistics(seed).items()}
        write_json(Path(folder) / "experiment_cfg/metadata.json", robots, indent=1)
        write_json(Path(folder) / "data_config.json", {
            "video": list(self.robot.views), "state": modes(self.robot.states, self.image["state"]),
            "action": modes(self.robot.actions, self.image["action"]), "horizon": self.robot.rows, "crop": self.image["crop"],
            "projector_index": INDEX}, indent=1)
        return n

    def processor_config(self):
        return {"processor_kwargs": dict.fromkeys((
            "image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction", "use_percentiles", "use_relative_action"))}

    def write_backbone(self, folder):
        """The folder of the authors' code that holds the backbone's config and tokenizer."""
        copy_tokenizer("eagle", folder)
        vision = {"model_type": "siglip_vision_model", "num_channels": 3, "hidden_act": "gelu_pytorch_tanh", "layer_norm_eps": 1e-6} | self.vision
        write_json(folder / "config.json", {
            "architectures": ["Eagle2_5_VLForConditionalGeneration"], "model_type": "eagle_2_5_vl", "downsample_ratio": 0.5,
            "image_token_index": TOKENS["<IMG_CONTEXT>"], "mlp_connector_layers": 1, "select_layer": -1, "use_pixel_shuffle": False,
            "text_config": text_config(self.text), "vision_config": vision}, indent=2)


def modes(keys, mode):
    """mode: of all keys, or a dictionary of them; a key that it leaves out passes as it is."""
    return {key: mode.get(key) for key in keys} if isinstance(mode, dict) else dict.fromkeys(keys, mode)


# --- cases -----------------------------------------------------------------------------------------------------------


def vision(d, layers, heads, ff, size, patch=14):
    return tower(d, layers, heads, ff, image_size=size, patch_size=patch)


def camera(width, height, state="min_max", action="min_max", crop=0.95):
    return {"camera": (width, height), "state": state, "action": action, "crop": crop}


def arm(*parts, **more):
    return case(*parts, options={"variant": "data_config.json"}, **more)


CASES = {
    # Two cameras of 4:3, cropped and squashed; a row less than the head's config says; numbers beyond their ranges, which nothing clips.
    "gr00t_n1_5/libero": arm(81, {"image": (30, 40, "png"), "wrist_image": (30, 40, "png")}, "Open the middle drawer, please.", Checkpoint(
        "my_arm", INDEX, Robot(("image", "wrist_image"), POSE | {"gripper": 2}, POSE | {"gripper": 1}, 5),
        vision(24, 3, 3, 40, 28), text(40, 5, 6, 2, 12, 56), head(3, (6, 4, 9), (2, 5, 8), 20, 14, 11, 6), camera(40, 30)), state=(0.5, -2.25, 0.1, 4.0, 0.03125, -3.5, 0.2, 0.3)),
    # Percentiles of states, means of actions; one camera that is enlarged; as many rows as the head's config says; eight steps.
    "gr00t_n1_5/percentiles": arm(82, {"front": (24, 24, "png")}, "push the plate slowly", Checkpoint(
        "my_arm", INDEX, Robot(("front",), {"pose": 4, "gripper": 1}, {"gripper": 1, "pose": 4}, 6),
        vision(20, 2, 2, 36, 42), text(36, 4, 4, 1, 16, 48), head(4, (5, 3, 8), (1, 3, 12), 18, 9, 7, 6, num_inference_timesteps=8),
        camera(24, 24, "q99", "mean_std", 0.9), n_future=5)),
    # Three cameras without a crop, a patch of seven pixels, one future token, no layers of self-attention over the features.
    "gr00t_n1_5/arms": arm(83, {"ego_view": (36, 48, "png"), "left": (36, 48, "png"), "right": (36, 48, "jpg")},
        "stack the green block on the yellow block", Checkpoint(
        "my_arm", INDEX, Robot(("ego_view", "left", "right"), {"left_arm": 3, "right_arm": 4}, {"left_arm": 3, "right_arm": 4}, 4),
        vision(24, 2, 2, 40, 21, 7), text(40, 3, 5, 5, 8, 52), head(3, (4, 5, 6), (3, 4, 10), 22, 12, 10, 7),
        camera(48, 36, "mean_std", "min_max", 1.0), n_future=1)),
    # Numbers so small that every eps shows; two words.
    "gr00t_n1_5/faint": arm(84, {"camera": (32, 32, "png")}, "Go on", Checkpoint(
        "my_arm", INDEX, Robot(("camera",), {"x": 1, "hand": 3}, {"x": 1, "hand": 2}, 3),
        vision(16, 2, 2, 24, 28), text(24, 4, 3, 1, 8, 32), head(3, (4, 2, 10), (1, 3, 8), 14, 6, 5, 4), camera(32, 32), faint=True)),
    # Every mode in which a key may be normalized, in one robot; numbers beyond their ranges; two rows more than the head's config says.
    "gr00t_n1_5/modes": arm(85, {"camera": (32, 32, "png")}, "wipe the table", Checkpoint(
        "my_arm", INDEX, Robot(("camera",), {"arm": 3, "hand": 2, "pose": 3, "grip": 2, "base": 1, "lift": 1},
                               {"base": 1, "grip": 2, "hand": 2, "pose": 2, "arm": 2}, 6),
        vision(16, 2, 2, 24, 28), text(24, 4, 3, 1, 8, 32), head(3, (4, 2, 10), (1, 3, 8), 14, 16, 11, 4),
        camera(32, 32, {"arm": "sin_cos", "hand": "mean_std", "pose": "q99", "grip": "binary", "lift": "min_max"},
               {"grip": "binary", "hand": "mean_std", "pose": "q99", "arm": "min_max"})),
        state=(0.5, -3.25, 2.5, 0.75, -2.0, 3.5, -4.0, 0.1, 0.75, 0.25, -1.5, 2.0)),
}


OPTIONS = {"variant": "data_config.json", "embodiment": "my_arm"}
FRAMES = LIBERO_FRAMES


def published(views, arch="gr00t_n1_5"):
    """The published size: 2.4 G parameters."""
    height, width = next(iter(views.values()))
    return gr00t.published(
        Checkpoint, views, "my_arm", INDEX, vision(1152, 27, 16, 4304, 224), text(2048, 28, 16, 8, 128, 6144) | {"vocab_size": 151680},
        head(12, (16, 32, 48), (4, 32, 64), 1024, 64, 32, 16), camera(width, height), n_future=32)


# --- random configurations -------------------------------------------------------------------------------------------


def draw_release(r, robot, tower, text_sizes, head, side, crop, size):
    parts = vision(*tower, 14 * r.choice((1, 2, 3)), r.choice((7, 14))), text(*text_sizes)
    how = {key: r.choice(("min_max", "q99", "mean_std", None)) for key in robot.states}
    return Checkpoint("robot", 1, robot, *parts, head, camera(size, size, how, how, crop), n_future=r.randint(1, 6))


DRAWN = {"gr00t_n1_5": functools.partial(gr00t.draw, "gr00t_n1_5", draw_release, variant="data_config.json")}


# --- the reference ---------------------------------------------------------------------------------------------------


def described(checkpoint):
    import diffusers

    return (f"transformers SiglipVisionModel and Qwen3ForCausalLM, parts of LeRobot's GR00TN17ActionHead, embodiment "
            f"{embodiment(checkpoint)}, diffusers {diffusers.__version__}")


def network(checkpoint, eagle):
    """The modules by the authors' names, with the checkpoint's weights."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17ActionHead, GR00TN17Config
    from torch import nn
    from transformers import Qwen3Config, Qwen3ForCausalLM, SiglipVisionConfig, SiglipVisionModel

    config = json.loads((checkpoint / "config.json").read_text())
    h = config["action_head_cfg"]
    language = {k: v for k, v in eagle["text_config"].items() if k not in ("architectures", "model_type")}
    language = Qwen3Config(**language | {"num_hidden_layers": config["backbone_cfg"]["select_layer"]}, attn_implementation="eager")
    tower = {k: v for k, v in eagle["vision_config"].items() if k != "model_type"}
    tower = SiglipVisionConfig(**tower, vision_use_head=False, attn_implementation="eager")
    whole, inner = nn.Module(), nn.Module()
    cross = {k: v for k, v in h["diffusion_model_cfg"].items() if k != "cross_attention_dim"}
    # As the authors' Gr00tPolicy._load_model: as many rows as the data config has, whatever the head's own config says.
    horizon = json.loads((checkpoint / "data_config.json").read_text())["horizon"]
    settings = h | {"action_horizon": horizon, "use_alternate_vl_dit": False, "max_action_dim": h["action_dim"], "state_history_length": 1, "diffusion_model_cfg": cross}
    whole.backbone, whole.action_head = nn.Module(), GR00TN17ActionHead(GR00TN17Config(**settings))
    whole.action_head.future_tokens = nn.Embedding(h["num_target_vision_tokens"], h["input_embedding_dim"])
    whole.backbone.eagle_model = inner
    inner.vision_model, inner.language_model = SiglipVisionModel(tower), Qwen3ForCausalLM(language)
    inner.mlp1 = nn.Sequential(nn.Linear(tower.hidden_size, language.hidden_size))
    stored = gr00t.stored_weights(checkpoint, ROOT)
    whole.load_state_dict({k: v for k, v in stored.items() if ".head." not in k}, strict=True)
    return whole.float().eval(), config


class Reference:
    def __init__(self, checkpoint, dtype):
        import torch
        from transformers import PreTrainedTokenizerFast

        folder = backbone_folder(checkpoint)
        eagle = json.loads((folder / "config.json").read_text())
        self.config = types.SimpleNamespace(type="gr00t_n1_5")
        self.model, self.settings = network(checkpoint, eagle)
        self.image_token, self.size = eagle["image_token_index"], eagle["vision_config"]["image_size"]
        self.n_view_token = (self.size // eagle["vision_config"]["patch_size"]) ** 2
        self.tokenizer, self.dtype = PreTrainedTokenizerFast(tokenizer_file=str(folder / "tokenizer.json")), torch.float32
        self.robot = json.loads((checkpoint / "data_config.json").read_text())
        self.statistics = json.loads((checkpoint / "experiment_cfg/metadata.json").read_text())[embodiment(checkpoint)]["statistics"]
        if dtype == "published":
            self.dtype = torch.bfloat16
            self.model.to(torch.bfloat16)

    def before(self, batch):
        """What the authors' transforms make of an observation."""
        import torch

        images = torch.stack([self.image(batch[f"observation.images.{view}"]) for view in self.robot["video"]])
        places = "".join(f"<image {i + 1}><img>{'<IMG_CONTEXT>' * self.n_view_token}</img>" for i in range(len(images)))
        prompt = ("<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n" + places + batch["task"]
                  + "<|im_end|>\n<|im_start|>assistant\n")
        state = np.concatenate([self.normalized(key, x) for key, x in self.parts("state", batch["observation.state"].numpy())])
        state = np.pad(state, (0, self.settings["action_head_cfg"]["max_state_dim"] - state.size)).astype(np.float32)
        return {"ids": torch.tensor([self.tokenizer(prompt)["input_ids"]]), "images": images, "state": torch.from_numpy(state)[None, None]}

    def image(self, frame):
        """frame: (3, height, width) in [0, 1], bytes divided by 255."""
        import torch
        from torchvision.transforms.v2 import functional

        sides = [int(n * self.robot["crop"]) for n in frame.shape[1:]]
        small = functional.resize(functional.center_crop(frame, sides), [self.size] * 2, antialias=True)
        return ((small * 255).to(torch.uint8).float() - 127.5) / 127.5

    def parts(self, kind, numbers):
        at = 0
        for key in self.robot[kind]:
            n = len(self.statistics[kind][key]["min"])
            yield key, numbers[..., at : at + n]
            at += n

    def limits(self, kind, key):
        return (np.asarray(self.statistics[kind][key][name], np.float32) for name in MODES[self.robot[kind][key]])

    def normalized(self, key, x):
        mode = self.robot["state"][key]
        if mode in UNSCALED:
            return UNSCALED[mode](x)
        low, high = self.limits("state", key)
        if mode == "mean_std":
            return np.where(high == 0, x, (x - low) / np.where(high == 0, 1, high))
        y = 2 * (x - low) / np.where(high == low, 1, high - low) - 1
        return np.clip(np.where(high == low, x, y), -1, 1) if mode == "q99" else np.where(high == low, 0, y)

    def actions(self, chunk):
        out = []
        for key, x in self.parts("action", chunk):
            mode = self.robot["action"][key]
            if mode in UNSCALED:
                out.append(UNSCALED[mode](x))
                continue
            low, high = self.limits("action", key)
            out.append(x * high + low if mode == "mean_std" else (x + 1) / 2 * (high - low) + low)
        return np.concatenate(out, -1).astype(np.float32)

    @property
    def columns(self):
        """Those of a chunk that the robot gets."""
        return slice(sum(len(self.statistics["action"][key]["min"]) for key in self.robot["action"]))

    def features(self, ids, images):
        inner = self.model.backbone.eagle_model
        embedded = inner.language_model.model.embed_tokens(ids).clone()
        embedded[ids == self.image_token] = inner.mlp1(inner.vision_model(images.to(self.dtype)).last_hidden_state).flatten(0, 1)
        return inner.language_model.model(inputs_embeds=embedded).last_hidden_state

    def predict_action_chunk(self, batch, noise, index=INDEX):
        import torch

        head, index = self.model.action_head, torch.tensor([index])
        with torch.inference_mode():
            context = head.vl_self_attention(head.vlln(self.features(batch["ids"], batch["images"])))
            state = head.state_encoder(batch["state"].to(self.dtype), index)
            x, n_step = noise.to(self.dtype), head.num_inference_timesteps
            assert x.shape[1] == head.action_horizon, "noise of another horizon than the network's"
            for k in range(n_step):
                time = torch.tensor([int(k / n_step * head.num_timestep_buckets)])
                action = head.action_encoder(x, time, index) + head.position_embedding.weight[: x.shape[1]]
                tokens = torch.cat([state, head.future_tokens.weight[None], action], dim=1)
                out = head.model(hidden_states=tokens, encoder_hidden_states=context, timestep=time)
                x = x + head.action_decoder(out, index)[:, -x.shape[1] :] / n_step
        return x


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16."""
    import torch

    reference = Reference(Path(checkpoint), dtype)
    return reference, reference.before, lambda chunk: torch.from_numpy(reference.actions(chunk[0].numpy()))[None]


class Recorder(HeadTaps):
    def __init__(self, reference):
        self.reference, model = reference, reference.model
        head, inner = model.action_head, model.backbone.eagle_model
        super().__init__(head.num_inference_timesteps)
        tower, language = inner.vision_model.vision_model, inner.language_model.model
        self.after(tower.embeddings.patch_embedding, lambda x: self.put("vision.patch_embed", x.flatten(2).transpose(1, 2)))
        for i, block in enumerate(tower.encoder.layers):
            self.after(block, lambda x, i=i: self.put(f"vision.blk.{i}", x))
        self.after(tower.post_layernorm, lambda x: self.put("vision.post_norm", x))
        self.after(inner.mlp1, lambda x: self.put("projector", x))
        self.normed_language(language)
        self.action_head(head)

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        self.put("tokens", batch["ids"][0])
        self.put("pixels", batch["images"])
        self.image = torch.zeros(batch["ids"].shape[1], dtype=torch.bool)  # all rows are looked at
        self.n_front = 1 + self.reference.model.action_head.future_tokens.num_embeddings
        chunk = self.reference.predict_action_chunk(batch, noise)[0]
        self.put(f"step.{self.step}.x", chunk)
        self.put("chunk", chunk[:, self.reference.columns])
        return self.taps
