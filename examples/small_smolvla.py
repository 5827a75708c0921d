# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's own SmolVLA class at five million parameters, from random weights: what the trainings of these examples share.

Tokenizer and backbone (without weights), statistics, the policy, its files in the published layout, and the state of a training.
"""

import json
from pathlib import Path
from typing import Any, Dict, List, Mapping, Sequence, Tuple

from vla_cpp.eval import lerobot_reference as reference  # noqa: F401  (before lerobot)
import torch
from vla_cpp.output import whole_file

PATCH, SHUFFLE = 16, 2  # pixels of a patch; patches, both ways, that become one token
FLOW_STEPS = 10  # Euler steps from noise to chunk
D_PADDED = 8  # numbers of a state or action inside the policy
VOCABULARY = 384  # 256 bytes, the special tokens and merges learned from the sentences
SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>"]
IMAGE = {"image_token": "<image>", "fake_image_token": "<fake_token_around_image>", "global_image_token": "<global-img>"}
END = "<end_of_utterance>"
BACKBONE_NAME = "vlm"  # what config.json calls the backbone; load() in lerobot_reference.py looks in the checkpoint's own folder


def make_tokenizer(lines: Sequence[str]) -> Any:
    """A byte-level BPE as SmolLM2 has one, digits split off singly, trained on lines of text; any text can be encoded."""
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers, trainers

    bpe = Tokenizer(models.BPE())
    digits, byte_level = pre_tokenizers.Digits(individual_digits=True), pre_tokenizers.ByteLevel(add_prefix_space=False)
    bpe.pre_tokenizer = pre_tokenizers.Sequence([digits, byte_level])
    bpe.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(vocab_size=VOCABULARY, special_tokens=SPECIAL, show_progress=False,
                                  initial_alphabet=pre_tokenizers.ByteLevel.alphabet())  # fmt: skip
    bpe.train_from_iterator([line + "\n" for line in lines], trainer)
    bpe.add_special_tokens([AddedToken(t, special=True, normalized=False) for t in [*IMAGE.values(), END]])
    return bpe


def save_backbone(folder: Path, lines: Sequence[str], size: int, width: int = 192) -> None:
    """Config, tokenizer and processor files, as the backbone's repository would hold them, without weights.

    size: pixels of a frame, both ways; width: of the vision tower
    """
    from transformers import (PreTrainedTokenizerFast, SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor,
                              SmolVLMVideoProcessor)  # fmt: skip

    bpe = make_tokenizer(lines)
    pad = bpe.token_to_id("<|im_end|>")
    SmolVLMConfig(
        vision_config=dict(hidden_size=width, intermediate_size=4 * width, num_hidden_layers=4, num_attention_heads=width // 32,
                           image_size=size, patch_size=PATCH),
        text_config=dict(model_type="llama", hidden_size=192, intermediate_size=512, num_hidden_layers=4,
                         num_attention_heads=6, num_key_value_heads=2, head_dim=32, rms_norm_eps=1e-5, rope_theta=100000.0,
                         vocab_size=-(-bpe.get_vocab_size() // 8) * 8, max_position_embeddings=512,
                         bos_token_id=bpe.token_to_id("<|im_start|>"), eos_token_id=pad, pad_token_id=pad, tie_word_embeddings=False),
        scale_factor=SHUFFLE, image_token_id=bpe.token_to_id("<image>"), pad_token_id=pad, tie_word_embeddings=False,
    ).save_pretrained(folder)  # fmt: skip
    fast = PreTrainedTokenizerFast(tokenizer_object=bpe, bos_token="<|im_start|>", eos_token=END, unk_token="<|endoftext|>",
                                   pad_token="<|im_end|>", model_max_length=512, extra_special_tokens=IMAGE)  # fmt: skip
    SmolVLMProcessor(SmolVLMImageProcessor(), fast, SmolVLMVideoProcessor(), image_seq_len=(size // PATCH // SHUFFLE) ** 2,
                     chat_template="{{ messages }}").save_pretrained(folder)  # fmt: skip


def make_policy(backbone: Path, views: Mapping[str, int], d_state: int, d_action: int, chunk: Tuple[int, int], n_token: int,
                statistics: Dict[str, Dict[str, torch.Tensor]]) -> Tuple[Any, Any, Any]:  # fmt: skip
    """The policy with random weights, its pre- and its post-processor.

    views: pixels of a camera's frame, both ways, by feature; the policy scales each to the size of the backbone
    chunk: (steps predicted, steps executed); n_token: length to which sentences are padded
    """
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
    from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors

    size = json.loads((backbone / "config.json").read_text())["vision_config"]["image_size"]
    config = SmolVLAConfig(
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (d_state,)),
                        **{view: PolicyFeature(FeatureType.VISUAL, (3, pixels, pixels)) for view, pixels in views.items()}},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (d_action,))},
        vlm_model_name=str(backbone), load_vlm_weights=False, num_vlm_layers=4, expert_width_multiplier=0.75,
        chunk_size=chunk[0], n_action_steps=chunk[1], num_steps=FLOW_STEPS, max_state_dim=D_PADDED, max_action_dim=D_PADDED,
        resize_imgs_with_padding=(size, size), tokenizer_max_length=n_token, pad_language_to="max_length",
        freeze_vision_encoder=False, train_expert_only=False, device="cpu", push_to_hub=False)  # fmt: skip
    policy = SmolVLAPolicy(config).float()
    for name, parameter in policy.named_parameters():  # the class freezes the last language layer; here all of them are new
        parameter.requires_grad_("lm_head" not in name)
    return (policy, *make_smolvla_pre_post_processors(config, statistics))


def measure(state: torch.Tensor, action: torch.Tensor, pad: torch.Tensor) -> Dict[str, Dict[str, torch.Tensor]]:
    """Mean and standard deviation, with a floor that keeps the deviation of a gripper usable, which hardly moves.

    state (n, d); action (n, horizon, d); pad (n, horizon), true beyond an episode's end, which does not count
    """
    action = action[~pad]
    return {"observation.state": {"mean": state.mean(0), "std": state.std(0).clamp_min(0.01)},
            "action": {"mean": action.mean(0), "std": action.std(0).clamp_min(0.05)}}  # fmt: skip


def save(policy: Any, before: Any, after: Any, out: Path) -> None:
    """Rounds the parameters to bfloat16 values, stored as float32, and writes the published layout.

    A bfloat16 copy of the file then holds exactly the same numbers, and differences between runtimes come from arithmetic alone.
    """
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.copy_(parameter.bfloat16().float())
    local = policy.config.vlm_model_name
    steps = [s for s in before.steps if hasattr(s, "tokenizer_name")]
    policy.config.vlm_model_name = steps[0].tokenizer_name = BACKBONE_NAME
    for part in (policy, before, after):
        part.save_pretrained(out)
    policy.config.vlm_model_name = steps[0].tokenizer_name = local


def features(state: List[str], action: List[str]) -> Dict[str, Dict[str, Any]]:
    """The numbers of a LeRobot data set, by their names."""
    named = {"observation.state": state, "action": action}
    return {key: {"dtype": "float32", "shape": (len(names),), "names": names} for key, names in named.items()}


def describe(out: Path, rate_hz: float, state: List[str], action: List[str]) -> None:
    """meta/info.json as a LeRobot data set has it: the names of the numbers and the control rate, for the converter."""
    info = {"fps": rate_hz, "features": features(state, action)}
    (out / "meta").mkdir(exist_ok=True)
    (out / "meta" / "info.json").write_text(json.dumps(info, indent=1) + "\n")


def light(frames: torch.Tensor, random: torch.Generator) -> torch.Tensor:
    """(n, 3, h, w) in [0, 1]: a little other brightness, contrast and colour for each image."""
    n = len(frames)
    gain = 1 + 0.1 * torch.randn(n, 1, 1, 1, generator=random) + 0.05 * torch.randn(n, 3, 1, 1, generator=random)
    return (frames * gain + 0.03 * torch.randn(n, 3, 1, 1, generator=random)).clamp(0, 1)


def keep(state: Dict[str, Any], file: Path) -> None:
    """What a training goes on from; an interruption leaves the file before it."""
    with whole_file(file) as part:
        torch.save(state, part)
