# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""SmolVLA: golden cases, random checkpoints in LeRobot's layout, and LeRobot's class as the reference."""

import random
from dataclasses import dataclass, field
from pathlib import Path

from . import lerobot_layout as layout
from .cases import MODES, TEXTS, Case, copy_tokenizer, draw_views
from .files import bfloat16_bits, write_json, write_stream
from .parameters import decoder, decoder_layer, linear, parameter, rms_norm, siglip, statistics, tower
from .recorder import ChunkRecorder

NAMES = {"smolvla": "lerobot.policies.smolvla.SmolVLAPolicy"}
HUB_NAME = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
N_TOKEN = 303  # of the tokenizer
VLM, EXPERT = "model.vlm_with_expert.vlm.", "model.vlm_with_expert.lm_expert."
CONFIG = {
    "chunk_size": 50, "n_action_steps": 50, "max_state_dim": 32, "max_action_dim": 32, "resize_imgs_with_padding": (512, 512),
    "normalization_mapping": layout.IDENTITY | {"STATE": "MEAN_STD", "ACTION": "MEAN_STD"}, "empty_cameras": 0,
    "adapt_to_pi_aloha": False, "use_delta_joint_actions_aloha": False, "tokenizer_max_length": 48, "num_steps": 10,
    "use_cache": True, "freeze_vision_encoder": True, "train_expert_only": True, "train_state_proj": True, "optimizer_lr": 1e-4,
    "optimizer_betas": [0.9, 0.95], "optimizer_eps": 1e-8, "optimizer_weight_decay": 1e-10, "optimizer_grad_clip_norm": 10,
    "scheduler_warmup_steps": 1000, "scheduler_decay_steps": 30000, "scheduler_decay_lr": 2.5e-6, "vlm_model_name": HUB_NAME,
    "load_vlm_weights": False, "add_image_special_tokens": False, "attention_mode": "cross_attn", "prefix_length": -1,
    "pad_language_to": "longest", "num_expert_layers": -1, "num_vlm_layers": 16, "self_attn_every_n_layers": 2,
    "expert_width_multiplier": 0.75, "min_period": 4e-3, "max_period": 4.0, "rtc_config": None, "compile_model": False,
    "compile_mode": "max-autotune"}
TEXT = {
    "attention_bias": False, "attention_dropout": 0.0, "bos_token_id": 1, "eos_token_id": 2, "hidden_act": "silu",
    "initializer_range": 0.02, "max_position_embeddings": 512, "mlp_bias": False, "model_type": "llama", "pad_token_id": 2,
    "pretraining_tp": 1, "rms_norm_eps": 1e-5, "rope_parameters": {"rope_theta": 100000.0, "rope_type": "default"},
    "tie_word_embeddings": False, "use_cache": True}
VISION = {"attention_dropout": 0.0, "hidden_act": "gelu_pytorch_tanh", "initializer_range": 0.02, "layer_norm_eps": 1e-6,
          "model_type": "smolvlm_vision", "num_channels": 3}


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of the backbone, what differs from SmolVLAConfig's defaults, features."""

    vision: dict
    text: dict
    factor: int
    policy: dict
    views: dict = field(default_factory=dict)  # view -> declared (height, width)
    d_state: int = 6
    d_action: int = 7
    n_vocab: int = N_TOKEN
    rename: dict = field(default_factory=dict)  # name in the data set -> name of the feature
    zero_spread: tuple = ()  # state numbers that never moved in the data: std 0, min = max

    @property
    def config(self):
        empty = layout.empty_cameras(self.policy.get("empty_cameras", 0), 480, 640)
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action, empty)
        return {"type": "smolvla"} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | CONFIG | self.policy

    @property
    def n_layer(self):
        cut = self.config["num_vlm_layers"]
        return cut if cut > 0 else self.text["num_hidden_layers"]

    @property
    def n_expert_layer(self):
        n = self.config["num_expert_layers"]
        return n if n > 0 else self.n_layer

    def is_cross(self, j):
        """Whether layer j of the expert projects its keys and values from the backbone's."""
        every = self.config["self_attn_every_n_layers"]
        return "cross" in self.config["attention_mode"] and not (every > 0 and j % every == 0)

    def shapes(self):
        v, t, c = self.vision, self.text, self.config
        d, d_expert = t["hidden_size"], int(t["hidden_size"] * c["expert_width_multiplier"])
        heads = t["num_attention_heads"], t["num_key_value_heads"], t["head_dim"]
        d_ff = 256 * -(-int(4 * int(2 * d_expert / 3)) // 256)
        n_position = (v["image_size"] // v["patch_size"]) ** 2
        out = siglip(f"{VLM}model.vision_model.", v["hidden_size"], v["intermediate_size"], v["num_hidden_layers"],
                     v["patch_size"], n_position)
        out |= linear(f"{VLM}model.connector.modality_projection.proj", d, v["hidden_size"] * self.factor**2, bias=False)
        out |= {f"{VLM}model.text_model.embed_tokens.weight": (self.n_vocab, d), f"{VLM}lm_head.weight": (self.n_vocab, d)}
        for i in range(self.n_layer):
            out |= decoder_layer(f"{VLM}model.text_model.layers.{i}.", d, t["intermediate_size"], *heads)
        for j in range(self.n_expert_layer):
            d_kv_in = heads[1] * heads[2] if self.is_cross(j) else d_expert
            out |= decoder_layer(f"{EXPERT}layers.{j}.", d_expert, d_ff, *heads, d_kv_in)
        out |= rms_norm(f"{VLM}model.text_model.norm", d) | rms_norm(f"{EXPERT}norm", d_expert)
        out |= linear("model.state_proj", d, c["max_state_dim"]) | linear("model.action_in_proj", d_expert, c["max_action_dim"])
        out |= linear("model.action_out_proj", c["max_action_dim"], d_expert)
        return out | linear("model.action_time_mlp_in", d_expert, 2 * d_expert) | linear("model.action_time_mlp_out", d_expert, d_expert)

    def dtype(self, name):
        """As published: towers in bfloat16; the projections and the cross layers' keys and values in float32."""
        if name.startswith(EXPERT) and ("k_proj" in name or "v_proj" in name):
            return "F32" if self.is_cross(int(name[len(EXPERT) :].split(".")[1])) else "BF16"
        return "BF16" if name.startswith((VLM, EXPERT)) else "F32"

    def write(self, seed, folder):
        """config.json, model.safetensors in the published dtypes, both pipelines, `vlm/`.  Returns the parameter count."""
        folder, c, shapes = Path(folder), self.config, self.shapes()
        write_json(folder / "config.json", c, indent=2)
        self.write_backbone(folder / "vlm")
        shown, actions, modes = c["input_features"], c["output_features"], c["normalization_mapping"]
        before = [layout.rename(self.rename), layout.BATCH, ("smolvla_new_line_processor", {}),
                  layout.tokenizer(HUB_NAME, c["tokenizer_max_length"], c["pad_language_to"]), layout.device(),
                  layout.normalizer("normalizer_processor", shown | actions, modes)]
        after = [layout.normalizer("unnormalizer_processor", actions, modes), layout.device()]
        layout.write_pipelines(folder, before, after, statistics(self.d_state, self.d_action, seed, self.zero_spread))

        def value(name):
            x = parameter(name, shapes[name], seed)
            return bfloat16_bits(x) if self.dtype(name) == "BF16" else x

        write_stream(folder / "model.safetensors", {n: (self.dtype(n), s) for n, s in sorted(shapes.items())}, value)
        return sum(map(layout.count, shapes.values()))

    def write_backbone(self, folder):
        """What the hub keeps in the backbone's repository, without weights: configuration, tokenizer, processor."""
        text, vision = TEXT | {"vocab_size": self.n_vocab} | self.text, VISION | self.vision
        write_json(folder / "config.json", {
            "image_token_id": self.n_vocab - 2, "model_type": "smolvlm", "pad_token_id": 2, "scale_factor": self.factor,
            "text_config": text, "tie_word_embeddings": False, "use_cache": True, "vision_config": vision}, indent=2)
        copy_tokenizer("smolvla", folder)


def published(views, arch="smolvla"):
    """The published size: 450 M parameters, 500 tensors."""
    vision = tower(768, 12, 12, 3072, image_size=512, patch_size=16)
    text = decoder(960, 32, 15, 5, 2560, 64, max_position_embeddings=8192)
    config = {name: CONFIG[name] for name in ("chunk_size", "max_action_dim")}
    config |= {"pad_language_to": "max_length", "prefix_length": 0, "num_expert_layers": 0}
    return Checkpoint(vision, text, 4, config, views, n_vocab=49280)


# --- cases -----------------------------------------------------------------------------------------------------------


def vision(d, layers, heads, ff, image, patch, eps=1e-6):
    return tower(d, layers, heads, ff, image_size=image, patch_size=patch, layer_norm_eps=eps)


def text(d, layers, heads, kv, d_head, ff, eps=1e-5):
    return decoder(d, layers, heads, kv, ff, d_head, rms_norm_eps=eps)


def policy(horizon, steps, size, width, **more):
    """size: (width, height) of the images that the network sees; width: of the expert, relative to the backbone."""
    return {"chunk_size": horizon, "n_action_steps": horizon, "num_steps": steps, "resize_imgs_with_padding": size,
            "expert_width_multiplier": width, **more}


CASES = {
    # Two views, both shrunk; one language layer cut off; attention wider than the model (6 x 12 against 48).
    "smolvla/two_views": Case(1, {"camera1": (40, 90, "png"), "camera2": (75, 52, "png")}, "open the middle drawer", Checkpoint(
        vision(36, 2, 3, 60, 32, 8), text(48, 4, 6, 2, 12, 56), 2,
        policy(5, 4, (32, 32), 0.75, num_vlm_layers=3, max_state_dim=8, max_action_dim=8, tokenizer_max_length=24,
               pad_language_to="max_length"), {"camera1": (40, 90), "camera2": (75, 52)})),
    # Three views of three aspects, one a JPEG file; an instruction beyond the bucket; self attention every third layer;
    # one key-value head; patch columns (3 * 7 * 7) that no vector width divides.
    "smolvla/long_text": Case(2, {"top": (20, 27, "png"), "wrist": (53, 53, "jpg"), "side": (64, 37, "png")},
                              "put the black bowl on top of the stove, then close the bottom drawer of the cabinet", Checkpoint(
        vision(40, 3, 5, 56, 28, 7), text(40, 4, 5, 1, 8, 48), 2,
        policy(7, 3, (28, 28), 0.6, num_vlm_layers=4, self_attn_every_n_layers=3, max_state_dim=16, max_action_dim=16,
               tokenizer_max_length=12, pad_language_to="longest"),
        {"top": (20, 27), "wrist": (53, 53), "side": (64, 37)}, d_state=14, d_action=14)),
    # The second of three views is absent, and so is the one that empty_cameras adds; features not in alphabetical order; ranges and
    # quantiles instead of means; a prefix padded at its end; an expert as wide as the backbone; other periods of the time embedding.
    "smolvla/absent_view": Case(3, {"wrist": (31, 60, "png"), "front": None, "base": (45, 45, "png"), "empty_camera_0": None},
                                "push the plate", Checkpoint(
        vision(32, 1, 2, 64, 32, 8), text(32, 3, 4, 2, 8, 48, 1e-6), 2,
        policy(9, 6, (32, 32), 1.0, num_vlm_layers=2, empty_cameras=1, prefix_length=60, max_state_dim=4,
               max_action_dim=4, tokenizer_max_length=16, pad_language_to="max_length", min_period=2e-3, max_period=8.0,
               normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MIN_MAX", "ACTION": "QUANTILES"}),
        {"wrist": (31, 60), "front": (31, 60), "base": (45, 45)}, d_state=3, d_action=4,
        rename={"observation.images.left": "observation.images.base"})),
    # Half as many expert layers as language layers, three query heads per key-value head; a 4 x 4 grid of patches read
    # from a 6 x 6 table of positions.
    "smolvla/sparse_expert": Case(4, {"camera": (44, 26, "png")}, "close drawer 42!", Checkpoint(
        vision(30, 2, 5, 60, 48, 8, 1e-5), text(36, 4, 9, 3, 4, 72), 2,
        policy(6, 5, (32, 32), 0.5, num_vlm_layers=4, num_expert_layers=2, self_attn_every_n_layers=4, max_state_dim=10,
               max_action_dim=6, tokenizer_max_length=20, pad_language_to="max_length"), {"camera": (44, 26)}, d_state=10,
        d_action=6)),
    # One view that needs no resizing, a 6 x 6 grid, pixel shuffle by 3, ten steps; a state number that never moved in the
    # data; an instruction that already ends its line and is not plain English.
    "smolvla/one_view": Case(5, {"camera1": (48, 48, "png")}, "Öffne die Schublade 12, bitte: 开抽屉\n", Checkpoint(
        vision(36, 2, 4, 44, 48, 8), text(48, 3, 3, 3, 16, 36), 3,
        policy(8, 10, (48, 48), 0.5, num_vlm_layers=3, max_state_dim=8, max_action_dim=8, tokenizer_max_length=64,
               pad_language_to="max_length"), {"camera1": (48, 48)}, d_state=5, d_action=3, zero_spread=(2,))),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(seed):
    """A case whose every size comes from the seed."""
    r = random.Random(seed)
    factor, patch = r.choice((1, 2, 2, 3)), r.choice((4, 5, 6, 8, 14))
    grid = factor * r.choice((1, 2, 2, 3))
    table = grid if r.random() < 0.7 else grid + r.choice((1, 2))
    vision_heads, kv = r.choice((1, 2, 3, 5)), r.choice((1, 2, 3))
    heads = kv * r.choice((1, 2, 3))
    d_model = heads * r.choice((8, 12, 16) if heads % 2 == 0 else (8, 16, 24))
    n_layer, n_cut = r.choice((1, 2, 3, 4, 6)), r.choice((0, 0, 1))
    n_expert, every = -1, r.choice((2, 2, 2, 3, 4, 1, 0, -1))
    if n_layer % 2 == 0 and r.random() < 0.3:
        n_expert, every = n_layer // 2, n_layer if r.random() < 0.5 else 2
    width = r.choice((0.5, 0.75, 1.0, 0.25))
    n_empty, d_state, d_action = r.choice((0, 0, 1)), r.randint(1, 14), r.randint(1, 14)
    views, frames = draw_views(r, n_empty)
    settings = policy(
        r.randint(1, 12), r.choice((1, 2, 5, 10)), (grid * patch, grid * patch), width if d_model * width % 2 == 0 else 1.0,
        num_vlm_layers=n_layer, num_expert_layers=n_expert, self_attn_every_n_layers=every, empty_cameras=n_empty,
        max_state_dim=max(d_state, r.choice((8, 16, 32))), max_action_dim=max(d_action, r.choice((8, 16, 32))),
        tokenizer_max_length=r.choice((8, 24, 48)), pad_language_to=r.choice(("longest", "max_length")),
        prefix_length=r.choice((-1, 0, 90)), attention_mode=r.choice(("cross_attn",) * 5 + ("self_attn",)),
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)},
        min_period=r.choice((4e-3, 1e-3)), max_period=r.choice((4.0, 2.0)))
    seen = vision(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)), table * patch, patch)
    language = text(d_model, n_layer + n_cut, heads, kv, r.choice((4, 6, 8, 16, 32)), r.choice((32, 50)))
    checkpoint = Checkpoint(seen, language, factor, settings, views, d_state, d_action)
    return Case(seed, frames, r.choice(TEXTS), checkpoint)


DRAWN = {"smolvla": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor); published: the dtypes of published files."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    folder = str(checkpoint)
    config = PreTrainedConfig.from_pretrained(folder)
    config.vlm_model_name, config.load_vlm_weights = str(Path(checkpoint) / "vlm"), False
    policy = SmolVLAPolicy.from_pretrained(folder, config=config, strict=True)
    policy = (published_dtypes(policy) if dtype == "published" else policy.float()).eval()
    tokenizer = {"tokenizer_processor": {"tokenizer_name": config.vlm_model_name}}
    before, after = make_pre_post_processors(config, pretrained_path=folder, preprocessor_overrides=tokenizer)
    return policy, before, after


def is_cross(config, j):
    every = config.self_attn_every_n_layers
    return "cross" in config.attention_mode and not (every > 0 and j % every == 0)


def published_dtypes(policy):
    inner = policy.model.vlm_with_expert
    inner.vlm.bfloat16(), inner.lm_expert.bfloat16()
    for j, layer in enumerate(inner.lm_expert.layers):
        if is_cross(policy.config, j):
            layer.self_attn.k_proj.float(), layer.self_attn.v_proj.float()
    return policy


class Recorder(ChunkRecorder):
    def __init__(self, policy):
        super().__init__(policy, policy.config.num_steps)
        model = policy.model
        backbone, expert = model.vlm_with_expert.get_vlm_model(), model.vlm_with_expert.lm_expert
        vision = backbone.vision_model
        self.vision_tower(vision)
        self.before(vision.embeddings.position_embedding, lambda ids: self.put("position_ids", ids[0]))
        self.per_view(backbone.connector, "connector")
        self.language_layers(backbone.text_model.layers)

        self.stepwise(model.action_time_mlp_out, "action_time_out")
        self.expert_layers(expert)
        self.stepwise(model.action_out_proj, "action_out")
        for j, layer in enumerate(expert.layers):
            if is_cross(policy.config, j):
                for name in ("k", "v"):
                    self.reprojected(getattr(layer.self_attn, f"{name}_proj"), f"expert.blk.{j}.{name}")

    def reprojected(self, module, name):
        head = self.policy.model.vlm_with_expert.config.text_config.head_dim
        self.after(module, lambda x: self.rows(name, x.unflatten(-1, (-1, head))) if self.step == 0 else None)

    def run(self, batch, noise):
        super().run(batch, noise)
        self.put("state", self.policy.prepare_state(batch)[0])
        return self.taps
