# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""π0-FAST: golden cases, random checkpoints in LeRobot's layout, and LeRobot's classes as the reference.

Sizes are stated as for π0 (pi.py).  `checkpoint/tokenizer` holds what the hub keeps in google/paligemma-3b-pt-224, with ids of
actions behind the vocabulary of π0's cases; `checkpoint/action_tokenizer` what it keeps in lerobot/fast-action-tokenizer.
"""

import json
import random
from dataclasses import dataclass, field
from pathlib import Path

from . import lerobot_layout as layout
from . import pi
from .cases import MODES, RECORDED, TEXTS, Case, draw_views
from .draw import bfloat16, f32
from .files import bfloat16_bits, write_json, write_stream
from .parameters import decoder_layer, linear, rms_norm, siglip, statistics, tower
from .pi import HUB_TOKENIZER, N_TOKEN, PATCH, TOWER, gemma, load_sized
from .recorder import ChunkRecorder, Taps

NAMES = {"pi0_fast": "lerobot.policies.pi0_fast.PI0FastPolicy"}
HUB_ACTIONS = "lerobot/fast-action-tokenizer"
STOP = "|"
DEFAULTS = {name: value for name, value in pi.CONFIG.items() if not name.startswith(("time_", "min_p", "max_p", "num_", "freeze", "train"))} | {
    "normalization_mapping": layout.IDENTITY | {"STATE": "MEAN_STD", "ACTION": "MEAN_STD"}, "tokenizer_max_length": 200,
    "max_action_tokens": 256, "text_tokenizer_name": HUB_TOKENIZER, "action_tokenizer_name": HUB_ACTIONS, "temperature": 0.0,
    "max_decoding_steps": 256, "fast_skip_tokens": 128, "validate_action_token_prefix": True, "use_kv_cache": True}

# --- the tokenizers ----------------------------------------------------------------------------------------------------

PROCESSOR = '''"""Holds a tokenizer and two numbers: what the reference reads of the published class of this name."""

from transformers.processing_utils import ProcessorMixin


class UniversalActionProcessor(ProcessorMixin):
    attributes = ["bpe_tokenizer"]
    bpe_tokenizer_class = "AutoTokenizer"

    def __init__(self, bpe_tokenizer, scale=10, vocab_size=1024, min_token=0, *, action_dim=None, time_horizon=None):
        self.scale, self.vocab_size, self.min_token = scale, vocab_size, min_token
        self.action_dim, self.time_horizon = action_dim, time_horizon
        super().__init__(bpe_tokenizer)
'''


@dataclass(frozen=True)
class Fast:
    """A small tokenizer of the published form: characters from U+0000 on stand for coefficients from min_token on, most tokens for one
    character or two."""

    n_character: int = 160
    min_token: int = -80
    scale: float = 10

    def vocabulary(self):
        """(token -> id, merges).  The characters themselves come first, as training puts them there, and then the symbols of their bytes."""
        from vla_cpp.convert.tokenizer_byte_level import byte_symbols

        symbols = byte_symbols()
        spelt = [[symbols[byte] for byte in chr(i).encode()] for i in range(self.n_character)]
        tokens = dict.fromkeys([*map(chr, range(self.n_character)), *(symbol for parts in spelt for symbol in parts)])
        merges = [tuple(parts) for parts in spelt if len(parts) == 2]
        near = ["".join(spelt[i]) for i in range(-self.min_token - 3, -self.min_token + 4)]
        merges += [(a, b) for a in near for b in near if a + b not in tokens]
        merges += [(2 * near[3], 2 * near[3]), (2 * near[3], near[3] + near[2]), (4 * near[3], 4 * near[3])]
        tokens |= dict.fromkeys(a + b for a, b in merges)
        return {token: i for i, token in enumerate(tokens)}, merges

    def write(self, folder):
        vocabulary, merges = self.vocabulary()
        step = {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": True}
        model = {"type": "BPE", "dropout": None, "unk_token": None, "continuing_subword_prefix": "", "end_of_word_suffix": "", "fuse_unk": False,
                 "byte_fallback": False, "ignore_merges": False, "vocab": vocabulary, "merges": [list(pair) for pair in merges]}
        write_json(folder / "bpe_tokenizer/tokenizer.json", {
            "version": "1.0", "truncation": None, "padding": None, "added_tokens": [], "normalizer": None, "pre_tokenizer": step,
            "post_processor": step, "decoder": step, "model": model})
        write_json(folder / "bpe_tokenizer/tokenizer_config.json", {"clean_up_tokenization_spaces": False, "model_max_length": 10**30,
                                                      "processor_class": "UniversalActionProcessor", "tokenizer_class": "PreTrainedTokenizerFast"})
        write_json(folder / "processor_config.json", {
            "action_dim": None, "auto_map": {"AutoProcessor": "processing_action_tokenizer.UniversalActionProcessor"}, "min_token": self.min_token,
            "processor_class": "UniversalActionProcessor", "scale": self.scale, "time_horizon": None, "vocab_size": len(vocabulary)})
        (folder / "processing_action_tokenizer.py").write_text(PROCESSOR, encoding="utf-8")


def write_tokenizer(n_action, folder, n_unused=0):
    """That of the other cases of π0 with a token for the end of actions, unused ones, and `n_action` behind them, of which FAST's ids are the
    first; "Action" and ":" stay two tokens, as PaliGemma's are."""
    source = RECORDED / "tokenizers/pi"
    spec = json.loads((source / "tokenizer.json").read_text())
    first = N_TOKEN + 1 + n_unused
    spec["model"]["vocab"] |= {STOP: N_TOKEN} | {f"<unused{i}>": i for i in range(N_TOKEN + 1, first)}
    spec["model"]["vocab"] |= {f"<loc{i:04}>": first + i for i in range(n_action)}
    spec["model"]["merges"].remove(["Action", ":"])
    write_json(folder / "tokenizer.json", spec)
    (folder / "tokenizer_config.json").write_bytes((source / "tokenizer_config.json").read_bytes())


# --- checkpoints -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of the towers, what differs from the config class's defaults, features."""

    policy: dict
    vision: dict  # fields of SiglipVisionConfig
    lm: dict  # fields of the reference's GemmaConfig
    views: dict = field(default_factory=dict)  # view -> declared (height, width)
    d_state: int = 6
    d_action: int = 7
    fast: Fast = Fast()
    rows: dict = field(default_factory=dict)  # token -> signs of its row of the embedding, as bits: found by search, so that the network says it
    zero_spread: tuple = ()
    size: str = "tiny"
    arch: str = "pi0_fast"

    @property
    def config(self):
        c = DEFAULTS | self.policy
        inputs, outputs = layout.features(self.views, self.d_state, self.d_action, layout.empty_cameras(c["empty_cameras"], *c["image_resolution"]))
        return {"type": self.arch} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | c

    @property
    def noise_shape(self):
        """Of what no network reads."""
        return self.config["n_action_steps"], self.d_action

    @property
    def n_action_token(self):
        return len(self.fast.vocabulary()[0]) + self.config["fast_skip_tokens"]

    @property
    def n_vocab(self):
        return 257152 if self.size == "full" else N_TOKEN + 1 + self.n_action_token

    def dims(self):
        if self.size == "full":
            return {"size": "full"}
        vision = {**self.vision, "image_size": self.config["image_resolution"][0]}  # which the class does not set
        return {"size": "tiny", "gemma_2b": self.lm, "vision": vision, "vocab_size": self.n_vocab}

    def shapes(self):
        v, d, heads = self.vision, self.lm["width"], (self.lm["num_heads"], self.lm["num_kv_heads"], self.lm["head_dim"])
        n_position = (self.config["image_resolution"][0] // PATCH) ** 2
        out = siglip(f"{TOWER}model.vision_tower.vision_model.", v["hidden_size"], v["intermediate_size"], v["num_hidden_layers"], PATCH, n_position)
        out |= linear(f"{TOWER}model.multi_modal_projector.linear", d, v["hidden_size"]) | {f"{TOWER}lm_head.weight": (self.n_vocab, d)}
        for i in range(self.lm["depth"]):
            out |= decoder_layer(f"{TOWER}model.language_model.layers.{i}.", d, self.lm["mlp_dim"], *heads)
        return out | rms_norm(f"{TOWER}model.language_model.norm", d)

    def value(self, name, shape, seed):
        """The rows of actions are twice as long as others, so that the network mostly says these. What the language model's layers add
        is large and half of the last norm's factors are negative, or the network would repeat its last tokens."""
        x = pi.Checkpoint.value(name, shape, seed)
        if name.endswith("language_model.norm.weight"):
            x[1::2] = -2 - x[1::2]
        if "language_model" in name and name.endswith(("down_proj.weight", "o_proj.weight")):
            x *= 4
        if name.endswith("lm_head.weight"):
            x[-self.n_action_token :] *= 2
            if self.size == "full":  # what stands for no action
                x[N_TOKEN + 1 : -self.n_action_token] = x[-self.config["fast_skip_tokens"] :] = 0
            for token, bits in self.rows.items():
                x[token] = [f32(0.5 if bits >> i & 1 else -0.5) for i in range(shape[1])]
        return bfloat16(x)

    def write(self, seed, folder):
        """config.json, model.safetensors in bfloat16, both pipelines, both tokenizers, dims.json.  Returns the parameter count."""
        folder, c, shapes = Path(folder), self.config, self.shapes()
        write_json(folder / "config.json", c, indent=2)
        write_json(folder / "dims.json", self.dims(), indent=1)
        write_tokenizer(self.n_action_token, folder / "tokenizer", self.n_vocab - N_TOKEN - 1 - self.n_action_token)
        self.fast.write(folder / "action_tokenizer")
        self.write_pipelines(c, seed, folder)
        shared = {f"{TOWER}model.language_model.embed_tokens.weight": f"{TOWER}lm_head.weight"}
        write_stream(folder / "model.safetensors", {n: ("BF16", s) for n, s in sorted(shapes.items())},
                     lambda name: bfloat16_bits(self.value(name, shapes[name], seed)), shared)
        return sum(map(layout.count, shapes.values()))

    def write_pipelines(self, c, seed, folder):
        shown, actions, modes = c["input_features"], c["output_features"], c["normalization_mapping"]
        relative = ("relative_actions_processor", {"enabled": c["use_relative_actions"], "exclude_joints": c["relative_exclude_joints"],
                                                   "action_names": c["action_feature_names"]})
        tokens = ("action_tokenizer_processor", {"trust_remote_code": True, "max_action_tokens": c["max_action_tokens"],
                                                 "action_tokenizer_name": c["action_tokenizer_name"]})
        before = [layout.rename({}), layout.BATCH, relative, layout.normalizer("normalizer_processor", shown | actions, modes),
                  ("pi0_fast_prepare_state_tokenizer_processor_step", {}), layout.tokenizer(HUB_TOKENIZER, c["tokenizer_max_length"]), tokens,
                  layout.device()]
        after = [layout.normalizer("unnormalizer_processor", actions, modes),
                 ("absolute_actions_processor", {"enabled": c["use_relative_actions"]}), layout.device()]
        layout.write_pipelines(folder, before, after, statistics(self.d_state, self.d_action, seed, self.zero_spread))


def policy(horizon, steps, side, n_token, **more):
    """horizon: (of training, of the answer)."""
    return {"chunk_size": horizon[0], "n_action_steps": horizon[1], "max_decoding_steps": steps, "image_resolution": (side, side),
            "tokenizer_max_length": n_token, "fast_skip_tokens": 5, **more}


FREE = {"validate_action_token_prefix": False}  # of a network that is not made to say the prefix first
CASES = {
    # Says no prefix and never stops: two views, one wide and one square; a third is absent.
    "pi0_fast/two_views": Case(61, {"base": (20, 28, "png"), "wrist": (36, 36, "png"), "absent": None}, "open the middle drawer", Checkpoint(
        policy((5, 5), 10, 28, 80, **FREE), tower(36, 2, 3, 52), gemma(40, 3, 8, 1, 8, 72),
        {"base": (20, 28), "wrist": (36, 36), "absent": (20, 28)})),
    # Says the prefix, actions, and stops; fewer rows than it was trained for; grouped heads, a 3 x 3 grid, a JPEG file.
    "pi0_fast/stops": Case(62, {"front": (48, 27, "jpg")}, "  close_the\ndrawer 42! ", Checkpoint(
        policy((7, 4), 24, 42, 100, normalization_mapping={"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILES"}),
        tower(30, 1, 5, 64), gemma(36, 2, 6, 2, 12, 80), {"front": (48, 27)}, d_action=3,
        rows={318: 0x9732C4812, 273: 0x8D5AC7A75, 300: 0xA7F0FD013, 638: 0x4DDBD7A69, 645: 0xC265BD0D1, 441: 0x689957AF7, 640: 0xEAB7B507D,
              456: 0x41959895, 642: 0xFE37F320F, 426: 0x92FC50884, 491: 0x5008FFA77, 637: 0x5A76D5AD9, 410: 0xF49C32263}),
        state=(-3.0, 3.0, 0.0, 0.25, -0.5, 1.5)),
    # Says the prefix and never stops; a prompt beyond the limit, so that the state is cut off; an added empty camera.
    "pi0_fast/long_text": Case(63, {"top": (40, 60, "png"), "left": (28, 28, "png"), "empty_camera_0": None},
                               "put the black bowl on top of the stove, then close the bottom drawer of the cabinet", Checkpoint(
        policy((6, 6), 14, 28, 24, empty_cameras=1), tower(32, 3, 4, 40), gemma(32, 4, 4, 1, 8, 56), {"top": (40, 60), "left": (28, 28)},
        d_state=14, d_action=5,
        rows={318: 0x46C0859E, 273: 0xCCC4D54C, 300: 0x42405DE3, 631: 0xCCC8871A, 459: 0x4280CDDD, 640: 0xAA00A51C})),
}


def published(views, arch="pi0_fast"):
    """The published size, 2.9 G parameters, with the small tokenizers: it says actions without a prefix, and does not stop."""
    return Checkpoint({"dtype": "bfloat16", "max_decoding_steps": 64, **FREE}, tower(1152, 27, 16, 4304), gemma(2048, 18, 8, 1, 256, 16384), views,
                      d_state=8, size="full")

# --- random configurations ---------------------------------------------------------------------------------------------


def draw(seed):
    """A case whose every size comes from the seed. Random answers begin with no prefix: where one is required both refuse."""
    r = random.Random(f"pi0_fast {seed}")
    kv, vision_heads, d_head = r.choice((1, 1, 2, 3)), r.choice((1, 2, 3, 5)), r.choice((4, 8, 12, 16, 32))
    n_empty, d_state, d_action, n_row = r.choice((0, 0, 1)), r.randint(1, 14), r.randint(1, 14), r.randint(1, 12)
    views, frames = draw_views(r, n_empty)
    settings = policy(
        (n_row + r.choice((0, 0, 3)), n_row), r.choice((1, 2, 5, 20, 40)), 14 * r.choice((1, 2, 2, 3, 4)), r.choice((8, 24, 48, 200)), empty_cameras=n_empty,
        normalization_mapping={"VISUAL": "IDENTITY", "STATE": r.choice(MODES), "ACTION": r.choice(MODES)}, fast_skip_tokens=r.choice((0, 1, 9)),
        validate_action_token_prefix=r.random() < 0.1, use_kv_cache=r.random() < 0.7, use_relative_actions=d_state >= d_action and r.random() < 0.3)
    lm = pi.gemma(r.choice((16, 24, 36, 40)), r.randint(1, 4), kv * r.choice((1, 2, 4, 8)), kv, d_head, r.choice((32, 50)))
    vision = pi.tower(vision_heads * r.choice((6, 8, 10, 12)), r.randint(1, 3), vision_heads, r.choice((24, 50)))
    low = r.choice((-80, -40, -150))
    fast = Fast(-2 * low, low, r.choice((10, 5, 12.5)))
    return Case(seed, frames, r.choice(TEXTS), Checkpoint(settings, vision, lm, views, d_state, d_action, fast))


DRAWN = {"pi0_fast": draw}


# --- the reference -----------------------------------------------------------------------------------------------------


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor) of a folder in the hub layout; published: the class's own bfloat16 mix."""
    folder = Path(checkpoint)
    names = {"text_tokenizer_name": str(folder / "tokenizer"), "action_tokenizer_name": str(folder / "action_tokenizer")}
    actions = {"action_tokenizer_name": names["action_tokenizer_name"], "paligemma_tokenizer_name": names["text_tokenizer_name"]}
    return load_sized(folder, dtype, names, {"action_tokenizer_processor": actions})


class Recorder(ChunkRecorder):
    """The language model's values of the prefix, and of the first and of the last token that it reads after it."""

    def __init__(self, policy):
        Taps.__init__(self, 0)
        self.policy, self.views, model = policy, {}, policy.model
        self.embed, model.embed_prefix_fast = model.embed_prefix_fast, self.on_prefix
        self.detokenize, policy.detokenize_actions = policy.detokenize_actions, self.on_tokens
        backbone, head = model.paligemma_with_expert.paligemma.model, model.paligemma_with_expert.paligemma.lm_head
        vision, decoder = backbone.vision_tower, backbone.language_model
        self.vision_tower(getattr(vision, "vision_model", vision))
        self.per_view(backbone.multi_modal_projector, "projector")
        for i, norm in enumerate([*(layer.input_layernorm for layer in list(decoder.layers)[1:]), decoder.norm]):
            self.before(norm, lambda x, i=i: self.tap(f"lm.blk.{i}", x))
        self.after(decoder.norm, lambda x: self.tap("lm.norm", x))
        self.after(head, self.on_logits)

    def tap(self, name, x):
        if self.step >= 0:
            self.put(f"step.{self.step}.{name}", x[0, -1:])  # without its cache the reference computes all of them again
        elif name == "lm.norm":
            self.put(name, x[0, -1:])
        else:
            self.rows(name, x)

    def on_logits(self, x):
        self.put("logits" if self.step < 0 else f"step.{self.step}.logits", x[0])
        self.step += 1

    def on_prefix(self, images, image_masks, tokens, masks, **kwargs):
        out = self.embed(images, image_masks, tokens, masks, **kwargs)
        self.valid, self.present = out[1][0], [bool(m[0]) for m in image_masks]
        self.rows("prefix", out[0])
        self.put("tokens", tokens[0][masks[0].bool()])
        return out

    def on_tokens(self, tokens, **kwargs):
        ids = tokens[0, : self.step + 1].tolist()
        stop = self.policy._paligemma_tokenizer.convert_tokens_to_ids(STOP)
        self.n_emitted = ids.index(stop) + 1 if stop in ids else len(ids)
        self.put("tokens_out", tokens[0, : self.n_emitted])
        return self.detokenize(tokens, **kwargs)

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        with torch.inference_mode():
            self.put("chunk", self.policy.predict_action_chunk(dict(batch))[0])
        for name, seen in self.views.items():
            self.put(name, torch.cat([x for x, here in zip(seen, self.present, strict=True) if here]))
        kept = {"0", str(self.n_emitted - 2)}
        return {name: values for name, values in self.taps.items() if not name.startswith("step.") or name.split(".")[1] in kept}
