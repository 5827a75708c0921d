# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""ACT: golden cases, random checkpoints in LeRobot's layout, and LeRobot's class as the reference.

The towers are torchvision's own ResNet-18 and -34, which have one width only: frames are small, so that what they give is.
"""

import random
import zlib
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np

from . import lerobot_layout as layout
from .cases import MODES, Case
from .draw import Generator, bfloat16, f32
from .files import bfloat16_bits, write_json, write_stream
from .parameters import linear, norm, parameter, statistics
from .recorder import Taps

NAMES = {"act": "lerobot.policies.act.ACTPolicy"}
BACKBONES = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
ENVIRONMENT = "observation.environment_state"
CONFIG = {
    "chunk_size": 100, "n_action_steps": 100, "normalization_mapping": {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"},
    "vision_backbone": "resnet18", "pretrained_backbone_weights": None, "replace_final_stride_with_dilation": False, "pre_norm": False,
    "dim_model": 512, "n_heads": 8, "dim_feedforward": 3200, "feedforward_activation": "relu", "n_encoder_layers": 4, "n_decoder_layers": 1,
    "use_vae": True, "latent_dim": 32, "n_vae_encoder_layers": 4, "temporal_ensemble_coeff": None, "dropout": 0.1, "kl_weight": 10.0,
    "optimizer_lr": 1e-5, "optimizer_weight_decay": 1e-4, "optimizer_lr_backbone": 1e-5}


def camera_statistics(seed):
    generator = Generator(seed)
    mean, std = generator.uniform(3) * f32(0.3) + f32(0.3), generator.uniform(3) * f32(0.2) + f32(0.15)
    ranges = {"min": mean - std, "max": mean + std, "q01": mean - f32(0.9) * std, "q99": mean + std, "q10": mean - f32(0.5) * std, "q90": mean + f32(0.6) * std}
    return {k: v.reshape(3, 1, 1) for k, v in ({"mean": mean, "std": std} | ranges).items()}


def write(checkpoint, dtypes, seed, folder):
    """config.json, model.safetensors, both pipelines or statistics among the weights.  Returns the parameter count."""
    folder, c, shapes = Path(folder), checkpoint.config, checkpoint.shapes()
    write_json(folder / "config.json", c, indent=2)
    numbers = {}
    if checkpoint.old:
        for feature, table in checkpoint.statistics(seed).items():
            for group in ("normalize_inputs", "normalize_targets", "unnormalize_outputs"):
                if (feature == "action") == (group != "normalize_inputs"):
                    numbers |= {f"{group}.buffer_{feature.replace('.', '_')}.{k}": table[k] for k in checkpoint.old_parts(feature)}
    else:
        shown, actions, modes = c["input_features"], c["output_features"], c["normalization_mapping"]
        before = [layout.rename({}), layout.BATCH, layout.device(), layout.normalizer("normalizer_processor", shown | actions, modes)]
        after = [layout.normalizer("unnormalizer_processor", actions, modes), layout.device()]
        layout.write_pipelines(folder, before, after, checkpoint.statistics(seed))
    listed = {name: (dtypes[name], shape) for name, shape in shapes.items()} | {name: ("F32", x.shape) for name, x in numbers.items()}

    def value(name):
        x = numbers[name] if name in numbers else checkpoint.value(name, shapes[name], seed)
        return bfloat16_bits(x) if dtypes.get(name) == "BF16" else x

    write_stream(folder / "model.safetensors", dict(sorted(listed.items())), value)
    return sum(map(layout.count, shapes.values()))


@dataclass(frozen=True)
class Checkpoint:
    """What differs from ACTConfig's defaults, features.  exact: scales of batch norms are powers of two, with which products of weights
    that bfloat16 holds are such weights again."""

    policy: dict
    views: dict  # view -> (height, width)
    d_state: int = 6
    d_action: int = 7
    d_environment: int = 0
    exact: bool = True
    imagenet: bool = True  # all views have the same statistics
    dtype: str = "F32"  # of convolutions
    old: bool = False  # statistics inside the weights
    zero_spread: tuple = field(default=())

    @property
    def config(self):
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action)
        if self.d_environment:
            inputs[ENVIRONMENT] = layout.feature("ENV", self.d_environment)
        return {"type": "act"} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | CONFIG | self.policy

    @property
    def states(self):
        """Width by feature, where there are several."""
        return {"observation.state": self.d_state, ENVIRONMENT: self.d_environment} if self.d_environment else None

    def shapes(self):
        c = self.config
        d, n_token, vae = c["dim_model"], 3 if self.d_environment else 2, "model.vae_encoder"
        out = resnet("model.backbone.", BACKBONES[c["vision_backbone"]])
        out |= {"model.encoder_img_feat_input_proj.weight": (d, 512, 1, 1), "model.encoder_img_feat_input_proj.bias": (d,)}
        out |= linear("model.encoder_robot_state_input_proj", d, self.d_state) | linear("model.encoder_latent_input_proj", d, c["latent_dim"])
        if self.d_environment:
            out |= linear("model.encoder_env_state_input_proj", d, self.d_environment)
        out |= {"model.encoder_1d_feature_pos_embed.weight": (n_token, d), "model.decoder_pos_embed.weight": (c["chunk_size"], d)}
        out |= linear("model.action_head", self.d_action, d) | norm("model.decoder.norm", d)
        for name, n, attentions in (("encoder", c["n_encoder_layers"], ("self_attn",)),
                                    ("decoder", c["n_decoder_layers"], ("self_attn", "multihead_attn")),
                                    ("vae_encoder", c["n_vae_encoder_layers"] if c["use_vae"] else 0, ("self_attn",))):
            for i in range(n):
                out |= layer(f"model.{name}.layers.{i}.", d, c["dim_feedforward"], attentions)
        if c["pre_norm"]:
            out |= norm("model.encoder.norm", d) | (norm(f"{vae}.norm", d) if c["use_vae"] else {})
        if c["use_vae"]:
            out |= {f"{vae}_cls_embed.weight": (1, d), f"{vae}_pos_enc": (1, 2 + c["chunk_size"], d)}
            out |= linear(f"{vae}_robot_state_input_proj", d, self.d_state) | linear(f"{vae}_action_input_proj", d, self.d_action)
            out |= linear(f"{vae}_latent_output_proj", 2 * c["latent_dim"], d)
        return out

    def value(self, name, shape, seed):
        if len(shape) == 4 and "backbone" in name:
            return filters(name, shape, seed)
        if "backbone" in name and not name.endswith(("bias", "mean")):
            return self.norm_factor(name, shape, seed)
        return parameter(name, shape, seed)

    def norm_factor(self, name, shape, seed):
        """Weight or variance of a batch norm."""
        generator = Generator(zlib.crc32(name.encode()) + 1_000_003 * seed)
        power = np.rint(generator.uniform(*shape) * f32(2) - f32(1))  # -1, 0, 1
        if not self.exact:
            power = bfloat16(generator.normal(*shape) * f32(0.3))
        if name.endswith("var"):
            return f32(4) ** power - f32(1e-5 if self.exact else 0)  # the class adds 1e-5
        return bfloat16(f32(2) ** power)

    def statistics(self, seed):
        out = statistics(self.d_state, self.d_action, seed, self.zero_spread)
        for i, view in enumerate(self.views):
            out[f"observation.images.{view}"] = camera_statistics(seed + 55 + (0 if self.imagenet else i))
        if self.d_environment:
            out[ENVIRONMENT] = statistics(self.d_environment, 1, seed + 5)["observation.state"]
        return out

    def old_parts(self, feature):
        """Statistics of a feature that the older layout keeps among the weights."""
        return "mean", "std"

    def write(self, seed, folder):
        dtypes = {name: self.dtype if len(shape) == 4 and "backbone" in name else "F32" for name, shape in self.shapes().items()}
        return write(self, dtypes, seed, folder)


def filters(name, shape, seed):
    """Of a convolution: whole numbers of 8 bits times a power of two, which are quicker to draw than normal ones."""
    words = np.random.RandomState((zlib.crc32(name.encode()) + 1_000_003 * seed) & 0xFFFFFFFF)
    n = layout.count(shape)
    step = f32(2) ** np.rint(np.log2(0.5 / (74 * np.sqrt(n / shape[0])))).astype(f32)
    return (np.frombuffer(words.bytes(n), np.int8).astype(f32) * step).reshape(shape)


def batch_norm(name, d):
    return {f"{name}.{part}": (d,) for part in ("weight", "bias", "running_mean", "running_var")}


def resnet(at, n_block):
    out = {f"{at}conv1.weight": (64, 3, 7, 7)} | batch_norm(f"{at}bn1", 64)
    d_in = 64
    for stage, n in enumerate(n_block):
        d = 64 << stage
        for i in range(n):
            block = f"{at}layer{stage + 1}.{i}."
            out |= {f"{block}conv1.weight": (d, d_in, 3, 3), f"{block}conv2.weight": (d, d, 3, 3)}
            out |= batch_norm(f"{block}bn1", d) | batch_norm(f"{block}bn2", d)
            if d != d_in:
                out |= {f"{block}downsample.0.weight": (d, d_in, 1, 1)} | batch_norm(f"{block}downsample.1", d)
            d_in = d
    return out


def layer(at, d, d_ff, attentions):
    out = linear(f"{at}linear1", d_ff, d) | linear(f"{at}linear2", d, d_ff)
    for name in attentions:
        out |= {f"{at}{name}.in_proj_weight": (3 * d, d), f"{at}{name}.in_proj_bias": (3 * d,)} | linear(f"{at}{name}.out_proj", d, d)
    for i in range(len(attentions) + 1):
        out |= norm(f"{at}norm{i + 1}", d)
    return out


FRAMES = {"top": (480, 640, "png"), "wrist": (480, 640, "png")}  # of the published size
INSTRUCTION = ""


def published(views, arch="act"):
    """The published size for ALOHA: 52 M parameters."""
    return Checkpoint({"chunk_size": CONFIG["chunk_size"]}, views, d_state=14, d_action=14)


# --- cases -----------------------------------------------------------------------------------------------------------


def policy(horizon, d, heads, ff, layers, **more):
    """layers: of encoder, decoder and the style variable's encoder."""
    return {"chunk_size": horizon, "n_action_steps": horizon, "dim_model": d, "n_heads": heads, "dim_feedforward": ff,
            "n_encoder_layers": layers[0], "n_decoder_layers": layers[1], "n_vae_encoder_layers": layers[2], **more}


def case(seed, frames, checkpoint):
    """The observation of a policy that reads no instruction."""
    return Case(seed, frames, "", checkpoint)


CASES = {
    # Two views whose cells no side divides, as published: norms behind the sums, one decoder layer.
    "act/two_views": case(31, {"top": (41, 70, "png"), "wrist": (41, 70, "png")}, Checkpoint(
        policy(9, 48, 4, 72, (2, 1, 1)), {"top": (41, 70), "wrist": (41, 70)}, d_state=14, d_action=14)),
    # Norms in front; three decoder layers; GELU; another statistic for each view; no encoder of the style variable.
    "act/pre_norm": case(32, {"left": (33, 34, "png"), "right": (33, 34, "jpg")}, Checkpoint(
        policy(5, 36, 3, 50, (3, 3, 1), pre_norm=True, feedforward_activation="gelu", use_vae=False),
        {"left": (33, 34), "right": (33, 34)}, d_state=7, d_action=8, imagenet=False)),
    # ResNet-34, stored in bfloat16; a state of the environment beside the robot's; ranges instead of means, of pixels too.
    "act/environment": case(33, {"camera": (64, 32, "png")}, Checkpoint(
        policy(6, 40, 5, 44, (1, 2, 2), vision_backbone="resnet34",
               normalization_mapping={"VISUAL": "MIN_MAX", "STATE": "MIN_MAX", "ENV": "MEAN_STD", "ACTION": "QUANTILES"}),
        {"camera": (64, 32)}, d_state=4, d_action=3, d_environment=11, dtype="BF16")),
    # Cameras of two sizes: the backbone runs once for each, over one view and over two.
    "act/two_sizes": case(35, {"front": (33, 70, "png"), "left": (41, 40, "png"), "right": (41, 40, "png")}, Checkpoint(
        policy(6, 32, 4, 48, (1, 1, 1)), {"front": (33, 70), "left": (41, 40), "right": (41, 40)}, d_state=5, d_action=4)),
    # The older layout, with statistics among the weights; one view, one layer, one head.
    "act/old_layout": case(34, {"image": (25, 50, "png")}, Checkpoint(
        policy(4, 20, 1, 28, (1, 1, 1), temporal_ensemble_coeff=0.01, n_action_steps=1), {"image": (25, 50)}, d_state=2, d_action=2,
        old=True, zero_spread=(1,))),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(seed):
    """A case from the seed: towers have one width, everything else is drawn; in one of ten a width that positions cannot be told in."""
    r = random.Random(f"act {seed}")
    heads = r.choice((1, 2, 3, 4, 5))
    d_model = 4 * heads * r.choice((1, 2, 3, 5)) if r.random() < 0.9 else 2 * heads * r.choice((3, 5, 7))
    height, width = r.randint(12, 80), r.randint(12, 80)
    frames = {f"cam{i}": (height, width, r.choice(("png", "png", "jpg"))) for i in range(r.randint(1, 3))}
    old, n_environment = r.random() < 0.2, r.choice((0, 0, 0, 1, 9))
    pixels = ("MEAN_STD",) if old else ("MEAN_STD", "MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10", "IDENTITY")
    states = ("MEAN_STD", "IDENTITY") if old else MODES
    modes = {"VISUAL": r.choice(pixels), "STATE": r.choice(states), "ACTION": r.choice(states)}
    if r.random() < 0.5:
        modes["ENV"] = r.choice(states)
    settings = policy(
        r.randint(1, 14), d_model, heads, r.choice((20, 50, 72)), (r.randint(1, 4), r.choice((1, 1, 2, 3)), r.randint(1, 2)),
        vision_backbone=r.choice(("resnet18", "resnet18", "resnet34")), pre_norm=r.random() < 0.4, use_vae=r.random() < 0.7,
        feedforward_activation=r.choice(("relu", "relu", "gelu")), latent_dim=r.choice((8, 32)), normalization_mapping=modes)
    checkpoint = Checkpoint(settings, {view: frame[:2] for view, frame in frames.items()}, r.randint(1, 20), r.randint(1, 20), n_environment,
                            exact=False, imagenet=r.random() < 0.5, dtype=r.choice(("F32", "F32", "BF16")), old=old)
    return case(seed, frames, checkpoint)


DRAWN = {"act": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor); published: products in bfloat16 as torch.autocast makes them."""
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    folder = str(checkpoint)
    config = PreTrainedConfig.from_pretrained(folder)
    policy = ACTPolicy.from_pretrained(folder, config=config, strict=not is_old(checkpoint)).float().eval()
    predict = policy.predict_action_chunk
    if dtype == "published":
        predict = torch.autocast("cpu", torch.bfloat16)(predict)
    policy.predict_action_chunk = lambda batch, noise=None: predict(batch)  # it knows no noise
    before, after = migrated(policy, checkpoint) if is_old(checkpoint) else make_pre_post_processors(config, pretrained_path=folder)

    def apart(batch):
        """A case's state has the numbers of both features."""
        state, n = batch["observation.state"], config.robot_state_feature.shape[0]
        return before(batch | {"observation.state": state[:n]} | ({ENVIRONMENT: state[n:]} if config.env_state_feature else {}))

    return policy, apart, after


def is_old(checkpoint):
    return not (Path(checkpoint) / "policy_preprocessor.json").is_file()


def migrated(policy, checkpoint):
    """The pipelines that LeRobot's migration makes of statistics among the weights."""
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.processor.migrate_policy_normalization import extract_normalization_stats
    from safetensors.torch import load_file

    stats = extract_normalization_stats(load_file(str(Path(checkpoint) / "model.safetensors")))
    return make_pre_post_processors(policy.config, dataset_stats=stats)


class Recorder(Taps):
    """Listens to one run of `predict_action_chunk`."""

    def __init__(self, policy):
        super().__init__(1)
        self.policy, self.views, self.step, model = policy, {}, 0, policy.model
        self.before(model.backbone, lambda x: self.seen("pixels", x))
        blocks = [block for stage in range(4) for block in model.backbone[f"layer{stage + 1}"]]
        ends = {len(model.backbone.layer1) - 1, len(blocks) - 1}
        for i, block in enumerate(blocks):
            if i in ends:
                self.after(block, lambda x, i=i: self.seen(f"vision.blk.{i}", x.permute(0, 2, 3, 1)))
        self.after(model.encoder_img_feat_input_proj, lambda x: self.seen("projector", x.permute(0, 2, 3, 1)))
        self.before(model.encoder, lambda x: self.put("prefix", x[:, 0]))
        for i, block in enumerate(model.encoder.layers):
            self.after(block, lambda x, i=i: self.put(f"encoder.blk.{i}", x[:, 0]))
        for i, block in enumerate(model.decoder.layers):
            self.after(block, lambda x, i=i: self.put(f"step.0.decoder.blk.{i}", x[:, 0]))
        self.after(model.decoder.norm, lambda x: self.put("step.0.decoder.norm", x[:, 0]))
        self.after(model.action_head, lambda x: self.put("step.0.action_out", x[0]))

    def seen(self, name, x):
        self.views.setdefault(name, []).append(x)

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        with torch.inference_mode():
            self.put("chunk", self.policy.predict_action_chunk(dict(batch))[0])
        for name, x in self.views.items():
            runs = [list(run) for _, run in groupby(x, key=lambda view: view.shape)]
            if name == "pixels" and len(runs) > 1:
                continue  # the runtime's are canvases of one size
            for n, run in enumerate(runs, 1):
                self.put(name if n == 1 else f"{name}#{n}", torch.cat(run))
        parts = [batch[name][0] for name in ("observation.state", ENVIRONMENT) if name in batch]
        self.put("state", torch.cat(parts))
        return self.taps
