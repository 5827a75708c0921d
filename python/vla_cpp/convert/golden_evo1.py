# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The references of Evo-1 for vla_cpp.convert.golden, and what to record of a run: LeRobot's policy for LeRobot's layout, and
for the authors' what golden_evo1_server says."""
from pathlib import Path

from vla_cpp.convert import golden, golden_evo1_server
from vla_cpp.convert.golden_evo1_server import read_options, towers_from_config


def is_lerobot(checkpoint):
    return (Path(checkpoint) / "model.safetensors").is_file()


def described(checkpoint):
    if is_lerobot(checkpoint):
        return "lerobot.policies.evo1.Evo1Policy"
    import cv2

    options = read_options(checkpoint)
    return f"Evo1_server.py {options['variant']}, {options['dead_rows']}, without its channel swap, cv2 {cv2.__version__}"


def in_bfloat16(towers):
    """As from_pretrained leaves them: parameters alone, for the frequencies of the rotary embedding stay in float32."""
    for p in towers.parameters():
        p.data = p.data.bfloat16()


def construct_lerobot(config):
    """The policy; its backbone from the configuration alone, where the constructor would ask for weights."""
    from lerobot.policies.evo1 import internvl3_embedder
    from lerobot.policies.evo1.modeling_evo1 import Evo1Policy
    from transformers import InternVLConfig

    def from_config(name, **options):
        return towers_from_config(InternVLConfig.from_pretrained(name))

    hub = internvl3_embedder.AutoModel
    internvl3_embedder.AutoModel = type("FromConfig", (), {"from_pretrained": staticmethod(from_config)})
    try:
        return Evo1Policy(config)
    finally:
        internvl3_embedder.AutoModel = hub


# --- loading ------------------------------------------------------------------------------------------------------


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor, postprocessor); published: towers in bfloat16, everything under autocast."""
    import torch

    policy, before, after = (load_lerobot if is_lerobot(checkpoint) else golden_evo1_server.load)(Path(checkpoint))
    published, predict = dtype == "published", policy.predict_action_chunk
    if published:
        in_bfloat16(policy.towers)

    def predict_from(batch, noise):
        draw = torch.rand
        torch.rand = lambda *shape, **options: (noise.reshape(shape) + 1) / 2  # the head makes 2 * rand - 1 of it
        try:
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=published):
                return predict(batch)[..., : policy.d_robot]
        finally:
            torch.rand = draw

    policy.predict_action_chunk = predict_from
    return policy, before, after


def load_lerobot(checkpoint):
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from safetensors.torch import load_file

    config = PreTrainedConfig.from_pretrained(str(checkpoint))
    config.vlm_model_name = str(checkpoint / "vlm")
    policy = construct_lerobot(config)
    policy.load_state_dict(load_file(checkpoint / "model.safetensors"), strict=True)
    before, after = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    policy.towers, policy.head = policy.model.embedder.model, policy.model.action_head
    policy.dead_rows, policy.d_robot = "unseen", config.output_features["action"].shape[0]
    policy.n_step = config.num_inference_timesteps

    def widened(chunk):
        """The postprocessor takes actions as wide as the network's."""
        import torch

        return after(torch.nn.functional.pad(chunk, (0, config.max_action_dim - chunk.shape[-1])))

    return policy.eval(), before, widened


# --- recording ----------------------------------------------------------------------------------------------------


class Recorder(golden.Taps):
    def __init__(self, policy):
        super().__init__(policy.n_step)
        self.policy = policy
        towers, head = policy.towers, policy.head
        towers.register_forward_pre_hook(self.on_towers, with_kwargs=True)
        vision, lm = towers.vision_tower, towers.language_model
        self.before(vision.embeddings, lambda x: self.views("pixels", x))
        self.after(vision.embeddings.patch_embeddings, lambda x: self.views("vision.patch_embed", x))
        for i, layer in enumerate(vision.encoder.layer):
            self.after(layer, lambda x, i=i: self.views(f"vision.blk.{i}", x))
        self.after(towers.multi_modal_projector, lambda x: self.views("connector", x))
        self.before(lm.layers[0].input_layernorm, lambda x: self.rows("prefix", x))
        for i, layer in enumerate(lm.layers):
            self.after(layer, lambda x, i=i: self.rows(f"lm.blk.{i}", x))
        self.after(lm.norm, lambda x: self.rows("lm.norm", x))
        self.before(head.state_encoder, lambda x: self.put("state", x[0]))
        self.after(head.state_encoder, lambda x: self.put("state_out", x))
        self.before(head.action_encoder, self.on_step)
        self.stepwise(head.action_encoder, "action_token")
        for i, block in enumerate(head.transformer_blocks):
            block.attn.register_forward_pre_hook(lambda m, args, i=i: self.on_attention(i, m, args[1]))
            self.stepwise(block, f"head.blk.{i}")
        self.after(head.seq_pool_proj, lambda x: self.at_step("pool", x[None]))
        self.after(head.mlp_head, self.on_velocity)

    def on_towers(self, module, args, inputs):
        """Which views, which rows of the prompt and which keys of the head carry something."""
        import torch

        ids, live = inputs["input_ids"][0], inputs["attention_mask"][0].bool()
        image = (ids == module.config.image_token_id).nonzero()[:, 0].view(-1, module.config.image_seq_length)
        self.present = live[image].all(dim=1)
        n = int(live.nonzero().max()) + 1
        self.put("tokens", ids[:n])
        every, state = torch.arange(len(ids)), torch.tensor([len(ids)])
        dead = self.policy.dead_rows
        self.valid = every if dead == "causal_attention" else every[live]
        self.keys = torch.cat([self.valid, state])
        self.twins = [image[~self.present], every[n:, None]] if dead == "zero_attention" else []
        for rows in self.twins:  # those of all absent views are the same, and so are all pads: one of each stands for them
            self.keys = torch.cat([self.keys, *rows[:1]])

    def views(self, name, x):
        self.put(name, x[self.present])

    def on_attention(self, i, attention, context):
        import torch

        if self.step != 0:
            return
        d, n_head = attention.embed_dim, attention.num_heads
        both = torch.nn.functional.linear(context[0], attention.in_proj_weight[d:], attention.in_proj_bias[d:])
        for rows in self.twins:
            assert all(torch.equal(context[0][rows[0]], context[0][r]) for r in rows)
        for name, x in zip("kv", both.split(d, dim=-1), strict=True):
            self.put(f"head.blk.{i}.{name}", x[self.keys].unflatten(-1, (n_head, -1)))

    def on_step(self, x):
        if self.whole and self.step >= 0:
            self.put(f"step.{self.step}.x", x[0])
        self.step += 1

    def on_velocity(self, x):
        assert x.isfinite().all()
        if not self.whole:
            self.put(f"step.{self.step}.velocity_out", x)

    def run(self, batch, noise):
        """Every tap of one inference."""
        self.whole = self.policy.d_robot == noise.shape[-1]  # else x has columns that nothing reads
        chunk = self.policy.predict_action_chunk(dict(batch), noise=noise)[0]
        if self.whole:
            self.put(f"step.{self.step}.x", chunk)
        self.put("chunk", chunk)
        return self.taps
