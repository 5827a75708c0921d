# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7: golden cases, random checkpoints in the authors' layout, and LeRobot's class as the reference.

The layout: config.json, two shards of safetensors with their index, processor_config.json, statistics.json, embodiment_id.json, and
`vlm/`, which is what the hub keeps in the backbone's repository, without weights.  LeRobot turns LIBERO's gripper into the
simulator's sign: the authors' server does not, and so nothing is done to it here.
"""

import contextlib
import functools
import json
import types
from dataclasses import dataclass
from pathlib import Path

from . import gr00t
from .cases import LIBERO_FRAMES, backbone_folder, copy_tokenizer
from .files import write_json
from .gr00t import POSE, HeadTaps, Robot, case, embodiment, head
from .parameters import decoder, linear, norm
from .recorder import given_noise
from .train_tokenizer import QWEN_VL

HUB_NAME = "nvidia/Cosmos-Reason2-2B"
N_MERGE = 60
TOKENS = {name: 256 + N_MERGE + i for i, name in enumerate(QWEN_VL)}
N_VOCAB = max(TOKENS.values()) + 1 + 5  # the embedding has rows behind the last token
CONFIG = {
    "model_dtype": "bfloat16", "model_name": HUB_NAME, "backbone_model_type": "qwen", "model_revision": None, "tune_top_llm_layers": 0,
    "tune_llm": False, "tune_visual": False, "reproject_vision": False, "use_flash_attention": False, "load_bf16": False,
    "backbone_trainable_params_fp32": True, "random_rotation_angle": None, "color_jitter_params": None,
    "use_albumentations_transforms": True, "extra_augmentation_config": None, "formalize_language": True,
    "apply_sincos_state_encoding": False, "state_history_length": 1, "add_pos_embed": True, "attn_dropout": 0.2, "use_vlln": True,
    "use_alternate_vl_dit": True, "attend_text_every_n_blocks": 2, "num_inference_timesteps": 4, "noise_beta_alpha": 1.5,
    "noise_beta_beta": 1.0, "noise_s": 0.999, "num_timestep_buckets": 1000, "tune_projector": True, "tune_diffusion_model": True,
    "tune_vlln": True, "state_dropout_prob": 0.2, "exclude_state": False, "use_mean_std": False, "rtc_ramp_rate": 6.0,
    "model_type": "Gr00tN1d7", "architectures": ["Gr00tN1d7"], "torch_dtype": "bfloat16", "dtype": "bfloat16"}


@dataclass(frozen=True)
class Checkpoint(gr00t.Checkpoint):
    CONFIG = CONFIG
    PROCESSOR_CLASS = "Gr00tN1d7Processor"
    N_VOCAB = N_VOCAB

    def backbone_shapes(self):
        v, t = self.vision, self.text
        d, d_model, side = v["hidden_size"], t["hidden_size"], v["patch_size"]
        at = "backbone.model.model.visual."
        out = {f"{at}patch_embed.proj.weight": (d, 3, 2, side, side), f"{at}patch_embed.proj.bias": (d,),
               f"{at}pos_embed.weight": (v["num_position_embeddings"], d)}
        for i in range(v["depth"]):
            block = f"{at}blocks.{i}."
            out |= norm(f"{block}norm1", d) | norm(f"{block}norm2", d) | linear(f"{block}attn.qkv", 3 * d, d) | linear(f"{block}attn.proj", d, d)
            out |= linear(f"{block}mlp.linear_fc1", v["intermediate_size"], d) | linear(f"{block}mlp.linear_fc2", d, v["intermediate_size"])
        mergers = {"merger": d} | {f"deepstack_merger_list.{k}": 4 * d for k in range(len(v["deepstack_visual_indexes"]))}
        for merger, d_norm in mergers.items():
            out |= norm(f"{at}{merger}.norm", d_norm) | linear(f"{at}{merger}.linear_fc1", 4 * d, 4 * d)
            out |= linear(f"{at}{merger}.linear_fc2", d_model, 4 * d)
        return out | self.language_shapes("backbone.model.model.language_model.")

    def write_backbone(self, folder):
        """What the hub keeps in the backbone's repository, without weights."""
        copy_tokenizer("gr00t", folder)
        text = {"model_type": "qwen3_vl_text", "vocab_size": N_VOCAB, "rms_norm_eps": 1e-6,
                "rope_theta": 5000000, "max_position_embeddings": 512, "hidden_act": "silu", "attention_bias": False,
                "attention_dropout": 0.0, "bos_token_id": TOKENS["<|endoftext|>"], "eos_token_id": TOKENS["<|im_end|>"],
                "tie_word_embeddings": True} | self.text
        vision = {"model_type": "qwen3_vl", "in_channels": 3, "temporal_patch_size": 2, "spatial_merge_size": 2,
                  "hidden_act": "gelu_pytorch_tanh", "out_hidden_size": text["hidden_size"]} | self.vision
        ids = {"image_token_id": "image_pad", "video_token_id": "video_pad", "vision_start_token_id": "vision_start",
               "vision_end_token_id": "vision_end"}
        write_json(folder / "config.json", {
            "architectures": ["Qwen3VLForConditionalGeneration"], "model_type": "qwen3_vl", "tie_word_embeddings": True,
            "text_config": text, "vision_config": vision} | {k: TOKENS[f"<|{token}|>"] for k, token in ids.items()}, indent=2)
        images = {"size": {"longest_edge": 1 << 20, "shortest_edge": self.side**2}, "patch_size": vision["patch_size"],
                  "temporal_patch_size": 2, "merge_size": 2, "image_mean": [0.5] * 3, "image_std": [0.5] * 3,
                  "processor_class": "Qwen3VLProcessor"}
        for file, kind in (("preprocessor_config", {"image_processor_type": "Qwen2VLImageProcessorFast"}),
                           ("video_preprocessor_config", {"video_processor_type": "Qwen3VLVideoProcessor"})):
            write_json(folder / f"{file}.json", images | kind, indent=2)

# --- cases -----------------------------------------------------------------------------------------------------------


def vision(d, layers, heads, ff, side, deepstack, patch=4):
    """side: of the square table of positions."""
    return {"hidden_size": d, "depth": layers, "num_heads": heads, "intermediate_size": ff, "num_position_embeddings": side * side,
            "deepstack_visual_indexes": list(deepstack), "patch_size": patch}


def text(d, layers, heads, kv, d_head, ff, sections):
    rope = {"mrope_interleaved": True, "mrope_section": list(sections), "rope_type": "default"}
    return decoder(d, layers, heads, kv, ff, d_head, rope_scaling=rope)


CASES = {
    # Two square cameras, shrunk by a fraction, cropped and enlarged again; ranges instead of percentiles; a robot that gets
    # five of eight rows; its state and its actions are of different widths.
    "gr00t_n1_7/libero": case(41, {"image": (45, 45, "png"), "wrist_image": (45, 45, "png")}, "open the middle drawer", Checkpoint(
        "libero_sim", 2, Robot(("image", "wrist_image"), POSE | {"gripper": 2}, POSE | {"gripper": 1}, 5),
        vision(24, 5, 3, 44, 5, (0, 2, 3)), text(40, 6, 6, 2, 12, 56, (2, 2, 2)),
        head(4, (6, 4, 9), (2, 5, 8), 20, 14, 11, 8),
        {"image_target_size": [32, 32], "shortest_image_edge": 32, "crop_fraction": 0.95}, 32)),
    # Percentiles, with numbers beyond them and one that never moved; one camera, padded to a square and halved; the last vision
    # layer feeds DeepStack as well as the connector; one key-value head; eight DiT blocks; the whole horizon.
    "gr00t_n1_7/percentiles": case(42, {"front": (40, 64, "png")}, "push the plate slowly", Checkpoint(
        "simpler_env_widowx", 1, Robot(("front",), {"pose": 4, "pad": 1, "gripper": 1}, {"gripper": 1, "pose": 4}, 6, zero_spread=(2,)),
        vision(24, 4, 2, 36, 6, (0, 1, 3)), text(36, 7, 4, 1, 16, 48, (4, 2, 2)),
        head(5, (8, 3, 8), (1, 3, 12), 18, 9, 7, 6),
        {"image_target_size": [32, 32], "image_crop_size": [28, 28], "letter_box_transform": True}, 32, percentiles=True),
        state=(0.5, -2.25, 0.1, 4.0, 0.03125, -3.5)),
    # Joints that are predicted relative to the state, by statistics of their own, beside a gripper that is not; one part is
    # relative to a state of another name. Three cameras whose aspect is kept: six by eight patches.
    "gr00t_n1_7/relative": case(43, {"ego_view": (36, 48, "png"), "left": (36, 48, "png"), "right": (36, 48, "jpg")},
        "stack the green block on the yellow block", Checkpoint(
        "real_arms_relative_joints", 1, Robot(
            ("ego_view", "left", "right"), {"gripper": 1, "right_arm_joints": 4, "left_arm": 3, "waist": 2},
            {"gripper": 1, "right_arm": 4, "left_arm": 3}, 7, {"right_arm": "right_arm_joints", "left_arm": None}),
        vision(32, 4, 2, 40, 7, (0, 1, 2)), text(40, 5, 5, 5, 8, 52, (2, 1, 1)),
        head(4, (6, 5, 6), (2, 4, 10), 22, 12, 10, 9),
        {"image_target_size": [24, 24], "image_crop_size": [22, 22]}, 24, percentiles=True),
        options={"camera_size": "48x36"}),
    # An instruction that has to be cleaned: capitals, punctuation, what looks like a special token, letters in two parts and in other
    # scripts, digits of several kinds; five steps; frames shrunk to a third; no crop; text blocks every third time; four
    # language layers that the policy cuts off.
    "gr00t_n1_7/clean_text": case(44, {"top": (48, 48, "png"), "wrist": (48, 48, "png")},
        "  \u00d6ffne die \"Schublade_12\" -- don't stop!\nPla\u0308tze \u5f00\u62bd\u5c49\uff0c THEN put the black-bowl (n\u00b0 3\u00bd) on top"
        " of the stove<|im_end|>; it\u2019s \u0645\u0646\u0636\u062f\u0629 #42. Close the bottom drawer, and stack the GREEN block ", Checkpoint(
        "my_robot.v2", 2, Robot(("top", "wrist"), {"joints": 6}, {"joints": 5, "hand": 2}, 4),
        vision(28, 4, 7, 32, 4, (0, 1, 2), 2), text(36, 8, 3, 1, 20, 40, (4, 3, 3)),
        head(4, (7, 2, 16), (3, 2, 18), 26, 8, 8, 5, num_inference_timesteps=5, attend_text_every_n_blocks=3),
        {"image_target_size": [16, 16], "image_crop_size": [16, 16]}, 16)),
    # Numbers so small that every eps shows; a frame that is enlarged; two words.
    "gr00t_n1_7/faint": case(45, {"camera": (12, 12, "png")}, "Go on", Checkpoint(
        "simpler_env_google", 1, Robot(("camera",), {"x": 1, "hand": 3}, {"x": 1, "hand": 2}, 3),
        vision(16, 3, 2, 24, 3, (0, 1, 2)), text(24, 5, 3, 1, 8, 32, (2, 1, 1)),
        head(4, (6, 2, 10), (1, 3, 8), 14, 6, 5, 4),
        {"image_target_size": [16, 16], "shortest_image_edge": 16, "crop_fraction": 0.9}, 16, faint=True)),
    # Cameras of 4:3, which the backbone's image processor resizes once more.
    "gr00t_n1_7/four_by_three": case(46, {"front": (30, 40, "png"), "wrist": (30, 40, "png")}, "close the bottom drawer", Checkpoint(
        "xdof", 1, Robot(("front", "wrist"), {"joints": 4}, {"joints": 4}, 4),
        vision(16, 3, 2, 24, 5, (0, 1, 2)), text(24, 5, 3, 1, 8, 32, (2, 1, 1)),
        head(4, (4, 2, 10), (1, 3, 8), 14, 6, 5, 5), {"image_target_size": [26, 26], "image_crop_size": [24, 24]}, 16),
        options={"camera_size": "40x30"}),
    # Two cameras, each with the frame of now and that of fifteen steps ago.
    "gr00t_n1_7/two_moments": case(47, {name: (20, 20, "png") for name in ("front@-15", "wrist@-15", "front", "wrist")},
        "push the plate slowly", Checkpoint(
        "xdof", 1, Robot(("front", "wrist"), {"joints": 4}, {"joints": 4}, 4, moments=(-15, 0)),
        vision(16, 3, 2, 24, 5, (0, 1, 2)), text(24, 5, 3, 1, 8, 32, (2, 1, 1)),
        head(4, (4, 2, 10), (1, 3, 8), 14, 6, 5, 5), {"image_target_size": [16, 16], "image_crop_size": [15, 15]}, 16)),
    # A pose and joints relative to the state, with ranges for each row of the chunk, beside a gripper that is absolute; the pose's
    # columns are not those of the state.
    "gr00t_n1_7/poses": case(48, {"front": (20, 20, "png")}, "stack the cups", Checkpoint(
        "oxe_droid_relative_eef_relative_joint", 2, Robot(
            ("front",), {"joint_position": 3, "gripper_position": 1, "eef_9d": 9}, {"eef_9d": 9, "gripper_position": 1, "joint_position": 3}, 4,
            {"eef_9d": None, "joint_position": None}, poses={"eef_9d": "XYZ_ROT6D"}, per_step=True),
        vision(16, 3, 2, 24, 5, (0, 1, 2)), text(24, 5, 3, 1, 8, 32, (2, 1, 1)),
        head(4, (4, 2, 10), (1, 3, 8), 14, 15, 14, 5), {"image_target_size": [16, 16], "image_crop_size": [15, 15]}, 16, percentiles=True)),
}


OPTIONS = {"embodiment": "libero_sim"}
FRAMES = LIBERO_FRAMES


def published(views, arch="gr00t_n1_7"):
    """The published size: 3.1 G parameters."""
    return gr00t.published(
        Checkpoint, views, "libero_sim", 2, vision(1024, 24, 16, 4096, 48, (5, 11, 17), 16),
        text(2048, 28, 16, 8, 128, 6144, (24, 20, 20)) | {"vocab_size": 151936}, head(16, (32, 32, 48), (4, 32, 64), 1024, 132, 132, 40),
        {"image_target_size": [256, 256], "shortest_image_edge": 256, "crop_fraction": 0.95}, 256)


# --- random configurations -------------------------------------------------------------------------------------------


def draw_release(r, robot, tower, text_sizes, head, side, crop, camera):
    sections = {8: (2, 1, 1), 12: (2, 2, 2), 16: (4, 2, 2)}[text_sizes[4]]
    deepstack = sorted(r.sample(range(tower[1]), 3))
    parts = vision(*tower, r.randint(3, 7), deepstack), text(*text_sizes, sections)
    image = {"image_target_size": [side] * 2, "shortest_image_edge": side, "crop_fraction": crop}
    return Checkpoint("robot", 1, robot, *parts, head, image, side, percentiles=r.random() < 0.5)


DRAWN = {"gr00t_n1_7": functools.partial(gr00t.draw, "gr00t_n1_7", draw_release)}


# --- the reference ---------------------------------------------------------------------------------------------------


def described(checkpoint):
    import cv2
    import diffusers

    return (f"lerobot.policies.groot.GrootPolicy, embodiment {embodiment(checkpoint)}, diffusers {diffusers.__version__}, "
            f"cv2 {cv2.__version__}")


@contextlib.contextmanager
def backbone_from(folder):
    """What LeRobot writes down of the backbone or reads from the hub comes from this folder."""
    from lerobot.policies.groot import groot_n1_7, processor_groot
    from transformers import Qwen3VLConfig

    config, build = groot_n1_7._cosmos_reason2_qwen3_vl_config, processor_groot._build_n1_7_processor
    groot_n1_7._cosmos_reason2_qwen3_vl_config = lambda: Qwen3VLConfig.from_pretrained(folder)
    processor_groot._build_n1_7_processor = lambda name="": build(str(folder))
    try:
        yield
    finally:
        groot_n1_7._cosmos_reason2_qwen3_vl_config, processor_groot._build_n1_7_processor = config, build


def widths(statistics, keys):
    return {key: len(statistics[key]["min"]) for key in keys}


def policy_config(checkpoint, tag):
    """LeRobot's configuration for one robot of the checkpoint, wide and long enough to cut nothing off."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.groot.configuration_groot import GrootConfig

    head = json.loads((checkpoint / "config.json").read_text())
    settings = json.loads((checkpoint / "processor_config.json").read_text())["processor_kwargs"]
    numbers = json.loads((checkpoint / "statistics.json").read_text())[tag]
    robot = settings["modality_configs"][tag]
    d_state, d_action = (sum(widths(numbers[m], robot[m]["modality_keys"]).values()) for m in ("state", "action"))
    views = {f"observation.images.{v}": PolicyFeature(FeatureType.VISUAL, (3, 1, 1)) for v in robot["video"]["modality_keys"]}
    return GrootConfig(
        base_model_path=str(checkpoint), embodiment_tag=tag, use_bf16=False, action_decode_transform="none", device="cpu",
        chunk_size=head["action_horizon"], n_action_steps=head["action_horizon"], max_state_dim=head["max_state_dim"],
        max_action_dim=head["max_action_dim"], push_to_hub=False,
        input_features=views | {"observation.state": PolicyFeature(FeatureType.STATE, (d_state,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (d_action,))})


def check_weights(model, checkpoint):
    """LeRobot's loader warns of a tensor that it misses and goes on."""
    import torch
    from safetensors import safe_open

    parameters = dict(model.named_parameters())
    for shard in sorted(checkpoint.glob("model-*.safetensors")):
        with safe_open(shard, "pt") as stored:
            for name in parameters.keys() & stored.keys():
                if torch.equal(parameters[name], stored.get_tensor(name).float()):
                    del parameters[name]
    if parameters:
        raise ValueError(f"{checkpoint}: {', '.join(sorted(parameters)[:9])} were not read")
    for name, table in model.named_buffers():
        if table.is_floating_point() and table.dtype != torch.float32:
            raise ValueError(f"{name} is {table.dtype}")


def load(checkpoint, dtype="float32", tag=None):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16, frequencies and noise included, as the
    authors' policy has it.  tag: instead of the one that convert.json names."""
    import torch
    from lerobot.policies.groot.modeling_groot import GrootPolicy
    from lerobot.policies.groot.processor_groot import make_groot_pre_post_processors

    checkpoint = Path(checkpoint).resolve()  # a relative path would be taken for the name of a repository
    config = policy_config(checkpoint, tag or embodiment(checkpoint))
    with backbone_from(backbone_folder(checkpoint)):
        policy = GrootPolicy(config).eval()
        before, after = make_groot_pre_post_processors(config)
        for step in before.steps:
            getattr(step, "proc", None)  # built on first use
    check_weights(policy._groot_model, checkpoint)
    if dtype == "published":
        policy._groot_model.to(torch.bfloat16)

    def from_bytes(batch):
        images = {k: (v * 255).round().byte() for k, v in batch.items() if k.startswith("observation.images.")}
        for name in [k for k in images if "@" in k]:  # an older frame of a camera: (time, 3, height, width)
            camera = name.split("@")[0]
            images[camera] = torch.stack([images.pop(name), images[camera]])[None]
        rest = {k: v for k, v in batch.items() if k not in images and "@" not in k}
        return before({**images, **rest})

    return Reference(policy), from_bytes, after


class Reference:
    """LeRobot's policy, with the noise given to it."""

    def __init__(self, policy):
        self.config, self.policy, self.model = types.SimpleNamespace(type="gr00t_n1_7"), policy, policy._groot_model

    def predict_action_chunk(self, batch, noise):
        with given_noise(noise):
            return self.policy.predict_action_chunk(dict(batch))


# --- recording ----------------------------------------------------------------------------------------------------


class QwenTaps(HeadTaps):
    """Hooks on Qwen3-VL; one request without pads; every view has the same size."""

    def backbone(self, visual, lm, image_token):
        self.visual, self.image_token = visual, image_token
        self.after(visual.patch_embed, lambda x: self.views("vision.patch_embed", x))
        for i, block in enumerate(visual.blocks):
            self.after(block, lambda x, i=i: self.views(f"vision.blk.{i}", x))
        for k, merger in enumerate(visual.deepstack_merger_list):
            self.after(merger, lambda x, k=k: self.views(f"deepstack.{k}", x))
        self.after(visual.merger, lambda x: self.views("connector", x))
        self.language(lm, len(visual.deepstack_merger_list))

    def views(self, name, x):
        self.put(name, x.unflatten(0, (self.n_view, -1)))

    def language(self, lm, n_deepstack):
        """What enters a layer is what the one before it left and what DeepStack added; nothing is added to the last one."""
        if len(lm.layers) <= n_deepstack:
            raise ValueError(f"{n_deepstack} DeepStack features for {len(lm.layers)} layers")
        lm.register_forward_pre_hook(lambda m, args, kw: self.put("position_ids", kw["position_ids"][-3:, 0]), with_kwargs=True)
        self.layers_in(lm)
        self.after(lm.layers[-1], lambda x: self.put(f"lm.blk.{len(lm.layers) - 1}", x[0]))

    def on_batch(self, batch):
        """Tokens, where the images are among them, and the pixels of the patches' rows."""
        grid, ids = batch["image_grid_thw"], batch["input_ids"][0]
        if not bool(batch["attention_mask"].all()) or not bool((grid == grid[:1]).all()):
            raise ValueError("a golden case has no pads, and views of one size")
        self.n_view, (_, rows, columns) = len(grid), grid[0].tolist()
        self.image = ids == self.image_token
        self.put("tokens", ids)
        vision = self.visual.config
        p, m = vision.patch_size, vision.spatial_merge_size
        x = batch["pixel_values"].view(self.n_view, rows // m, columns // m, m, m, 3, vision.temporal_patch_size, p, p)
        if not bool((x == x[:, :, :, :, :, :, :1]).all()):
            raise ValueError("an image differs from its copy in time")
        x = x[:, :, :, :, :, :, 0].permute(0, 5, 1, 3, 6, 2, 4, 7)  # view, channel, then block, row or column in it, pixel
        self.put("pixels", x.reshape(self.n_view, 3, rows * p, columns * p))


class Recorder(QwenTaps):
    def __init__(self, reference):
        self.reference, model = reference, reference.model
        super().__init__(model.action_head.num_inference_timesteps)
        self.backbone(model.backbone.visual, model.backbone.language_model, model.backbone.model.config.image_token_id)
        self.action_head(model.action_head)

    def run(self, batch, noise):
        """Every tap of one inference."""
        model = self.reference.model
        self.on_batch(batch)
        get_action = model.get_action

        def keep_whole(*args, **kwargs):
            out = get_action(*args, **kwargs)
            self.put(f"step.{self.step}.x", out["action_pred"][0])
            return out

        model.get_action = keep_whole
        chunk = self.reference.predict_action_chunk(batch, noise)[0]
        if not bool(chunk.isfinite().all()):
            raise ValueError("the chunk is not finite")
        self.put("chunk", chunk)
        return self.taps
