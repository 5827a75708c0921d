# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""SmolVLA's reference for vla_cpp.convert.golden: LeRobot's class, and what to record of a run."""
from pathlib import Path

from vla_cpp.convert import golden

NAMES = {"smolvla": "lerobot.policies.smolvla.SmolVLAPolicy"}


def published_dtypes(policy):
    """The dtypes of published files: backbone and expert bfloat16; cross layers' k/v and the five projections float32."""
    inner = policy.model.vlm_with_expert
    inner.vlm.bfloat16(), inner.lm_expert.bfloat16()
    for j, layer in enumerate(inner.lm_expert.layers):
        if is_cross(policy.config, j):
            layer.self_attn.k_proj.float(), layer.self_attn.v_proj.float()
    return policy


def is_cross(config, j):
    """Whether the reference builds layer j of the expert with keys and values projected from the backbone's."""
    every = config.self_attn_every_n_layers
    return "cross" in config.attention_mode and not (every > 0 and j % every == 0)


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor) of a folder in the hub layout with the backbone's files under `vlm/`."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    folder = str(checkpoint)
    config = PreTrainedConfig.from_pretrained(folder)
    config.vlm_model_name, config.load_vlm_weights = str(Path(checkpoint) / "vlm"), False
    policy = SmolVLAPolicy.from_pretrained(folder, config=config, strict=True)
    policy = (published_dtypes(policy) if dtype == "published" else policy.float()).eval()
    tokenizer = {"tokenizer_processor": {"tokenizer_name": config.vlm_model_name}}
    before, after = make_pre_post_processors(config, pretrained_path=folder, preprocessor_overrides=tokenizer)
    return policy, before, after


class Recorder(golden.Recorder):
    def __init__(self, policy):
        super().__init__(policy, policy.config.num_steps)
        model = policy.model
        backbone, expert = model.vlm_with_expert.get_vlm_model(), model.vlm_with_expert.lm_expert
        vision = backbone.vision_model
        self.vision_tower(vision)
        self.before(vision.embeddings.position_embedding, lambda ids: self.put("position_ids", ids[0]))
        self.per_view(backbone.connector, "connector")
        self.language_layers(backbone.text_model.layers)

        self.stepwise(model.action_time_mlp_out, "action_time_out")
        self.expert_layers(expert)
        self.stepwise(model.action_out_proj, "action_out")
        for j, layer in enumerate(expert.layers):
            if is_cross(policy.config, j):
                for name in ("k", "v"):
                    self.reprojected(getattr(layer.self_attn, f"{name}_proj"), f"expert.blk.{j}.{name}")

    def reprojected(self, module, name):
        head = self.policy.model.vlm_with_expert.config.text_config.head_dim
        self.after(module, lambda x: self.rows(name, x.unflatten(-1, (-1, head))) if self.step == 0 else None)

    def run(self, batch, noise):
        super().run(batch, noise)
        self.put("state", self.policy.prepare_state(batch)[0])
        return self.taps
