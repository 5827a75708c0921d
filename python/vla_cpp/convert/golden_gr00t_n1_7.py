# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7's reference for vla_cpp.convert.golden: LeRobot's class on the authors' layout, and what to record of a run.

A checkpoint serves several robots; `convert.json` beside it says for which one the case is.  LeRobot turns LIBERO's gripper
into the simulator's sign: the authors' server does not, and so nothing is done to it here.
"""
import contextlib
import json
import types
from pathlib import Path

from vla_cpp.convert import golden


def described(checkpoint):
    import cv2
    import diffusers

    return (f"lerobot.policies.groot.GrootPolicy, embodiment {embodiment(checkpoint)}, diffusers {diffusers.__version__}, "
            f"cv2 {cv2.__version__}")


def embodiment(checkpoint):
    return json.loads((Path(checkpoint).parent / "convert.json").read_text())["embodiment"]


# --- loading ------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def backbone_from(folder):
    """What LeRobot writes down of the backbone or reads from the hub comes from this folder."""
    from lerobot.policies.groot import groot_n1_7, processor_groot
    from transformers import Qwen3VLConfig

    config, build = groot_n1_7._cosmos_reason2_qwen3_vl_config, processor_groot._build_n1_7_processor
    groot_n1_7._cosmos_reason2_qwen3_vl_config = lambda: Qwen3VLConfig.from_pretrained(folder)
    processor_groot._build_n1_7_processor = lambda name="": build(str(folder))
    try:
        yield
    finally:
        groot_n1_7._cosmos_reason2_qwen3_vl_config, processor_groot._build_n1_7_processor = config, build


def widths(statistics, keys):
    return {key: len(statistics[key]["min"]) for key in keys}


def policy_config(checkpoint, tag):
    """LeRobot's configuration for one robot of the checkpoint, wide and long enough to cut nothing off."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.groot.configuration_groot import GrootConfig

    head = json.loads((checkpoint / "config.json").read_text())
    settings = json.loads((checkpoint / "processor_config.json").read_text())["processor_kwargs"]
    numbers = json.loads((checkpoint / "statistics.json").read_text())[tag]
    robot = settings["modality_configs"][tag]
    d_state, d_action = (sum(widths(numbers[m], robot[m]["modality_keys"]).values()) for m in ("state", "action"))
    views = {f"observation.images.{v}": PolicyFeature(FeatureType.VISUAL, (3, 1, 1)) for v in robot["video"]["modality_keys"]}
    return GrootConfig(
        base_model_path=str(checkpoint), embodiment_tag=tag, use_bf16=False, action_decode_transform="none", device="cpu",
        chunk_size=head["action_horizon"], n_action_steps=head["action_horizon"], max_state_dim=head["max_state_dim"],
        max_action_dim=head["max_action_dim"], push_to_hub=False,
        input_features=views | {"observation.state": PolicyFeature(FeatureType.STATE, (d_state,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (d_action,))})


def check_weights(model, checkpoint):
    """LeRobot's loader warns of a tensor that it misses and goes on."""
    import torch
    from safetensors.torch import load_file

    stored = {}
    for shard in sorted(checkpoint.glob("model-*.safetensors")):
        stored |= load_file(shard)
    for name, p in model.named_parameters():
        if not torch.equal(p, stored[name].float()):
            raise ValueError(f"{checkpoint}: {name} was not read")
    for name, table in model.named_buffers():
        if table.is_floating_point() and table.dtype != torch.float32:
            raise ValueError(f"{name} is {table.dtype}")


def load(checkpoint, dtype="float32", tag=None):
    """(reference, preprocessor, postprocessor); published: everything in bfloat16, frequencies and noise included, as the
    authors' policy has it.  tag: instead of the one that convert.json names."""
    import torch
    from lerobot.policies.groot.modeling_groot import GrootPolicy
    from lerobot.policies.groot.processor_groot import make_groot_pre_post_processors

    checkpoint = Path(checkpoint).resolve()  # a relative path would be taken for the name of a repository
    config = policy_config(checkpoint, tag or embodiment(checkpoint))
    with backbone_from(golden.backbone_folder(checkpoint)):
        policy = GrootPolicy(config).eval()
        before, after = make_groot_pre_post_processors(config)
        for step in before.steps:
            getattr(step, "proc", None)  # built on first use
    check_weights(policy._groot_model, checkpoint)
    if dtype == "published":
        policy._groot_model.to(torch.bfloat16)

    def from_bytes(batch):
        return before({k: (v * 255).round().byte() if k.startswith("observation.images.") else v for k, v in batch.items()})

    return Reference(policy), from_bytes, after


class Reference:
    """LeRobot's policy, with the noise given to it."""

    def __init__(self, policy):
        self.config, self.policy, self.model = types.SimpleNamespace(type="gr00t_n1_7"), policy, policy._groot_model

    def predict_action_chunk(self, batch, noise):
        import torch

        def given(size, dtype, device):
            return noise.reshape(size).to(dtype)

        draw, torch.randn = torch.randn, given
        try:
            with torch.inference_mode():
                return self.policy.predict_action_chunk(dict(batch))
        finally:
            torch.randn = draw


# --- recording ----------------------------------------------------------------------------------------------------


class Recorder(golden.Taps):
    """One request without pads; every view has the same size."""

    def __init__(self, reference):
        self.reference, model = reference, reference.model
        head, visual, lm = model.action_head, model.backbone.visual, model.backbone.language_model
        super().__init__(head.num_inference_timesteps)
        self.after(visual.patch_embed, lambda x: self.views("vision.patch_embed", x))
        for i, block in enumerate(visual.blocks):
            self.after(block, lambda x, i=i: self.views(f"vision.blk.{i}", x))
        for k, merger in enumerate(visual.deepstack_merger_list):
            self.after(merger, lambda x, k=k: self.views(f"deepstack.{k}", x))
        self.after(visual.merger, lambda x: self.views("connector", x))
        self.language(lm, len(visual.deepstack_merger_list))
        self.after(head.vlln, lambda x: self.put("vl.norm", x[0]))
        for i, block in enumerate(getattr(head.vl_self_attention, "transformer_blocks", [])):
            self.after(block, lambda x, i=i: self.put(f"vl.blk.{i}", x[0]))
        self.action_head(head)

    def views(self, name, x):
        self.put(name, x.unflatten(0, (self.n_view, -1)))

    def language(self, lm, n_deepstack):
        """What enters a layer is what the one before it left and what DeepStack added; nothing is added to the last one."""
        if len(lm.layers) <= n_deepstack:
            raise ValueError(f"{n_deepstack} DeepStack features for {len(lm.layers)} layers")
        lm.register_forward_pre_hook(lambda m, args, kw: self.put("position_ids", kw["position_ids"][-3:, 0]), with_kwargs=True)
        for i, layer in enumerate(lm.layers):
            name = f"lm.blk.{i - 1}" if i else "prefix"
            self.before(layer, lambda x, name=name: self.put(name, x[0]))
        self.after(lm.layers[-1], lambda x: self.put(f"lm.blk.{len(lm.layers) - 1}", x[0]))

    def action_head(self, head):
        self.before(head.state_encoder, lambda x: self.put("state", x[0, 0]))
        self.after(head.state_encoder, lambda x: self.put("state_out", x[0]))
        self.before(head.action_encoder, self.on_step)
        dit = head.model
        dit.register_forward_pre_hook(lambda m, args, kw: self.at_step("action_token", kw["hidden_states"][:, 1:]), with_kwargs=True)
        for i, block in enumerate(dit.transformer_blocks):
            self.stepwise(block, f"dit.blk.{i}")
            if i % 2 == 0:
                of_text = i % (2 * dit.attend_text_every_n_blocks) == 0
                for leaf, module in (("k", block.attn1.to_k), ("v", block.attn1.to_v)):
                    self.after(module, lambda x, name=f"dit.blk.{i}.{leaf}", a=block.attn1, t=of_text: self.seen(name, x, a.heads, t))
        self.stepwise(dit, "dit.out")

    def seen(self, name, x, n_head, of_text):
        """Keys or values of the rows that a cross block looks at: those of the text or those of the images."""
        if self.step == 0:
            self.put(name, x[0][self.image != of_text].unflatten(-1, (n_head, -1)))

    def on_step(self, x):
        if self.step >= 0:
            self.put(f"step.{self.step}.x", x[0])
        self.step += 1

    def on_batch(self, batch):
        """Tokens, where the images are among them, and the pixels of the patches' rows."""
        grid, ids = batch["image_grid_thw"], batch["input_ids"][0]
        vision = self.reference.model.backbone.visual.config
        if not bool(batch["attention_mask"].all()) or not bool((grid == grid[:1]).all()):
            raise ValueError("a golden case has no pads, and views of one size")
        self.n_view, (_, rows, columns) = len(grid), grid[0].tolist()
        self.image = ids == self.reference.model.backbone.model.config.image_token_id
        self.put("tokens", ids)
        p, m = vision.patch_size, vision.spatial_merge_size
        x = batch["pixel_values"].view(self.n_view, rows // m, columns // m, m, m, 3, vision.temporal_patch_size, p, p)
        if not bool((x == x[:, :, :, :, :, :, :1]).all()):
            raise ValueError("a picture differs from its copy in time")
        x = x[:, :, :, :, :, :, 0].permute(0, 5, 1, 3, 6, 2, 4, 7)  # view, channel, then block, row or column in it, pixel
        self.put("pixels", x.reshape(self.n_view, 3, rows * p, columns * p))

    def run(self, batch, noise):
        """Every tap of one inference."""
        model = self.reference.model
        self.on_batch(batch)
        get_action = model.get_action

        def keep_whole(*args, **kwargs):
            out = get_action(*args, **kwargs)
            self.put(f"step.{self.step}.x", out["action_pred"][0])
            return out

        model.get_action = keep_whole
        chunk = self.reference.predict_action_chunk(batch, noise)[0]
        if not bool(chunk.isfinite().all()):
            raise ValueError("the chunk is not finite")
        self.put("chunk", chunk)
        return self.taps
