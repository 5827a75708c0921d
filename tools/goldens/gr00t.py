# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the golden cases of GR00T share: robots, the action head's shapes, files in the authors' layout, hooks on LeRobot's head.

A checkpoint serves several robots, with cameras, keys and statistics of their own; `convert.json` beside it says for which one the
case is.
"""

import json
import math
import random
from dataclasses import dataclass, field
from pathlib import Path

from . import lerobot_layout as layout
from .cases import Case
from .draw import bfloat16
from .files import bfloat16_bits, write_json, write_stream
from .parameters import decoder_layer, linear, norm, parameter, rms_norm, statistics
from .recorder import Taps

ABSOLUTE = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
RELATIVE = ABSOLUTE | {"rep": "RELATIVE"}
# Where residual streams begin, and what is added to them.
FAINT = ("patch_embed", "pos_embed", "attn.proj", "linear_fc2", "embed_tokens", "o_proj", "down_proj", "vlln", "to_out", "ff.net.2",
         "state_encoder.layer2", "W3", "position_embedding")


@dataclass(frozen=True)
class Robot:
    """What a checkpoint knows of one embodiment."""

    views: tuple
    states: dict  # key -> width
    actions: dict  # key -> width
    rows: int  # of the head's horizon, which the robot gets
    relative: dict = field(default_factory=dict)  # action key -> the state key that it is added to, None: of the same name
    zero_spread: tuple = ()
    moments: tuple = (0,)  # steps at which frames are taken
    state_moments: tuple = (0,)
    poses: dict = field(default_factory=dict)  # relative action key -> format of the pose that it is
    mean_std: tuple = ()  # keys of states and actions
    sin_cos: tuple = ()  # keys of states
    per_step: bool = False  # relative actions have statistics for each row

    def statistics(self, seed):
        return statistics(sum(self.states.values()), sum(self.actions.values()), seed, self.zero_spread)


OTHER = "new_embodiment", 0, Robot(("ego_view",), {"arm": 3}, {"hand": 1, "arm": 3}, 4)


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of towers and head, robots, how a frame becomes an image.  A release adds CONFIG, PROCESSOR_CLASS, N_VOCAB,
    backbone_shapes() and write_backbone()."""

    tag: str
    index: int  # of the embodiment
    robot: Robot
    vision: dict  # fields of the tower's config
    text: dict  # fields of the language model's, with the number of layers that the backbone has
    head: dict  # fields of config.json
    image: dict  # fields of processor_kwargs: how a frame becomes an image
    side: int = 0  # of the smallest square image that the backbone's processor leaves alone
    percentiles: bool = False
    faint: bool = False  # what enters a residual stream is so small that every norm's eps shows

    @property
    def d_state(self):
        return sum(self.states.values())

    @property
    def d_action(self):
        return sum(self.robot.actions.values())

    @property
    def states(self):
        return {f"{key}@{t}" if t else key: n for t in self.robot.state_moments for key, n in self.robot.states.items()}

    @property
    def zero_spread(self):
        return self.robot.zero_spread

    @property
    def policy(self):
        return {"chunk_size": self.head["action_horizon"], "max_action_dim": self.head["max_action_dim"]}

    @property
    def robots(self):
        other, index, robot = OTHER
        return {self.tag: (self.index, self.robot)} | ({} if other == self.tag else {other: (index, robot)})

    def language_shapes(self, at):
        """Qwen3: the layers that the policy keeps."""
        t = self.text
        d, d_head = t["hidden_size"], t["head_dim"]
        out = {f"{at}embed_tokens.weight": (t.get("vocab_size", self.N_VOCAB), d)} | rms_norm(f"{at}norm", d)
        for i in range(self.head["select_layer"]):
            layer = f"{at}layers.{i}."
            out |= decoder_layer(layer, d, t["intermediate_size"], t["num_attention_heads"], t["num_key_value_heads"], d_head)
            out |= rms_norm(f"{layer}self_attn.q_norm", d_head) | rms_norm(f"{layer}self_attn.k_norm", d_head)
        return out

    def head_shapes(self):
        h, d_model = self.head, self.text["hidden_size"]
        d, d_hidden, d_state, d_action = h["input_embedding_dim"], h["hidden_size"], h["max_state_dim"], h["max_action_dim"]
        n, dit = h["max_num_embodiments"], h["diffusion_model_cfg"]

        def attention(at, d, d_context):
            parts = (("to_q", d), ("to_k", d_context), ("to_v", d_context), ("to_out.0", d))
            out = {k: v for part, d_in in parts for k, v in linear(f"{at}.attn1.{part}", d, d_in).items()}
            return out | linear(f"{at}.ff.net.0.proj", 4 * d, d) | linear(f"{at}.ff.net.2", d, 4 * d)

        def per_robot(name, d_in, d_out):
            return {f"action_head.{name}.W": (n, d_in, d_out), f"action_head.{name}.b": (n, d_out)}

        out = norm("action_head.vlln", d_model) | {"action_head.position_embedding.weight": (h["max_seq_len"], d)}
        for i in range((h.get("vl_self_attention_cfg") or {"num_layers": 0})["num_layers"]):
            at = f"action_head.vl_self_attention.transformer_blocks.{i}"
            out |= norm(f"{at}.norm1", d_model) | norm(f"{at}.norm3", d_model) | attention(at, d_model, d_model)
        at = "action_head.model."
        for i in range(dit["num_layers"]):
            block = f"{at}transformer_blocks.{i}"
            out |= linear(f"{block}.norm1.linear", 2 * d, d) | attention(block, d, d if i % 2 else d_model)
        time = f"{at}timestep_encoder.timestep_embedder."
        out |= linear(f"{time}linear_1", d, 256) | linear(f"{time}linear_2", d, d)
        out |= linear(f"{at}proj_out_1", 2 * d, d) | linear(f"{at}proj_out_2", dit["output_dim"], d)
        out |= per_robot("state_encoder.layer1", d_state, d_hidden) | per_robot("state_encoder.layer2", d_hidden, d)
        out |= per_robot("action_encoder.W1", d_action, d) | per_robot("action_encoder.W2", 2 * d, d) | per_robot("action_encoder.W3", d, d)
        return out | per_robot("action_decoder.layer1", d_hidden, d_hidden) | per_robot("action_decoder.layer2", d_hidden, d_action)

    def value(self, name, shape, seed):
        x = parameter(name, shape, seed)
        if name == "action_head.vlln.weight":  # a norm by another name
            x = bfloat16(x + 1)
        if name.startswith("action_head.") and len(shape) == 3:  # [embodiment, in, out], which parameter() leaves too small
            x = x * 2.0 ** round(math.log2(shape[2]) / 2)
        return x / 16 if self.faint and any(part in name for part in FAINT) else x

    def write(self, seed, folder):
        """Returns the parameter count."""
        folder = Path(folder)
        self.write_backbone(folder / "vlm")
        settings = self.processor_config()
        same = ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction", "use_percentiles", "use_relative_action")
        config = self.CONFIG | {"backbone_embedding_dim": self.text["hidden_size"]} | {k: settings["processor_kwargs"][k] for k in same} | self.head
        ids = {tag: index for tag, (index, _) in self.robots.items()}
        for file, value in (("config", config), ("processor_config", settings), ("statistics", self.statistics(seed)), ("embodiment_id", ids)):
            write_json(folder / f"{file}.json", value, indent=1)
        index = {}
        for i, shapes in enumerate((self.backbone_shapes(), self.head_shapes())):
            file = f"model-{i + 1:05d}-of-00002.safetensors"
            write_stream(folder / file, {n: ("BF16", s) for n, s in sorted(shapes.items())},
                         lambda name, shapes=shapes: bfloat16_bits(self.value(name, shapes[name], seed)), {"format": "pt"})
            index |= {name: (file, layout.count(shape)) for name, shape in shapes.items()}
        n = sum(count for _, count in index.values())
        write_json(folder / "model.safetensors.index.json", {
            "metadata": {"total_size": 2 * n}, "weight_map": {name: file for name, (file, _) in sorted(index.items())}}, indent=1)
        return n

    def processor_config(self):
        settings = {
            "modality_configs": {tag: modalities(robot) for tag, (_, robot) in self.robots.items()},
            "image_crop_size": None, "image_target_size": None, "use_albumentations": True, "random_rotation_angle": None,
            "color_jitter_params": None, "shortest_image_edge": None, "crop_fraction": None, "letter_box_transform": False,
            "model_name": self.CONFIG["model_name"], "model_type": self.CONFIG["backbone_model_type"], "formalize_language": True,
            "max_state_dim": self.head["max_state_dim"], "max_action_dim": self.head["max_action_dim"], "max_action_horizon": self.head["action_horizon"],
            "use_percentiles": self.percentiles, "use_mean_std": False, "clip_outliers": True,
            "apply_sincos_state_encoding": any(robot.sin_cos for _, robot in self.robots.values()),
            "use_relative_action": any(robot.relative for _, robot in self.robots.values()), "exclude_state": False,
            "state_dropout_prob": 0.2}
        return {"processor_class": self.PROCESSOR_CLASS, "processor_kwargs": settings | self.image}

    def statistics(self, seed):
        out = {}
        for i, (tag, (_, robot)) in enumerate(self.robots.items()):
            flat = robot.statistics(seed + i)
            steps = [per_key(robot.statistics(seed + i + 1000 + t)["action"], robot.actions) for t in range(robot.rows)]
            relative = steps[0]
            if robot.per_step:
                relative = {key: {name: [step[key][name] for step in steps] for name in steps[0][key]} for key in robot.actions}
            out[tag] = {"state": per_key(flat["observation.state"], robot.states), "action": per_key(flat["action"], robot.actions),
                        "relative_action": {key: relative[key] for key in robot.relative}}
        return out


def modalities(robot):
    def part(keys, deltas, actions=None, sin_cos=(), mean_std=()):
        return {"delta_indices": deltas, "modality_keys": list(keys), "sin_cos_embedding_keys": list(sin_cos) or None,
                "mean_std_embedding_keys": [key for key in keys if key in mean_std] or None, "action_configs": actions}

    def config(key):
        pose = {"type": "EEF", "format": robot.poses[key]} if key in robot.poses else {}
        return RELATIVE | {"state_key": robot.relative[key]} | pose if key in robot.relative else ABSOLUTE

    return {"video": part(robot.views, list(robot.moments)), "state": part(robot.states, list(robot.state_moments), None, robot.sin_cos, robot.mean_std),
            "action": part(robot.actions, list(range(robot.rows)), [config(key) for key in robot.actions], (), robot.mean_std),
            "language": part(["annotation.human.action.task_description"], [0])}


def per_key(numbers, groups):
    """Statistics of a whole vector -> those of its parts."""
    out, start = {}, 0
    for key, n in groups.items():
        out[key] = {k: numbers[k][start : start + n].tolist() for k in ("min", "max", "mean", "std", "q01", "q99")}
        start += n
    return out


def head(layers, dit, vl, d_hidden, d_state, d_action, horizon, **more):
    """layers: of the language model, which the policy keeps; dit, vl: (layers, heads, width of a head)."""
    same = {"positional_embeddings": None, "dropout": 0.2, "final_dropout": True}
    sizes = ("num_layers", "num_attention_heads", "attention_head_dim")
    return {"select_layer": layers, "input_embedding_dim": dit[1] * dit[2], "hidden_size": d_hidden, "max_state_dim": d_state,
            "max_action_dim": d_action, "action_horizon": horizon, "max_seq_len": horizon + 4, "max_num_embodiments": 3,
            "diffusion_model_cfg": same | dict(zip(sizes, dit)) | {
                "norm_type": "ada_norm", "output_dim": d_hidden, "interleave_self_attention": True},
            "vl_self_attention_cfg": same | dict(zip(sizes, vl)) if vl else None, **more}


def case(seed, frames, instruction, description, **more):
    options = {"embodiment": description.tag} | more.pop("options", {})
    return Case(seed, frames, instruction, description, options=options, **more)


POSE = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 1)

def published(checkpoint, views, tag, index, vision, text, head, *how, **more):
    """The published size, for a robot of LIBERO's with these views."""
    robot = Robot(tuple(views), POSE | {"gripper": 2}, POSE | {"gripper": 1}, 16)
    head |= {"max_seq_len": 1024, "max_num_embodiments": 32}
    return checkpoint(tag, index, robot, vision, text, head, *how, **more)


# --- random configurations -------------------------------------------------------------------------------------------


def draw_robot(arch, r, n_view):
    widths = {f"k{i}": r.choice((1, 2, 3, 4)) for i in range(r.randint(1, 4))}
    actions, relative, poses = dict(widths), {}, {}
    if arch != "gr00t_n1_5":
        relative = {key: None for key in widths if r.random() < 0.5}
        if r.random() < 0.4:
            kind = "XYZ_ROTVEC" if arch == "gr00t_n1_6" else "XYZ_ROT6D"
            widths["pose"] = actions["pose"] = 6 if kind == "XYZ_ROTVEC" else 9
            relative["pose"], poses["pose"] = None, kind
    mixed = arch == "gr00t_n1_6"  # LeRobot's N1.7 does not read these lists, and takes one moment of the state
    moments = r.choice(((0,), (0,), (-2, 0))) if mixed else (0,)
    mean_std = tuple(k for k in widths if mixed and k not in poses and r.random() < 0.3)
    return Robot(tuple(f"cam{i}" for i in range(n_view)), widths, dict(r.sample(sorted(actions.items()), len(actions))), r.randint(1, 6), relative,
                 poses=poses, mean_std=mean_std, sin_cos=tuple(k for k in widths if mixed and r.random() < 0.2), per_step=r.random() < 0.5,
                 state_moments=moments)


def draw(arch, release, seed, **options):
    """A case whose every size comes from the seed, of square cameras: aspects are checked elsewhere. release: draws what a release has of its own."""
    r = random.Random(f"{arch} {seed}")
    heads, kv, d_head = r.choice(((4, 2, 8), (3, 1, 12), (6, 3, 8), (5, 5, 8), (2, 2, 16)))
    vl_heads = r.choice((2, 3, 4))
    d_model, n_view = vl_heads * 2 * r.choice((4, 5, 6)), r.randint(1, 3)
    robot = draw_robot(arch, r, n_view)
    every, steps = r.choice((1, 2, 2, 3)), r.choice((1, 2, 4, 5))
    vl = None if arch == "gr00t_n1_6" else (r.choice((1, 2, 3)), vl_heads, d_model // vl_heads)
    more = {} if arch == "gr00t_n1_5" else {"attend_text_every_n_blocks": every}
    kept, vision_heads = r.choice((4, 5)), r.choice((1, 2, 3))
    sizes = head(kept, (r.randint(2, 7), r.choice((2, 3, 4)), 2 * r.choice((3, 4, 5))), vl, 2 * r.randint(4, 12),
                 2 * sum(robot.states.values()) + r.randint(0, 3), sum(robot.actions.values()) + r.randint(0, 3), robot.rows + r.randint(0, 3),
                 num_inference_timesteps=steps, **more)
    side, crop, camera = 8 * r.choice((2, 3, 4)), r.choice((0.8, 0.9, 0.95)), r.randint(12, 70)
    tower = vision_heads * 4 * r.choice((2, 3, 4)), r.randint(3, 5), vision_heads, 2 * r.randint(8, 20)
    text_sizes = d_model, kept + r.randint(0, 2), heads, kv, d_head, r.choice((32, 50))
    checkpoint = release(r, robot, tower, text_sizes, sizes, side, crop, camera)
    frames = {view: (camera, camera, r.choice(("png", "png", "jpg"))) for view in robot.views}
    return case(seed, frames, r.choice(("go", "Pick up the red cube!", "naïve café 漢字 n° 5", "word " * 20)), checkpoint, options=options)


# --- the reference ---------------------------------------------------------------------------------------------------


def embodiment(checkpoint):
    return json.loads((Path(checkpoint).parent / "convert.json").read_text())["embodiment"]


def stored_weights(checkpoint, root):
    """In float32, with one table for embedding and head."""
    from safetensors.torch import load_file

    stored = {}
    for shard in sorted(checkpoint.glob("*.safetensors")):
        stored |= {name: value.float() for name, value in load_file(shard).items()}
    stored[root + "language_model.lm_head.weight"] = stored[root + "language_model.model.embed_tokens.weight"]
    return stored


class HeadTaps(Taps):
    """Hooks on LeRobot's action head and on the language model in front of it.  A recorder sets `image`, which says of every token whether it is an image's."""

    n_front = 1  # tokens in front of those of the actions

    def layers_in(self, language):
        """What enters a layer is what the one before it left."""
        for i, layer in enumerate(language.layers):
            self.before(layer, lambda x, name=f"lm.blk.{i - 1}" if i else "prefix": self.put(name, x[0]))

    def normed_language(self, language):
        self.layers_in(language)
        self.before(language.norm, lambda x: self.put(f"lm.blk.{len(language.layers) - 1}", x[0]))
        self.after(language.norm, lambda x: self.put("lm.norm", x[0]))

    def action_head(self, head):
        self.after(head.vlln, lambda x: self.put("vl.norm", x[0]))
        for i, block in enumerate(getattr(head.vl_self_attention, "transformer_blocks", [])):
            self.after(block, lambda x, i=i: self.put(f"vl.blk.{i}", x[0]))
        self.before(head.state_encoder, lambda x: self.put("state", x[0].flatten()))
        self.after(head.state_encoder, lambda x: self.put("state_out", x[0]))
        self.before(head.action_encoder, self.on_step)
        self.dit(head.model)

    def dit(self, dit):
        dit.register_forward_pre_hook(lambda m, args, kw: self.at_step("action_token", kw["hidden_states"][:, self.n_front :]), with_kwargs=True)
        for i, block in enumerate(dit.transformer_blocks):
            self.stepwise(block, f"dit.blk.{i}")
            if i % 2 == 0:
                of_text = i % (2 * getattr(dit, "attend_text_every_n_blocks", 1)) == 0
                for leaf, module in (("k", block.attn1.to_k), ("v", block.attn1.to_v)):
                    self.after(module, lambda x, name=f"dit.blk.{i}.{leaf}", a=block.attn1, t=of_text: self.seen(name, x, a.heads, t))
        self.stepwise(dit, "dit.out")

    def seen(self, name, x, n_head, of_text):
        """Keys or values of the rows that a cross block looks at: those of the text or those of the images."""
        if self.step == 0:
            self.put(name, x[0][self.image != of_text].unflatten(-1, (n_head, -1)))

    def on_step(self, x):
        if self.step >= 0:
            self.put(f"step.{self.step}.x", x[0])
        self.step += 1
