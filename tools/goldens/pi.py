# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5: golden cases, random checkpoints in LeRobot's layout at any size, and LeRobot's classes as the reference.

The classes know two sizes, by name.  `checkpoint/dims.json` states others: `gemma_2b` and `gemma_300m` with the fields of
the reference's GemmaConfig, `vision` with fields of SiglipVisionConfig, `vocab_size`.  `{"size": "full"}` is the published
size.  `checkpoint/tokenizer` holds what the hub keeps in google/paligemma-3b-pt-224.
"""

import contextlib
import functools
import importlib
import json
import random
import sys
from dataclasses import dataclass, field
from pathlib import Path

from . import lerobot_layout as layout
from .cases import MODES, TEXTS, Case, copy_tokenizer, draw_views
from .draw import bfloat16
from .files import bfloat16_bits, write_json, write_stream
from .parameters import decoder_layer, linear, parameter, rms_norm, siglip, statistics, tower
from .recorder import ChunkRecorder

NAMES = {"pi0": "lerobot.policies.pi0.PI0Policy", "pi05": "lerobot.policies.pi05.PI05Policy", "pi0_fast": "lerobot.policies.pi0_fast.PI0FastPolicy"}
HUB_TOKENIZER = "google/paligemma-3b-pt-224"
N_TOKEN = 410  # of the tokenizer
PATCH = 14
PWE = "model.paligemma_with_expert."
TOWER = f"{PWE}paligemma."
CONFIG = {
    "paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m", "dtype": "float32", "chunk_size": 50,
    "n_action_steps": 50, "max_state_dim": 32, "max_action_dim": 32, "num_inference_steps": 10, "time_sampling_beta_alpha": 1.5,
    "time_sampling_beta_beta": 1.0, "time_sampling_scale": 0.999, "time_sampling_offset": 0.001, "min_period": 0.004,
    "max_period": 4.0, "use_relative_actions": False, "relative_exclude_joints": ["gripper"], "action_feature_names": None,
    "rtc_config": None, "image_resolution": (224, 224), "empty_cameras": 0, "gradient_checkpointing": False,
    "compile_model": False, "compile_mode": "max-autotune", "freeze_vision_encoder": False, "train_expert_only": False,
    "optimizer_lr": 2.5e-05, "optimizer_betas": [0.9, 0.95], "optimizer_eps": 1e-08, "optimizer_weight_decay": 0.01,
    "optimizer_grad_clip_norm": 1.0, "scheduler_warmup_steps": 1000, "scheduler_decay_steps": 30000, "scheduler_decay_lr": 2.5e-06}
DEFAULTS = {
    "pi0": CONFIG | {"normalization_mapping": layout.IDENTITY | {"STATE": "MEAN_STD", "ACTION": "MEAN_STD"}, "tokenizer_max_length": 48},
    "pi05": CONFIG | {"normalization_mapping": layout.IDENTITY | {"STATE": "QUANTILES", "ACTION": "QUANTILES"}, "tokenizer_max_length": 200}}


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of the towers, what differs from the config class's defaults, features."""

    arch: str
    policy: dict
    vision: dict  # fields of SiglipVisionConfig
    lm: dict  # fields of the reference's GemmaConfig
    expert: dict  # the same
    views: dict = field(default_factory=dict)  # view -> declared (height, width)
    d_state: int = 6
    d_action: int = 7
    n_vocab: int = N_TOKEN
    rename: dict = field(default_factory=dict)
    zero_spread: tuple = ()
    size: str = "tiny"

    @property
    def config(self):
        c = DEFAULTS[self.arch] | self.policy
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action,
                                          layout.empty_cameras(c["empty_cameras"], *c["image_resolution"]))
        return {"type": self.arch} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | c

    def dims(self):
        if self.size == "full":
            return {"size": "full"}
        return {"size": "tiny", "gemma_2b": self.lm, "gemma_300m": self.expert, "vision": self.vision, "vocab_size": self.n_vocab}

    def norms(self, name, d):
        """Of the expert: those of pi0.5 are scaled, shifted and gated by the time."""
        return rms_norm(name, d) if self.arch == "pi0" else linear(f"{name}.dense", 3 * d, d)

    def shapes(self):
        v, c, d, d_expert = self.vision, self.config, self.lm["width"], self.expert["width"]
        n_position = (c["image_resolution"][0] // PATCH) ** 2
        out = siglip(f"{TOWER}model.vision_tower.vision_model.", v["hidden_size"], v["intermediate_size"], v["num_hidden_layers"],
                     PATCH, n_position)
        out |= linear(f"{TOWER}model.multi_modal_projector.linear", d, v["hidden_size"])
        out |= {f"{TOWER}lm_head.weight": (self.n_vocab, d), f"{PWE}gemma_expert.lm_head.weight": (self.n_vocab, d_expert)}
        for at, gemma, norms in ((f"{TOWER}model.language_model.", self.lm, rms_norm), (f"{PWE}gemma_expert.model.", self.expert, self.norms)):
            heads = gemma["num_heads"], gemma["num_kv_heads"], gemma["head_dim"]
            for i in range(gemma["depth"]):
                out |= decoder_layer(f"{at}layers.{i}.", gemma["width"], gemma["mlp_dim"], *heads, norms=norms)
            out |= norms(f"{at}norm", gemma["width"])
        out |= linear("model.action_in_proj", d_expert, c["max_action_dim"]) | linear("model.action_out_proj", c["max_action_dim"], d_expert)
        if self.arch == "pi0":
            out |= linear("model.state_proj", d_expert, c["max_state_dim"])
        mlp, d_in = ("action_time_mlp", 2 * d_expert) if self.arch == "pi0" else ("time_mlp", d_expert)
        return out | linear(f"model.{mlp}_in", d_expert, d_in) | linear(f"model.{mlp}_out", d_expert, d_expert)

    @staticmethod
    def value(name, shape, seed):
        """Gemma's norms multiply by 1 + weight; an adaptive norm's gates spread about 1, or its layer would hardly matter."""
        x = parameter(name, shape, seed)
        if "norm" in name and name.endswith(".weight") and len(shape) == 1 and "vision" not in name:
            x -= 1
        if name.endswith(".dense.bias"):
            x[2 * len(x) // 3 :] += 1
        return bfloat16(x)

    def write(self, seed, folder):
        """config.json, model.safetensors in bfloat16, both pipelines, `tokenizer/`, dims.json.  Returns the parameter count."""
        folder, c, shapes = Path(folder), self.config, self.shapes()
        write_json(folder / "config.json", c, indent=2)
        write_json(folder / "dims.json", self.dims(), indent=1)
        copy_tokenizer("pi", folder / "tokenizer")
        self.write_pipelines(c, seed, folder)
        shared = {f"{TOWER}model.language_model.embed_tokens.weight": f"{TOWER}lm_head.weight"}
        write_stream(folder / "model.safetensors", {n: ("BF16", s) for n, s in sorted(shapes.items())},
                     lambda name: bfloat16_bits(self.value(name, shapes[name], seed)), shared)
        return sum(map(layout.count, shapes.values()))

    def write_pipelines(self, c, seed, folder):
        shown, actions, modes = c["input_features"], c["output_features"], c["normalization_mapping"]
        normalizer = layout.normalizer("normalizer_processor", shown | actions, modes)
        tokenizer = layout.tokenizer(HUB_TOKENIZER, c["tokenizer_max_length"])
        relative = ("relative_actions_processor", {"enabled": c["use_relative_actions"], "exclude_joints": c["relative_exclude_joints"],
                                                   "action_names": c["action_feature_names"]})
        if self.arch == "pi0":
            steps = [("pi0_new_line_processor", {}), tokenizer, layout.device(), relative, normalizer]
        else:
            steps = [relative, normalizer, ("pi05_prepare_state_tokenizer_processor_step", {}), tokenizer, layout.device()]
        after = [layout.normalizer("unnormalizer_processor", actions, modes),
                 ("absolute_actions_processor", {"enabled": c["use_relative_actions"]}), layout.device()]
        numbers = statistics(self.d_state, self.d_action, seed, self.zero_spread)
        layout.write_pipelines(folder, [layout.rename(self.rename), layout.BATCH, *steps], after, numbers)


def gemma(width, depth, heads, kv, d_head, ff):
    return {"width": width, "depth": depth, "mlp_dim": ff, "num_heads": heads, "num_kv_heads": kv, "head_dim": d_head}


def policy(horizon, steps, side, d_max, n_token, **more):
    return {"chunk_size": horizon, "n_action_steps": horizon, "num_inference_steps": steps, "image_resolution": (side, side),
            "max_state_dim": d_max[0], "max_action_dim": d_max[1], "tokenizer_max_length": n_token, **more}


def published(views, arch="pi0"):
    """The published size: 3.2 G parameters that are used (pi0), and the expert's unused head."""
    config = {"dtype": "bfloat16", "chunk_size": 50, "max_action_dim": 32}
    return Checkpoint(arch, config, tower(1152, 27, 16, 4304), gemma(2048, 18, 8, 1, 256, 16384),
                      gemma(1024, 18, 8, 1, 256, 4096), views, d_state=8, n_vocab=257152, size="full")


CASES = {
    # Two views, one wide and one square; a third is declared and never sent. One key-value head, as published, with heads
    # wider in all than the models.
    "pi0/two_views": Case(11, {"base": (20, 28, "png"), "wrist": (36, 36, "png"), "absent": None}, "open the middle drawer", Checkpoint(
        "pi0", policy(5, 4, 28, (10, 9), 20), tower(36, 2, 3, 52), gemma(40, 3, 8, 1, 8, 72), gemma(32, 3, 8, 1, 8, 48),
        {"base": (20, 28), "wrist": (36, 36), "absent": (20, 28)}, d_state=8)),
    # Three views of three aspects, one a JPEG file; an instruction beyond the limit; grouped heads; a 3 x 3 grid; quantiles;
    # other periods of the time embedding.
    "pi0/long_text": Case(12, {"top": (60, 31, "png"), "wrist": (53, 53, "jpg"), "side": (37, 64, "png")},
                          " put the black_bowl on top of the stove, then close the bottom drawer of the cabinet", Checkpoint(
        "pi0", policy(7, 3, 42, (14, 16), 12, min_period=2e-3, max_period=8.0,
                      normalization_mapping={"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILES"}),
        tower(30, 1, 5, 64), gemma(36, 2, 6, 2, 12, 80), gemma(28, 2, 6, 2, 12, 56),
        {"top": (60, 31), "wrist": (53, 53), "side": (37, 64)}, d_state=14, d_action=14)),
    # One of three views absent in the middle, and one that empty_cameras adds; ten steps; ranges; a state number that never
    # moved in the data; an expert as wide as the language model.
    "pi0/absent_view": Case(13, {"wrist": (31, 60, "png"), "front": None, "base": (28, 28, "png"), "empty_camera_0": None},
                            "Öffne die Schublade 12: 开抽屉\n", Checkpoint(
        "pi0", policy(9, 10, 28, (6, 6), 40, empty_cameras=1,
                      normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MIN_MAX", "ACTION": "MIN_MAX"}),
        tower(32, 3, 4, 40), gemma(32, 4, 4, 1, 8, 56), gemma(32, 4, 4, 1, 8, 40),
        {"wrist": (31, 60), "front": (31, 60), "base": (28, 28)}, d_state=5, d_action=3, zero_spread=(2,))),
    # The same towers as pi0/two_views; quantiles, as published; an added empty camera.
    "pi05/two_views": Case(21, {"base": (20, 28, "png"), "wrist": (36, 36, "png"), "empty_camera_0": None}, "open the middle drawer",
                           Checkpoint(
        "pi05", policy(5, 4, 28, (10, 9), 80, empty_cameras=1), tower(36, 2, 3, 52), gemma(40, 3, 8, 1, 8, 72),
        gemma(32, 3, 8, 1, 8, 48), {"base": (20, 28), "wrist": (36, 36)}, d_state=8)),
    # States below and above the range of the bins; means instead of quantiles; blanks, underscores and a line break around
    # the instruction; grouped heads; ten steps.
    "pi05/wide_state": Case(22, {"front": (48, 27, "png")}, "  close_the\ndrawer 42! ", Checkpoint(
        "pi05", policy(6, 10, 42, (8, 8), 100, max_period=2.0,
                       normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}),
        tower(30, 1, 5, 64), gemma(36, 2, 6, 2, 12, 80), gemma(28, 2, 6, 2, 12, 56), {"front": (48, 27)}, d_state=6, d_action=6),
        state=(-3.0, 3.0, 0.0, 0.25, -0.5, 1.5)),
    # A prompt beyond the limit, so that the state is cut off; three views, one absent, one a JPEG file.
    "pi05/long_text": Case(23, {"top": (40, 60, "jpg"), "left": (28, 28, "png"), "right": None},
                           "put the black bowl on top of the stove, then close the bottom drawer of the cabinet", Checkpoint(
        "pi05", policy(8, 5, 28, (14, 14), 24), tower(32, 3, 4, 40), gemma(32, 4, 4, 1, 8, 56), gemma(32, 4, 4, 1, 8, 40),
        {"top": (40, 60), "left": (28, 28), "right": (28, 28)}, d_state=14, d_action=14)),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(arch, seed):
    """A case whose every size comes from the seed; the patches of their tower have 14 pixels."""
    r = random.Random(seed)
    kv, vision_heads, depth, d_head = r.choice((1, 1, 2, 3)), r.choice((1, 2, 3, 5)), r.randint(1, 4), r.choice((4, 8, 12, 16, 32))
    heads = kv * r.choice((1, 2, 4, 8))
    n_empty, d_state, d_action = r.choice((0, 0, 1)), r.randint(1, 14), r.randint(1, 14)
    views, frames = draw_views(r, n_empty)
    modes = {"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)}
    settings = policy(
        r.randint(1, 12), r.choice((1, 2, 5, 10)), 14 * r.choice((1, 2, 2, 3, 4)),
        (max(d_state, r.choice((8, 16, 32))), max(d_action, r.choice((8, 16, 32)))), r.choice((8, 24, 48, 200)),
        empty_cameras=n_empty, normalization_mapping=modes, min_period=r.choice((4e-3, 1e-3)), max_period=r.choice((4.0, 2.0)),
        use_relative_actions=d_state >= d_action and r.random() < 0.3)
    lm, expert = (gemma(r.choice((16, 24, 36, 40)), depth, heads, kv, d_head, r.choice((32, 50))) for _ in range(2))
    vision = tower(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)))
    checkpoint = Checkpoint(arch, settings, vision, lm, expert, views, d_state, d_action)
    return Case(seed, frames, r.choice(TEXTS), checkpoint)


DRAWN = {arch: functools.partial(draw, arch) for arch in ("pi0", "pi05")}


# --- the reference ---------------------------------------------------------------------------------------------------


def modeling(arch):
    return importlib.import_module(f"lerobot.policies.{arch}.modeling_{arch}")


def set_sizes(arch, dims):
    """From here on this process builds towers of these sizes; everything else is the reference's code."""
    m = modeling(arch)
    if not hasattr(m, "published_names"):
        m.published_names = (m.get_gemma_config, m.PaliGemmaForConditionalGenerationWithPiGemma, getattr(m, "PiGemmaForCausalLM", None))
    gemma_config, backbone, expert = m.published_names

    def small_backbone(config):
        for key, value in dims["vision"].items():
            setattr(config.vision_config, key, value)
        width = dims["gemma_2b"]["width"]
        config.vision_config.projection_dim = config.projection_dim = width
        config.text_config.vocab_size = config._vocab_size = dims["vocab_size"]
        config.image_token_index = config.image_token_id = dims["vocab_size"] - 1
        config.text_config.pad_token_id = 0
        return backbone(config)

    def small_expert(config):
        config.vocab_size = dims["vocab_size"]
        return expert(config)

    full = dims.get("size") == "full"
    m.get_gemma_config = gemma_config if full else lambda variant: m.GemmaConfig(**dims[variant])
    m.PaliGemmaForConditionalGenerationWithPiGemma = backbone if full else small_backbone
    m.PiGemmaForCausalLM = expert if full else small_expert


@contextlib.contextmanager
def without_initial_values():
    """Constructs modules without drawing weights: of 3.5 G parameters that alone takes minutes, and all their memory."""
    import torch
    import transformers

    layers = (torch.nn.Linear, torch.nn.Embedding, torch.nn.Conv2d)
    kept = [(layer, layer.reset_parameters) for layer in layers], transformers.PreTrainedModel.init_weights
    for layer in layers:
        layer.reset_parameters = lambda self: None
    transformers.PreTrainedModel.init_weights = lambda self, *args, **kwargs: None
    try:
        yield
    finally:
        for layer, reset in kept[0]:
            layer.reset_parameters = reset
        transformers.PreTrainedModel.init_weights = kept[1]


def construct(config, dims):
    """The policy of a configuration at these sizes, with one table for embedding and head, as its loader leaves them."""
    set_sizes(config.type, dims)
    with without_initial_values():
        policy = getattr(modeling(config.type), NAMES[config.type].split(".")[-1])(config)
    tower = policy.model.paligemma_with_expert.paligemma
    tower.model.language_model.embed_tokens.weight = tower.lm_head.weight
    return policy


def read_weights(policy, file):
    """Every parameter from the file, one by one: from_pretrained goes on with random weights after a failure."""
    import torch
    from safetensors import safe_open

    parameters = dict(policy.named_parameters(remove_duplicate=False))
    with safe_open(file, "pt") as weights, torch.no_grad():
        for name in weights.keys():
            parameters[name].copy_(weights.get_tensor(name))
        missing = set(parameters) - set(weights.keys()) - {f"{TOWER}model.language_model.embed_tokens.weight"}
    if missing:
        raise ValueError(f"{file} lacks {sorted(missing)}")


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor) of a folder in the hub layout; published: the class's own bfloat16 mix."""
    return load_sized(Path(checkpoint), dtype, {}, {})


def load_sized(folder, dtype, own, overrides):
    """own: fields of the configuration that name folders of this machine.  overrides: of further steps of the preprocessor."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors

    config = PreTrainedConfig.from_pretrained(str(folder))
    config.dtype = "bfloat16" if dtype == "published" else "float32"
    for name, value in own.items():
        setattr(config, name, value)
    policy = construct(config, json.loads((folder / "dims.json").read_text()))
    read_weights(policy, folder / "model.safetensors")
    overrides = {"tokenizer_processor": {"tokenizer_name": str(folder / "tokenizer")}, **overrides}
    before, after = make_pre_post_processors(config, pretrained_path=str(folder), preprocessor_overrides=overrides)
    return policy.eval(), before, after


class Recorder(ChunkRecorder):
    def __init__(self, policy):
        super().__init__(policy, policy.config.num_inference_steps)
        model, self.has_state = policy.model, policy.config.type == "pi0"
        backbone, expert = model.paligemma_with_expert.paligemma.model, model.paligemma_with_expert.gemma_expert.model
        vision = backbone.vision_tower
        self.vision_tower(getattr(vision, "vision_model", vision))
        self.per_view(backbone.multi_modal_projector, "projector")
        self.language_layers(backbone.language_model.layers)
        if self.has_state:
            self.after(model.state_proj, lambda x: self.put("state_in", x[0]))
            self.stepwise(model.action_time_mlp_out, "action_time_out")
        self.expert_layers(expert)
        self.stepwise(model.action_out_proj, "action_out")
        module = sys.modules[type(model).__module__]
        self.clone, module.clone_past_key_values = module.clone_past_key_values, self.on_clone

    def at_step(self, name, x):
        super().at_step(name, x[:, -self.policy.config.chunk_size :])  # without pi0's state token

    def on_clone(self, past_key_values):
        self.seen = self.clone(past_key_values)  # the step appends its own keys and values to it
        return self.seen

    def on_step(self, x_t, past_key_values, **kwargs):
        velocity = super().on_step(x_t, past_key_values, **kwargs)
        if self.step == 0 and self.has_state:
            for i, layer in enumerate(self.seen.layers):
                self.with_state(f"expert.blk.{i}.k", layer.keys), self.with_state(f"expert.blk.{i}.v", layer.values)
        return velocity

    def with_state(self, name, x):
        """The valid rows of the prefix, then the state, of (1, head, token, d_head)."""
        import torch

        rows = x[0].transpose(0, 1)
        self.put(name, torch.cat([rows[: len(self.valid)][self.valid], rows[len(self.valid) :][:1]]))

    def run(self, batch, noise):
        super().run(batch, noise)
        if self.has_state:
            self.put("state", self.policy.prepare_state(batch)[0])
        return self.taps
