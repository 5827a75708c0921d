# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""TurboVLA of its authors: golden cases, random checkpoints as their trainer saves them, and their own code as the reference.

The reference is in no package: TURBOVLA_REFERENCE names a checkout of H-EmbodVis/TurboVLA.  It needs timm and a transformers of 4.x, and
runs as its users run it, but for the towers, which are made from their configs: all weights are in the checkpoint.  Which tokens of DINOv3
it reads depends on the transformers beside it (NORMED_UP_TO), so that a case is recorded with the release that reads what the case says.
"""

import json
import os
import random
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import lerobot_layout as layout
from .cases import LIBERO_FRAMES, LIBERO_INSTRUCTION, TEXTS, Case, copy_tokenizer
from .files import write_json, write_torch
from .parameters import linear, norm, parameter, statistics
from .recorder import Taps
from .turbovla import bert, dinov3, text, vision

REFERENCE, COMMIT = "TURBOVLA_REFERENCE", "c3dd2be"
NORMED_UP_TO = "4.57.1"
N_TOKEN, ENDS = 117, (".", "?")  # of the tokenizer, with the ends of sentences that it gets
VISION, LANGUAGE, WEIGHTS, STATISTICS = "vision_encoder.backbone.", "text_encoder.bert.", "policy.pth", "libero_all4_stats.json"
FUSION, STATE, DECODER = "vision_language_interaction.", "action_head.state_projection.", "action_head.decoder."
# TurboVLAConfig's defaults, where a case says nothing else.
CONFIG = {
    "text": {"model_name_or_path": "bert-base-uncased", "max_length": 256, "padding_length": None, "padding_length_by_instruction": {},
             "sub_sentence_present": True, "frozen": True, "force_eval_when_frozen": True, "zero_padded_tokens": False,
             "local_files_only": True, "attention_implementation": None},
    "vision": {"model_name_or_path": "facebook/dinov3-vitb16-pretrain-lvd1689m", "image_size": 256, "num_views": 2,
               "position_embedding": "view", "encode_views_separately": True, "frozen": False, "local_files_only": True,
               "attention_implementation": None, "compute_precision": "bf16_autocast", "position_init_std": 0.01,
               "position_scale_init": 0.01, "dropout": 0.1},
    "interaction": {"hidden_dim": 256, "nheads": 8, "num_layers": 6, "dim_feedforward": 2048, "enhancer_inner_dim": 1024,
                    "text_dropout": 0.0, "fusion_dropout": 0.0, "fusion_droppath": 0.1, "padding_strategy": "key_padding_mask",
                    "residual_style": "normalized", "attention_backend": "manual", "compute_precision": "fp32"},
    "action": {"action_dim": 7, "state_dim": 8, "horizon": 12, "num_state_tokens": 2, "num_layers": 3, "mlp_hidden_dim": 512,
               "state_hidden_dim": 256, "dropout": 0.1}}


@dataclass(frozen=True)
class Checkpoint:
    """Sizes of both backbones, what differs from TurboVLAConfig's defaults by part, names of the cameras."""

    vision: dict
    text: dict
    parts: dict
    views: tuple = ("image", "image2")
    n_vocab: int = N_TOKEN
    member: str = "model_state_dict"
    layers: str = "layer"  # what transformers calls the list of the tower's layers: model.layer since 5.0
    zero_spread: tuple = ()
    other_stats: tuple = ()  # entries beside the one of the policy
    d_state = 8
    d_action = 7

    @property
    def config(self):
        own = {"vision": {"num_views": len(self.views)}}
        return {"name": "TurboVLA"} | {part: CONFIG[part] | own.get(part, {}) | self.parts.get(part, {}) for part in CONFIG}

    @property
    def policy(self):
        return {"chunk_size": self.config["action"]["horizon"], "max_action_dim": self.d_action}

    def shapes(self):
        c, v = self.config, self.vision
        f, a, d, d_in = c["interaction"], c["action"], c["interaction"]["hidden_dim"], v["hidden_size"]
        out = {name.replace("model.layer.", self.layers + "."): shape for name, shape in dinov3(VISION, v).items()}
        out |= bert(LANGUAGE, self.text, self.n_vocab) | linear("text_encoder.text_projection", d, self.text["hidden_size"])
        d_mlp, at = max(4 * d, d_in // 2), "vision_projection."
        out |= norm(f"{at}input_norm", d_in) | linear(f"{at}mlp.0", d_mlp, d_in) | linear(f"{at}mlp.3", d, d_mlp)
        out |= linear(f"{at}skip", d, d_in, False) | norm(f"{at}output_norm", d)
        out |= self.places(d)
        for i in range(f["num_layers"]):
            out |= encoder(f"{FUSION}text_layers.{i}.", d, f["enhancer_inner_dim"]) | both(f"{FUSION}fusion_layers.{i}.", d, f["enhancer_inner_dim"])
        n_token, d_hidden = a["num_state_tokens"], a["state_hidden_dim"]
        out |= norm(f"{STATE}net.0", a["state_dim"]) | linear(f"{STATE}net.1", d_hidden, a["state_dim"])
        out |= linear(f"{STATE}net.4", n_token * d, d_hidden) | {f"{STATE}position": (1, n_token, d)} | norm(f"{STATE}output_norm", d)
        out |= {f"{DECODER}action_queries.weight": (a["horizon"], d)}
        for i in range(a["num_layers"]):
            at = f"{DECODER}decoder.layers.{i}."
            out |= encoder(at, d, f["dim_feedforward"]) | stacked(f"{at}multihead_attn.", d) | norm(f"{at}norm3", d)
        widths = (d, a["mlp_hidden_dim"], a["mlp_hidden_dim"], a["action_dim"])
        for i in range(3):
            out |= linear(f"{DECODER}action_projection.layers.{i}", widths[i + 1], widths[i])
        return out

    def places(self, d):
        c, n_view = self.config["vision"], len(self.views)
        if c["position_embedding"] == "view":
            return {"view_embedding": (1, n_view, d)}
        n_patch = (c["image_size"] // self.vision["patch_size"]) ** 2
        return {"view_embedding": (1, n_view, 1, d), "patch_position_embedding": (1, n_view, n_patch, d),
                "patch_position_scale": (1, n_view, 1, 1)}

    def write(self, seed, folder):
        """The file of weights with its config, statistics, both backbones' configs.  Returns the parameter count."""
        folder, shapes = Path(folder), self.shapes()
        write_json(folder / "vision_encoder/config.json", {"model_type": "dinov3_vit"} | self.vision, indent=2)
        write_json(folder / "vision_encoder/preprocessor_config.json", {
            "do_normalize": True, "do_rescale": True, "do_resize": True, "image_mean": [0.485, 0.456, 0.406],
            "image_processor_type": "DINOv3ViTImageProcessorFast", "image_std": [0.229, 0.224, 0.225], "rescale_factor": 1 / 255,
            "size": {"height": 224, "width": 224}}, indent=2)
        write_json(folder / "language_encoder/config.json", {"model_type": "bert", "vocab_size": self.n_vocab} | self.text, indent=2)
        write_tokenizer(folder / "language_encoder")
        write_json(folder / STATISTICS, self.statistics(seed), indent=1)
        tensors = {name: self.value(name, seed, shape) for name, shape in shapes.items()}
        write_torch(folder / WEIGHTS, tensors, self.member, global_step=80000, loss=0.0625, args={"seed": 42}, model_config=self.config)
        return sum(map(layout.count, shapes.values()))

    def statistics(self, seed):
        def entry(seed):
            found = statistics(self.d_state, self.d_action, seed, self.zero_spread)
            state, action = ({k: v.tolist() for k, v in found[name].items()} for name in ("observation.state", "action"))
            return {"action": action, "proprio": state, "state": {k: [0.0] * self.d_state for k in state}}

        others = {name: entry(seed + 1 + i) for i, name in enumerate(self.other_stats)}
        return {"libero_all4_no_noops": entry(seed), **others, "metadata": {"dataset_dirs": ["data"]}}

    @staticmethod
    def value(name, seed, shape):
        """Scales of layers are near 1, as those of norms; tables and tokens are drawn as matrices."""
        known = name.replace("LayerNorm", "norm").replace("lambda1", "norm.weight").replace("net.0", "norm")
        known = known.replace("gamma_v", "gamma_v.norm.weight").replace("gamma_l", "gamma_l.norm.weight")
        return parameter(known, shape[1:] if shape[0] == 1 and len(shape) > 1 else shape, seed).reshape(shape)


def write_tokenizer(folder):
    """That of BERT's goldens, with the two ends of sentences."""
    copy_tokenizer("bert", folder)
    file = folder / "tokenizer.json"
    spec = json.loads(file.read_text(encoding="utf-8"))
    spec["model"]["vocab"] |= {token: N_TOKEN - len(ENDS) + i for i, token in enumerate(ENDS)}
    file.write_text(json.dumps(spec, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def stacked(at, d):
    return {f"{at}in_proj_weight": (3 * d, d), f"{at}in_proj_bias": (3 * d,)} | linear(f"{at}out_proj", d, d)


def encoder(at, d, d_ff):
    return (stacked(f"{at}self_attn.", d) | linear(f"{at}linear1", d_ff, d) | linear(f"{at}linear2", d, d_ff) | norm(f"{at}norm1", d)
            | norm(f"{at}norm2", d))


def both(at, d, d_inner):
    out = {}
    for side in "vl":
        out |= norm(f"{at}layer_norm_{side}", d) | {f"{at}gamma_{side}": (d,)} | linear(f"{at}attn.out_{side}_proj", d, d_inner)
        out |= linear(f"{at}attn.{side}_proj", d_inner, d) | linear(f"{at}attn.values_{side}_proj", d_inner, d)
    return out


FRAMES, INSTRUCTION = {"image": LIBERO_FRAMES["image"], "image2": LIBERO_FRAMES["wrist_image"]}, LIBERO_INSTRUCTION


def published(views=("image", "image2"), arch="turbovla_authors"):
    """The size of the LIBERO checkpoints: 0.2 B parameters."""
    sizes = vision(768, 12, 12, 3072, 16, 4), text(768, 12, 12, 3072, 512)
    return Checkpoint(*sizes, {"text": {"padding_length": 21}}, tuple(views), n_vocab=30522)


# --- cases -----------------------------------------------------------------------------------------------------------


def parts(side, fusion, action, texts, **more_vision):
    """fusion: width, heads, layers, width of the MLP of actions, inner width; action: horizon, tokens of the state, layers, its two widths."""
    d, heads, layers, ff, inner, *style = fusion
    horizon, n_token, n_decoder, hidden, state = action
    return {"text": texts, "vision": {"image_size": side, **more_vision},
            "interaction": {"hidden_dim": d, "nheads": heads, "num_layers": layers, "dim_feedforward": ff, "enhancer_inner_dim": inner,
                            **(style[0] if style else {})},
            "action": {"horizon": horizon, "num_state_tokens": n_token, "num_layers": n_decoder, "mlp_hidden_dim": hidden,
                       "state_hidden_dim": state}}


def frames(side, *views):
    return {view: (side, side, "png") for view in views}


DRAWER = "open the top drawer. put the bowl inside"
CASES = {
    # As published but smaller: two views, two sentences, an instruction whose own number of rows is less than that of all texts.
    "turbovla_authors/two_views": Case(51, frames(24, "image", "image2"), DRAWER, Checkpoint(
        vision(32, 3, 4, 72, 8, 4), text(36, 2, 3, 44), parts(24, (40, 4, 2, 56, 36), (6, 2, 3, 44, 28), {
            "padding_length": 28, "padding_length_by_instruction": {DRAWER: 24, "open the drawer": 11}})),
        options={"vision_tokens": "normed"}),
    # An instruction that leaves no row for padding, so that its words see themselves alone; one head in the layers; no registers; a state
    # number that never moved; statistics of several data sets; weights under another name.
    "turbovla_authors/exact_fit": Case(52, frames(20, "left", "right"), "close the drawer now", Checkpoint(
        vision(24, 2, 2, 60, 10, 0, layer_norm_eps=1e-6), text(28, 1, 2, 36), parts(20, (30, 3, 1, 40, 20), (5, 1, 1, 24, 36), {
            "padding_length": 20, "padding_length_by_instruction": {"close the drawer now": 6}}), ("left", "right"), member="model",
        zero_spread=(3,), other_stats=("libero_10_no_noops",)),
        options={"vision_tokens": "normed", "views": ["left", "right"], "stats": "libero_all4_no_noops"}),
    # As for RoboTwin: a place for each patch of three views, the layers' input kept, rows of padding that stay zeros.
    "turbovla_authors/zero_fill": Case(53, frames(16, "head", "left", "right"), "Put the bowl ON top of the stove? Then close the drawer", Checkpoint(
        vision(24, 1, 3, 40, 8, 1), text(20, 2, 1, 52), parts(16, (36, 6, 3, 28, 42, {
            "padding_strategy": "zero_fill", "residual_style": "pre_norm", "attention_backend": "sdpa"}), (7, 3, 2, 20, 24),
            {"padding_length": 32, "zero_padded_tokens": True}, position_embedding="learned_patch", encode_views_separately=False),
        ("head", "left", "right")),
        options={"vision_tokens": "normed", "views": ["head", "left", "right"]}),
    # No rows beyond the text, which is cut, with capitals, accents, Chinese characters and words that are unknown; one view.
    "turbovla_authors/long_text": Case(54, frames(28, "camera"),
        "Put the Blâck bowl ON top of the stove. 然后关上 the drawer! Schließe dann die Schublade n° 12", Checkpoint(
        vision(20, 2, 1, 28, 7, 2, rope_theta=37.5), text(44, 2, 4, 32), parts(28, (24, 2, 2, 36, 44), (4, 2, 2, 28, 20),
            {"max_length": 18}), ("camera",)),
        options={"vision_tokens": "normed", "views": ["camera"]}),
    # Tokens of DINOv3's last block, as later releases of transformers give them; BERT sees all words, padding begins as zeros.
    "turbovla_authors/last_block": Case(55, frames(24, "image", "image2"), "push the plate. close the drawer", Checkpoint(
        vision(28, 2, 7, 48, 12, 4), text(24, 2, 3, 40, layer_norm_eps=1e-6), parts(24, (32, 2, 2, 24, 28), (8, 2, 2, 32, 16), {
            "padding_length": 19, "sub_sentence_present": False, "zero_padded_tokens": True})),
        options={"vision_tokens": "last_block"}),
}

# --- random configurations -------------------------------------------------------------------------------------------


SENTENCES = ("open the drawer", "open the drawer. put the bowl inside", "close it? now. ", "put the bowl on the plate.", ". ? .", "[SEP] a [PAD] b [CLS]",
             "word " * 40)


def draw(seed):
    """A case whose every size comes from the seed: sentences, rows of padding, residuals, places."""
    r = random.Random(f"turbovla_authors {seed}")
    vision_heads, text_heads, heads, patch = r.choice((1, 2, 3)), r.choice((1, 2, 3, 5)), r.choice((1, 2, 3, 4, 6)), r.choice((4, 5, 8, 14))
    side, n_position, n_view = patch * r.randint(1, 4), r.choice((20, 40)), r.randint(1, 3)
    views = [f"cam{i}" for i in range(n_view)]
    seen = vision(4 * vision_heads * r.choice((2, 3, 5)), r.randint(1, 3), vision_heads, r.choice((20, 36, 50)), patch, r.choice((0, 1, 4, 4)),
                  layer_norm_eps=r.choice((1e-5, 1e-6)), rope_theta=r.choice((100.0, 37.5)))
    language = text(4 * text_heads * r.choice((1, 2, 3)), r.randint(1, 3), text_heads, r.choice((20, 36, 50)), n_position)
    words = r.choice((*TEXTS, *SENTENCES, *SENTENCES))
    n_row = r.choice((None, r.randint(3, n_position), r.randint(10, n_position), n_position))
    own = {words: r.randint(3, n_row), "another one": 3} if n_row and r.random() < 0.5 else {}
    texts = {"max_length": n_row or r.randint(3, n_position), "padding_length": n_row, "padding_length_by_instruction": own,
             "sub_sentence_present": r.random() < 0.8, "zero_padded_tokens": r.random() < 0.3}
    style = {"padding_strategy": r.choice(("key_padding_mask", "zero_fill")), "residual_style": r.choice(("normalized", "pre_norm")),
             "attention_backend": r.choice(("manual", "sdpa"))}
    inner = 4 * max(1, heads // 2) * r.choice((1, 2, 5))
    fusion = (4 * heads * max(1, heads // 2) * r.choice((1, 2)), heads, r.randint(1, 3), r.choice((20, 50)), inner, style)
    action = (r.randint(1, 14), r.randint(1, 4), r.randint(1, 3), r.choice((16, 44)), r.choice((20, 36)))
    sizes = parts(side, fusion, action, texts, position_embedding=r.choice(("view", "learned_patch")),
                  encode_views_separately=r.random() < 0.5)
    checkpoint = Checkpoint(seen, language, sizes, tuple(views))
    options = {"vision_tokens": tokens_read(), "views": views}
    return Case(seed, {view: (side, side, "png") for view in views}, words, checkpoint, options=options)


DRAWN = {"turbovla_authors": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


def open_reference():
    if REFERENCE not in os.environ:
        raise SystemExit(f"error: {REFERENCE} is not set: give it the folder of a checkout of https://github.com/H-EmbodVis/TurboVLA")
    if os.environ[REFERENCE] not in sys.path:
        sys.path.insert(0, os.environ[REFERENCE])


def from_config(config):
    """The weights of both towers are in the checkpoint."""
    from transformers import AutoConfig, AutoModel

    return AutoModel.from_config(AutoConfig.from_pretrained(config.model_name_or_path))


class Reference:
    def __init__(self, checkpoint, dtype):
        import torch

        open_reference()
        from turbovla.evaluation import policy as base
        from turbovla.evaluation import suite_policy
        from turbovla.models import text_encoder, vision_encoder

        text_encoder._load_pretrained_model = vision_encoder._load_pretrained_model = from_config
        tower = json.loads((checkpoint / "vision_encoder/config.json").read_text())
        stated = torch.load(checkpoint / WEIGHTS, map_location="cpu")["model_config"]
        # Literals there, of LIBERO's images and of ViT-B.
        base.EXPECTED_IMAGE_SIZE, base.DINO_PATCH_SIZE = stated["vision"]["image_size"], tower["patch_size"]
        self.policy = suite_policy.TurboVLAPolicy(
            str(checkpoint / WEIGHTS), str(checkpoint / "vision_encoder"), str(checkpoint / "language_encoder"), "cpu", verbose=False,
            precision="fp32" if dtype == "float32" else "bf16", stats_path=checkpoint / STATISTICS, stats_key="libero_all4_no_noops")
        self.config, self.model = types.SimpleNamespace(type="turbovla_authors"), self.policy.model
        self.vision_tokens = read_options(checkpoint)["vision_tokens"]
        self.check_tokens(self.vision_tokens, base.EXPECTED_IMAGE_SIZE)

    def check_tokens(self, wanted, side):
        """That this transformers reads what the case says."""
        import torch
        import transformers

        tower = self.model.vision_encoder.backbone
        with torch.inference_mode():
            out = tower(pixel_values=torch.zeros(1, 3, side, side), output_hidden_states=True)
        found = "normed" if torch.equal(out.hidden_states[-1], out.last_hidden_state) else "last_block"
        if found != wanted:
            raise SystemExit(f"error: transformers {transformers.__version__} reads {found} tokens and the case {wanted}: "
                             f"{NORMED_UP_TO} and earlier read normed ones, later releases those of the last block")

    def before(self, batch):
        """What the policy gives to its network: pictures and the state, by its own functions, for any number of views."""
        views = [name for name in batch if name.startswith("observation.images.")]
        pictures = [(batch[name] * 255).round().byte().permute(1, 2, 0).numpy() for name in views]
        policy, state = self.policy, batch["observation.state"].numpy()
        samples, states = policy._build_batch(pictures[:1], pictures[-1:], [state])
        samples = {"dinov3": policy.dinov3_processor(pictures)["pixel_values"][None]}
        return batch["task"], *policy._prepare_model_inputs(samples, states)

    def predict_action_chunk(self, batch, noise=None):
        """Their evaluation predicts a chunk without noise."""
        instruction, samples, states = batch
        return self.model([instruction], samples, states)

    def after(self, chunk):
        import torch

        return torch.from_numpy(np.stack([self.policy._normalized_row_to_env_action(row) for row in chunk[0].float().numpy()]))[None]


def tokens_read():
    """What the transformers at hand reads."""
    import transformers
    from packaging.version import Version

    return "normed" if Version(transformers.__version__) <= Version(NORMED_UP_TO) else "last_block"


def read_options(checkpoint):
    return json.loads((checkpoint.parent / "convert.json").read_text())


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16."""
    reference = Reference(Path(checkpoint), dtype)
    return reference, reference.before, reference.after


def described(checkpoint):
    return f"H-EmbodVis/TurboVLA {COMMIT}, {read_options(Path(checkpoint))['vision_tokens']} tokens of DINOv3"


class Recorder(Taps):
    """Listens to one run of the network."""

    def __init__(self, reference):
        super().__init__(1)
        self.model, self.views, self.step, model = reference.model, {}, 0, reference.model
        tower, lm, fusion = model.vision_encoder.backbone, model.text_encoder.bert, model.vision_language_interaction
        self.before(tower, lambda x: self.seen("pixels", x))
        self.after(tower.embeddings.patch_embeddings, lambda x: self.seen("vision.patch_embed", x.flatten(2).transpose(1, 2)))
        for i, block in enumerate(getattr(tower, "layer", None) or tower.model.layer):
            self.after(block, lambda x, i=i: self.seen(f"vision.blk.{i}", x))
        if reference.vision_tokens == "normed":
            self.before(model.vision_projection, lambda x: self.put("vision.post_norm", x[0]))
        self.after(model.vision_projection, lambda x: self.put("projector", x[0]))
        self.before(lm.embeddings.word_embeddings, lambda ids: self.put("tokens", ids[0]))
        self.after(lm.embeddings.LayerNorm, lambda x: self.put("lm.embd_norm", x[0]))
        for i, block in enumerate(lm.encoder.layer):
            self.after(block, lambda x, i=i: self.put(f"lm.blk.{i}", x[0]))
        self.after(model.text_encoder.text_projection, lambda x: self.put("text_in", x[0]))
        for i, layer in enumerate(fusion.fusion_layers):
            layer.register_forward_hook(lambda m, args, out, i=i: self.fused(i, *out))
        for i, layer in enumerate(fusion.text_layers):
            self.after(layer, lambda x, i=i: self.put(f"fusion.blk.{i}.among", x[:, 0]))
        self.listen_to_head(model.action_head)

    def listen_to_head(self, head):
        self.before(head.state_projection, lambda x: self.put("state", x[0]))
        self.after(head.state_projection, lambda x: self.put("state_in", x[0]))
        self.before(head.decoder, lambda x: self.put("prefix", x[0]))
        for i, layer in enumerate(head.decoder.decoder.layers):
            self.after(layer, lambda x, i=i: self.put(f"step.0.decoder.blk.{i}", x[0]))
        for name, layer in zip(("action_in", "action_mid", "action_out"), head.decoder.action_projection.layers, strict=True):
            self.after(layer, lambda x, name=name: self.put(f"step.0.{name}", x[0]))

    def seen(self, name, x):
        self.views.setdefault(name, []).append(x)

    def fused(self, i, image, text):
        self.put(f"fusion.blk.{i}.image", image[0])
        self.put(f"fusion.blk.{i}.text", text[0])

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        instruction, samples, states = batch
        with torch.inference_mode():
            self.put("chunk", self.model([instruction], samples, states)[0])
        for name, x in self.views.items():
            self.put(name, torch.cat(x))
        return self.taps
