# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""VLA-JEPA: golden cases, random checkpoints in LeRobot's layout, and LeRobot's class as the reference.

A checkpoint holds `vlm/`, what the hub keeps in the repository of Qwen3-VL, without weights.  Of the world model, which learns beside
the policy and is not asked at inference, it has two tensors of each half.
"""

import contextlib
import random
import types
from dataclasses import dataclass, field
from pathlib import Path

from . import gr00t_n1_7
from . import lerobot_layout as layout
from .cases import LIBERO_FRAMES, LIBERO_INSTRUCTION, MODES, TEXTS, Case, backbone_folder
from .files import bfloat16_bits, write_json, write_stream
from .gr00t_n1_7 import N_VOCAB, TOKENS, QwenTaps, text, vision
from .parameters import linear, parameter, statistics
from .recorder import given_noise

NAMES = {"vla_jepa": "lerobot.policies.vla_jepa.VLAJEPAPolicy"}
HUB_NAME = "Qwen/Qwen3-VL-2B-Instruct"
QWEN, HEAD = "model.qwen.model.", "model.action_model."
TABLE, LM_HEAD = f"{QWEN}model.language_model.embed_tokens.weight", f"{QWEN}lm_head.weight"  # one tensor under two names
PRESETS = {"DiT-B": (12, 64), "DiT-L": (32, 48), "DiT-test": (2, 8)}  # heads and the width of one
PROMPT = ("Your task is {instruction}. Infer the temporal dynamics from frames {actions} and produce the corresponding policy actions "
          "{e_actions}.")
CONFIG = {
    "chunk_size": 7, "n_action_steps": 7, "normalization_mapping": layout.IDENTITY | {"STATE": "MEAN_STD", "ACTION": "MIN_MAX"},
    "qwen_model_name": HUB_NAME, "jepa_encoder_name": "facebook/vjepa2-vitl-fpc64-256", "freeze_qwen": False, "enable_world_model": True,
    "reinit_modules": None, "tokenizer_padding_side": "left", "prompt_template": PROMPT, "special_action_token": "<|action_{}|>",
    "embodied_action_token": "<|embodied_action|>", "action_dim": 7, "state_dim": 8, "num_action_tokens_per_timestep": 8,
    "num_embodied_action_tokens_per_instruction": 32, "num_inference_timesteps": 4, "action_hidden_size": 1024,
    "action_model_type": "DiT-B", "action_num_layers": 16, "action_num_heads": None, "action_attention_head_dim": None,
    "action_dropout": 0.2, "action_num_timestep_buckets": 1000, "action_noise_beta_alpha": 1.5, "action_noise_beta_beta": 1.0,
    "action_noise_s": 0.999, "num_target_vision_tokens": 32, "action_max_seq_len": 1024, "num_video_frames": 8, "predictor_depth": 12,
    "predictor_num_heads": 8, "predictor_mlp_ratio": 4.0, "predictor_dropout": 0.0, "world_model_loss_weight": 0.1,
    "jepa_tubelet_size": 2, "repeated_diffusion_steps": 8, "resize_images_to": None, "binarize_gripper_action": True,
    "pre_snap_gripper_action": True, "clip_normalized_actions": True, "gripper_dim": 6, "gripper_threshold": 0.5,
    "torch_dtype": "bfloat16", "optimizer_lr": 1e-4, "optimizer_betas": [0.9, 0.95], "optimizer_eps": 1e-8,
    "optimizer_weight_decay": 1e-10, "optimizer_grad_clip_norm": 10.0, "scheduler_warmup_steps": 1000, "scheduler_decay_steps": 30000,
    "scheduler_decay_lr": 2.5e-6}
D_VIDEO = 8  # width of the world model


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of the backbone, what differs from VLAJEPAConfig's defaults, features."""

    vision: dict
    text: dict
    policy: dict
    views: dict  # view -> declared (height, width)
    d_state: int = 8  # 0: none
    d_action: int = 7
    side: int = 0  # of the smallest square image that the backbone's processor leaves alone
    tubelet: int = 2  # frames that the world model's encoder sees as one
    rename: dict = field(default_factory=dict)  # name in the data set -> name of the feature
    zero_spread: tuple = ()
    dtype: str = "BF16"  # of the backbone
    prunes: str = "embed_tokens"  # of two names of one table the one that is not stored; "" where both are

    @property
    def config(self):
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action)
        widths = {"action_dim": self.d_action, "state_dim": self.d_state}
        return {"type": "vla_jepa"} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | CONFIG | widths | self.policy

    @property
    def backbone(self):
        return gr00t_n1_7.Checkpoint("", 0, None, self.vision, self.text, {"select_layer": self.text["num_hidden_layers"]}, {}, self.side)

    @property
    def n_row(self):
        """Rows of the table of tokens, which grows where it has none for the tokens that the policy adds."""
        return max(self.text.get("vocab_size", N_VOCAB), max(TOKENS.values()) + 1 + 4 * self.config["chunk_size"] + 1)

    def shapes(self):
        out = {QWEN + name.removeprefix("backbone.model."): shape for name, shape in self.backbone.backbone_shapes().items()}
        out[TABLE] = out[LM_HEAD] = (self.n_row, self.text["hidden_size"])
        if self.prunes:
            del out[TABLE if self.prunes == "embed_tokens" else LM_HEAD]
        return out | head_shapes(self.config, self.text["hidden_size"]) | self.world_model()

    def world_model(self):
        if not self.config["enable_world_model"]:
            return {}
        encoder, predictor = "model.video_encoder.encoder.embeddings.patch_embeddings.proj", "model.video_predictor.predictor_embed"
        convolution = {f"{encoder}.weight": (D_VIDEO, 3, self.tubelet, 16, 16), f"{encoder}.bias": (D_VIDEO,)}
        return convolution | linear(predictor, D_VIDEO, D_VIDEO * self.config["jepa_tubelet_size"])

    def write(self, seed, folder):
        """config.json, model.safetensors, both pipelines, the backbone's files.  Returns the parameter count."""
        folder, c, shapes = Path(folder), self.config, self.shapes()
        write_json(folder / "config.json", c, indent=2)
        self.backbone.write_backbone(folder / "vlm")
        shown, actions, modes = c["input_features"], c["output_features"], c["normalization_mapping"]
        before = [layout.rename(self.rename), layout.BATCH, layout.device(), layout.normalizer("normalizer_processor", shown | actions, modes)]
        layout.write_pipelines(folder, before, self.after(shown | actions, modes), statistics(self.d_state, self.d_action, seed, self.zero_spread))
        dtypes = {name: self.dtype if name.startswith(QWEN) else "F32" for name in shapes}

        def value(name):
            x = parameter(TABLE if name == LM_HEAD else name, shapes[name], seed)
            return bfloat16_bits(x) if dtypes[name] == "BF16" else x

        alias = {"embed_tokens": {TABLE: LM_HEAD}, "lm_head": {LM_HEAD: TABLE}, "": {}}[self.prunes]
        write_stream(folder / "model.safetensors", {n: (dtypes[n], s) for n, s in sorted(shapes.items())}, value, {"format": "pt"} | alias)
        return sum(map(layout.count, shapes.values()))

    def after(self, features, modes):
        """As LeRobot saves the steps: those of the gripper without its dimension and its threshold, which a loaded pipeline then has from
        their classes (processor_vla_jepa.py: neither class has a get_config)."""
        c, steps = self.config, []
        if c["clip_normalized_actions"]:
            steps.append(("vla_jepa_clip_actions", {}))
        if c["pre_snap_gripper_action"]:
            steps.append(("vla_jepa_pre_snap_gripper", {}))
        steps.append(layout.normalizer("unnormalizer_processor", features, modes))
        if c["binarize_gripper_action"]:
            steps.append(("vla_jepa_binarize_gripper", {}))
        return [*steps, layout.device()]


def head_shapes(c, d_context):
    heads, d_head = (own or preset for own, preset in zip((c["action_num_heads"], c["action_attention_head_dim"]), PRESETS[c["action_model_type"]], strict=True))
    d, d_hidden, d_action, at = heads * d_head, c["action_hidden_size"], c["action_dim"], f"{HEAD}model."
    out = linear(f"{at}timestep_encoder.timestep_embedder.linear_1", d, 256) | linear(f"{at}timestep_encoder.timestep_embedder.linear_2", d, d)
    for i in range(c["action_num_layers"]):
        block = f"{at}transformer_blocks.{i}."
        out |= linear(f"{block}norm1.linear", 2 * d, d)
        for part, d_in in (("to_q", d), ("to_k", d if i % 2 else d_context), ("to_v", d if i % 2 else d_context), ("to_out.0", d)):
            out |= linear(f"{block}attn1.{part}", d, d_in)
        out |= linear(f"{block}ff.net.0.proj", 4 * d, d) | linear(f"{block}ff.net.2", d, 4 * d)
    out |= linear(f"{at}proj_out_1", 2 * d, d) | linear(f"{at}proj_out_2", d_hidden, d)
    out |= linear(f"{HEAD}action_encoder.layer1", d, d_action) | linear(f"{HEAD}action_encoder.layer2", d, 2 * d) | linear(f"{HEAD}action_encoder.layer3", d, d)
    out |= linear(f"{HEAD}action_decoder.layer1", d_hidden, d_hidden) | linear(f"{HEAD}action_decoder.layer2", d_action, d_hidden)
    if c["state_dim"]:
        out |= linear(f"{HEAD}state_encoder.layer1", d_hidden, c["state_dim"]) | linear(f"{HEAD}state_encoder.layer2", d, d_hidden)
    n_position = max(1024, c["chunk_size"] + c["num_action_tokens_per_timestep"] + 4)
    return out | {f"{HEAD}future_tokens.weight": (c["num_embodied_action_tokens_per_instruction"], d), f"{HEAD}position_embedding.weight": (n_position, d)}


FRAMES, INSTRUCTION = LIBERO_FRAMES, LIBERO_INSTRUCTION


def published(views, arch="vla_jepa"):
    """The published size, with the robot of LIBERO: 2.3 B parameters, without those of the world model."""
    sizes = vision(1024, 24, 16, 4096, 48, (5, 11, 17), 16), text(2048, 28, 16, 8, 128, 6144, (24, 20, 20)) | {"vocab_size": 151936}
    return Checkpoint(*sizes, {"chunk_size": CONFIG["chunk_size"], "enable_world_model": False, "resize_images_to": [224, 224]}, views, side=256)


# --- cases -----------------------------------------------------------------------------------------------------------


def policy(horizon, steps, heads, layers, d_hidden, n_embodied, **more):
    """heads: of the transformer, and the width of one."""
    return {"chunk_size": horizon, "n_action_steps": horizon, "num_inference_timesteps": steps, "action_num_heads": heads[0],
            "action_attention_head_dim": heads[1], "action_num_layers": layers, "action_hidden_size": d_hidden,
            "num_embodied_action_tokens_per_instruction": n_embodied, **more}


SHORT = "Do {instruction}: {actions} {e_actions}"

CASES = {
    # As published but smaller: two cameras, shrunk by areas and enlarged again by the backbone's processor; a world model that the
    # policy does not ask; a gripper that is snapped.
    "vla_jepa/libero": Case(51, {"image": (28, 28, "png"), "wrist_image": (31, 28, "png")}, "open the middle drawer", Checkpoint(
        vision(16, 4, 2, 28, 5, (0, 2, 3)), text(16, 5, 4, 2, 8, 28, (2, 1, 1)), policy(5, 4, (3, 8), 3, 20, 6, resize_images_to=[20, 20]),
        {"image": (28, 28), "wrist_image": (31, 28)}, d_state=5, side=24)),
    # One camera of 4:3, shrunk as it is; no state; five steps; a tokenizer with room for the policy's tokens; a short prompt; an
    # instruction with letters in two parts, other scripts, special tokens of all kinds and braces.
    "vla_jepa/camera": Case(82, {"front": (36, 48, "png")},
        " Öffne \"Schublade_12\"{actions} -- don't\nPlätze 开抽屉 %s<|im_end|>{{0}} #42", Checkpoint(
        vision(12, 5, 3, 20, 6, (1, 2, 4)), text(16, 4, 3, 1, 8, 24, (2, 1, 1)) | {"vocab_size": N_VOCAB + 40},
        policy(4, 5, (2, 6), 4, 14, 9, prompt_template=SHORT, num_action_tokens_per_timestep=3, enable_world_model=False,
               normalization_mapping=layout.IDENTITY | {"STATE": "MEAN_STD", "ACTION": "QUANTILES"}),
        {"front": (36, 48)}, d_state=0, d_action=6, side=32, prunes="lm_head")),
    # Three cameras, enlarged by areas to a size that the backbone takes; a preset's heads; action tokens behind the embodied ones; actions
    # as they are; weights in float32, the table stored twice; another name of a view.
    "vla_jepa/three_views": Case(62, {"top": (10, 13, "png"), "left": (20, 14, "jpg"), "right": (12, 12, "png")}, "stack the cups", Checkpoint(
        vision(16, 4, 1, 24, 3, (0, 1, 3)), text(24, 4, 2, 2, 12, 20, (2, 2, 2)),
        policy(6, 3, (None, None), 2, 18, 4, action_model_type="DiT-test", resize_images_to=[16, 24], num_video_frames=6,
               prompt_template="{instruction}, {e_actions}{actions}", num_action_tokens_per_timestep=2, clip_normalized_actions=False,
               pre_snap_gripper_action=False, binarize_gripper_action=False, torch_dtype="float32",
               normalization_mapping=layout.IDENTITY | {"STATE": "MIN_MAX", "ACTION": "MEAN_STD"}),
        {"top": (10, 13), "left": (20, 14), "right": (12, 12)}, d_state=9, d_action=8, side=16, tubelet=3, dtype="F32", prunes="",
        rename={"observation.images.cam": "observation.images.top"})),
    # Frames that the backbone takes as they are; one step, one layer, one embodied token; a number that never moved; a gripper that is
    # snapped and not turned.
    "vla_jepa/small": Case(77, {"camera": (16, 24, "png")}, "Go on", Checkpoint(
        vision(12, 3, 1, 16, 4, (0, 1, 2)), text(16, 4, 2, 1, 8, 16, (2, 1, 1)),
        policy(3, 1, (1, 10), 1, 12, 1, prompt_template=SHORT, num_video_frames=4, jepa_tubelet_size=1, binarize_gripper_action=False,
               enable_world_model=False, normalization_mapping=layout.IDENTITY | {"STATE": "QUANTILES", "ACTION": "IDENTITY"}),
        {"camera": (16, 24)}, d_state=4, d_action=7, side=16, zero_spread=(2,))),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(seed):
    """A case whose every size comes from the seed: prompts, tokens, cameras, steps of the pipeline; in one of ten an instruction that the backbone takes an image for."""
    r = random.Random(f"vla_jepa {seed}")
    heads, kv, d_head = r.choice(((4, 2, 8), (3, 1, 12), (6, 3, 8), (5, 5, 8), (2, 2, 16), (1, 1, 12)))
    vision_heads, depth, side, n_view = r.choice((1, 2, 3)), r.randint(3, 5), 8 * r.choice((2, 3, 4)), r.randint(1, 3)
    deepstack = sorted(r.sample(range(depth), r.choice((1, 2, 3))))
    sizes = (vision(vision_heads * 4 * r.choice((2, 3, 4)), depth, vision_heads, 2 * r.randint(8, 20), r.randint(3, 7), deepstack),
             text(2 * r.randint(6, 18), r.randint(4, 6), heads, kv, d_head, r.choice((32, 50)), {8: (2, 1, 1), 12: (2, 2, 2), 16: (4, 2, 2)}[d_head])
             | r.choice(({}, {"vocab_size": N_VOCAB + 60})))
    frames = {f"cam{i}": (r.randint(12, 60), r.randint(12, 60), r.choice(("png", "png", "jpg"))) for i in range(n_view)}
    area = [r.randint(10, 40), r.randint(10, 40)] if r.random() < 0.6 else None
    if area is None:
        frames = {view: (*frames["cam0"][:2], frame[2]) for view, frame in frames.items()}
    world_model, video = r.random() < 0.5, r.choice((4, 6, 8))
    modes = {"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)}
    flags = {key: r.random() < 0.6 for key in ("clip_normalized_actions", "pre_snap_gripper_action", "binarize_gripper_action")}
    settings = policy(
        r.randint(1, 12), r.choice((1, 2, 4, 7)), r.choice(((2, 6), (3, 4), (1, 10), (None, None))), r.randint(1, 5), r.randint(6, 30), r.randint(1, 12),
        action_model_type="DiT-test", resize_images_to=area, enable_world_model=world_model, num_video_frames=video, torch_dtype=r.choice(("float32", "bfloat16")),
        num_action_tokens_per_timestep=r.randint(1, 8), normalization_mapping=modes, action_num_timestep_buckets=r.choice((1000, 1000, 100)),
        prompt_template=r.choice((PROMPT, SHORT, "{instruction}{e_actions}", "{actions} {instruction}\n{e_actions}!")), **flags)
    checkpoint = Checkpoint(*sizes, settings, {view: frame[:2] for view, frame in frames.items()}, r.choice((0, 1, 7, 20)), r.randint(1, 12), side,
                            tubelet=r.choice((1, 2)), dtype=r.choice(("BF16", "BF16", "F32")), prunes=r.choice(("embed_tokens", "lm_head", "")))
    words = r.choice((*TEXTS, "{actions} of %s {0}")) if r.random() < 0.9 else "go<|placeholder|>"
    return Case(seed, frames, words, checkpoint)


DRAWN = {"vla_jepa": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def from_folder(folder, checkpoint):
    """The backbone without weights, instead of a download; and of the world model's encoder what the policy's constructor reads."""
    import torch
    from lerobot.policies.vla_jepa import modeling_vla_jepa, qwen_interface
    from safetensors import safe_open
    from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

    def backbone(name, torch_dtype):
        return Qwen3VLForConditionalGeneration(Qwen3VLConfig.from_pretrained(folder)).to(torch_dtype)

    class Encoder(torch.nn.Module):
        def __init__(self):
            super().__init__()
            with safe_open(checkpoint / "model.safetensors", "pt") as stored:
                _, _, tubelet, _, _ = stored.get_slice("model.video_encoder.encoder.embeddings.patch_embeddings.proj.weight").get_shape()
            self.config = types.SimpleNamespace(tubelet_size=tubelet, hidden_size=D_VIDEO, image_size=16)

    own = qwen_interface.Qwen3VLForConditionalGeneration, modeling_vla_jepa.AutoModel, modeling_vla_jepa.AutoVideoProcessor
    qwen_interface.Qwen3VLForConditionalGeneration = types.SimpleNamespace(from_pretrained=backbone)
    modeling_vla_jepa.AutoModel = types.SimpleNamespace(from_pretrained=lambda *args, **kwargs: Encoder())
    modeling_vla_jepa.AutoVideoProcessor = types.SimpleNamespace(from_pretrained=lambda *args: None)
    try:
        yield
    finally:
        qwen_interface.Qwen3VLForConditionalGeneration, modeling_vla_jepa.AutoModel, modeling_vla_jepa.AutoVideoProcessor = own


def read_weights(policy, checkpoint):
    """Everything but the world model is stored, and nothing else."""
    from safetensors.torch import load_file

    missing, unexpected = policy.load_state_dict(load_file(checkpoint / "model.safetensors"), strict=False)
    other = [name for name in (*missing, *unexpected) if not name.startswith("model.video_") and "embed_tokens" not in name and "lm_head" not in name]
    if other:
        raise ValueError(f"{checkpoint}: {', '.join(other[:9])}")


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: the backbone in bfloat16 behind torch.autocast, as the policy runs it."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.vla_jepa import modeling_vla_jepa

    checkpoint = Path(checkpoint).resolve()
    config = PreTrainedConfig.from_pretrained(str(checkpoint))
    folder = backbone_folder(checkpoint)
    config.qwen_model_name = str(folder)
    if dtype == "float32":
        config.torch_dtype = "float32"
    with from_folder(folder, checkpoint):
        policy = modeling_vla_jepa.VLAJEPAPolicy(config).eval()
    read_weights(policy, checkpoint)
    return Reference(policy, dtype), *make_pre_post_processors(config, pretrained_path=str(checkpoint))


class Reference:
    """LeRobot's policy, with the noise given to it, and in float32 without torch.autocast, which it else turns on everywhere."""

    def __init__(self, policy, dtype):
        self.config, self.policy, self.dtype, self.model = types.SimpleNamespace(type="vla_jepa"), policy, dtype, policy.model

    def predict_action_chunk(self, batch, noise):
        from lerobot.policies.vla_jepa import modeling_vla_jepa

        autocast = modeling_vla_jepa._get_autocast_context
        if self.dtype == "float32":
            modeling_vla_jepa._get_autocast_context = lambda *args: contextlib.nullcontext()
        try:
            with given_noise(noise):
                return self.policy.predict_action_chunk(dict(batch))
        finally:
            modeling_vla_jepa._get_autocast_context = autocast


class Recorder(QwenTaps):
    """Of a prompt, the tokens up to the last embodied one: those behind it change nothing that the head reads."""

    def __init__(self, reference):
        self.reference, model = reference, reference.model
        head, qwen = model.action_model, model.qwen.model
        super().__init__(head.num_inference_timesteps)
        self.n_front = head.future_tokens.num_embeddings + (head.state_encoder is not None)
        self.build_inputs, model.qwen.build_inputs = model.qwen.build_inputs, self.on_inputs
        self.backbone(qwen.model.visual, qwen.model.language_model, qwen.config.image_token_id)
        self.head(head)

    def head(self, head):
        if head.state_encoder is not None:
            self.before(head.state_encoder, lambda x: self.put("state", x[0].flatten()))
            self.after(head.state_encoder, lambda x: self.put("state_out", x[0]))
        self.before(head.action_encoder, self.on_step)
        self.dit(head.model)

    def on_inputs(self, **prompt):
        import torch

        batch = self.build_inputs(**prompt)
        embodied = (batch["input_ids"][0] == self.reference.model.embodied_action_token_id).nonzero()
        self.n_row = int(embodied[-1]) + 1
        self.on_batch(batch)
        self.image = torch.zeros(len(embodied), dtype=torch.bool)  # of the rows that the head looks at
        return batch

    def put(self, name, x):
        if name in ("tokens", "prefix") or name.startswith("lm.blk."):
            x = x[: self.n_row]
        super().put(name, x[:, : self.n_row] if name == "position_ids" else x)

    def run(self, batch, noise):
        """Every tap of one inference."""
        chunk = self.reference.predict_action_chunk(batch, noise)[0]
        self.put(f"step.{self.step}.x", chunk)
        self.put("chunk", chunk)
        return self.taps
