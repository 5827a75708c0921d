# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""X-VLA: golden cases, random checkpoints in LeRobot's layout, and LeRobot's class as the reference.

A checkpoint holds the tokenizer, which LeRobot fetches from a hub, in `tokenizer/`.
"""

import math
import random
import re
from dataclasses import dataclass, field
from pathlib import Path

from . import lerobot_layout as layout
from .cases import LIBERO_INSTRUCTION, MODES, TEXTS, Case, copy_tokenizer
from .files import bfloat16_bits, write_json, write_stream
from .parameters import linear, norm, parameter, statistics
from .recorder import Taps, given_noise

NAMES = {"xvla": "lerobot.policies.xvla.XVLAPolicy"}
HUB_NAME = "facebook/bart-large"
N_TOKEN = 301  # of the tokenizer
VLM, HEAD = "model.vlm.", "model.transformer."
CONFIG = {
    "chunk_size": 32, "n_action_steps": 32, "dtype": "float32",
    "normalization_mapping": layout.IDENTITY | {"STATE": "IDENTITY", "ACTION": "IDENTITY"}, "tokenizer_name": HUB_NAME,
    "tokenizer_max_length": 64, "tokenizer_padding_side": "right", "pad_language_to": "max_length", "hidden_size": 1024, "depth": 24,
    "num_heads": 16, "mlp_ratio": 4.0, "num_domains": 30, "len_soft_prompts": 32, "dim_time": 32, "max_len_seq": 512, "use_hetero_proj": False,
    "action_mode": "ee6d", "num_denoising_steps": 10, "use_proprio": True, "max_state_dim": 32, "max_action_dim": 20, "domain_feature_key": None,
    "resize_imgs_with_padding": None, "num_image_views": None, "empty_cameras": 0, "freeze_vision_encoder": False,
    "freeze_language_encoder": False, "train_policy_transformer": True, "train_soft_prompts": True, "optimizer_lr": 1e-4,
    "optimizer_betas": [0.9, 0.99], "optimizer_eps": 1e-8, "optimizer_weight_decay": 0.0, "optimizer_grad_clip_norm": 10.0,
    "optimizer_soft_prompt_lr_scale": 1.0, "optimizer_soft_prompt_warmup_lr_scale": None, "scheduler_warmup_steps": 1000,
    "scheduler_decay_steps": 30000, "scheduler_decay_lr": 2.5e-6}
# What the authors' own code calls the parts of Florence-2, in which published checkpoints have them.
VENDORED = [
    (r"(vision_tower\.convs\.\d+)\.conv\.", r"\1.proj."), (r"(blocks.*)\.(conv[12])\.", r"\1.\2.fn.dw."),
    (r"(spatial_block)\.norm1\.", r"\1.window_attn.norm."), (r"(channel_block)\.norm1\.", r"\1.channel_attn.norm."),
    (r"\.(window_attn|channel_attn)\.(qkv|proj)\.", r".\1.fn.\2."), (r"\.norm2\.", ".ffn.norm."), (r"\.ffn\.(fc[12])\.", r".ffn.fn.net.\1."),
    (r"multi_modal_projector\.image_projection\.weight", "image_projection"), (r"multi_modal_projector\.image_proj_norm", "image_proj_norm"),
    (r"multi_modal_projector\.image_position_embed", "image_pos_embed"),
    (r"multi_modal_projector\.visual_temporal_embed", "visual_temporal_embed"), (r"language_model\.", "language_model.model.")]
OUTPUTS = {"ee6d": 20, "joint": 14, "agibot_ee6d": 20, "franka_joint7": 7, "so101_bimanual": 12}  # numbers of an action; auto has the feature's


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of Florence-2, what differs from XVLAConfig's defaults, features."""

    vision: dict
    text: dict
    policy: dict
    views: dict  # view -> declared (height, width)
    d_state: int = 6  # 0: none
    d_action: int = 20
    domain: int = 0
    n_vocab: int = N_TOKEN
    rename: dict = field(default_factory=dict)  # name in the data set -> name of the feature
    zero_spread: tuple = ()
    dtype: str = "F32"
    vendored: bool = False  # names of the authors' own code

    @property
    def config(self):
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action)
        return {"type": "xvla"} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | CONFIG | self.policy | {
            "florence_config": self.florence}

    @property
    def florence(self):
        vision, text = dict(self.vision), dict(self.text, vocab_size=self.n_vocab)
        if self.vendored:
            table = {"type": "learned_abs_2d", "max_pos_embeddings": vision.pop("max_position_embeddings")}
            moments = {"type": "COSINE", "max_temporal_embeddings": vision.pop("max_temporal_embeddings")}
            vision |= {"model_type": "davit", "dim_embed": vision.pop("embed_dim"), "image_pos_embed": table,
                       "visual_temporal_embedding": moments, "image_feature_source": ["spatial_avg_pool", "temporal_avg_pool"]}
            text["model_type"] = "florence2_language"
        return {"model_type": "florence2", "pad_token_id": 1, "bos_token_id": 0, "eos_token_id": 2, "projection_dim": vision["projection_dim"],
                "vision_config": vision, "text_config": text}

    @property
    def d_token(self):
        """Numbers of a row of an action with time and state."""
        c = self.config
        return c["max_action_dim"] + c["dim_time"] + (c["max_state_dim"] if c["use_proprio"] else 0)

    def per_domain(self):
        """(name, d_in, d_out) of layers that each domain has of its own."""
        c, d = self.config, self.config["hidden_size"]
        out = [("action_encoder", self.d_token, d), ("action_decoder", d, c["max_action_dim"])]
        projections = [(name, self.vision["projection_dim"], d) for name in ("vlm_proj", "aux_visual_proj")]
        return out + (projections if c["use_hetero_proj"] else [])

    def shapes(self):
        c, d = self.config, self.config["hidden_size"]
        out = davit(f"{VLM}vision_tower.", self.vision) | projector(f"{VLM}multi_modal_projector.", self.vision)
        out |= bart(f"{VLM}language_model.", self.text, self.n_vocab)
        for i in range(c["depth"]):
            at, d_ff = f"{HEAD}blocks.{i}.", int(d * c["mlp_ratio"])
            out |= norm(f"{at}norm1", d) | norm(f"{at}norm2", d) | linear(f"{at}attn.qkv", 3 * d, d) | linear(f"{at}attn.proj", d, d)
            out |= linear(f"{at}mlp.fc1", d_ff, d) | linear(f"{at}mlp.fc2", d, d_ff)
        for name, d_in, d_out in self.per_domain():
            out |= {f"{HEAD}{name}.fc.weight": (c["num_domains"], d_in * d_out), f"{HEAD}{name}.bias.weight": (c["num_domains"], d_out)}
        if not c["use_hetero_proj"]:
            out |= linear(f"{HEAD}vlm_proj", d, self.vision["projection_dim"]) | linear(f"{HEAD}aux_visual_proj", d, self.vision["projection_dim"])
        out |= {f"{HEAD}pos_emb": (1, c["max_len_seq"], d)} | norm(f"{HEAD}norm", d)
        if c["len_soft_prompts"]:
            out[f"{HEAD}soft_prompt_hub.weight"] = (c["num_domains"], c["len_soft_prompts"] * d)
        return out

    def stored(self):
        """Name in the file -> (the name of today, shape)."""
        out = {}
        for name, shape in self.shapes().items():
            stored = old_name(name) if self.vendored else name
            out[stored] = name, (shape[::-1] if stored.endswith("image_projection") else shape)
        return out

    def write(self, seed, folder):
        """config.json, model.safetensors, both pipelines, the tokenizer.  Returns the parameter count."""
        folder, c, stored = Path(folder), self.config, self.stored()
        write_json(folder / "config.json", c, indent=2)
        copy_tokenizer("bart", folder / "tokenizer")
        shown, actions, modes = c["input_features"], c["output_features"], c["normalization_mapping"]
        before = [layout.rename(self.rename), layout.BATCH, layout.tokenizer(HUB_NAME, c["tokenizer_max_length"], c["pad_language_to"]),
                  ("xvla_image_to_float", {"image_keys": None, "validate_range": True}), ("xvla_imagenet_normalize", {"image_keys": None}),
                  ("xvla_add_domain_id", {"domain_id": self.domain}), layout.device(),
                  layout.normalizer("normalizer_processor", shown | actions, modes)]
        after = [layout.normalizer("unnormalizer_processor", actions, modes), layout.device()]
        layout.write_pipelines(folder, before, after, statistics(self.d_state, self.d_action, seed, self.zero_spread))

        def value(name):
            today, shape = stored[name]
            x = self.value(today, seed, shape[::-1] if name.endswith("image_projection") else shape)
            x = x.T.copy() if name.endswith("image_projection") else x
            return bfloat16_bits(x) if self.dtype == "BF16" else x

        write_stream(folder / "model.safetensors", {n: (self.dtype, s) for n, (_, s) in sorted(stored.items())}, value)
        return sum(map(layout.count, self.shapes().values()))

    def value(self, name, seed, shape):
        """Matrices of domains are drawn for the width that they are multiplied with, tables with numbers that are seen."""
        if name.endswith("encoder.embed_tokens.weight"):  # one table under two names
            name = name.replace("encoder.embed_tokens", "shared")
        widths = {f"{HEAD}{layer}.fc.weight": d_in for layer, d_in, _ in self.per_domain()}
        widths |= {f"{HEAD}pos_emb": 4, f"{HEAD}soft_prompt_hub.weight": 4, f"{HEAD}action_encoder.bias.weight": 4}
        known = re.sub(r"layer_?norm(_embedding)?\.", "norm.", name)
        if name in widths and math.prod(shape) % widths[name] == 0:
            return parameter(known, (math.prod(shape) // widths[name], widths[name]), seed).reshape(shape)
        return parameter(known, shape, seed)


def davit(at, v):
    out, d_in = {}, 3
    for s, (d, patch, pre) in enumerate(zip(v["embed_dim"], v["patch_size"], v["patch_prenorm"])):
        out |= {f"{at}convs.{s}.conv.weight": (d, d_in, patch, patch), f"{at}convs.{s}.conv.bias": (d,)} | norm(f"{at}convs.{s}.norm", d_in if pre else d)
        for b in range(v["depths"][s]):
            for block, attention in (("spatial_block", "window_attn"), ("channel_block", "channel_attn")):
                here = f"{at}blocks.{s}.{b}.{block}."
                for conv in ("conv1", "conv2"):
                    out |= {f"{here}{conv}.weight": (d, 1, 3, 3), f"{here}{conv}.bias": (d,)}
                d_ff = int(d * v["mlp_ratio"])
                out |= norm(f"{here}norm1", d) | norm(f"{here}norm2", d) | linear(f"{here}{attention}.qkv", 3 * d, d) | linear(f"{here}{attention}.proj", d, d)
                out |= linear(f"{here}ffn.fc1", d_ff, d) | linear(f"{here}ffn.fc2", d, d_ff)
        d_in = d
    return out


def projector(at, v):
    d, d_out, n = v["embed_dim"][-1], v["projection_dim"], v["max_position_embeddings"]
    return linear(f"{at}image_projection", d_out, d, bias=False) | norm(f"{at}image_proj_norm", d_out) | {
        f"{at}image_position_embed.row_embeddings.weight": (n, d // 2), f"{at}image_position_embed.column_embeddings.weight": (n, d - d // 2),
        f"{at}visual_temporal_embed.pos_idx_to_embed": (v["max_temporal_embeddings"], d)}


def bart(at, t, n_vocab):
    d, table = t["d_model"], (n_vocab, t["d_model"])
    out = {f"{at}shared.weight": table, f"{at}encoder.embed_tokens.weight": table,
           f"{at}encoder.embed_positions.weight": (t["max_position_embeddings"] + 2, d)} | norm(f"{at}encoder.layernorm_embedding", d)
    for i in range(t["encoder_layers"]):
        layer = f"{at}encoder.layers.{i}."
        for part in "kvq":
            out |= linear(f"{layer}self_attn.{part}_proj", d, d)
        out |= linear(f"{layer}self_attn.out_proj", d, d) | linear(f"{layer}fc1", t["encoder_ffn_dim"], d) | linear(f"{layer}fc2", d, t["encoder_ffn_dim"])
        out |= norm(f"{layer}self_attn_layer_norm", d) | norm(f"{layer}final_layer_norm", d)
    return out


def old_name(name):
    """In the authors' own code."""
    if not name.startswith(VLM):
        return name
    for today, before in VENDORED:
        name = re.sub(today, before, name, count=1)
    return name


FRAMES, INSTRUCTION = {view: (256, 256, "png") for view in ("image", "image2", "image3")}, LIBERO_INSTRUCTION  # of the published size


def published(views, arch="xvla"):
    """The published size: Florence-2 large, 24 layers and 30 domains, 0.9 B parameters."""
    large = vision((256, 512, 1024, 2048), (1, 1, 9, 1), (8, 16, 32, 64), (8, 16, 32, 64), 12, 1024)
    settings = policy(30, 10, 1024, 24, 16, resize_imgs_with_padding=(224, 224), num_domains=30, len_soft_prompts=32, dim_time=32,
                      max_len_seq=512, tokenizer_max_length=50, max_state_dim=20, max_action_dim=20)
    return Checkpoint(large, text(1024, 12, 16, 4096, 4096), settings, views, d_state=20, n_vocab=51289, dtype="BF16")


# --- cases -----------------------------------------------------------------------------------------------------------


def vision(widths, depths, heads, groups, window, d_out, patch=(7, 3, 3, 3), stride=(4, 2, 2, 2), prenorm=(False, True, True, True), **more):
    n = len(widths)
    return {"embed_dim": list(widths), "depths": list(depths), "num_heads": list(heads), "num_groups": list(groups), "window_size": window,
            "projection_dim": d_out, "patch_size": list(patch[:n]), "patch_stride": list(stride[:n]),
            "patch_padding": [p // 2 for p in patch[:n]], "patch_prenorm": list(prenorm[:n]), "mlp_ratio": 4.0, "max_temporal_embeddings": 100,
            "max_position_embeddings": 50, **more}


def text(d, layers, heads, d_ff, positions=80):
    """As published the decoder is in the config, which the policy drops."""
    return {"d_model": d, "encoder_layers": layers, "encoder_attention_heads": heads, "encoder_ffn_dim": d_ff, "decoder_layers": 1,
            "decoder_attention_heads": heads, "decoder_ffn_dim": d_ff, "max_position_embeddings": positions, "activation_function": "gelu",
            "scale_embedding": False}


def policy(horizon, steps, d, depth, heads, **more):
    return {"chunk_size": horizon, "n_action_steps": horizon, "num_denoising_steps": steps, "hidden_size": d, "depth": depth, "num_heads": heads,
            "max_action_dim": 20, "num_domains": 3, "len_soft_prompts": 4, "dim_time": 8, "max_len_seq": 64, **more}


MAPPING = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
CASES = {
    # Two views of two aspects, both with a border; a third that the robot does not have; as published but smaller: grippers as logits,
    # windows that the map does not fill, text padded to its limit.
    "xvla/two_views": Case(51, {"image": (40, 90, "png"), "image2": (75, 52, "png")}, "open the middle drawer of the cabinet", Checkpoint(
        vision((12, 16, 24), (1, 2, 1), (2, 4, 3), (3, 2, 6), 3, 20), text(20, 2, 2, 28),
        policy(5, 4, 24, 3, 3, resize_imgs_with_padding=(32, 32), num_image_views=3, tokenizer_max_length=20, max_state_dim=22),
        {"image": (40, 90), "image2": (40, 90)}, d_state=20, domain=1)),
    # Four views, one absent in the middle and one that is added; an instruction beyond its limit that is not padded; projections of each
    # domain; a robot of six numbers in a network of nine; no state; bfloat16; another name for a view.
    "xvla/long_text": Case(52, {"top": (24, 24, "png"), "wrist": None, "side": (30, 37, "jpg")},
                           "Put the Blâck bowl ON top  of the stove, 然后关上 the drawer! It's n° 12", Checkpoint(
        vision((8, 16), (1, 1), (2, 2), (2, 4), 4, 24, max_position_embeddings=20), text(24, 1, 3, 36),
        policy(4, 3, 28, 2, 4, resize_imgs_with_padding=(24, 24), tokenizer_max_length=14, pad_language_to="longest", use_hetero_proj=True,
               use_proprio=False, action_mode="auto", max_action_dim=9, empty_cameras=1, max_len_seq=70, dim_time=7,
               normalization_mapping=MAPPING | {"ACTION": "QUANTILES"}), {"top": (24, 24), "wrist": (24, 24), "side": (30, 37)}, d_state=0, d_action=6,
        domain=2, dtype="BF16", rename={"observation.images.cam": "observation.images.side"})),
    # The names of the authors' own code; frames of the network's size, of which nothing is a multiple; two arms of joints; no soft prompts;
    # one view.
    "xvla/joints": Case(53, {"camera": (29, 43, "png")}, "push the plate slowly</s> now", Checkpoint(
        vision((10, 18, 20), (1, 1, 1), (1, 3, 2), (2, 3, 1), 4, 16, patch=(5, 3, 3), stride=(3, 2, 2), mlp_ratio=2.5), text(16, 2, 4, 20),
        policy(6, 5, 20, 2, 2, action_mode="joint", max_action_dim=14, len_soft_prompts=0, tokenizer_max_length=12, max_state_dim=16,
               mlp_ratio=1.7, normalization_mapping=MAPPING), {"camera": (29, 43)}, d_state=14, d_action=14, vendored=True, zero_spread=(3,))),
    # A window larger than the map; 12 numbers of two arms, whose state is padded to 20; ranges; ten steps.
    "xvla/two_arms": Case(54, {"left": (24, 24, "png"), "right": (20, 61, "png")}, "close drawer 42!", Checkpoint(
        vision((16, 12), (2, 1), (4, 3), (4, 2), 12, 12, prenorm=(True, False)), text(12, 1, 1, 30),
        policy(7, 10, 16, 2, 1, resize_imgs_with_padding=(24, 24), action_mode="so101_bimanual", tokenizer_max_length=9, max_state_dim=20,
               num_image_views=2, len_soft_prompts=1, max_len_seq=36,
               normalization_mapping=MAPPING | {"STATE": "MIN_MAX", "ACTION": "MIN_MAX"}), {"left": (24, 24), "right": (24, 24)}, d_state=12, d_action=12)),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(seed):
    """A case from the seed: stages, windows and groups of every size, all action spaces, both spellings of the backbone; in one of ten more
    tokens than positions."""
    r = random.Random(f"xvla {seed}")
    n_stage = r.randint(1, 4)
    heads = [r.choice((1, 2, 3)) for _ in range(n_stage)]
    widths = [h * g for h, g in zip(heads, [2 * r.choice((2, 3, 4, 5)) for _ in range(n_stage)])]
    groups = [r.choice([g for g in (1, 2, 3, 4, 6, 8) if w % g == 0]) for w in widths]
    patch = [r.choice((3, 5, 7)), *(r.choice((1, 3, 3)) for _ in range(3))]
    stride, prenorm = [r.choice((2, 3, 4)), *(r.choice((1, 2, 2)) for _ in range(3))], [r.random() < 0.5 for _ in range(4)]
    lm_heads = r.choice((1, 2, 3))
    d_lm = 4 * lm_heads * r.choice((1, 2, 3))
    seen = vision(widths, [r.randint(1, 2) for _ in widths], heads, groups, r.choice((2, 3, 4, 12)), d_lm, patch, stride[:n_stage], prenorm,
                  mlp_ratio=r.choice((2.0, 4.0, 1.3)))
    mode, frames = r.choice(("ee6d", "ee6d", "auto", "joint", "agibot_ee6d", "franka_joint7", "so101_bimanual")), {}
    for i in range(r.randint(1, 4)):
        frames[f"cam{i}"] = (r.randint(12, 50), r.randint(12, 50), r.choice(("png", "png", "jpg"))) if i == 0 or r.random() < 0.8 else None
    size = (r.randint(12, 36), r.randint(12, 36))
    resizes = r.random() < 0.8
    if not resizes:
        frames = {view: frame and (*size, "png") for view, frame in frames.items()}
    reads_state = mode in ("ee6d", "joint", "so101_bimanual") or r.random() < 0.6
    d_action = r.randint(1, 9) if mode == "auto" else OUTPUTS[mode]
    columns = {"auto": d_action + r.randint(0, 3), "joint": 14}.get(mode, 20)
    d_state = r.choice((7, 12, 20)) if reads_state else 0
    max_state = 20 if mode == "so101_bimanual" else max(20, d_state) + r.randint(0, 4)
    head = r.choice((1, 2, 4))
    more = {"resize_imgs_with_padding": size if resizes else None, "action_mode": mode, "max_action_dim": columns, "use_proprio": reads_state,
            "max_state_dim": max_state, "num_image_views": r.choice((None, None, 1, 4)), "empty_cameras": r.choice((0, 0, 1)) if resizes else 0,
            "use_hetero_proj": r.random() < 0.3, "len_soft_prompts": r.choice((0, 1, 5)), "dim_time": r.choice((4, 7, 32)), "mlp_ratio": r.choice((4.0, 1.7)),
            "tokenizer_max_length": r.randint(4, 40), "pad_language_to": r.choice(("max_length", "max_length", "longest")),
            "max_len_seq": r.choice((1500, 1500, 1500, 60)),
            "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": r.choice(("IDENTITY", *MODES)), "ACTION": r.choice(("IDENTITY", *MODES))}}
    settings = policy(r.randint(1, 9), r.choice((1, 2, 5, 10)), 4 * head * r.choice((1, 2, 3)), r.randint(1, 4), head, **more)
    views = {view: frame[:2] if frame else size for view, frame in frames.items()}
    language = text(d_lm, r.randint(1, 3), lm_heads, r.choice((12, 30, 50)), r.choice((900, 900, 900, 40)))
    checkpoint = Checkpoint(seen, language, settings, views, d_state, d_action, r.randint(0, 2), dtype=r.choice(("F32", "F32", "BF16")),
                            vendored=r.random() < 0.4)
    return Case(seed, frames, r.choice((*TEXTS, "Ouvre le TIROIR à côté de l'évier, 한국어 Ⅷ ﬁn", "</s>a<mask>  <pad>it's")), checkpoint)


DRAWN = {"xvla": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor); published: the class's own bfloat16.  Of `postprocess` of the action space the policy only cuts
    what the robot has no number for: sigmoids of grippers are the postprocessor's here."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.xvla.modeling_xvla import XVLAPolicy

    folder = str(checkpoint)
    config = PreTrainedConfig.from_pretrained(folder)
    config.dtype = "bfloat16" if dtype == "published" else "float32"
    policy = XVLAPolicy.from_pretrained(folder, config=config).eval()
    generate, space = policy._get_action_chunk, policy.model.action_space
    finish, space.postprocess = space.postprocess, lambda x: x[..., : finish(x.clone()).shape[-1]]

    def predict(batch, noise):
        with given_noise(noise):
            return generate(dict(batch))

    policy.predict_action_chunk = predict
    tokenizer = {"tokenizer_processor": {"tokenizer_name": str(Path(checkpoint) / "tokenizer")}}
    before, after = make_pre_post_processors(config, pretrained_path=folder, preprocessor_overrides=tokenizer)
    return policy, before, lambda chunk: after(finish(chunk.clone()))


class Recorder(Taps):
    """Listens to one run of `predict_action_chunk`."""

    def __init__(self, policy):
        super().__init__(policy.config.num_denoising_steps)
        self.policy, model = policy, policy.model
        tower, projector, encoder = model.vlm.vision_tower, model.vlm.multi_modal_projector, model.vlm.language_model.encoder
        self.before(tower, lambda x: self.put("pixels", x))
        for s, (conv, blocks) in enumerate(zip(tower.convs, tower.blocks)):
            self.cells(conv, f"vision.stage.{s}.embed")
            for b, block in enumerate(blocks):
                self.cells(block.spatial_block, f"vision.stage.{s}.blk.{b}.spatial")
                self.cells(block.channel_block, f"vision.stage.{s}.blk.{b}.channel")
        self.after(projector, lambda x: self.put("projector.norm", x))
        self.before(encoder.layers[0], lambda x: self.put("lm.embd_norm", x[0]))
        encoder.register_forward_pre_hook(lambda m, args, kw: self.put("prefix", kw["inputs_embeds"][0]), with_kwargs=True)
        for i, layer in enumerate(encoder.layers):
            self.after(layer, lambda x, i=i: self.put(f"lm.blk.{i}", x[0]))
        head, space = model.transformer, model.action_space
        self.preprocess, space.preprocess = space.preprocess, self.on_step
        for name, tap in (("vlm_proj", "vlm_in"), ("aux_visual_proj", "aux_in")):
            self.after(getattr(head, name), lambda x, tap=tap: self.seen_once(tap, x[0]))
        self.stepwise(head.action_encoder, "action_in")
        for i, block in enumerate(head.blocks):
            self.stepwise(block, f"transformer.blk.{i}")
        self.stepwise(head.norm, "transformer.norm")
        self.stepwise(head.action_decoder, "action_out")
        self.after(head, lambda x: self.put("x", x[0]))

    def cells(self, module, name):
        self.after(module, lambda x: self.put(name, x.permute(0, 2, 3, 1)))

    def seen_once(self, name, x):
        if self.step == 0 and x.numel():
            self.put(name, x)

    def on_step(self, proprio, x_t):
        if self.step >= 0:
            self.put(f"step.{self.step}.x", x_t[0])
        self.step += 1
        if self.step == 0 and proprio.shape[1]:
            self.put("state", proprio[0])
        return self.preprocess(proprio, x_t)

    def run(self, batch, noise):
        """Every tap of one inference."""
        tokens, mask = (batch[f"observation.language.{name}"][0] for name in ("tokens", "attention_mask"))
        self.put("tokens", tokens[mask.bool()])
        self.put("chunk", self.policy.predict_action_chunk(batch, noise)[0])
        self.taps[f"step.{self.step}.x"] = self.taps.pop("x")
        return self.taps
