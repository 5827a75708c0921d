# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""TurboVLA: golden cases, random checkpoints in LeRobot's layout, and the class of its package as the reference.

A checkpoint holds the configs of both backbones and the tokenizer, which the package fetches from a hub: `vision_encoder/` and
`language_encoder/`.  The package is lerobot_policy_turbovla of PyPI.
"""

import random
from dataclasses import dataclass, field
from pathlib import Path

from . import lerobot_layout as layout
from .cases import LIBERO_FRAMES, LIBERO_INSTRUCTION, MODES, TEXTS, Case, copy_tokenizer
from .files import bfloat16_bits, write_json, write_stream
from .parameters import linear, norm, parameter, statistics, tower
from .recorder import Taps

NAMES = {"turbovla": "lerobot_policy_turbovla.TurboVLAPolicy"}
N_TOKEN = 115  # of the tokenizer
VISION, LANGUAGE = "model.vision_encoder.", "model.language_encoder."
CONFIG = {
    "chunk_size": 12, "n_action_steps": 12, "normalization_mapping": layout.IDENTITY | {"STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
    "vision_backbone": "facebook/dinov3-vitb16-pretrain-lvd1689m", "language_backbone": "google-bert/bert-base-uncased",
    "load_pretrained_backbones": False, "freeze_vision_backbone": True, "freeze_language_backbone": True, "image_size": 224,
    "max_language_tokens": 32, "dim_model": 256, "n_heads": 8, "dim_feedforward": 1024, "feedforward_activation": "relu", "dropout": 0.1,
    "n_fusion_layers": 6, "n_decoder_layers": 4, "optimizer_lr": 5e-5, "optimizer_weight_decay": 1e-4, "optimizer_lr_backbone": 5e-6,
    "optimizer_grad_clip_norm": 10.0, "scheduler_warmup_steps": 10000, "scheduler_decay_steps": 80000, "scheduler_decay_lr": 5e-7}


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of both backbones, what differs from TurboVLAConfig's defaults, features."""

    vision: dict
    text: dict
    policy: dict
    views: dict  # view -> declared (height, width)
    d_state: int = 6  # 0: none
    d_action: int = 7
    n_vocab: int = N_TOKEN
    rename: dict = field(default_factory=dict)  # name in the data set -> name of the feature
    zero_spread: tuple = ()
    dtype: str = "F32"  # of the backbones

    @property
    def config(self):
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action)
        return {"type": "turbovla"} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | CONFIG | self.policy

    def shapes(self):
        c, d, fusion, decoder = self.config, self.config["dim_model"], "model.vl_interaction.", "model.action_decoder."
        out = dinov3(VISION, self.vision) | bert(LANGUAGE, self.text, self.n_vocab)
        out |= linear("model.vision_proj", d, self.vision["hidden_size"]) | linear("model.language_proj", d, self.text["hidden_size"])
        n_patch = (c["image_size"] // self.vision["patch_size"]) ** 2
        out |= {"model.patch_pos_embed": (1, n_patch, d), "model.camera_embed.weight": (len(self.views), d)}
        if self.d_state:
            out |= linear("model.state_proj", d, self.d_state) | {"model.state_embed": (1, 1, d)}
        for i in range(c["n_fusion_layers"]):
            at = f"{fusion}layers.{i}."
            for stream, attention in (("vision", "text_to_vision_attn"), ("text", "vision_to_text_attn")):
                out |= norm(f"{at}norm_{stream}_attn", d) | norm(f"{at}norm_{stream}_ffn", d)
                out |= attention_of(f"{at}{attention}.", d) | mlp(f"{at}{stream}_ffn.", d, c["dim_feedforward"])
        for i in range(c["n_decoder_layers"]):
            at = f"{decoder}layers.{i}."
            out |= norm(f"{at}norm_self_attn", d) | norm(f"{at}norm_cross_attn", d) | norm(f"{at}norm_ffn", d)
            out |= attention_of(f"{at}self_attn.", d) | attention_of(f"{at}cross_attn.", d) | mlp(f"{at}ffn.", d, c["dim_feedforward"])
        out |= norm(f"{fusion}norm_vision", d) | norm(f"{fusion}norm_text", d) | norm(f"{decoder}norm", d)
        return out | {f"{decoder}query_embed.weight": (c["chunk_size"], d)} | linear(f"{decoder}action_head", self.d_action, d)

    def write(self, seed, folder):
        """config.json, model.safetensors, both pipelines, both backbones' configs.  Returns the parameter count."""
        folder, c, shapes = Path(folder), self.config, self.shapes()
        write_json(folder / "config.json", c, indent=2)
        write_json(folder / "vision_encoder/config.json", {"model_type": "dinov3_vit"} | self.vision, indent=2)
        write_json(folder / "language_encoder/config.json", {"model_type": "bert", "vocab_size": self.n_vocab} | self.text, indent=2)
        copy_tokenizer("bert", folder / "language_encoder")
        shown, actions, modes = c["input_features"], c["output_features"], c["normalization_mapping"]
        before = [layout.rename(self.rename), layout.BATCH, layout.device(), layout.normalizer("normalizer_processor", shown | actions, modes)]
        after = [layout.normalizer("unnormalizer_processor", actions, modes), layout.device()]
        layout.write_pipelines(folder, before, after, statistics(self.d_state, self.d_action, seed, self.zero_spread))
        dtypes = {name: self.dtype if name.startswith((VISION, LANGUAGE)) else "F32" for name in shapes}

        def value(name):
            x = self.value(name, seed, shapes[name])
            return bfloat16_bits(x) if dtypes[name] == "BF16" else x

        write_stream(folder / "model.safetensors", {n: (dtypes[n], s) for n, s in sorted(shapes.items())}, value)
        return sum(map(layout.count, shapes.values()))

    @staticmethod
    def value(name, seed, shape):
        """Scales of layers are near 1, as those of norms; tables and tokens are drawn as matrices."""
        known = name.replace("LayerNorm", "norm").replace("lambda1", "norm.weight")
        return parameter(known, shape[1:] if len(shape) == 3 else shape, seed).reshape(shape)


def dinov3(at, v):
    d = v["hidden_size"]
    out = {f"{at}embeddings.cls_token": (1, 1, d), f"{at}embeddings.mask_token": (1, 1, d),
           f"{at}embeddings.register_tokens": (1, v["num_register_tokens"], d),
           f"{at}embeddings.patch_embeddings.weight": (d, 3, v["patch_size"], v["patch_size"]), f"{at}embeddings.patch_embeddings.bias": (d,)}
    for i in range(v["num_hidden_layers"]):
        layer = f"{at}model.layer.{i}."
        for part in "qkvo":
            out |= linear(f"{layer}attention.{part}_proj", d, d, part != "k")
        out |= linear(f"{layer}mlp.up_proj", v["intermediate_size"], d) | linear(f"{layer}mlp.down_proj", d, v["intermediate_size"])
        for j in (1, 2):
            out |= norm(f"{layer}norm{j}", d) | {f"{layer}layer_scale{j}.lambda1": (d,)}
    return out | norm(f"{at}norm", d)


def bert(at, t, n_vocab):
    d = t["hidden_size"]
    tables = {"word": n_vocab, "position": t["max_position_embeddings"], "token_type": 2}
    out = {f"{at}embeddings.{name}_embeddings.weight": (n, d) for name, n in tables.items()} | norm(f"{at}embeddings.LayerNorm", d)
    for i in range(t["num_hidden_layers"]):
        layer = f"{at}encoder.layer.{i}."
        for part in ("self.query", "self.key", "self.value", "output.dense"):
            out |= linear(f"{layer}attention.{part}", d, d)
        out |= linear(f"{layer}intermediate.dense", t["intermediate_size"], d) | linear(f"{layer}output.dense", d, t["intermediate_size"])
        out |= norm(f"{layer}attention.output.LayerNorm", d) | norm(f"{layer}output.LayerNorm", d)
    return out | linear(f"{at}pooler.dense", d, d)


def attention_of(at, d):
    return {k: v for part in ("q_proj", "k_proj", "v_proj", "out_proj") for k, v in linear(at + part, d, d).items()}


def mlp(at, d, d_ff):
    return linear(at + "linear1", d_ff, d) | linear(at + "linear2", d, d_ff)


FRAMES, INSTRUCTION = LIBERO_FRAMES, LIBERO_INSTRUCTION


def published(views, arch="turbovla"):
    """The published size, with the robot of LIBERO: 0.2 B parameters."""
    sizes = vision(768, 12, 12, 3072, 16, 4), text(768, 12, 12, 3072, 512)
    return Checkpoint(*sizes, {"chunk_size": CONFIG["chunk_size"]}, views, d_state=8, d_action=7, n_vocab=30522)


# --- cases -----------------------------------------------------------------------------------------------------------


def vision(d, layers, heads, ff, patch, registers, **more):
    return tower(d, layers, heads, ff, patch_size=patch, num_register_tokens=registers, **more)


def text(d, layers, heads, ff, positions=40, **more):
    return tower(d, layers, heads, ff, max_position_embeddings=positions, **more)


def policy(horizon, d, heads, ff, layers, side, **more):
    """layers: of the fusion and of the decoder."""
    return {"chunk_size": horizon, "n_action_steps": horizon, "dim_model": d, "n_heads": heads, "dim_feedforward": ff,
            "n_fusion_layers": layers[0], "n_decoder_layers": layers[1], "image_size": side, **more}


CASES = {
    # Two views of two aspects, both resized; as published but smaller: four registers, several layers of everything.
    "turbovla/two_views": Case(41, {"image": (40, 90, "png"), "wrist_image": (75, 52, "png")}, "open the middle drawer of the cabinet",
                               Checkpoint(vision(32, 3, 4, 72, 8, 4), text(36, 2, 3, 44), policy(6, 40, 5, 56, (2, 2), 24),
                                          {"image": (40, 90), "wrist_image": (40, 90)}, d_state=8)),
    # Three views; an instruction beyond its limit, with capitals, accents, Chinese characters and words that are unknown; GELU; backbones
    # stored in bfloat16; other names for views.
    "turbovla/long_text": Case(42, {"top": (24, 24, "png"), "wrist": (53, 41, "jpg"), "side": (30, 37, "png")},
                               "Put the Blâck bowl ON top of the stove, 然后关上 the drawer! Schließe dann die Schublade n° 12",
                               Checkpoint(vision(24, 2, 2, 60, 8, 1, layer_norm_eps=1e-6), text(28, 3, 2, 36, 20),
                                          policy(5, 36, 3, 40, (2, 3), 24, max_language_tokens=12, feedforward_activation="gelu"),
                                          {"top": (24, 24), "wrist": (53, 41), "side": (30, 37)}, d_state=14, d_action=14, dtype="BF16",
                                          rename={"observation.images.cam": "observation.images.side"})),
    # No state, no registers, one view, one layer and one decoder layer of all; another period; quantiles.
    "turbovla/no_state": Case(43, {"camera": (33, 60, "png")}, "push the plate slowly", Checkpoint(
        vision(24, 1, 3, 40, 7, 0, rope_theta=37.5), text(20, 1, 1, 52, layer_norm_eps=1e-6), policy(7, 20, 1, 28, (1, 1), 28,
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "QUANTILES"}), {"camera": (33, 60)}, d_state=0,
        d_action=3)),
    # Frames of the network's size; a state number that never moved; ranges; a tower that is narrower than the trunk.
    "turbovla/same_size": Case(44, {"right": (20, 20, "png"), "left": (20, 20, "png")}, "close drawer 42 [SEP] now", Checkpoint(
        vision(32, 2, 1, 28, 10, 2), text(44, 2, 4, 32), policy(4, 60, 6, 24, (1, 4), 20, max_language_tokens=16,
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MIN_MAX", "ACTION": "MIN_MAX"}), {"right": (20, 20), "left": (20, 20)},
        d_state=5, d_action=4, zero_spread=(3,))),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(seed):
    """A case whose every size comes from the seed; its instruction may have letters of every kind; in one of ten an image that patches do not fill."""
    r = random.Random(f"turbovla {seed}")
    vision_heads, text_heads, heads, patch = r.choice((1, 2, 3)), r.choice((1, 2, 3, 5)), r.choice((1, 2, 3, 5)), r.choice((4, 5, 8, 14))
    side, n_position = patch * r.randint(1, 5) + (r.random() < 0.1), r.choice((12, 20, 40))
    frames = {f"cam{i}": (r.randint(12, 90), r.randint(12, 90), r.choice(("png", "png", "jpg"))) for i in range(r.randint(1, 4))}
    if r.random() < 0.2:
        frames = {view: (side, side, "png") for view in frames}
    seen = vision(4 * vision_heads * r.choice((2, 3, 5)), r.randint(1, 4), vision_heads, r.choice((20, 36, 50)), patch, r.choice((0, 1, 4, 4)),
                  layer_norm_eps=r.choice((1e-5, 1e-6)), rope_theta=r.choice((100.0, 100.0, 37.5, 1e4)))
    language = text(4 * text_heads * r.choice((1, 2, 3)), r.randint(1, 4), text_heads, r.choice((20, 36, 50)), n_position)
    settings = policy(
        r.randint(1, 14), 4 * heads * r.choice((1, 2, 3)), heads, r.choice((20, 50, 72)), (r.randint(1, 4), r.randint(1, 4)), side,
        max_language_tokens=r.randint(3, n_position), feedforward_activation=r.choice(("relu", "relu", "gelu")),
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)})
    checkpoint = Checkpoint(seen, language, settings, {view: frame[:2] for view, frame in frames.items()}, r.choice((0, 1, 7, 20)), r.randint(1, 20),
                            dtype=r.choice(("F32", "F32", "BF16")))
    return Case(seed, frames, r.choice((*TEXTS, "Ouvre le TIROIR à côté de l'évier, 한국어 Ⅷ ﬁn", "[SEP]a[MASK] [cls]")), checkpoint)


DRAWN = {"turbovla": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor); published: products in bfloat16 as torch.autocast makes them."""
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot_policy_turbovla import TurboVLAPolicy

    folder = str(checkpoint)
    config = PreTrainedConfig.from_pretrained(folder)
    config.vision_backbone, config.language_backbone = (str(Path(checkpoint) / f"{part}_encoder") for part in ("vision", "language"))
    config.load_pretrained_backbones = False
    policy = TurboVLAPolicy.from_pretrained(folder, config=config, strict=True).float().eval()
    predict = policy.predict_action_chunk
    if dtype == "published":
        predict = torch.autocast("cpu", torch.bfloat16)(predict)
    policy.predict_action_chunk = lambda batch, noise=None: predict(batch)  # it knows no noise
    return policy, *make_pre_post_processors(config, pretrained_path=folder)


class Recorder(Taps):
    """Listens to one run of `predict_action_chunk`."""

    def __init__(self, policy):
        super().__init__(1)
        self.policy, self.views, self.step, model = policy, {}, 0, policy.model
        tower, lm = model.vision_encoder, model.language_encoder
        self.before(tower, lambda x: self.seen("pixels", x))
        self.after(tower.embeddings.patch_embeddings, lambda x: self.seen("vision.patch_embed", x.flatten(2).transpose(1, 2)))
        for i, block in enumerate(tower.model.layer):
            self.after(block, lambda x, i=i: self.seen(f"vision.blk.{i}", x))
        self.after(tower.norm, lambda x: self.seen("vision.post_norm", x[:, -model.n_patches :]))
        self.after(model.vision_proj, lambda x: self.seen("projector", x))
        self.before(lm.embeddings.word_embeddings, lambda ids: self.put("tokens", ids[0]))
        self.after(lm.embeddings.LayerNorm, lambda x: self.put("lm.embd_norm", x[0]))
        for i, block in enumerate(lm.encoder.layer):
            self.after(block, lambda x, i=i: self.put(f"lm.blk.{i}", x[0]))
        self.after(model.language_proj, lambda x: self.put("text_in", x[0]))
        if model.state_proj is not None:
            self.before(model.state_proj, lambda x: self.put("state", x[0]))
            self.after(model.state_proj, lambda x: self.put("state_in", x))
        for i, layer in enumerate(model.vl_interaction.layers):
            layer.register_forward_hook(lambda m, args, out, i=i: self.fused(i, *out))
        decoder = model.action_decoder
        self.before(decoder, lambda x: self.put("prefix", x[0]))
        for i, layer in enumerate(decoder.layers):
            self.after(layer, lambda x, i=i: self.put(f"step.0.decoder.blk.{i}", x[0]))
        self.after(decoder.norm, lambda x: self.put("step.0.decoder.norm", x[0]))
        self.after(decoder.action_head, lambda x: self.put("step.0.action_out", x[0]))

    def seen(self, name, x):
        self.views.setdefault(name, []).append(x)

    def fused(self, i, image, text):
        self.put(f"fusion.blk.{i}.image", image[0])
        self.put(f"fusion.blk.{i}.text", text[0])

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        with torch.inference_mode():
            self.put("chunk", self.policy.predict_action_chunk(dict(batch))[0])
        for name, x in self.views.items():
            self.put(name, torch.cat(x))
        return self.taps
