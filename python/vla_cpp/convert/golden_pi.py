# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The reference of pi0 and pi0.5 for vla_cpp.convert.golden: LeRobot's classes at any size, and what to record of a run.

The classes know two sizes, by name.  `checkpoint/dims.json` states others: `gemma_2b` and `gemma_300m` with the fields of
the reference's GemmaConfig, `vision` with fields of SiglipVisionConfig, `vocab_size`.  `{"size": "full"}` is the published
size.  `checkpoint/tokenizer` holds what the hub keeps in google/paligemma-3b-pt-224.
"""
import contextlib
import importlib
import json
import sys
from pathlib import Path

from vla_cpp.convert import golden

NAMES = {"pi0": "lerobot.policies.pi0.PI0Policy", "pi05": "lerobot.policies.pi05.PI05Policy"}
HUB_TOKENIZER = "google/paligemma-3b-pt-224"
TOWER = "model.paligemma_with_expert.paligemma."


def modeling(arch):
    return importlib.import_module(f"lerobot.policies.{arch}.modeling_{arch}")


def set_sizes(arch, dims):
    """From here on this process builds towers of these sizes; everything else is the reference's code."""
    m = modeling(arch)
    if not hasattr(m, "published_names"):
        m.published_names = (m.get_gemma_config, m.PaliGemmaForConditionalGenerationWithPiGemma, m.PiGemmaForCausalLM)
    gemma_config, backbone, expert = m.published_names

    def small_backbone(config):
        for key, value in dims["vision"].items():
            setattr(config.vision_config, key, value)
        width = dims["gemma_2b"]["width"]
        config.vision_config.projection_dim = config.projection_dim = width
        config.text_config.vocab_size = config._vocab_size = dims["vocab_size"]
        config.image_token_index = config.image_token_id = dims["vocab_size"] - 1
        config.text_config.pad_token_id = 0
        return backbone(config)

    def small_expert(config):
        config.vocab_size = dims["vocab_size"]
        return expert(config)

    full = dims.get("size") == "full"
    m.get_gemma_config = gemma_config if full else lambda variant: m.GemmaConfig(**dims[variant])
    m.PaliGemmaForConditionalGenerationWithPiGemma = backbone if full else small_backbone
    m.PiGemmaForCausalLM = expert if full else small_expert


@contextlib.contextmanager
def without_initial_values():
    """Constructs modules without drawing weights: of 3.5 G parameters that alone takes minutes, and all their memory."""
    import torch
    import transformers

    layers = (torch.nn.Linear, torch.nn.Embedding, torch.nn.Conv2d)
    kept = [(layer, layer.reset_parameters) for layer in layers], transformers.PreTrainedModel.init_weights
    for layer in layers:
        layer.reset_parameters = lambda self: None
    transformers.PreTrainedModel.init_weights = lambda self, *args, **kwargs: None
    try:
        yield
    finally:
        for layer, reset in kept[0]:
            layer.reset_parameters = reset
        transformers.PreTrainedModel.init_weights = kept[1]


def construct(config, dims):
    """The policy of a configuration at these sizes, with one table for embedding and head, as its loader leaves them."""
    set_sizes(config.type, dims)
    with without_initial_values():
        policy = getattr(modeling(config.type), NAMES[config.type].split(".")[-1])(config)
    tower = policy.model.paligemma_with_expert.paligemma
    tower.model.language_model.embed_tokens.weight = tower.lm_head.weight
    return policy


def read_weights(policy, file):
    """Every parameter from the file, one by one: from_pretrained goes on with random weights after a failure."""
    import torch
    from safetensors import safe_open

    parameters = dict(policy.named_parameters(remove_duplicate=False))
    with safe_open(file, "pt") as weights, torch.no_grad():
        for name in weights.keys():
            parameters[name].copy_(weights.get_tensor(name))
        missing = set(parameters) - set(weights.keys()) - {f"{TOWER}model.language_model.embed_tokens.weight"}
    if missing:
        raise ValueError(f"{file} lacks {sorted(missing)}")


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor) of a folder in the hub layout; published: the class's own bfloat16 mix."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors

    folder = Path(checkpoint)
    config = PreTrainedConfig.from_pretrained(str(folder))
    config.dtype = "bfloat16" if dtype == "published" else "float32"
    policy = construct(config, json.loads((folder / "dims.json").read_text()))
    read_weights(policy, folder / "model.safetensors")
    tokenizer = {"tokenizer_processor": {"tokenizer_name": str(folder / "tokenizer")}}
    before, after = make_pre_post_processors(config, pretrained_path=str(folder), preprocessor_overrides=tokenizer)
    return policy.eval(), before, after


class Recorder(golden.Recorder):
    def __init__(self, policy):
        super().__init__(policy, policy.config.num_inference_steps)
        model, self.has_state = policy.model, policy.config.type == "pi0"
        backbone, expert = model.paligemma_with_expert.paligemma.model, model.paligemma_with_expert.gemma_expert.model
        vision = backbone.vision_tower
        self.vision_tower(getattr(vision, "vision_model", vision))
        self.per_view(backbone.multi_modal_projector, "projector")
        self.language_layers(backbone.language_model.layers)
        if self.has_state:
            self.after(model.state_proj, lambda x: self.put("state_in", x[0]))
            self.stepwise(model.action_time_mlp_out, "action_time_out")
        self.expert_layers(expert)
        self.stepwise(model.action_out_proj, "action_out")
        module = sys.modules[type(model).__module__]
        self.clone, module.clone_past_key_values = module.clone_past_key_values, self.on_clone

    def at_step(self, name, x):
        super().at_step(name, x[:, -self.policy.config.chunk_size :])  # without pi0's state token

    def on_clone(self, past_key_values):
        self.seen = self.clone(past_key_values)  # the step appends its own keys and values to it
        return self.seen

    def on_step(self, x_t, past_key_values, **kwargs):
        velocity = super().on_step(x_t, past_key_values, **kwargs)
        if self.step == 0 and self.has_state:
            for i, layer in enumerate(self.seen.layers):
                self.with_state(f"expert.blk.{i}.k", layer.keys), self.with_state(f"expert.blk.{i}.v", layer.values)
        return velocity

    def with_state(self, name, x):
        """The valid rows of the prefix, then the state, of (1, head, token, d_head)."""
        import torch

        rows = x[0].transpose(0, 1)
        self.put(name, torch.cat([rows[: len(self.valid)][self.valid], rows[len(self.valid) :][:1]]))

    def run(self, batch, noise):
        super().run(batch, noise)
        if self.has_state:
            self.put("state", self.policy.prepare_state(batch)[0])
        return self.taps
