# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The backbones of GR00T N1.5 and N1.6, Eagle 2.5 and Eagle 3: a tower of the SigLIP family, a connector, the first layers of Qwen3.

Their configs, tokenizers and processors are in the authors' source tree, not beside the weights.
References: Isaac-GR00T gr00t/model/backbone/eagle2_hg_model (N1.5), gr00t/model/modules/nvidia/Eagle-Block2A-2B-v2 (N1.6).
"""

from __future__ import annotations

import math
import os
from typing import Dict, List, Mapping

from ...ascii_bpe import special_ids
from ...errors import Problems
from ...files import member, read_json
from ...layers import QWEN3, Rows, linear, norm
from ...networks import NORM_EPS, decoder, defaults, pick, pooling_head, read_vision, siglip
from ...section import Fixed, Section
from ...tokenizer import TokenizerPlan
from .. import Dropped
from . import language
from . import prompt as prompts
from .images import Area
from .prompt import END, START, Prompt, Template
from .sizes import WHERE, Sizes

IMAGE = "<IMG_CONTEXT>"
SYSTEM = START + "system\nYou are a helpful assistant." + END + "\n" + START + "user\n"
OPEN, CLOSE = "<image {i}><img>", "</img>"
# Defaults of transformers' SiglipVisionConfig, Siglip2VisionConfig and Qwen3Config.
VISION = defaults(768, 3072, 12, 12, image_size=224, num_patches=256, patch_size=16, layer_norm_eps=1e-6)
VISION_FIXED: Fixed = {
    "hidden_act": ("gelu_pytorch_tanh", "gelu_pytorch_tanh"),
    "num_channels": (3, 3),
    "use_rope": (False, False),
    "use_windows_attn": (False, False),
}
TEXT = {**language.TEXT, "max_position_embeddings": 32768, "rope_theta": 10000.0}
TEXT_FIXED: Fixed = {"use_sliding_window": (False, False)}
IMAGE_FIXED: Fixed = {
    "do_resize": (None, False),
    "do_rescale": (None, True),
    "do_normalize": (None, True),
    "rescale_factor": (None, 1 / 255),
    "image_mean": (None, [0.5, 0.5, 0.5]),
    "image_std": (None, [0.5, 0.5, 0.5]),
}
FILE = "preprocessor_config.json"


class Eagle:
    """One of the two backbones. `root`: prefix of its tensors, up to the dot. `merge`: patches per side of a token."""

    def __init__(self, model_type: str, root: str, merge: int, template: Template, folder: str) -> None:
        self.model_type, self.root, self.merge, self.TEMPLATE, self.folder = model_type, root, merge, template, folder
        self.LM = root + "language_model.model."

    def read(self, folder: str, kept: int, s: Sizes, problems: Problems) -> None:
        config = read_json(os.path.join(folder, "config.json"))
        whole = Section(WHERE, config, {}, problems)
        fixed: Fixed = {
            "model_type": (None, self.model_type),
            "select_layer": (-1, -1),
            "use_pixel_shuffle": (None, self.merge > 1),
            "mlp_connector_layers": (None, self.merge),
            "downsample_ratio": (0.5, 0.5),
        }
        whole.check_fixed(fixed, self.folder)
        text = Section(WHERE + ": text_config", member(config, "text_config", dict, WHERE), TEXT, problems)
        language.read(text, kept, s)
        text.check_fixed(TEXT_FIXED)
        rope = language.rope_section(text, {})
        rope.refuse_unknown({"rope_type", "type", "rope_theta"})
        if rope.get("rope_type") not in (None, "default") or rope.get("type") not in (None, "default"):
            rope.bad("rope_type", "'default'", unsupported=True)
        s.lm.rope_base = (rope if "rope_theta" in rope.values else text).number("rope_theta")
        s.merge = self.merge
        self._read_vision(Section(WHERE + ": vision_config", member(config, "vision_config", dict, WHERE), VISION, problems), s)

    def _read_vision(self, vision: Section, s: Sizes) -> None:
        vision.check_fixed(VISION_FIXED)
        s.vision = read_vision(vision, 0, vision.count("patch_size"))
        if self.merge == 1:
            side = vision.count("image_size")
            s.image_width = s.image_height = side
            s.n_position_side = side // s.vision.patch_size
            if side % s.vision.patch_size:
                vision.bad("image_size", "a multiple of patch_size {}".format(s.vision.patch_size))
            return
        s.n_position_side = math.isqrt(vision.count("num_patches"))
        if s.n_position_side**2 != vision.get("num_patches"):
            vision.bad("num_patches", "a square")

    def read_area(self, folder: str, s: Sizes, problems: Problems) -> Area:
        """The image sizes that smart_resize of the processor keeps, and the rule for others."""
        path = os.path.join(folder, FILE)
        Section("backbone " + FILE, read_json(path), {}, problems).check_fixed(IMAGE_FIXED)
        side = self.merge * s.vision.patch_size
        return Area(FILE, "pillow_bicubic", side, side, 4 * side**2, 4096 * side**2)

    def read_prompt(self, tokenizer: TokenizerPlan, folder: str, s: Sizes, problems: Problems) -> Prompt:
        prompt = prompts.read_prompt(self.TEMPLATE, tokenizer, self.folder, s, problems)
        (image,) = special_ids(tokenizer.keys, (IMAGE,), "", Problems(""))
        config = read_json(os.path.join(folder, "config.json"))
        if config.get("image_token_index") != image:
            expected = "{}, the tokenizer's {}".format(image, IMAGE)
            problems.add(WHERE + ": image_token_index", expected, repr(config.get("image_token_index")))
        return prompt

    def weights(self, s: Sizes) -> Rows:
        vision = self.root + "vision_model.vision_model."
        rows = siglip(vision, s.vision, s.n_position_side**2)
        if self.merge > 1:
            # The checkpoint flattens patches pixel by pixel, the bundle channel by channel.
            rows[0] = rows[0]._replace(stored=rows[0].shape, regroup=3)
        return [*rows, *self._connector(s), *decoder(s.lm, self.LM, QWEN3)]

    def _connector(self, s: Sizes) -> Rows:
        source = self.root + "mlp1."
        if self.merge == 1:
            return linear("projector", source + "0", s.lm.d_model, s.vision.d_model)
        # For a square of patches, the checkpoint stores each feature's patches together, the bundle each patch's features.
        n_patch, d = self.merge**2, self.merge**2 * s.vision.d_model
        *regrouped, bias = norm("connector.norm", source + "0", d) + linear("connector.up", source + "1", s.lm.d_model, d)
        down = linear("connector.down", source + "3", s.lm.d_model, s.lm.d_model)
        return [*(row._replace(regroup=n_patch) for row in regrouped), bias, *down]

    def dropped(self, s: Sizes) -> List[Dropped]:
        rows = pooling_head(self.root + "vision_model.vision_model.", s.vision, "pooling head of the tower")
        lm_head = Dropped(self.root + "language_model.lm_head.weight", (s.lm.n_vocab, s.lm.d_model), "language head")
        mask = Dropped("action_head.mask_token", (1, 1, s.d_dit), "stands for the state in training")
        return [*rows, lm_head, mask]

    def keys(self, s: Sizes) -> Dict[str, Mapping[str, object]]:
        vision = dict(s.vision_keys(), norm_eps=s.vision.norm_eps)
        if self.merge == 1:
            return {"vision": dict(vision, image_size=s.image_width, position_rule="row_major")}
        own = pick(s, "image_width image_height n_position_side")
        return {"vision": {**vision, **own}, "connector": dict(factor=self.merge, norm_eps=NORM_EPS)}


EAGLE_2_5 = Eagle(
    "eagle_2_5_vl",
    "backbone.eagle_model.",
    1,
    Template(SYSTEM, END + "\n" + START + "assistant\n", OPEN, IMAGE, CLOSE),
    "--backbone needs the folder eagle2_hg_model of the authors' code",
)
EAGLE_3 = Eagle(
    "eagle_3_vl",
    "backbone.model.",
    2,
    Template(SYSTEM, END + "\n", OPEN, IMAGE, CLOSE, behind=True),
    "--backbone needs the folder Eagle-Block2A-2B-v2 of the authors' code",
)
