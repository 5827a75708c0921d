# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Evo-1: golden cases, random checkpoints in both published layouts, and their references.

`authors`: config.json, norm_stats.json and mp_rank_00_model_states.pt, as the authors' trainer leaves them; evo1_server is their
reference.  `lerobot`: the hub layout, with LeRobot's own class.  `vlm/` is what the hub keeps in the backbone's repository, without
weights.  Layer scales are near 1 and not 1.
"""

import random
from dataclasses import dataclass
from pathlib import Path

from . import evo1_server
from . import lerobot_layout as layout
from .cases import MODES, Case, copy_tokenizer
from .draw import bfloat16
from .evo1_server import read_options, towers_from_config
from .files import bfloat16_bits, write_json, write_stream, write_torch
from .parameters import decoder, decoder_layer, linear, norm, parameter, rms_norm, sines, statistics, tower
from .recorder import Taps

HUB_NAMES = {"authors": "OpenGVLab/InternVL3-1B", "lerobot": "OpenGVLab/InternVL3-1B-hf"}
N_TOKEN, IMAGE_TOKEN = 324, 321  # of the tokenizer
PATCH = 14
FAINT = (".embeddings.", ".lambda_", "embed_tokens", ".W3.")
CONFIG = {
    "training_stage": "stage1", "postprocess_action_dim": None, "binarize_gripper": False, "gripper_index": 6,
    "gripper_threshold": 0.5, "gripper_below_threshold_value": 1.0, "gripper_above_threshold_value": -1.0,
    "normalization_mapping": layout.IDENTITY | {"STATE": "MIN_MAX", "ACTION": "MIN_MAX"}, "use_flash_attn": False,
    "action_head": "flowmatching", "dropout": 0.0, "num_categories": 1, "return_cls_only": False,
    "enable_gradient_checkpointing": True, "gradient_checkpointing_use_reentrant": False, "finetune_vlm": False,
    "finetune_language_model": False, "finetune_vision_model": False, "finetune_action_head": True,
    "apply_training_stage_defaults": True, "task_field": "task", "embodiment_id_field": None, "default_embodiment_id": 0,
    "rtc_config": None, "optimizer_lr": 1e-05, "optimizer_betas": [0.9, 0.999], "optimizer_eps": 1e-08,
    "optimizer_weight_decay": 1e-05, "optimizer_grad_clip_norm": 1.0, "scheduler_warmup_steps": 300}
TEXT = {"max_position_embeddings": 512, "rms_norm_eps": 1e-6, "tie_word_embeddings": False, "hidden_act": "silu"}
VISION = {"norm_type": "layer_norm", "layer_norm_eps": 1e-6, "hidden_act": "gelu"}
HF_TEXT = {"attention_dropout": 0.0, "bos_token_id": None, "eos_token_id": None, "initializer_range": 0.02, "max_window_layers": 28,
           "model_type": "qwen2", "pad_token_id": None, "sliding_window": None, "use_cache": True, "use_sliding_window": False}
HF_VISION = {
    "attention_bias": True, "attention_dropout": 0.0, "hidden_dropout_prob": 0.0, "initializer_range": 0.02,
    "layer_scale_init_value": 0.1, "model_type": "internvl_vision", "num_channels": 3, "patch_size": [PATCH, PATCH],
    "projection_dropout": 0.0, "use_absolute_position_embeddings": True, "use_mask_token": False, "use_mean_pooling": True,
    "use_qk_norm": False}


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of towers and head, features, normalization."""

    layout: str  # authors or lerobot
    side: int  # of the square images that the network sees
    vision: dict  # fields of InternVLVisionConfig
    text: dict  # fields of Qwen2Config, with the number of layers that the backbone has
    n_layer: int  # the first ones, which the policy keeps
    head: dict  # num_heads, num_layers, hidden_dim, state_hidden_dim
    policy: dict  # chunk_size, max_state_dim, max_action_dim, max_text_length; for LeRobot any other field of its Evo1Config
    views: dict  # view -> declared (height, width)
    d_state: int = 8
    d_action: int = 7
    normalization: str = "bounds"  # authors: bounds, normal or bounds_q99; LeRobot's modes stand in `policy`
    keys: tuple = ("franka_ee_pose_delta", "libero_10_no_noops_lerobot")  # authors: where norm_stats.json has the statistics
    other_keys: tuple = ()  # authors: data sets beside the last key, with statistics of their own
    faint: bool = False  # what enters the towers and the head is so small that every norm's eps shows
    zero_spread: tuple = ()
    n_vocab: int = N_TOKEN
    noise = "uniform"

    def image_tokens(self):
        return (self.side // PATCH // 2) ** 2

    def shapes(self):
        """By the names of LeRobot's modules, without what stands before them."""
        v, t, d = self.vision, self.text, self.vision["hidden_size"]
        d_model, n_head = t["hidden_size"], t["num_attention_heads"]
        at = "towers.vision_tower."
        out = {f"{at}embeddings.cls_token": (1, 1, d), f"{at}embeddings.patch_embeddings.projection.weight": (d, 3, PATCH, PATCH),
               f"{at}embeddings.patch_embeddings.projection.bias": (d,),
               f"{at}embeddings.position_embeddings": (1, (self.side // PATCH) ** 2 + 1, d)}
        for i in range(v["num_hidden_layers"]):
            layer = f"{at}encoder.layer.{i}."
            out |= {f"{layer}lambda_1": (d,), f"{layer}lambda_2": (d,)} | norm(f"{layer}layernorm_before", d) | norm(f"{layer}layernorm_after", d)
            for part in ("q_proj", "k_proj", "v_proj", "projection_layer"):
                out |= linear(f"{layer}attention.{part}", d, d)
            out |= linear(f"{layer}mlp.fc1", v["intermediate_size"], d) | linear(f"{layer}mlp.fc2", d, v["intermediate_size"])
        at = "towers.multi_modal_projector."
        out |= norm(f"{at}layer_norm", 4 * d) | linear(f"{at}linear_1", d_model, 4 * d) | linear(f"{at}linear_2", d_model, d_model)
        at = "towers.language_model."
        out |= {f"{at}embed_tokens.weight": (self.n_vocab, d_model)} | rms_norm(f"{at}norm", d_model)
        for i in range(self.n_layer):
            out |= decoder_layer(f"{at}layers.{i}.", d_model, t["intermediate_size"], n_head, t["num_key_value_heads"],
                                 d_model // n_head, qkv_bias=True)
        return out | self.head_shapes(d_model)

    def head_shapes(self, d):
        h, horizon, d_action = self.head, self.policy["chunk_size"], self.policy["max_action_dim"]
        out = {"head.time_pos_enc.pe": (1, 1000, d), "head.action_encoder.pos_encoding.pe": (1, horizon, d)}
        out |= linear("head.action_encoder.W1.linear", d, d_action)
        for part in ("W2", "W3"):
            out |= linear(f"head.action_encoder.{part}.linear", d, d)
        out |= linear("head.state_encoder.fc1.linear", h["state_hidden_dim"], self.policy["max_state_dim"])
        out |= linear("head.state_encoder.fc2.linear", d, h["state_hidden_dim"])
        for i in range(h["num_layers"]):
            at = f"head.transformer_blocks.{i}."
            out |= {f"{at}attn.in_proj_weight": (3 * d, d), f"{at}attn.in_proj_bias": (3 * d,)} | linear(f"{at}attn.out_proj", d, d)
            out |= norm(f"{at}norm1", d) | norm(f"{at}norm2", d) | linear(f"{at}ff.0", 4 * d, d) | linear(f"{at}ff.2", d, 4 * d)
        out |= norm("head.norm_out", d) | linear("head.seq_pool_proj", d, horizon * d)
        return out | linear("head.mlp_head.fc1.linear", h["hidden_dim"], d) | linear("head.mlp_head.fc2.linear", horizon * d_action, h["hidden_dim"])

    def value(self, name, shape, seed):
        if name.endswith(".pe"):
            return sines(shape)
        drawn = name if self.layout == "authors" else in_lerobot(name)
        x = parameter(drawn, shape, seed)
        if ".lambda_" in name:  # trained ones are near 1 here, or the vision layers would hardly count
            x = bfloat16(x + 1)
        return x / 64 if self.faint and any(part in name for part in FAINT) else x

    def write(self, seed, folder):
        """Returns the parameter count."""
        folder = Path(folder)
        self.write_backbone(folder / "vlm")
        (self.write_authors if self.layout == "authors" else self.write_lerobot)(seed, folder)
        return sum(layout.count(shape) for name, shape in self.shapes().items() if not name.endswith(".pe"))

    def write_backbone(self, folder):
        """What the hub keeps in the backbone's repository, without weights and code."""
        copy_tokenizer("evo1", folder)
        text, vision = TEXT | {"vocab_size": self.n_vocab} | self.text, VISION | self.vision
        if self.layout == "lerobot":
            for name in ("vocab.json", "merges.txt", "added_tokens.json"):  # which the authors' slow class reads
                (folder / name).unlink()
            rope = {"rope_theta": float(text.pop("rope_theta", 1e6)), "rope_type": "default"}
            write_json(folder / "config.json", {
                "architectures": ["InternVLForConditionalGeneration"], "downsample_ratio": 0.5, "model_type": "internvl",
                "image_seq_length": self.image_tokens(), "image_token_id": IMAGE_TOKEN, "projector_hidden_act": "gelu",
                "text_config": HF_TEXT | {"layer_types": ["full_attention"] * text["num_hidden_layers"], "rope_parameters": rope} | text,
                "tie_word_embeddings": False, "vision_config": HF_VISION | {"image_size": [self.side, self.side]} | vision,
                "vision_feature_layer": -1, "vision_feature_select_strategy": "default"}, indent=2)
            return
        write_json(folder / "config.json", {
            "model_type": "internvl_chat", "architectures": ["InternVLChatModel"], "downsample_ratio": 0.5, "ps_version": "v2",
            "select_layer": -1, "force_image_size": self.side, "dynamic_image_size": True, "max_dynamic_patch": 12,
            "min_dynamic_patch": 1, "use_thumbnail": True, "template": "internvl2_5", "hidden_size": text["hidden_size"],
            "tie_word_embeddings": False,
            "vision_config": vision | {"model_type": "intern_vit_6b", "image_size": self.side, "patch_size": PATCH, "qkv_bias": True,
                                       "qk_normalization": False},
            "llm_config": {"rope_theta": 1e6} | text | {
                "model_type": "qwen2", "architectures": ["Qwen2ForCausalLM"], "use_cache": False,
                "rope_scaling": {"factor": 2.0, "rope_type": "dynamic", "type": "dynamic"}}}, indent=2)

    def norm_stats(self, seed):
        """Statistics under a robot, or under arm and data set."""

        def numbers(seed):
            found = statistics(self.d_state, self.d_action, seed, self.zero_spread)
            return {f: {k: v.tolist() for k, v in s.items()} for f, s in found.items()}

        *arm, last = self.keys
        found = {key: numbers(seed + 1 + i) for i, key in enumerate(self.other_keys)} | {last: numbers(seed)}
        return {arm[0]: found} if arm else found

    def write_authors(self, seed, folder):
        """The three files of the authors' trainer, and dims.json for two literals of their code."""
        config = self.head | {
            "embed_dim": self.text["hidden_size"], "horizon": self.policy["chunk_size"], "num_categories": 1, "dropout": 0.2,
            "state_dim": self.policy["max_state_dim"], "per_action_dim": self.policy["max_action_dim"],
            "vlm_name": HUB_NAMES["authors"], "action_head": "flowmatching", "return_cls_only": False}
        if len(self.keys) == 1:  # the older files
            config["action_dim"] = config["horizon"] * config["per_action_dim"]
        else:
            config["normalization_type"] = self.normalization
        write_json(folder / "config.json", config, indent=2)
        write_json(folder / "dims.json", {"language_layers": self.n_layer, "prompt_tokens": self.policy["max_text_length"]})
        write_json(folder / "norm_stats.json", self.norm_stats(seed), indent=1)
        tensors = evo1_server.stacked({n: bfloat16_bits(self.value(n, s, seed)) for n, s in self.shapes().items()})
        write_torch(folder / "mp_rank_00_model_states.pt", tensors, global_steps=100, ds_version="0.16.4",
                    buffer_names=[name for name in tensors if name.endswith(".pe")])

    @property
    def config(self):
        """Of LeRobot's layout."""
        empty = layout.empty_cameras(self.policy.get("empty_cameras", 0), self.side, self.side)
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action, empty)
        return {"type": "evo1"} | layout.COMMON | {
            "use_amp": True, "input_features": inputs, "output_features": outputs, "vlm_model_name": HUB_NAMES["lerobot"],
            "vlm_num_layers": self.n_layer, "image_resolution": (self.side, self.side), "embed_dim": self.text["hidden_size"],
            "n_action_steps": self.policy["chunk_size"]} | CONFIG | self.head | self.policy

    def write_lerobot(self, seed, folder):
        """config.json, model.safetensors in bfloat16 and both pipelines."""
        c, shapes = self.config, self.shapes()
        names = {in_lerobot(name): name for name in sorted(shapes)}
        write_json(folder / "config.json", c, indent=2)
        self.write_pipelines(c, seed, folder)
        write_stream(folder / "model.safetensors", {n: ("BF16", shapes[own]) for n, own in names.items()},
                     lambda name: bfloat16_bits(self.value(names[name], shapes[names[name]], seed)))

    def write_pipelines(self, c, seed, folder):
        d_state, d_action, modes = c["max_state_dim"], c["max_action_dim"], c["normalization_mapping"]
        shown = c["input_features"] | {"observation.state": layout.feature("STATE", d_state)}
        actions = {"action": layout.feature("ACTION", d_action)}
        before = [layout.rename({}), layout.BATCH, ("evo1_pad_state_processor", {"max_state_dim": d_state}),
                  ("evo1_pad_action_processor", {"max_action_dim": d_action}),
                  layout.normalizer("normalizer_processor", shown | actions, modes), layout.device()]
        gripper = {k: c[k] for k in ("binarize_gripper", "gripper_index", "gripper_threshold", "gripper_below_threshold_value",
                                     "gripper_above_threshold_value")}
        after = [layout.normalizer("unnormalizer_processor", actions, modes),
                 ("evo1_action_processor", {"action_dim": self.d_action, **gripper}), layout.device("float32")]
        numbers = statistics(self.d_state, self.d_action, seed, self.zero_spread)
        for feature, width in (("observation.state", d_state), ("action", d_action)):
            numbers[feature] = {k: padded(v, width, {"mean": 0, "std": 1}.get(k, 1 if k in ("max", "q99", "q90") else -1))
                                for k, v in numbers[feature].items()}
        layout.write_pipelines(folder, before, after, numbers)


def padded(x, width, fill):
    return [*x.tolist(), *[fill] * (width - len(x))]


MODULES = {"towers.": "model.embedder.model.", "head.": "model.action_head."}  # -> where LeRobot's policy has them


def in_lerobot(name):
    at = name.split(".")[0] + "."
    return MODULES[at] + name[len(at) :]


# What the files of the authors do not say, for the published size.
OPTIONS = {"variant": "r2", "masked_rows": "zero_attention", "views": ["camera1", "camera2"], "max_views": 3}


def published(views, arch="evo1"):
    """The published size in the authors' layout: 775 M parameters."""
    return Checkpoint(
        "authors", 448, tower(1024, 24, 16, 4096), decoder(896, 24, 14, 2, 4864, max_position_embeddings=32768), 14,
        head(8, 8, 1024, 1024), policy(50, 1024), views, n_vocab=151674)


def head(layers, heads, d_hidden, d_state_hidden):
    return {"num_layers": layers, "num_heads": heads, "hidden_dim": d_hidden, "state_hidden_dim": d_state_hidden}


def policy(horizon, n_token, d_state=24, d_action=24, **more):
    return {"chunk_size": horizon, "max_text_length": n_token, "max_state_dim": d_state, "max_action_dim": d_action, **more}


def said(variant, masked_rows, views, **more):
    """What whoever converts the authors' files has to know."""
    return {"variant": variant, "masked_rows": masked_rows, "views": list(views), "max_views": 3, **more}


CASES = {
    # The authors' layout: two views for three slots; one frame of the network's size, one not; pads; numbers of the state
    # beyond their range.
    "evo1/two_views": Case(31, {"agentview": (56, 56, "png"), "wrist": (45, 71, "png")}, "open the middle drawer", Checkpoint(
        "authors", 56, tower(36, 2, 3, 52), decoder(48, 3, 6, 2, 64), 2, head(2, 4, 40, 28), policy(5, 64),
        {"agentview": (56, 56), "wrist": (45, 71)}),
        state=(0.5, -1.25, 0.25, 2.0, -0.125, -3.0, 0.0625, 0.75),
        options=said("r2", "zero_attention", ("agentview", "wrist"))),
    # The first revision: 32 steps, another scale of time, pixels normalized in float32, -1 where the state is filled up. The
    # slot in the middle is empty; 6 x 6 patches; many pads; a state number that never moved in the data.
    "evo1/first_revision": Case(32, {"front": (70, 52, "png"), "left": None, "wrist": (84, 84, "png")}, "push the plate slowly",
        Checkpoint(
        "authors", 84, tower(30, 3, 5, 44, layer_norm_eps=1e-5), decoder(32, 3, 4, 1, 56, rope_theta=1e5, rms_norm_eps=1e-5), 2,
        head(3, 2, 24, 36), policy(7, 104), {"front": (70, 52), "left": (84, 84), "wrist": (84, 84)}, d_state=9, keys=("sawyer",),
        zero_spread=(2,)),
        options=said("r1", "zero_attention", ("front", "left", "wrist"))),
    # Rows that carry nothing take part: the first slot is empty and there are pads. Means instead of ranges, of one of two
    # data sets; as many heads of keys as of queries.
    "evo1/causal_rows": Case(33, {"high": None, "left": (40, 64, "png"), "right": (56, 56, "png")},
        "stack the green block on the yellow block", Checkpoint(
        "authors", 56, tower(32, 2, 4, 40), decoder(40, 3, 5, 5, 48), 2, head(2, 5, 44, 20), policy(6, 60),
        {"high": (56, 56), "left": (40, 64), "right": (56, 56)}, d_state=14, d_action=14, normalization="normal",
        keys=("aloha_joint", "robotwin_stack"), other_keys=("robotwin_push",)),
        options=said("r2", "causal_attention", ("high", "left", "right"), stats="aloha_joint/robotwin_stack")),
    # Two slots are empty, the first among them, and share their rows; one pad; numbers so small that every eps shows.
    "evo1/one_view": Case(36, {"left": None, "front": (33, 49, "png"), "right": None}, "go", Checkpoint(
        "authors", 56, tower(32, 1, 4, 48), decoder(32, 2, 4, 2, 40), 1, head(2, 2, 36, 44), policy(3, 39),
        {"left": (56, 56), "front": (33, 49), "right": (56, 56)}, d_state=5, d_action=4, faint=True),
        options=said("r2", "zero_attention", ("left", "front", "right"))),
    # Nothing is dead: every view present and an instruction beyond the limit, with capitals, digits, a letter in two parts
    # and lines around it; quantiles; a robot with as many numbers as the network.
    "evo1/long_text": Case(35, {"top": (56, 56, "png"), "left": (38, 50, "png"), "right": (90, 60, "png")},
        "\n O\u0308ffne die Schublade 12: 开抽屉, THEN put the black bowl on top of the stove, and close the bottom drawer\n", Checkpoint(
        "authors", 56, tower(28, 2, 2, 44), decoder(32, 2, 4, 2, 72, rope_theta=1e4), 2, head(1, 4, 52, 40), policy(4, 72),
        {"top": (56, 56), "left": (38, 50), "right": (90, 60)}, d_state=24, d_action=24, normalization="bounds_q99"),
        options=said("r2", "zero_attention", ("top", "left", "right"))),
    # LeRobot's layout: the first of three cameras absent, so that the others move up; a JPEG file; the gripper made one of two
    # numbers. Absent may be as many as are declared as empty ones: one such is there instead.
    "evo1/lerobot": Case(34, {"front": None, "wrist": (61, 97, "jpg"), "empty_camera_0": (90, 84, "png")},
        "Put the black_bowl on top of the stove!", Checkpoint(
        "lerobot", 84, tower(40, 2, 5, 36), decoder(36, 4, 3, 1, 64), 3, head(2, 3, 30, 26),
        policy(6, 80, 10, 9, num_inference_timesteps=8, vlm_dtype="float32", max_views=3, binarize_gripper=True, empty_cameras=1),
        {"front": (52, 90), "wrist": (61, 97)})),
    # As published files say: pixels normalized in bfloat16. One frame of the network's size; means and quantiles; a state number
    # that never moved in the data; an instruction beyond the limit.
    "evo1/lerobot_bfloat16": Case(37, {"wrist": (56, 56, "png"), "base": (80, 43, "png"), "empty_camera_0": None},
        "close the bottom drawer, and then stack the green block on the yellow block", Checkpoint(
        "lerobot", 56, tower(24, 2, 3, 40), decoder(32, 3, 4, 2, 48), 2, head(2, 4, 20, 24),
        policy(4, 56, 12, 7, num_inference_timesteps=5, vlm_dtype="bfloat16", max_views=3, empty_cameras=1,
               normalization_mapping={"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "QUANTILES"}),
        {"wrist": (56, 56), "base": (80, 43)}, d_state=6, zero_spread=(1,))),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(seed):
    """A case whose every size comes from the seed, in either published layout: three slots for views, rows of absent ones and of pads masked or not."""
    r = random.Random(f"evo1 {seed}")
    grid, kv, vision_heads = 2 * r.choice((1, 2, 2, 3)), r.choice((1, 2, 3)), r.choice((1, 2, 3, 5))
    heads = kv * r.choice((1, 2, 3))
    d_model = heads * r.choice((8, 12, 16))
    kept, d_state, d_action = r.randint(1, 4), r.randint(1, 24), r.randint(1, 24)
    vision = tower(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)), layer_norm_eps=r.choice((1e-6, 1e-5)))
    text = decoder(d_model, kept + r.choice((0, 0, 2)), heads, kv, r.choice((32, 50)), rope_theta=r.choice((1e4, 1e6)), rms_norm_eps=r.choice((1e-6, 1e-5)))
    last = head(r.randint(1, 3), r.choice([n for n in (1, 2, 3, 4, 6) if d_model % n == 0]), r.choice((20, 44)), r.choice((24, 36)))
    n_token = 3 * (grid // 2) ** 2 + r.choice((24, 40, 64))
    views = {f"cam{i}": (r.randint(12, 90), r.randint(12, 90)) for i in range(r.randint(1, 3))}
    frames = {view: (*size, r.choice(("png", "png", "jpg"))) for view, size in views.items()}
    if len(frames) > 1 and r.random() < 0.5:
        frames[r.choice(list(frames))] = None
    sizes, rest = (14 * grid, vision, text, kept, last), {"d_state": d_state, "d_action": d_action}
    words = r.choice(("go", "Pick up the red_cube!", "naïve café 漢字 n° 5", "word " * 20))
    if r.random() < 0.5:
        n_empty, width = sum(frame is None for frame in frames.values()), r.choice((0, 3))
        settings = policy(r.randint(1, 12), n_token, d_state + width, d_action + width, num_inference_timesteps=r.choice((1, 4, 10)),
                          vlm_dtype=r.choice(("float32", "bfloat16")), max_views=3, empty_cameras=n_empty,
                          normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)})
        frames |= {f"empty_camera_{i}": None for i in range(n_empty)}
        return Case(seed, frames, words, Checkpoint("lerobot", *sizes, settings, views, **rest))
    keys, revision = r.choice((("sawyer",), ("aloha_joint", "robotwin_stack"))), r.choice(("r1", "r2"))
    normalization = r.choice(("bounds", "bounds_q99", "normal")) if len(keys) > 1 and revision == "r2" else "bounds"
    options = said(revision, r.choice(("zero_attention", "causal_attention")), views)
    checkpoint = Checkpoint("authors", *sizes, policy(r.randint(1, 12), n_token), views, **rest, normalization=normalization, keys=keys)
    return Case(seed, frames, words, checkpoint, options=options)


DRAWN = {"evo1": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


def is_lerobot(checkpoint):
    return (Path(checkpoint) / "model.safetensors").is_file()


def described(checkpoint):
    if is_lerobot(checkpoint):
        return "lerobot.policies.evo1.Evo1Policy"
    import cv2

    options = read_options(checkpoint)
    return f"Evo1_server.py {options['variant']}, {options['masked_rows']}, without its channel swap, cv2 {cv2.__version__}"


def in_bfloat16(towers):
    """As from_pretrained leaves them: parameters alone, for the frequencies of the rotary embedding stay in float32."""
    for p in towers.parameters():
        p.data = p.data.bfloat16()


def construct_lerobot(config):
    """The policy; its backbone from the configuration alone, where the constructor would ask for weights."""
    from lerobot.policies.evo1 import internvl3_embedder
    from lerobot.policies.evo1.modeling_evo1 import Evo1Policy
    from transformers import InternVLConfig

    def from_config(name, **options):
        return towers_from_config(InternVLConfig.from_pretrained(name))

    hub = internvl3_embedder.AutoModel
    internvl3_embedder.AutoModel = type("FromConfig", (), {"from_pretrained": staticmethod(from_config)})
    try:
        return Evo1Policy(config)
    finally:
        internvl3_embedder.AutoModel = hub


# --- loading ------------------------------------------------------------------------------------------------------


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor); published: towers in bfloat16, everything under autocast."""
    import torch

    policy, before, after = (load_lerobot if is_lerobot(checkpoint) else evo1_server.load)(Path(checkpoint))
    published, predict = dtype == "published", policy.predict_action_chunk
    if published:
        in_bfloat16(policy.towers)

    def predict_from(batch, noise):
        draw = torch.rand
        torch.rand = lambda *shape, **options: (noise.reshape(shape) + 1) / 2  # the head makes 2 * rand - 1 of it
        try:
            with torch.no_grad(), torch.autocast(noise.device.type, torch.bfloat16, enabled=published):
                return predict(batch)[..., : policy.d_robot]
        finally:
            torch.rand = draw

    policy.predict_action_chunk = predict_from
    return policy, before, after


def load_lerobot(checkpoint):
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from safetensors.torch import load_file

    config = PreTrainedConfig.from_pretrained(str(checkpoint))
    config.vlm_model_name = str(checkpoint / "vlm")
    policy = construct_lerobot(config)
    policy.load_state_dict(load_file(checkpoint / "model.safetensors"), strict=True)
    before, after = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    policy.towers, policy.head = policy.model.embedder.model, policy.model.action_head
    policy.masked_rows, policy.d_robot = "unseen", config.output_features["action"].shape[0]
    policy.n_step = config.num_inference_timesteps

    def widened(chunk):
        """The postprocessor takes actions as wide as the network's."""
        import torch

        return after(torch.nn.functional.pad(chunk, (0, config.max_action_dim - chunk.shape[-1])))

    return policy.eval(), before, widened


# --- recording ----------------------------------------------------------------------------------------------------


class Recorder(Taps):
    def __init__(self, policy):
        super().__init__(policy.n_step)
        self.policy = policy
        towers, head = policy.towers, policy.head
        towers.register_forward_pre_hook(self.on_towers, with_kwargs=True)
        vision, lm = towers.vision_tower, towers.language_model
        self.before(vision.embeddings, lambda x: self.views("pixels", x))
        self.after(vision.embeddings.patch_embeddings, lambda x: self.views("vision.patch_embed", x))
        for i, layer in enumerate(vision.encoder.layer):
            self.after(layer, lambda x, i=i: self.views(f"vision.blk.{i}", x))
        self.after(towers.multi_modal_projector, lambda x: self.views("connector", x))
        self.before(lm.layers[0].input_layernorm, lambda x: self.rows("prefix", x))
        for i, layer in enumerate(lm.layers):
            self.after(layer, lambda x, i=i: self.rows(f"lm.blk.{i}", x))
        self.after(lm.norm, lambda x: self.rows("lm.norm", x))
        self.before(head.state_encoder, lambda x: self.put("state", x[0]))
        self.after(head.state_encoder, lambda x: self.put("state_out", x))
        self.before(head.action_encoder, self.on_step)
        self.stepwise(head.action_encoder, "action_token")
        for i, block in enumerate(head.transformer_blocks):
            block.attn.register_forward_pre_hook(lambda m, args, i=i: self.on_attention(i, m, args[1]))
            self.stepwise(block, f"head.blk.{i}")
        self.after(head.seq_pool_proj, lambda x: self.at_step("pool", x[None]))
        self.after(head.mlp_head, self.on_velocity)

    def on_towers(self, module, args, inputs):
        """Which views, which rows of the prompt and which keys of the head carry something."""
        import torch

        ids, live = inputs["input_ids"][0], inputs["attention_mask"][0].bool()
        image = (ids == module.config.image_token_id).nonzero()[:, 0].view(-1, module.config.image_seq_length)
        self.present = live[image].all(dim=1)
        n = int(live.nonzero().max()) + 1
        self.put("tokens", ids[:n])
        every, state = torch.arange(len(ids)), torch.tensor([len(ids)])
        masked = self.policy.masked_rows
        self.valid = every if masked == "causal_attention" else every[live]
        self.keys = torch.cat([self.valid, state])
        self.twins = [image[~self.present], every[n:, None]] if masked == "zero_attention" else []
        for rows in self.twins:  # those of all absent views are the same, and so are all pads: one of each stands for them
            self.keys = torch.cat([self.keys, *rows[:1]])

    def views(self, name, x):
        self.put(name, x[self.present])

    def on_attention(self, i, attention, context):
        import torch

        if self.step != 0:
            return
        d, n_head = attention.embed_dim, attention.num_heads
        both = torch.nn.functional.linear(context[0], attention.in_proj_weight[d:], attention.in_proj_bias[d:])
        tolerance = 32 * torch.finfo(context.dtype).eps * context.abs().max()  # a product may sum its last rows in another order
        for rows in self.twins:
            assert all((context[0][rows[0]] - context[0][r]).abs().max() <= tolerance for r in rows)
        for name, x in zip("kv", both.split(d, dim=-1), strict=True):
            self.put(f"head.blk.{i}.{name}", x[self.keys].unflatten(-1, (n_head, -1)))

    def on_step(self, x):
        if self.whole and self.step >= 0:
            self.put(f"step.{self.step}.x", x[0])
        self.step += 1

    def on_velocity(self, x):
        assert x.isfinite().all()
        if not self.whole:
            self.put(f"step.{self.step}.velocity_out", x)

    def run(self, batch, noise):
        """Every tap of one inference."""
        self.whole = self.policy.d_robot == noise.shape[-1]  # else x has columns that nothing reads
        chunk = self.policy.predict_action_chunk(dict(batch), noise=noise)[0]
        if self.whole:
            self.put(f"step.{self.step}.x", chunk)
        self.put("chunk", chunk)
        return self.taps
