# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random Evo-1 checkpoints at any size, in both published layouts.

`authors`: config.json, norm_stats.json and mp_rank_00_model_states.pt, as the authors' trainer leaves them.  `lerobot`: the
hub layout, made with LeRobot's own class.  `vlm/` is what the hub keeps in the backbone's repository, without weights.

As random_smolvla: a parameter depends on its name and the seed alone, norm factors and layer scales are near 1 and not 1,
biases not 0, every value is representable in bfloat16, both tables of sines included.
"""
import json
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

from random_smolvla import TASKS, randomise, statistics

HUB_NAMES = {"authors": "OpenGVLab/InternVL3-1B", "lerobot": "OpenGVLab/InternVL3-1B-hf"}
ADDED = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>", "<quad>", "</quad>"]
PATCH = 14


@dataclass(frozen=True)
class Description:
    """A checkpoint: sizes of towers and head, features, normalization."""

    layout: str  # authors or lerobot
    side: int  # of the square pictures that the network sees
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
    n_merge: int = 60
    noise = "uniform"

    def image_tokens(self):
        return (self.side // PATCH // 2) ** 2

    def n_vocab(self):
        return 256 + self.n_merge + len(ADDED)


# What the files of the authors do not say, for the published size.
OPTIONS = {"variant": "r2", "dead_rows": "zero_attention", "views": ["camera1", "camera2"], "view_slots": 3}


def published(views):
    """The description of the published size in the authors' layout: 775 M parameters."""
    return Description(
        "authors", 448, {"hidden_size": 1024, "num_hidden_layers": 24, "num_attention_heads": 16, "intermediate_size": 4096},
        {"hidden_size": 896, "num_hidden_layers": 24, "num_attention_heads": 14, "num_key_value_heads": 2, "vocab_size": 151674,
         "intermediate_size": 4864, "max_position_embeddings": 32768}, 14,
        {"num_layers": 8, "num_heads": 8, "hidden_dim": 1024, "state_hidden_dim": 1024},
        {"chunk_size": 50, "max_state_dim": 24, "max_action_dim": 24, "max_text_length": 1024}, views)


def tokenizer(n_merge, added=ADDED, frames=tuple(f"Image-{i}: <\n{{}}\n" for i in (1, 2, 3)), **more):
    """Qwen2's own rules with other merges; the added tokens follow the vocabulary, in the published order.  frames: what stands
    around an instruction."""
    from tokenizers import AddedToken, Tokenizer, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast, Qwen2Tokenizer

    published, fast = Qwen2Tokenizer().backend_tokenizer, Tokenizer(models.BPE())
    fast.normalizer, fast.pre_tokenizer, fast.decoder = published.normalizer, published.pre_tokenizer, published.decoder
    corpus = [frame.format(task) for task in TASKS for frame in frames]
    fast.train_from_iterator(corpus, trainers.BpeTrainer(
        vocab_size=256 + n_merge, initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False))
    if fast.get_vocab_size() != 256 + n_merge:
        raise ValueError(f"the corpus gives {fast.get_vocab_size() - 256} merges, not {n_merge}")
    fast.add_tokens([AddedToken(t, special=True, normalized=False) for t in added])
    return PreTrainedTokenizerFast(tokenizer_object=fast, pad_token="<|endoftext|>", eos_token="<|im_end|>", padding_side="right",
                                   model_max_length=12288, clean_up_tokenization_spaces=False, **more)


def save_tokenizer(words, folder):
    """tokenizer.json and tokenizer_config.json as published: Qwen2's class, added tokens in both.  Returns the former."""
    words.save_pretrained(folder)
    spec = json.loads(words.backend_tokenizer.to_str())
    settings = json.loads((folder / "tokenizer_config.json").read_text())
    settings |= {"tokenizer_class": "Qwen2Tokenizer", "added_tokens_decoder": {
        str(t["id"]): {k: v for k, v in t.items() if k != "id"} for t in spec["added_tokens"]}}
    settings.pop("backend", None)
    (folder / "tokenizer_config.json").write_text(json.dumps(settings, indent=2) + "\n")
    return spec


def write_tokenizer(description, folder):
    """tokenizer.json, and for the authors' layout the three files that their slow class reads."""
    spec = save_tokenizer(tokenizer(description.n_merge), folder)
    if description.layout == "authors":
        (folder / "vocab.json").write_text(json.dumps(spec["model"]["vocab"], ensure_ascii=False))
        (folder / "merges.txt").write_text("#version: 0.2\n" + "".join(" ".join(m) + "\n" for m in spec["model"]["merges"]))
        (folder / "added_tokens.json").write_text(json.dumps({t["content"]: t["id"] for t in spec["added_tokens"]}, indent=2))


def write_backbone(description, folder):
    """What the hub keeps in the backbone's repository, without weights and code."""
    from transformers import InternVLConfig

    folder.mkdir(parents=True, exist_ok=True)
    write_tokenizer(description, folder)
    d, side = description, description.side
    text = {"max_position_embeddings": 512, "rope_theta": 1e6, "rms_norm_eps": 1e-6, "tie_word_embeddings": False,
            "vocab_size": d.n_vocab()} | d.text
    vision = {"norm_type": "layer_norm", "layer_norm_eps": 1e-6, "patch_size": PATCH} | d.vision
    if d.layout == "lerobot":
        vision |= {"image_size": [side, side], "patch_size": [PATCH, PATCH], "attention_bias": True, "use_qk_norm": False}
        InternVLConfig(vision_config=vision, text_config=text | {"model_type": "qwen2"}, downsample_ratio=0.5,
                       image_token_id=d.n_vocab() - len(ADDED) + ADDED.index("<IMG_CONTEXT>"), image_seq_length=d.image_tokens(),
                       tie_word_embeddings=False, architectures=["InternVLForConditionalGeneration"]).save_pretrained(folder)
        return
    config = {
        "model_type": "internvl_chat", "architectures": ["InternVLChatModel"], "downsample_ratio": 0.5, "ps_version": "v2",
        "select_layer": -1, "force_image_size": side, "dynamic_image_size": True, "max_dynamic_patch": 12, "min_dynamic_patch": 1,
        "use_thumbnail": True, "template": "internvl2_5", "hidden_size": text["hidden_size"], "tie_word_embeddings": False,
        "vision_config": vision | {"model_type": "intern_vit_6b", "image_size": side, "hidden_act": "gelu", "qkv_bias": True,
                                   "qk_normalization": False},
        "llm_config": text | {"model_type": "qwen2", "architectures": ["Qwen2ForCausalLM"], "hidden_act": "silu",
                              "use_cache": False, "rope_scaling": {"factor": 2.0, "rope_type": "dynamic", "type": "dynamic"}}}
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")


FAINT = (".embeddings.", ".lambda_", "embed_tokens", ".W3.")


def settle(modules, description):
    """Layer scales as trained ones are not: near 1, or the vision layers would hardly count.  Tables as bfloat16 has them."""
    for name, p in modules.named_parameters():
        if ".lambda_" in name:
            p.data.add_(1).copy_(p.data.bfloat16())
        if description.faint and any(part in name for part in FAINT):
            p.data /= 64
    for name, table in modules.named_buffers():
        if name.endswith(".pe"):
            table.copy_(table.bfloat16())


def norm_stats(description, seed):
    """Statistics under a robot, or under arm and data set."""

    def numbers(seed):
        return {f: {k: v.tolist() for k, v in s.items()} for f, s in statistics(description, seed).items()}

    *arm, last = description.keys
    found = {key: numbers(seed + 1 + i) for i, key in enumerate(description.other_keys)} | {last: numbers(seed)}
    return {arm[0]: found} if arm else found


def as_deepspeed(state):
    """The trainer's file: parameters are views of one flat buffer, tables stand alone, and other things lie about."""
    import torch

    tables = [name for name in state if name.endswith(".pe")]
    parameters = [name for name in state if name not in tables]
    flat = torch.cat([state[name].flatten() for name in parameters])
    views = flat.split([state[name].numel() for name in parameters])
    module = OrderedDict(state) | {name: view.view_as(state[name]) for name, view in zip(parameters, views, strict=True)}
    module._metadata = OrderedDict({"": {"version": 1}})
    shapes = [OrderedDict((name, state[name].shape) for name in parameters)]
    return {"module": module, "buffer_names": tables, "optimizer": None, "param_shapes": shapes, "lr_scheduler": None,
            "sparse_tensor_module_names": set(), "skipped_steps": 0, "global_steps": 100, "dp_world_size": 8, "mp_world_size": 1,
            "ds_config": {"bf16": {"enabled": True}, "zero_optimization": {"stage": 2}}, "ds_version": "0.16.4"}


def write_authors(description, seed, folder):
    """The three files of the authors' trainer, and dims.json for two literals of their code.  Returns the parameter count."""
    import torch
    from vla_cpp.convert import golden_evo1_server as server

    d = description
    head = d.head | {"embed_dim": d.text["hidden_size"], "horizon": d.policy["chunk_size"], "num_categories": 1, "dropout": 0.2,
                     "state_dim": d.policy["max_state_dim"], "per_action_dim": d.policy["max_action_dim"]}
    config = head | {"vlm_name": HUB_NAMES["authors"], "action_head": "flowmatching", "return_cls_only": False}
    if len(d.keys) == 1:  # the older files
        config["action_dim"] = head["horizon"] * head["per_action_dim"]
    else:
        config["normalization_type"] = d.normalization
    dims = {"language_layers": d.n_layer, "prompt_tokens": d.policy["max_text_length"]}
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    (folder / "dims.json").write_text(json.dumps(dims) + "\n")
    modules = server.construct(folder)
    randomise(modules, seed), settle(modules, d)
    state = {name: torch.cat(parts).bfloat16() for name, parts in server.tensors(modules)}
    torch.save(as_deepspeed(state), folder / "mp_rank_00_model_states.pt")
    (folder / "norm_stats.json").write_text(json.dumps(norm_stats(d, seed), indent=1) + "\n")
    return sum(p.numel() for p in modules.parameters())


def policy_config(description, backbone):
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.evo1.configuration_evo1 import Evo1Config

    d = description
    views = {f"observation.images.{v}": PolicyFeature(FeatureType.VISUAL, (3, *s)) for v, s in d.views.items()}
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (d.d_state,))}
    return Evo1Config(
        input_features=views | state, output_features={"action": PolicyFeature(FeatureType.ACTION, (d.d_action,))},
        vlm_model_name=str(backbone), vlm_num_layers=d.n_layer, image_resolution=(d.side, d.side), use_flash_attn=False,
        embed_dim=d.text["hidden_size"], n_action_steps=d.policy["chunk_size"], device="cpu", push_to_hub=False,
        **d.head, **d.policy)


def write_lerobot(description, seed, folder):
    """config.json, model.safetensors in bfloat16 and both pipelines.  Returns the parameter count."""
    from lerobot.policies.evo1.processor_evo1 import make_evo1_pre_post_processors
    from vla_cpp.convert import golden_evo1

    config = policy_config(description, folder / "vlm")
    policy = golden_evo1.construct_lerobot(config)
    randomise(policy, seed), settle(policy, description)
    before, after = make_evo1_pre_post_processors(config, statistics(description, seed))
    config.vlm_model_name = HUB_NAMES["lerobot"]
    policy.bfloat16().save_pretrained(folder)
    before.save_pretrained(folder), after.save_pretrained(folder)
    return sum(p.numel() for p in policy.parameters())


def write_checkpoint(description, seed, folder):
    """A checkpoint in the layout of its description, with `vlm/`.  Returns the parameter count."""
    folder = Path(folder)
    write_backbone(description, folder / "vlm")
    return {"authors": write_authors, "lerobot": write_lerobot}[description.layout](description, seed, folder)
