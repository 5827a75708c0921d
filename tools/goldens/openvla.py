# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""OpenVLA: golden cases, random checkpoints in the layout of openvla-7b, and the authors' own code as the reference.

The reference is in no package: OPENVLA_REFERENCE names a checkout of openvla/openvla.  It needs transformers 4.40.1, tokenizers 0.19.1 and
timm 0.9.16 beside torch, torchvision, gguf, safetensors and pillow: an environment of its own, into which a .pth file may bring torch of
another one.  It runs as its users run it (get_vla_action of their evaluation, without its crop, for which alone they load tensorflow), but
for three things: products are torch's own attention (`sdpa`; their flash attention has no kernel for CPUs), the towers are as narrow and
shallow as the weights (`timm.create_model` gets these sizes; heads, patches and registers are those of the models' names), and the literal
29871, the id of U+2581 in Llama 2's vocabulary, is that of the small one.
"""

import functools
import importlib.machinery
import json
import os
import random
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .cases import TEXTS, Case, copy_tokenizer
from .draw import f32
from .files import bfloat16_bits, write_json, write_stream
from .parameters import decoder, decoder_layer, linear, norm, parameter, rms_norm
from .parameters import statistics as random_statistics
from .recorder import Taps

REFERENCE, COMMIT = "OPENVLA_REFERENCE", "c8f03f4"
N_TOKEN, EMPTY, STOP = 408, 370, 2  # of the tokenizer, without <PAD>: the empty token, </s>
EMPTY_THERE = "29871"
PATCH, N_HEAD, N_REGISTER, PAD_TO = 14, 16, 4, 64
TIMM = ["vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"]
MEANS, STDS = [[0.484375, 0.455078125, 0.40625], [0.5] * 3], [[0.228515625, 0.2236328125, 0.224609375], [0.5] * 3]
DINO, SIGLIP, LM = "vision_backbone.featurizer.", "vision_backbone.fused_featurizer.", "language_model.model."
MARGIN = 1e-3  # of the likeliest token before the next one, of the largest logit


@dataclass(frozen=True)
class Tower:
    """Of timm's VisionTransformer."""

    d: int
    depth: int
    d_ff: int

    def shapes(self, at, side, n_register=0):
        d, out = self.d, {}
        if n_register:
            out |= {f"{at}cls_token": (1, 1, d), f"{at}reg_token": (1, n_register, d)}
        out |= {f"{at}pos_embed": (1, (side // PATCH) ** 2, d), f"{at}patch_embed.proj.weight": (d, 3, PATCH, PATCH), f"{at}patch_embed.proj.bias": (d,)}
        for i in range(self.depth):
            block = f"{at}blocks.{i}."
            out |= norm(f"{block}norm1", d) | linear(f"{block}attn.qkv", 3 * d, d) | linear(f"{block}attn.proj", d, d)
            out |= norm(f"{block}norm2", d) | linear(f"{block}mlp.fc1", self.d_ff, d) | linear(f"{block}mlp.fc2", d, self.d_ff)
            out |= {f"{block}{scale}.scale_factor": (d,) for scale in ("ls1", "ls2") if n_register}
        return out | norm(f"{at}norm", d)

    def pool(self, at):
        d = self.d
        out = {f"{at}latent": (1, 1, d)} | linear(f"{at}q", d, d) | linear(f"{at}kv", 2 * d, d) | linear(f"{at}proj", d, d)
        return out | norm(f"{at}norm", d) | linear(f"{at}mlp.fc1", self.d_ff, d) | linear(f"{at}mlp.fc2", d, self.d_ff)


@dataclass(frozen=True)
class Checkpoint:
    dino: Tower
    siglip: Tower
    text: dict  # sizes of LlamaConfig
    side: int = 28
    d_action: int = 7
    n_bin: int = 256
    n_shard: int = 1
    own_statistics: bool = False  # dataset_statistics.json, as fine-tuning writes it
    other_stats: tuple = ()  # data sets beside the robot's own
    unmasked: tuple = (6,)  # columns that are not normalized; None: the statistics have no mask
    n_token: int = N_TOKEN  # of the language model, without its padding
    zero_spread = ()
    d_state = 0

    @property
    def policy(self):
        return {"chunk_size": 1, "max_action_dim": self.d_action}

    @property
    def n_vocab(self):
        return self.n_token + PAD_TO

    def shapes(self):
        t, d = self.text, self.text["hidden_size"]
        n_head, n_kv = t["num_attention_heads"], t["num_key_value_heads"]
        d_patch = self.dino.d + self.siglip.d
        out = self.dino.shapes(DINO, self.side, N_REGISTER) | self.siglip.shapes(SIGLIP, self.side) | self.siglip.pool(f"{SIGLIP}attn_pool.")
        out |= linear("projector.fc1", 4 * d_patch, d_patch) | linear("projector.fc2", d, 4 * d_patch) | linear("projector.fc3", d, d)
        out |= {f"{LM}embed_tokens.weight": (self.n_vocab, d)} | rms_norm(f"{LM}norm", d)
        for i in range(t["num_hidden_layers"]):
            out |= decoder_layer(f"{LM}layers.{i}.", d, t["intermediate_size"], n_head, n_kv, d // n_head)
        return out | linear("language_model.lm_head", self.n_vocab, d, False)

    def value(self, name, shape, seed):
        """Scales of LayerScale are near 1, as norms are; tables and tokens are drawn as matrices. Only action tokens are likely."""
        known = name.replace("scale_factor", "norm.weight").replace("pos_embed", "position_embedding")
        x = parameter(known, shape[1:] if shape[0] == 1 and len(shape) > 1 else shape, seed).reshape(shape)
        if name == "language_model.lm_head.weight":
            others = np.ones(self.n_vocab, bool)
            others[self.n_token - self.n_bin + 1 : self.n_token] = False
            x[others] /= f32(64)
        return x

    def write(self, seed, folder):
        """Returns the parameter count."""
        folder, shapes = Path(folder), self.shapes()
        folder.mkdir(parents=True, exist_ok=True)
        copy_tokenizer("openvla", folder)
        write_json(folder / "config.json", self.config(seed), indent=1)
        write_json(folder / "generation_config.json", {
            "_from_model_config": True, "bos_token_id": 1, "eos_token_id": STOP, "pad_token_id": N_TOKEN, "transformers_version": "4.40.1"}, indent=1)
        write_json(folder / "preprocessor_config.json", self.preprocessor(), indent=1)
        if self.own_statistics:
            write_json(folder / "dataset_statistics.json", self.statistics(seed), indent=1)
        names = sorted(shapes)
        files = {"model.safetensors": names}
        if self.n_shard > 1:
            files = {f"model-{i + 1:05}-of-{self.n_shard:05}.safetensors": names[i :: self.n_shard] for i in range(self.n_shard)}
            write_json(folder / "model.safetensors.index.json",
                       {"metadata": {}, "weight_map": {name: file for file, part in files.items() for name in part}})
        for file, part in files.items():
            write_stream(folder / file, {name: ("BF16", shapes[name]) for name in part},
                         lambda name: bfloat16_bits(self.value(name, shapes[name], seed)), {"format": "pt"})
        return sum(int(np.prod(shape)) for shape in shapes.values())

    def config(self, seed):
        text = {"model_type": "llama", "pad_token_id": N_TOKEN, "torch_dtype": "bfloat16", "vocab_size": self.n_vocab}
        return {
            "arch_specifier": "no-align+fused-gelu-mlp", "architectures": ["OpenVLAForActionPrediction"],
            "auto_map": {"AutoConfig": "configuration_prismatic.OpenVLAConfig",
                         "AutoModelForVision2Seq": "modeling_prismatic.OpenVLAForActionPrediction"},
            "hf_llm_id": "meta-llama/Llama-2-7b-hf", "image_resize_strategy": "resize-naive", "image_sizes": [self.side] * 2,
            "llm_backbone_id": "llama2-7b-pure", "llm_max_length": 2048, "model_type": "openvla", "n_action_bins": self.n_bin,
            "norm_stats": {"elsewhere": {"action": {}}} if self.own_statistics else self.statistics(seed), "output_projector_states": False,
            "pad_to_multiple_of": PAD_TO, "pad_token_id": N_TOKEN, "text_config": text | self.text, "timm_model_ids": TIMM,
            "timm_override_act_layers": [None, None], "torch_dtype": "bfloat16", "transformers_version": "4.40.1",
            "use_fused_vision_backbone": True, "vision_backbone_id": "dinosiglip-vit-so-224px"}

    def preprocessor(self):
        size = [self.side] * 2
        return {
            "auto_map": {"AutoImageProcessor": "processing_prismatic.PrismaticImageProcessor", "AutoProcessor": "processing_prismatic.PrismaticProcessor"},
            "image_processor_type": "PrismaticImageProcessor", "image_resize_strategy": "resize-naive", "input_sizes": [[3, *size]] * 2,
            "interpolations": ["bicubic", "bicubic"], "means": MEANS, "processor_class": "PrismaticProcessor", "stds": STDS,
            "tvf_crop_params": [{"output_size": size}] * 2, "tvf_do_letterbox": False, "tvf_letterbox_fill": None,
            "tvf_normalize_params": [{"inplace": False, "mean": mean, "std": std} for mean, std in zip(MEANS, STDS, strict=True)],
            "tvf_resize_params": [{"antialias": True, "interpolation": 3, "max_size": None, "size": size}] * 2, "use_fused_vision_backbone": True}

    def statistics(self, seed):
        """By data set, in float64, of which few are numbers of float32."""

        def entry(seed):
            action = {k: (v.astype(np.float64) * 1.0000000123).tolist() for k, v in random_statistics(1, self.d_action, seed)["action"].items()}
            mask = {} if self.unmasked is None else {"mask": [i not in self.unmasked for i in range(self.d_action)]}
            return {"action": action | mask, "num_trajectories": 10, "num_transitions": 1000, "proprio": {"mean": [0.0] * 7}}

        return {name: entry(seed + i) for i, name in enumerate(("bridge_orig", *self.other_stats))}


FRAMES = {"image": (256, 256, "png")}  # of the published size


def published(views=("image",), arch="openvla"):
    """The size of openvla-7b: 7.5 G parameters, with fewer tokens than the 29,872 from which the reference's empty token is one of them."""
    return Checkpoint(Tower(1024, 24, 4096), Tower(1152, 27, 4304), decoder(4096, 32, 32, 32, 11008), 224, n_token=29760)


def case(seed, frame, text, checkpoint, **options):
    return Case(seed, {"image": frame}, text, checkpoint, options=options)


CASES = {
    # As published but smaller: two data sets, a camera of another aspect, heads that share keys, the gripper as the network gives it.
    "openvla/bridge": case(61, (48, 64, "png"), "Put the Carrot on the plate", Checkpoint(
        Tower(32, 3, 44), Tower(48, 4, 56), decoder(32, 3, 4, 2, 44), other_stats=("fractal20220817_data",)), stats="bridge_orig"),
    # A fine-tune with statistics of its own in a file, without a mask; shards; fewer bins and numbers of an action; nine patches; other
    # constants; characters that no piece has.
    "openvla/fine_tuned": case(62, (42, 42, "jpg"), "öffne das 2. Fach,  then 漢字 <s>", Checkpoint(
        Tower(48, 2, 60), Tower(32, 2, 36), decoder(40, 2, 5, 5, 28, rms_norm_eps=1e-5, rope_theta=5000.0), side=42, d_action=4, n_bin=64, n_shard=3,
        own_statistics=True, unmasked=None)),
}

# --- random configurations ------------------------------------------------------------------------------------------


def draw(seed):
    """A case from the seed: widths of both towers, sides, heads that share keys, bins, numbers of an action, statistics, shards."""
    global MARGIN
    r, MARGIN = random.Random(f"openvla {seed}"), 0.0  # tokens that rounding changes would show
    kv, d_head = r.choice((1, 2, 3)), r.choice((4, 6, 8, 16))
    heads = kv * r.choice((1, 2, 3))
    towers = [Tower(16 * r.choice((1, 2, 3, 4)), r.randint(2, 5), r.randint(10, 70)) for _ in range(2)]
    text = decoder(heads * d_head, r.randint(1, 4), heads, kv, r.choice((20, 36, 50)), rms_norm_eps=r.choice((1e-6, 1e-5)),
                   rope_theta=r.choice((10000.0, 500.0)))
    d_action = r.randint(1, 9)
    unmasked = r.choice((None, (), (d_action - 1,), tuple(i for i in range(d_action) if r.random() < 0.4)))
    others = r.choice(((), ("fractal20220817_data", "taco_play")))
    checkpoint = Checkpoint(*towers, text, 14 * r.choice((1, 2, 2, 3)), d_action, r.choice((256, 256, 17, 100)), r.choice((1, 1, 3)),
                            r.random() < 0.3, others, unmasked)
    frame = r.randint(10, 90), r.randint(10, 90), r.choice(("png", "png", "jpg"))
    return case(seed, frame, r.choice((*TEXTS, "", "Pick UP the <s> cube</s> \u2581", "<PAD>")), checkpoint, **({"stats": "bridge_orig"} if others else {}))


DRAWN = {"openvla": draw}


# --- the reference --------------------------------------------------------------------------------------------------


def open_reference(variable=REFERENCE, repository="openvla/openvla", empty=("tensorflow",)):
    """Puts the reference on the path; packages whose __init__ imports what trains a policy get an empty one.  Returns the module of its evaluation."""
    if variable not in os.environ:
        raise SystemExit(f"error: {variable} is not set: give it the folder of a checkout of https://github.com/{repository}")
    root = Path(os.environ[variable])
    if "experiments.robot.openvla_utils" not in sys.modules:
        sys.path.insert(0, str(root))
        for name in ("prismatic", "prismatic.extern", "prismatic.extern.hf", *empty):
            sys.modules[name] = package = types.ModuleType(name)
            package.__spec__ = importlib.machinery.ModuleSpec(name, None, is_package=True)
            package.__path__ = [str(root / name.replace(".", "/"))]
        name = "prismatic.extern.hf.modeling_prismatic"
        file = root / (name.replace(".", "/") + ".py")
        sys.modules[name] = model = types.ModuleType(name)
        model.__package__ = name.rpartition(".")[0]
        exec(compile(file.read_text().replace(EMPTY_THERE, str(EMPTY)), str(file), "exec"), model.__dict__)
    from experiments.robot import openvla_utils

    return openvla_utils


def sizes_of(folder):
    """{name: shape} of a checkpoint's tensors."""
    from safetensors import safe_open

    shapes = {}
    for file in sorted(folder.glob("*.safetensors")):
        with safe_open(file, "pt") as content:
            shapes |= {name: tuple(content.get_slice(name).get_shape()) for name in content.keys()}
    return shapes


def narrow(create, shapes):
    """timm's create_model for the towers that the weights are of."""
    towers = dict(zip(TIMM, (DINO, SIGLIP), strict=True))

    def made(name, **how):
        at = towers[name]
        d_ff, d = shapes[f"{at}blocks.0.mlp.fc1.weight"]
        depth = 1 + max(int(name[len(at) :].split(".")[1]) for name in shapes if name.startswith(f"{at}blocks."))
        return create(name, embed_dim=d, depth=depth, mlp_ratio=(d_ff + 0.5) / d, **how)

    return made


def opened(checkpoint, kind):
    """As their get_vla opens a checkpoint."""
    from prismatic.extern.hf import modeling_prismatic

    create, timm = modeling_prismatic.timm.create_model, modeling_prismatic.timm
    timm.create_model = narrow(create, sizes_of(checkpoint))
    try:
        model, info = modeling_prismatic.OpenVLAForActionPrediction.from_pretrained(
            checkpoint, torch_dtype=kind, attn_implementation="sdpa", output_loading_info=True)
    finally:
        timm.create_model = create
    assert not info["missing_keys"] and not info["unexpected_keys"], info
    if (checkpoint / "dataset_statistics.json").is_file():
        model.norm_stats = json.loads((checkpoint / "dataset_statistics.json").read_text())
    return model


class Reference:
    def __init__(self, checkpoint, dtype):
        import torch

        utils = open_reference()
        from prismatic.extern.hf import processing_prismatic
        from prismatic.extern.hf.configuration_prismatic import OpenVLAConfig

        kind = torch.float32 if dtype == "float32" else torch.bfloat16
        utils.AutoImageProcessor.register(OpenVLAConfig, processing_prismatic.PrismaticImageProcessor, exist_ok=True)
        model = opened(checkpoint, kind)
        self.model, self.processor = model.eval(), processing_prismatic.PrismaticProcessor.from_pretrained(checkpoint)
        utils.torch = types.SimpleNamespace(bfloat16=kind)  # to which they round pixels
        self.utils, self.images = utils, processing_prismatic.TVF
        self.stats = read_options(checkpoint).get("stats")
        self.config, self.action = types.SimpleNamespace(type="openvla"), model.get_action_stats

    def before(self, batch):
        (view,) = (name for name in batch if name.startswith("observation.images."))
        return {"full_image": (batch[view] * 255).round().byte().permute(1, 2, 0).numpy(), "task": batch["task"]}

    def act(self, observation, stats):
        """Their evaluation's action, un-normalized with `stats`."""
        self.model.get_action_stats = lambda key: stats
        return self.utils.get_vla_action(self.model, self.processor, "openvla-7b", observation, observation["task"], self.stats)

    def predict_action_chunk(self, batch, noise=None):
        """What their code leaves where nothing is normalized."""
        import torch

        own = self.action(self.stats)
        self.chunk = self.act(batch, own | {"mask": np.zeros(len(own["q01"]), bool)})
        self.batch = batch
        return torch.from_numpy(self.chunk)[None, None]

    def after(self, chunk):
        """Their un-normalization of the tokens that a chunk is of."""
        import torch

        found = np.abs(np.asarray(chunk[0, 0], np.float64)[:, None] - self.model.bin_centers).argmin(1)
        ids, generate = torch.from_numpy(self.model.vocab_size - 1 - found)[None], self.model.generate
        self.model.generate = lambda *_, **__: ids
        try:
            return torch.from_numpy(self.act(self.batch, self.action(self.stats)))[None, None]
        finally:
            self.model.generate = generate


def read_options(checkpoint):
    file = checkpoint.parent / "convert.json"
    return json.loads(file.read_text()) if file.is_file() else {}


def load(checkpoint, dtype="float32"):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16."""
    reference = Reference(Path(checkpoint), dtype)
    return reference, reference.before, reference.after


def described(checkpoint):
    return f"openvla/openvla {COMMIT}, attention of torch"


class Recorder(Taps):
    """Listens to one run of predict_action, whose first pass is the prefix's and each further one a token's."""

    def __init__(self, reference):
        super().__init__(len(reference.action(reference.stats)["q01"]) - 1)
        self.reference, self.step, self.ids, model = reference, -2, [], reference.model
        towers, language = model.vision_backbone, model.language_model
        for name, tower in (("dino", towers.featurizer), ("siglip", towers.fused_featurizer)):
            for i in {0, len(tower.blocks) - 2}:
                self.after(tower.blocks[i], lambda x, name=f"{name}.blk.{i}": self.put(name, x))
        language.register_forward_pre_hook(self.on_pass)
        self.before(language.model.layers[0], lambda x: self.put("prefix", x[0]) if self.step < 0 else None)
        for i in {0, len(language.model.layers) - 1}:
            self.after(language.model.layers[i], functools.partial(self.seen, f"lm.blk.{i}"))
        self.after(language.lm_head, lambda x: self.answered(x[:, -1:]))
        generate = model.generate

        def told(ids, **how):
            self.put("tokens", ids[0])
            return generate(ids, **how)

        model.generate = told

    def on_pass(self, module, args):
        self.step += 1

    def seen(self, name, x):
        self.put(name, x[0]) if self.step < 0 else self.at_step(name, x)

    def answered(self, logits):
        """The likeliest token is so by more than rounding."""
        self.seen("logits", logits)
        first, second = logits.flatten().topk(2).values
        assert logits.dtype.itemsize < 4 or first - second > MARGIN * logits.abs().max()
        self.ids.append(int(logits.argmax()))

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        to_tensor = self.reference.images.to_tensor

        def seen(image):
            self.put("pixels", to_tensor(image)[None])
            return to_tensor(image)

        self.reference.images.to_tensor = seen
        try:
            with torch.inference_mode():
                self.put("chunk", self.reference.predict_action_chunk(batch)[0])
        finally:
            self.reference.images.to_tensor = to_tensor
        self.put("tokens_out", torch.tensor(self.ids))
        return self.taps
