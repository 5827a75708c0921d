# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random SmolVLA checkpoints in the hub layout, made with LeRobot's own class.

`write_checkpoint` is shared by the golden fixtures and by the full-size comparison.  A parameter depends on its name and
the seed alone, so the same description gives the same file.  Norm weights are not 1 and biases are not 0, so a missing
multiply or add shows; every value is representable in bfloat16, so every storage type holds the same numbers.
"""
import math
import zlib
from dataclasses import dataclass, field
from pathlib import Path

HUB_NAME = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>"]
TASKS = [
    "pick up the red cube and place it in the basket", "open the middle drawer of the cabinet", "push the plate slowly",
    "put the black bowl on top of the stove", "close the bottom drawer", "stack the green block on the yellow block",
]
PUBLISHED_VISION = {"hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12,
                    "image_size": 512, "patch_size": 16}
PUBLISHED_TEXT = {"hidden_size": 960, "intermediate_size": 2560, "num_hidden_layers": 32, "num_attention_heads": 15,
                  "num_key_value_heads": 5, "head_dim": 64, "max_position_embeddings": 8192}


@dataclass(frozen=True)
class Description:
    """A checkpoint: sizes of the backbone, what differs from SmolVLAConfig's defaults, features."""

    vision: dict
    text: dict
    factor: int
    policy: dict
    views: dict = field(default_factory=dict)  # view -> declared (height, width)
    d_state: int = 6
    d_action: int = 7
    n_merge: int = 40
    n_vocab: int = 0  # rows of the embedding; 0: as many as the tokenizer has tokens
    rename: dict = field(default_factory=dict)  # name in the data set -> name of the feature
    zero_spread: tuple = ()  # state numbers that never moved in the data: std 0, min = max


def published(views):
    """The description of the published size: 450 M parameters, 500 tensors."""
    policy = {"pad_language_to": "max_length", "prefix_length": 0, "num_expert_layers": 0, "chunk_size": 50,
              "n_action_steps": 50, "max_state_dim": 32, "max_action_dim": 32, "num_steps": 10}
    return Description(PUBLISHED_VISION, PUBLISHED_TEXT, 4, policy, views, n_merge=400, n_vocab=49280)


def backbone_config(description, n_vocab):
    from transformers import SmolVLMConfig

    text = {"model_type": "llama", "rms_norm_eps": 1e-5, "rope_theta": 100000.0, "max_position_embeddings": 512,
            "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 2, "tie_word_embeddings": False, "vocab_size": n_vocab}
    return SmolVLMConfig(vision_config=description.vision, text_config=text | description.text, pad_token_id=2,
                         scale_factor=description.factor, image_token_id=n_vocab - 2, tie_word_embeddings=False)


def tokenizer(n_merge):
    """A byte-level BPE like the published one (single digits split off), trained on a few robot sentences."""
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast

    fast = Tokenizer(models.BPE())
    steps = [pre_tokenizers.Digits(individual_digits=True), pre_tokenizers.ByteLevel(add_prefix_space=False)]
    fast.pre_tokenizer, fast.decoder = pre_tokenizers.Sequence(steps), decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    fast.train_from_iterator([t + "\n" for t in TASKS], trainers.BpeTrainer(
        vocab_size=len(SPECIAL) + len(alphabet) + n_merge, special_tokens=SPECIAL, initial_alphabet=alphabet,
        show_progress=False))
    images = {"global_image_token": "<global-img>", "fake_image_token": "<fake_token_around_image>",
              "image_token": "<image>"}
    added = [*images.values(), "<end_of_utterance>"]
    fast.add_special_tokens([AddedToken(t, special=True, normalized=False) for t in added])
    return PreTrainedTokenizerFast(
        tokenizer_object=fast, bos_token="<|im_start|>", eos_token="<end_of_utterance>", unk_token="<|endoftext|>",
        pad_token="<|im_end|>", model_max_length=8192, extra_special_tokens=images)


def write_backbone(description, folder):
    """What the hub keeps in the backbone's repository, without weights: configuration, tokenizer, processor."""
    from transformers import SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

    words = tokenizer(description.n_merge)
    backbone_config(description, description.n_vocab or len(words)).save_pretrained(folder)
    SmolVLMProcessor(SmolVLMImageProcessor(), words, SmolVLMVideoProcessor(), image_seq_len=4,
                     chat_template="{{ messages }}").save_pretrained(folder)


def randomise(module, seed):
    """Every parameter from its name and the seed, at a scale that keeps every path alive."""
    import torch

    with torch.no_grad():
        for name, p in module.named_parameters():
            generator = torch.Generator().manual_seed(zlib.crc32(name.encode()) + 1_000_003 * seed)
            x = torch.randn(p.shape, generator=generator)
            if p.ndim == 1:
                x = 0.1 * x + (1.0 if "norm" in name and name.endswith("weight") else 0.0)
            elif "position_embedding" in name:
                x = 0.5 * x
            else:
                x = x / math.sqrt(p[0].numel())
            p.copy_(x.bfloat16().to(p.dtype))
    return module


def statistics(description, seed):
    """Data-set statistics with every field that a normalization mode reads."""
    import torch

    generator, out = torch.Generator().manual_seed(seed + 77), {}
    for key, n in (("observation.state", description.d_state), ("action", description.d_action)):
        mean, std = torch.randn(n, generator=generator) * 0.3, torch.rand(n, generator=generator) * 0.5 + 0.1
        if key == "observation.state":
            std[list(description.zero_spread)] = 0.0
        low, high = mean - 2.9 * std, mean + 3.1 * std
        out[key] = {"mean": mean, "std": std, "min": low, "max": high, "q01": mean - 2.3 * std, "q99": mean + 2.2 * std,
                    "q10": mean - 1.3 * std, "q90": mean + 1.2 * std}
    return out


def policy_config(description, backbone):
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

    views = {f"observation.images.{v}": PolicyFeature(FeatureType.VISUAL, (3, *s)) for v, s in description.views.items()}
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (description.d_state,))}
    return SmolVLAConfig(
        input_features=state | views, output_features={"action": PolicyFeature(FeatureType.ACTION, (description.d_action,))},
        vlm_model_name=str(backbone), load_vlm_weights=False, device="cpu", push_to_hub=False, **description.policy)


def write_checkpoint(description, seed, folder):
    """config.json, model.safetensors in the published dtypes, both pipelines, `vlm/`.  Returns the parameter count."""
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
    from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors

    from vla_cpp.convert.golden_smolvla import published_dtypes

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_backbone(description, folder / "vlm")
    config = policy_config(description, folder / "vlm")
    policy = randomise(SmolVLAPolicy(config).float(), seed).eval()
    before, after = make_smolvla_pre_post_processors(config, statistics(description, seed))
    config.vlm_model_name = HUB_NAME  # as published files say
    for step in before.steps:
        if hasattr(step, "tokenizer_name"):
            step.tokenizer_name = HUB_NAME
        if hasattr(step, "rename_map"):
            step.rename_map = description.rename
    published_dtypes(policy).save_pretrained(folder)
    before.save_pretrained(folder), after.save_pretrained(folder)
    return sum(p.numel() for p in policy.parameters())
