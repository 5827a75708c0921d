# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random GR00T N1.7 checkpoints at any size, in the authors' layout: config.json, two shards of safetensors with their index,
processor_config.json, statistics.json, embodiment_id.json.  `vlm/` is what the hub keeps in the backbone's repository, without
weights.

As random_smolvla: a parameter depends on its name and the seed alone, norm factors are near 1 and not 1, biases not 0, every
value is representable in bfloat16.  A checkpoint serves a second robot too, with other cameras, keys and statistics.
"""
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from random_evo1 import save_tokenizer, tokenizer
from random_smolvla import randomise, statistics

HUB_NAME = "nvidia/Cosmos-Reason2-2B"
ADDED = [f"<|{name}|>" for name in (
    "endoftext", "im_start", "im_end", "object_ref_start", "object_ref_end", "box_start", "box_end", "quad_start", "quad_end",
    "vision_start", "vision_end", "vision_pad", "image_pad", "video_pad")]
TEMPLATE = (
    "{% for message in messages %}<|im_start|>{{ message.role }}\n{% for part in message.content %}{% if part.type == 'image' %}"
    "<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ part.text }}{% endif %}{% endfor %}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}")
ABSOLUTE = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
RELATIVE = ABSOLUTE | {"rep": "RELATIVE"}
N_DEAD = 5  # rows of the embedding behind the last token


@dataclass(frozen=True)
class Robot:
    """What a checkpoint knows of one embodiment."""

    views: tuple
    states: dict  # key -> width
    actions: dict  # key -> width
    rows: int  # of the head's horizon, which the robot gets
    relative: dict = field(default_factory=dict)  # action key -> the state key that it is added to, None: of the same name
    zero_spread: tuple = ()

    @property
    def d_state(self):
        return sum(self.states.values())

    @property
    def d_action(self):
        return sum(self.actions.values())


OTHER = "new_embodiment", 0, Robot(("ego_view",), {"arm": 3}, {"hand": 1, "arm": 3}, 4)


@dataclass(frozen=True)
class Description:
    """A checkpoint: sizes of towers and head, robots, the way of a picture."""

    tag: str
    index: int  # of the embodiment
    robot: Robot
    vision: dict  # fields of Qwen3VLVisionConfig
    text: dict  # fields of Qwen3VLTextConfig, with the number of layers that the backbone has
    head: dict  # fields of config.json
    picture: dict  # fields of processor_kwargs: how a frame becomes a picture
    side: int  # of the smallest square picture that the backbone's processor leaves alone
    percentiles: bool = False
    faint: bool = False  # what enters a residual stream is so small that every norm's eps shows
    n_merge: int = 60

    @property
    def d_state(self):
        return self.robot.d_state

    @property
    def states(self):
        return self.robot.states

    @property
    def zero_spread(self):
        return self.robot.zero_spread

    @property
    def d_action(self):
        return self.robot.d_action

    @property
    def policy(self):
        return {"chunk_size": self.head["action_horizon"], "max_action_dim": self.head["max_action_dim"]}

    def robots(self):
        other, index, robot = OTHER
        return {self.tag: (self.index, self.robot), other: (index, robot)}


def write_backbone(description, folder):
    """What the hub keeps in the backbone's repository, without weights."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = ("<|im_start|>user\n{}<|im_end|>\n",)
    save_tokenizer(tokenizer(description.n_merge, ADDED, frames, chat_template=TEMPLATE), folder)
    ids = {name: 256 + description.n_merge + i for i, name in enumerate(ADDED)}
    text = {"model_type": "qwen3_vl_text", "vocab_size": 256 + description.n_merge + len(ADDED) + N_DEAD, "rms_norm_eps": 1e-6,
            "rope_theta": 5000000, "max_position_embeddings": 512, "hidden_act": "silu", "attention_bias": False,
            "attention_dropout": 0.0, "bos_token_id": ids["<|endoftext|>"], "eos_token_id": ids["<|im_end|>"],
            "tie_word_embeddings": True} | description.text
    vision = {"model_type": "qwen3_vl", "in_channels": 3, "temporal_patch_size": 2, "spatial_merge_size": 2,
              "hidden_act": "gelu_pytorch_tanh", "out_hidden_size": text["hidden_size"]} | description.vision
    config = {"architectures": ["Qwen3VLForConditionalGeneration"], "model_type": "qwen3_vl", "tie_word_embeddings": True,
              "text_config": text, "vision_config": vision} | {
                  f"{name}_token_id": ids[f"<|{token}|>"] for name, token in (
                      ("image", "image_pad"), ("video", "video_pad"), ("vision_start", "vision_start"), ("vision_end", "vision_end"))}
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    pictures = {"size": {"longest_edge": 1 << 20, "shortest_edge": description.side ** 2}, "patch_size": vision["patch_size"],
                "temporal_patch_size": 2, "merge_size": 2, "image_mean": [0.5] * 3, "image_std": [0.5] * 3,
                "processor_class": "Qwen3VLProcessor"}
    for file, kind in (("preprocessor_config", {"image_processor_type": "Qwen2VLImageProcessorFast"}),
                       ("video_preprocessor_config", {"video_processor_type": "Qwen3VLVideoProcessor"})):
        (folder / f"{file}.json").write_text(json.dumps(pictures | kind, indent=2) + "\n")


def modalities(robot):
    def part(keys, deltas, actions=None):
        return {"delta_indices": deltas, "modality_keys": list(keys), "sin_cos_embedding_keys": None, "mean_std_embedding_keys": None,
                "action_configs": actions}

    configs = [RELATIVE | {"state_key": robot.relative[k]} if k in robot.relative else ABSOLUTE for k in robot.actions]
    return {"video": part(robot.views, [0]), "state": part(robot.states, [0]),
            "action": part(robot.actions, list(range(robot.rows)), configs),
            "language": part(["annotation.human.action.task_description"], [0])}


def processor_config(description):
    d, used = description, any(robot.relative for _, robot in description.robots().values())
    settings = {
        "modality_configs": {tag: modalities(robot) for tag, (_, robot) in d.robots().items()},
        "image_crop_size": None, "image_target_size": None, "use_albumentations": True, "random_rotation_angle": None,
        "color_jitter_params": None, "shortest_image_edge": None, "crop_fraction": None, "letter_box_transform": False,
        "model_name": HUB_NAME, "model_type": "qwen", "formalize_language": True, "max_state_dim": d.head["max_state_dim"],
        "max_action_dim": d.head["max_action_dim"], "max_action_horizon": d.head["action_horizon"], "use_percentiles": d.percentiles,
        "use_mean_std": False, "clip_outliers": True, "apply_sincos_state_encoding": False, "use_relative_action": used,
        "exclude_state": False, "state_dropout_prob": 0.2}
    return {"processor_class": "Gr00tN1d7Processor", "processor_kwargs": settings | d.picture}


def per_key(numbers, groups):
    """Statistics of a whole vector -> those of its parts."""
    out, start = {}, 0
    for key, n in groups.items():
        out[key] = {k: numbers[k][start:start + n].tolist() for k in ("min", "max", "mean", "std", "q01", "q99")}
        start += n
    return out


def all_statistics(description, seed):
    out = {}
    for i, (tag, (_, robot)) in enumerate(description.robots().items()):
        flat, changes = statistics(robot, seed + i), statistics(robot, seed + i + 1000)["action"]
        relative = per_key(changes, robot.actions)
        out[tag] = {"state": per_key(flat["observation.state"], robot.states), "action": per_key(flat["action"], robot.actions),
                    "relative_action": {key: relative[key] for key in robot.relative}}
    return out


# Where residual streams begin, and what is added to them.
FAINT = ("patch_embed", "pos_embed", "attn.proj", "linear_fc2", "embed_tokens", "o_proj", "down_proj", "vlln", "to_out", "ff.net.2",
         "state_encoder.layer2", "W3", "position_embedding")


def settle(model, description):
    """What randomise() does not know: a norm by another name, and weights of [embodiment, in, out], which it left too small."""
    norm = model.action_head.vlln.weight.data
    norm.add_(1).copy_(norm.bfloat16())
    for name, p in model.action_head.named_parameters():
        if p.ndim == 3:
            p.data *= 2.0 ** round(math.log2(p.shape[2]) / 2)
    for name, p in model.named_parameters():
        if description.faint and any(part in name for part in FAINT):
            p.data /= 16


def write_weights(model, folder):
    """Two shards and their index, in bfloat16."""
    from safetensors.torch import save_file

    index, size = {}, 0
    for i, part in enumerate(("backbone.", "action_head.")):
        file = f"model-{i + 1:05d}-of-00002.safetensors"
        tensors = {k: v.bfloat16().contiguous() for k, v in model.state_dict().items() if k.startswith(part) and "lm_head" not in k}
        save_file(tensors, folder / file, metadata={"format": "pt"})
        index |= dict.fromkeys(tensors, file)
        size += sum(2 * v.numel() for v in tensors.values())
    text = json.dumps({"metadata": {"total_size": size}, "weight_map": dict(sorted(index.items()))}, indent=1)
    (folder / "model.safetensors.index.json").write_text(text + "\n")


def write_checkpoint(description, seed, folder):
    """A checkpoint in the authors' layout, with `vlm/`.  Returns the parameter count."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config
    from vla_cpp.convert.golden_gr00t_n1_7 import backbone_from

    d, folder = description, Path(folder)
    write_backbone(d, folder / "vlm")
    settings = processor_config(d)
    same = ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction", "use_percentiles", "use_relative_action")
    config = GR00TN17Config(backbone_embedding_dim=d.text["hidden_size"], **{k: settings["processor_kwargs"][k] for k in same}, **d.head)
    with backbone_from(folder / "vlm"):
        model = randomise(GR00TN17(config, load_backbone_weights=False).float(), seed).eval()
    settle(model, d)
    fields = config.to_diff_dict() | {"architectures": ["Gr00tN1d7"], "model_type": "Gr00tN1d7", "torch_dtype": "bfloat16"}
    ids = {tag: index for tag, (index, _) in d.robots().items()}
    for file, value in (("config", fields), ("processor_config", settings), ("statistics", all_statistics(d, seed)),
                        ("embodiment_id", ids)):
        (folder / f"{file}.json").write_text(json.dumps(value, indent=1) + "\n")
    write_weights(model, folder)
    return sum(p.numel() for p in model.parameters())
