# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The backbone of GR00T N1.7, a Qwen3-VL: its config.json, its tensors, its keys, and the image sizes that it accepts.

Keys of the config that the classes do not read have no effect in the reference either.
"""

from __future__ import annotations

import math
import os
from typing import Dict, List, Mapping

from ... import chat_template
from ...ascii_bpe import special_ids
from ...errors import Code, Problems, refuse
from ...files import member, read_json
from ...layers import QWEN3, Names, Rows, blocks, linear, norm, patch_embed, table
from ...networks import MAX_LAYERS, decoder, pick
from ...section import Fixed, Section
from ...tokenizer import TokenizerPlan
from .. import Dropped
from . import language
from . import prompt as prompts
from .images import Area
from .prompt import END, START, Prompt, Template
from .sizes import WHERE, Sizes

VISUAL, LM = "backbone.model.model.visual.", "backbone.model.model.language_model."
BLOCK = Names("attn.qkv. attn.proj", "mlp.linear_fc1 mlp.linear_fc2", "norm1 norm2")
OPEN, CLOSE, IMAGE = "<|vision_start|>", "<|vision_end|>", "<|image_pad|>"
# One user turn without a system turn; the images come before the instruction.
TEMPLATE = Template(START + "user\n", END + "\n", OPEN, IMAGE, CLOSE)
FOLDER = "--backbone needs the folder of nvidia/Cosmos-Reason2-2B"
# Defaults of transformers' Qwen3VLVisionConfig, Qwen3VLTextConfig and Qwen3VLConfig.
VISION = {
    "depth": 27,
    "hidden_size": 1152,
    "intermediate_size": 4304,
    "num_heads": 16,
    "patch_size": 16,
    "out_hidden_size": 3584,
    "num_position_embeddings": 2304,
    "deepstack_visual_indexes": [8, 16, 24],
}
VISION_FIXED: Fixed = {
    "hidden_act": ("gelu_pytorch_tanh", "gelu_pytorch_tanh"),
    "in_channels": (3, 3),
    "spatial_merge_size": (2, 2),
    "temporal_patch_size": (2, 2),
}
TEXT = {**language.TEXT, "max_position_embeddings": 128000, "rope_theta": 500000.0}
FILE = "preprocessor_config.json"
# Keys of transformers' Qwen2VLImageProcessor. A key with None must be stated, since the class's default is for another model.
SIZES = {"size": None, "min_pixels": None, "max_pixels": None}
IMAGE_FIXED: Fixed = {
    "do_resize": (True, True),
    "do_rescale": (True, True),
    "do_normalize": (True, True),
    "do_convert_rgb": (True, True),
    "resample": (3, 3),
    "rescale_factor": (1 / 255, 1 / 255),
    "image_mean": (None, [0.5, 0.5, 0.5]),
    "image_std": (None, [0.5, 0.5, 0.5]),
    "temporal_patch_size": (2, 2),
    "merge_size": (2, 2),
}
IMAGE_IGNORED = set(
    """image_processor_type processor_class data_format input_data_format disable_grouping return_tensors device default_to_square
    feature_extractor_type do_center_crop crop_size do_pad pad_size""".split()
)


def read(folder: str, kept: int, s: Sizes, problems: Problems, hint: str = FOLDER) -> None:
    """Reads the config in a folder. `hint`: says which folder --backbone needs."""
    config = read_json(os.path.join(folder, "config.json"))
    Section(WHERE, config, {}, problems).check_fixed({"model_type": (None, "qwen3_vl")}, hint)
    text = Section(WHERE + ": text_config", member(config, "text_config", dict, WHERE), TEXT, problems)
    language.read(text, kept, s)
    _read_rope(text, s)
    _read_vision(Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), VISION, problems), s)


def _read_vision(vision: Section, s: Sizes) -> None:
    vision.check_fixed(VISION_FIXED)
    side = vision.get("patch_size")
    if isinstance(side, list) and len(side) == 2 and side[0] == side[1]:
        vision.values = {**vision.values, "patch_size": side[0]}
    s.vision.patch_size, s.vision.n_layer = vision.count("patch_size"), vision.count("depth", maximum=MAX_LAYERS)
    s.vision.d_model, s.vision.d_ff = vision.count("hidden_size"), vision.count("intermediate_size")
    s.vision.n_head = vision.count("num_heads")
    s.n_position_side = math.isqrt(vision.count("num_position_embeddings"))
    if s.vision.d_model % s.vision.n_head or s.vision.d_model // s.vision.n_head % 4:
        vision.bad("num_heads", "heads of a multiple of 4, which divide hidden_size {}".format(s.vision.d_model))
    if s.n_position_side**2 != vision.get("num_position_embeddings"):
        vision.bad("num_position_embeddings", "a square")
    if vision.count("out_hidden_size") != s.lm.d_model:
        vision.bad("out_hidden_size", "the language model's width {}".format(s.lm.d_model))
    layers = vision.get("deepstack_visual_indexes")
    if (
        not isinstance(layers, list)
        or any(type(i) is not int or not 0 <= i < s.vision.n_layer for i in layers)
        or sorted(set(layers)) != layers
        or not 1 <= len(layers) <= s.lm.n_layer
    ):
        expected = "rising numbers of layers below {}, no more than the {} language layers".format(s.vision.n_layer, s.lm.n_layer)
        vision.bad("deepstack_visual_indexes", expected)
        layers = []
    s.deepstack_layers = layers


def _read_rope(text: Section, s: Sizes) -> None:
    rope = language.rope_section(text, {"mrope_section": [24, 20, 20]})
    rope.refuse_unknown({"mrope_section", "mrope_interleaved", "rope_type", "type", "rope_theta"})
    if rope.get("rope_type") not in (None, "default") or rope.get("type") not in (None, "default", "mrope"):
        rope.bad("rope_type", "'default'", unsupported=True)
    rope.check_fixed({"mrope_interleaved": (True, True)})
    s.lm.rope_base = (rope if "rope_theta" in rope.values else text).number("rope_theta")
    sections = rope.get("mrope_section")
    counts = isinstance(sections, list) and len(sections) == 3 and all(type(n) is int and n > 0 for n in sections)
    if not counts or sum(sections) != s.lm.d_head // 2 or 3 * max(sections[1:]) > s.lm.d_head // 2:
        expected = "three counts for time, height and width that make {}, half a head's width".format(s.lm.d_head // 2)
        rope.bad("mrope_section", expected)
        sections = [1, 1, 1]
    s.rope_sections = sections


def read_area(folder: str, s: Sizes, problems: Problems) -> Area:
    """The image sizes that smart_resize of the image processor keeps."""
    path = os.path.join(folder, FILE)
    if not os.path.exists(path):
        hint = "it lies beside the backbone's config.json, and says to which sizes images are held"
        raise refuse(path, "the backbone's image processor", "none", hint, Code.IO)
    section = Section("backbone " + FILE, read_json(path), SIZES, problems)
    section.refuse_unknown({*SIZES, *IMAGE_FIXED, *IMAGE_IGNORED, "patch_size"})
    section.check_fixed(IMAGE_FIXED)
    if section.get("patch_size") != s.vision.patch_size:
        section.bad("patch_size", "{} as in the backbone's vision_config".format(s.vision.patch_size))
    size = section.get("size") if isinstance(section.get("size"), dict) else {}
    limits = []
    for own, key in (("min_pixels", "shortest_edge"), ("max_pixels", "longest_edge")):
        stated = size.get(key) if section.get(own) is None else section.get(own)
        if type(stated) is not int or not 0 < stated < 1 << 31:
            section.bad("size", "shortest_edge and longest_edge, counts of pixels")
            stated = 1
        limits.append(stated)
    return Area(FILE, "torch_bicubic_16bit", 0, 2 * s.vision.patch_size, *limits)


def weights(s: Sizes) -> Rows:
    v = s.vision
    patch, bias = patch_embed(VISUAL + "patch_embed.proj", v.d_model, v.patch_size)
    # The patch embedding reads two moments; here both are the same frame.
    side = patch.stored[-1]
    moments = [patch._replace(stored=(v.d_model, 3, 2, side, side), pick=(2, time)) for time in (0, 1)]
    rows = [
        moments[0],
        moments[1]._replace(target="vision.patch_embed_next.weight"),
        bias,
        *table("vision.position", VISUAL + "pos_embed.weight", s.n_position_side**2, v.d_model),
        *blocks("vision.", VISUAL + "blocks.{}.", BLOCK, v.n_layer, v.d_model, v.d_ff),
        *_merger("connector.", VISUAL + "merger.", s, v.d_model),
    ]
    for k in range(len(s.deepstack_layers)):
        rows += _merger("deepstack.{}.".format(k), "{}deepstack_merger_list.{}.".format(VISUAL, k), s, 4 * v.d_model)
    return rows + decoder(s.lm, LM, QWEN3, "layers")


def _merger(target: str, source: str, s: Sizes, d_norm: int) -> Rows:
    d = 4 * s.vision.d_model
    up, down = linear(target + "up", source + "linear_fc1", d, d), linear(target + "down", source + "linear_fc2", s.lm.d_model, d)
    return [*norm(target + "norm", source + "norm", d_norm), *up, *down]


def keys(s: Sizes) -> Dict[str, Mapping[str, object]]:
    literals = dict(norm_eps=1e-6, rope_base=1e4)  # literals of the reference
    own = pick(s, "image_width image_height n_position_side merge deepstack_layers")
    return {"vision": {**s.vision_keys(), **own, **literals}, "lm": dict(rope_sections=s.rope_sections)}


def read_prompt(tokenizer: TokenizerPlan, folder: str, s: Sizes, problems: Problems, hint: str = FOLDER) -> Prompt:
    prompt = prompts.read_prompt(TEMPLATE, tokenizer, hint, s, problems)
    own = (OPEN, CLOSE, IMAGE)
    _check_ids(folder, dict(zip(own, special_ids(tokenizer.keys, own, "", Problems("")))), problems)
    _check_template(folder, problems)
    return prompt


def _check_ids(folder: str, ids: dict, problems: Problems) -> None:
    """Checks that the config and the tokenizer have the same ids of image tokens: the network finds them by the config's ids."""
    config = read_json(os.path.join(folder, "config.json"))
    for key, default, text in (("image_token_id", 151655, IMAGE), ("vision_start_token_id", 151652, OPEN)):
        if config.get(key, default) != ids[text]:
            problems.add("{}: {}".format(WHERE, key), "{}, the tokenizer's {}".format(ids[text], text), repr(config.get(key, default)))


def _check_template(folder: str, problems: Problems) -> None:
    """Checks that the chat template, which is a program, renders user turns to the bundle's prompt."""
    where, template = chat_template.find(folder)
    if template is None:
        return
    for n_view, text, generates in ((1, "go", False), (3, " Pick {{ x }} up,\n now <|im_end|> \n", False), (2, "", True)):
        wanted = TEMPLATE.before + (OPEN + IMAGE + CLOSE) * n_view + text + TEMPLATE.after + (START + "assistant\n" if generates else "")
        found = chat_template.user_turn(template, where, n_view, text, generates)
        if found != wanted:
            problems.unsupported(where, "Qwen3-VL's, which makes {!r} of a user's turn".format(wanted), repr(found)[:200])
            return


def dropped(s: Sizes) -> List[Dropped]:
    reason = "final language norm: the action head reads the last layer as it is before it"
    head = Dropped("backbone.model.lm_head.weight", (s.lm.n_vocab, s.lm.d_model), "language head")
    return [Dropped(LM + "norm.weight", (s.lm.d_model,), reason), head]
