# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random pi0 and pi0.5 checkpoints in the hub layout, made with LeRobot's own classes at any size.

As random_smolvla: a parameter depends on its name and the seed alone, norm factors are not 1, biases not 0, every value is
representable in bfloat16.  `write_checkpoint` serves the golden fixtures and the full-size comparison.
"""
import importlib
import json
from dataclasses import dataclass, field
from pathlib import Path

from random_smolvla import TASKS, randomise, statistics

SPECIAL = ["<pad>", "<eos>", "<bos>", "<unk>"]
N_BYTE = 256


@dataclass(frozen=True)
class Description:
    """A checkpoint: sizes of the towers, what differs from the config class's defaults, features."""

    arch: str
    policy: dict
    vision: dict = None  # fields of SiglipVisionConfig; None, with the other two: the published size
    lm: dict = None  # fields of the reference's GemmaConfig
    expert: dict = None  # the same
    views: dict = field(default_factory=dict)  # view -> declared (height, width)
    d_state: int = 6
    d_action: int = 7
    n_piece: int = 150  # tokens beside the special ones and the bytes
    rename: dict = field(default_factory=dict)
    zero_spread: tuple = ()

    def dims(self):
        if self.lm is None:
            return {"size": "full"}
        n_vocab = len(SPECIAL) + N_BYTE + self.n_piece
        return {"size": "tiny", "gemma_2b": self.lm, "gemma_300m": self.expert, "vision": self.vision, "vocab_size": n_vocab}


def published(arch, views):
    """The description of the published size: 3.2 G parameters that are used (pi0), and the expert's unused head."""
    policy = {"dtype": "bfloat16", "chunk_size": 50, "n_action_steps": 50, "max_state_dim": 32, "max_action_dim": 32}
    return Description(arch, policy, views=views, d_state=8)


def tokenizer(n_piece):
    """BPE with byte fallback and a leading <bos>, digits alone, blanks as U+2581: the published tokenizer's form with
    other merges."""
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast

    fast = Tokenizer(models.BPE(unk_token="<unk>"))
    fast.normalizer = normalizers.Replace(" ", "▁")
    fast.pre_tokenizer = pre_tokenizers.Split(Regex(r"\d|\n|▁?[^▁\d\n]+|▁"), "isolated")
    corpus = [f"Task: {t}, State: 0 1 2 3 4 5 6 7 8 9 -1;\nAction: " for t in TASKS]
    fast.train_from_iterator(corpus, trainers.BpeTrainer(
        vocab_size=len(SPECIAL) + n_piece, special_tokens=SPECIAL, show_progress=False))
    spec = json.loads(fast.to_str())
    pieces = sorted(spec["model"]["vocab"], key=spec["model"]["vocab"].get)[len(SPECIAL) :]
    if len(pieces) != n_piece:
        raise ValueError(f"the corpus gives {len(pieces)} pieces, not {n_piece}")
    order = SPECIAL + [f"<0x{b:02X}>" for b in range(N_BYTE)] + pieces
    spec["model"] |= {"vocab": {t: i for i, t in enumerate(order)}, "byte_fallback": True, "fuse_unk": True}
    spec["pre_tokenizer"] = {"type": "Split", "pattern": {"String": " "}, "behavior": "MergedWithPrevious", "invert": False}
    start, text = {"SpecialToken": {"id": "<bos>", "type_id": 0}}, {"Sequence": {"id": "A", "type_id": 0}}
    other = {"Sequence": {"id": "B", "type_id": 1}}
    spec["post_processor"] = {"type": "TemplateProcessing", "single": [start, text], "pair": [start, text, other],
                              "special_tokens": {"<bos>": {"id": "<bos>", "ids": [2], "tokens": ["<bos>"]}}}
    return PreTrainedTokenizerFast(tokenizer_object=Tokenizer.from_str(json.dumps(spec)), bos_token="<bos>", eos_token="<eos>",
                                   unk_token="<unk>", pad_token="<pad>", model_max_length=8192)


def policy_config(description):
    from lerobot.configs import FeatureType, PolicyFeature

    arch = description.arch
    module = importlib.import_module(f"lerobot.policies.{arch}.configuration_{arch}")
    views = {f"observation.images.{v}": PolicyFeature(FeatureType.VISUAL, (3, *s)) for v, s in description.views.items()}
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (description.d_state,))}
    action = {"action": PolicyFeature(FeatureType.ACTION, (description.d_action,))}
    return getattr(module, f"{arch.upper()}Config")(input_features=state | views, output_features=action, device="cpu",
                                                    push_to_hub=False, **description.policy)


def centre(policy):
    """Gemma's norms multiply by 1 + weight; an adaptive norm's gates spread about 1, or its layer would hardly matter."""
    for name, p in policy.named_parameters():
        if "norm" in name and name.endswith(".weight") and p.ndim == 1 and "vision" not in name:
            p.data -= 1
        if name.endswith(".dense.bias"):
            p.data[2 * len(p) // 3 :] += 1
            p.data.copy_(p.data.bfloat16().to(p.dtype))


def pipelines(config, description, seed, folder):
    """Both pipelines; the tokenizer's name is a literal in the reference, so its folder stands in for the hub meanwhile."""
    import lerobot.processor.tokenizer_processor as tokenizer_step

    arch = description.arch
    make = getattr(importlib.import_module(f"lerobot.policies.{arch}.processor_{arch}"), f"make_{arch}_pre_post_processors")
    hub = tokenizer_step.AutoTokenizer
    local = type("Local", (), {"from_pretrained": staticmethod(lambda name, **kw: hub.from_pretrained(str(folder)))})
    tokenizer_step.AutoTokenizer = local
    try:
        before, after = make(config, statistics(description, seed))
    finally:
        tokenizer_step.AutoTokenizer = hub
    for step in before.steps:
        if hasattr(step, "rename_map"):
            step.rename_map = description.rename
    return before, after


def write_checkpoint(description, seed, folder):
    """config.json, model.safetensors in bfloat16, both pipelines, `tokenizer/`, dims.json.  Returns the parameter count."""
    from vla_cpp.convert import golden_pi

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer(description.n_piece).save_pretrained(folder / "tokenizer")
    (folder / "dims.json").write_text(json.dumps(description.dims(), indent=1) + "\n")
    config = policy_config(description)
    policy = golden_pi.construct(config, description.dims())
    randomise(policy, seed), centre(policy)
    before, after = pipelines(config, description, seed, folder / "tokenizer")
    policy.bfloat16().save_pretrained(folder)
    before.save_pretrained(folder), after.save_pretrained(folder)
    return sum(p.numel() for p in policy.parameters())
