# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The references of Evo-1 for vla_cpp.convert.golden: two layouts of files, and what to record of a run.

`lerobot`: LeRobot's policy.  `authors`: what their server computes for one request, written down here on transformers' own
InternVL and Qwen2 and LeRobot's copy of the action head, since their towers are code that comes with the weights.  The
checkpoint does not say which revision of the server it is for, how its language model treated masked rows, and what its
views are called: `convert.json` beside the checkpoint does.  The server swaps the channels of what it receives; clients
that want RGB seen send BGR.  Frames are RGB here, and nothing is swapped.
"""
import json
import types
from pathlib import Path

from vla_cpp.convert import golden

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
WIDTH = 24  # numbers of state and action that the authors' server knows
REVISIONS = {"r1": (32, 1000), "r2": (50, 999)}  # steps, and the factor from time to a row of the table
STATISTICS = {"bounds": ("min", "max"), "bounds_q99": ("q01", "q99"), "normal": ("mean", "std")}


def is_lerobot(checkpoint):
    return (Path(checkpoint) / "model.safetensors").is_file()


def described(checkpoint):
    if is_lerobot(checkpoint):
        return "lerobot.policies.evo1.Evo1Policy"
    options = read_options(checkpoint)
    return f"Evo1_server.py {options['variant']}, {options['dead_rows']}, without its channel swap"


def read_options(checkpoint):
    return json.loads((Path(checkpoint).parent / "convert.json").read_text())


def read_dims(checkpoint):
    """Two literals of the authors' code, which dims.json replaces for other sizes."""
    file = checkpoint / "dims.json"
    return {"language_layers": 14, "prompt_tokens": 1024} | (json.loads(file.read_text()) if file.is_file() else {})


# --- construction -------------------------------------------------------------------------------------------------


def towers_from_config(config):
    """transformers' InternVL, eager, with weights from no file."""
    import transformers

    config._attn_implementation = "eager"
    return transformers.InternVLModel._from_config(config)


def in_bfloat16(towers):
    """As from_pretrained leaves them: parameters alone, for the frequencies of the rotary embedding stay in float32."""
    for p in towers.parameters():
        p.data = p.data.bfloat16()


def native_config(chat, image_token):
    """transformers' configuration of a backbone whose own code is not loaded."""
    from transformers import InternVLConfig

    vision, text = dict(chat["vision_config"]), dict(chat["llm_config"])
    side, patch = chat["force_image_size"], vision["patch_size"]
    keep = ("hidden_size", "num_hidden_layers", "num_attention_heads", "intermediate_size", "norm_type", "layer_norm_eps", "hidden_act")
    vision = {k: vision[k] for k in keep} | {"attention_bias": vision["qkv_bias"], "use_qk_norm": vision["qk_normalization"],
                                             "image_size": [side, side], "patch_size": [patch, patch]}
    text.pop("rope_scaling")  # dynamic, which begins beyond max_position_embeddings
    return InternVLConfig(vision_config=vision, text_config=text, image_token_id=image_token, downsample_ratio=chat["downsample_ratio"],
                          image_seq_length=int((side // patch * chat["downsample_ratio"]) ** 2), tie_word_embeddings=False)


def construct_authors(checkpoint):
    """{towers, head} of a folder's configurations."""
    import torch
    from lerobot.policies.evo1.flow_matching import FlowmatchingActionHead
    from transformers import AutoTokenizer

    checkpoint = Path(checkpoint)
    config = json.loads((checkpoint / "config.json").read_text())
    chat = json.loads((checkpoint / "vlm" / "config.json").read_text())
    token = AutoTokenizer.from_pretrained(checkpoint / "vlm").convert_tokens_to_ids("<IMG_CONTEXT>")
    towers = towers_from_config(native_config(chat, token))
    towers.language_model.layers = towers.language_model.layers[: read_dims(checkpoint)["language_layers"]]
    same = ("embed_dim", "hidden_dim", "horizon", "per_action_dim", "num_heads", "num_layers", "dropout", "num_categories", "state_dim",
            "state_hidden_dim")
    head = FlowmatchingActionHead(action_dim=config["horizon"] * config["per_action_dim"], **{k: config[k] for k in same})
    return torch.nn.ModuleDict({"towers": towers, "head": head})


def authors_tensors(modules):
    """(name in the authors' file, what it holds, stacked) of every tensor."""
    towers, head = modules["towers"], modules["head"]
    vision, projector = towers.vision_tower, towers.multi_modal_projector
    tower, patches = "embedder.model.vision_model.", vision.embeddings.patch_embeddings.projection
    yield f"{tower}embeddings.class_embedding", [vision.embeddings.cls_token.data]
    yield f"{tower}embeddings.position_embedding", [vision.embeddings.position_embeddings.data]
    for leaf in ("weight", "bias"):
        yield f"{tower}embeddings.patch_embedding.{leaf}", [getattr(patches, leaf).data]
        for place, module in ((0, projector.layer_norm), (1, projector.linear_1), (3, projector.linear_2)):
            yield f"embedder.model.mlp1.{place}.{leaf}", [getattr(module, leaf).data]
    for i, layer in enumerate(vision.encoder.layer):
        at, attention = f"{tower}encoder.layers.{i}.", layer.attention
        yield f"{at}ls1", [layer.lambda_1.data]
        yield f"{at}ls2", [layer.lambda_2.data]
        alone = {"norm1": layer.layernorm_before, "norm2": layer.layernorm_after, "attn.proj": attention.projection_layer,
                 "mlp.fc1": layer.mlp.fc1, "mlp.fc2": layer.mlp.fc2}
        for leaf in ("weight", "bias"):
            yield f"{at}attn.qkv.{leaf}", [getattr(m, leaf).data for m in (attention.q_proj, attention.k_proj, attention.v_proj)]
            for name, module in alone.items():
                yield f"{at}{name}.{leaf}", [getattr(module, leaf).data]
    for name, value in towers.language_model.state_dict().items():
        yield f"embedder.model.language_model.model.{name}", [value]
    for name, value in head.state_dict().items():
        yield f"action_head.{name}", [value]


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
    policy, before, after = (load_lerobot if is_lerobot(checkpoint) else load_authors)(Path(checkpoint))
    policy.published = dtype == "published"
    if policy.published:
        in_bfloat16(policy.towers)
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


def load_authors(checkpoint):
    import torch

    weights = torch.load(checkpoint / "mp_rank_00_model_states.pt", weights_only=True)["module"]
    modules = construct_authors(checkpoint)
    places = dict(authors_tensors(modules))
    if places.keys() != weights.keys():
        raise ValueError(f"{checkpoint}: names differ: {sorted(places.keys() ^ weights.keys())}")
    for name, parts in places.items():
        for part, value in zip(parts, weights[name].split([len(p) for p in parts]), strict=True):
            part.copy_(value)
    server = Server(checkpoint, modules.eval())
    return server, server.before, server.after


class Server:
    """The authors' server, one request at a time."""

    def __init__(self, checkpoint, modules):
        from transformers import AutoTokenizer

        self.config = types.SimpleNamespace(type="evo1")
        options, config = read_options(checkpoint), json.loads((checkpoint / "config.json").read_text())
        self.towers, self.head, self.options = modules["towers"], modules["head"], options
        self.dead_rows, self.r1 = options["dead_rows"], options["variant"] == "r1"
        self.n_step, self.time_scale = REVISIONS[options["variant"]]
        self.n_token = read_dims(checkpoint)["prompt_tokens"]
        self.tokenizer = AutoTokenizer.from_pretrained(checkpoint / "vlm")
        statistics = json.loads((checkpoint / "norm_stats.json").read_text())
        for key in filter(None, options.get("stats", "").split("/")):
            statistics = statistics[key]
        while "action" not in statistics:  # under the only robot, or the only arm and its only data set
            (statistics,) = statistics.values()
        self.statistics, self.normalization = statistics, config.get("normalization_type", "bounds")
        self.d_robot = len(statistics["action"]["min"])

    def before(self, batch):
        """What the network receives: pixels, tokens, their mask, state."""
        import torch

        frames = [batch.get(f"observation.images.{v}") for v in self.options["views"]]
        frames += [None] * (self.options["view_slots"] - len(frames))
        pixels = torch.stack([self.pixels(f) for f in frames])
        n_view, n_token = len(frames), self.towers.config.image_seq_length
        prompt = "".join(f"Image-{i + 1}: <img>{'<IMG_CONTEXT>' * n_token}</img>\n" for i in range(n_view)) + batch["task"].strip()
        words = self.tokenizer([prompt], return_tensors="pt", padding="max_length", truncation=True, max_length=self.n_token)
        ids, mask = words["input_ids"], words["attention_mask"].clone()
        context = (ids[0] == self.towers.config.image_token_id).nonzero()[:, 0].view(n_view, n_token)
        for rows, frame in zip(context, frames, strict=True):
            if frame is None:
                mask[0, rows] = 0
        return {"pixel_values": pixels, "input_ids": ids, "attention_mask": mask, "state": self.state(batch["observation.state"])[None]}

    def pixels(self, frame):
        """(3, side, side) as the tower reads it: bfloat16.  An absent view is black."""
        import cv2
        import numpy as np
        import torch

        side = self.towers.config.vision_config.image_size[0]
        picture = np.zeros((side, side, 3), np.uint8)
        if frame is not None:
            picture = cv2.resize((frame * 255).round().byte().permute(1, 2, 0).numpy(), (side, side))
        x = torch.from_numpy(picture).permute(2, 0, 1).float().div(255)
        mean, std = torch.tensor(MEAN).view(3, 1, 1), torch.tensor(STD).view(3, 1, 1)
        return ((x - mean) / std).bfloat16() if self.r1 else (x.bfloat16() - mean.bfloat16()) / std.bfloat16()

    def table(self, feature):
        """The two statistics that the normalization reads."""
        import torch

        return (torch.tensor(self.statistics[feature][k]) for k in STATISTICS[self.normalization])

    def state(self, x):
        import torch

        low, high = self.table("observation.state")
        if self.r1:  # widened before, so that what was added becomes -1
            x, low, high = (torch.nn.functional.pad(t, (0, WIDTH - len(t))) for t in (x, low, high))
        if self.normalization == "normal":
            x = (x - low) / (high + 1e-8)
        else:
            x = torch.clamp(2 * (x - low) / (high - low + 1e-8) - 1, -1.0, 1.0)
        return torch.nn.functional.pad(x, (0, WIDTH - len(x)))

    def after(self, chunk):
        low, high = self.table("action")
        return chunk * (high + 1e-8) + low if self.normalization == "normal" else (chunk + 1.0) / 2.0 * (high - low + 1e-8) + low

    def predict_action_chunk(self, batch, noise):
        """(1, horizon, WIDTH), normalised."""
        import torch

        mask, hooks = batch["attention_mask"], []
        if self.dead_rows == "zero_attention":  # as flash attention leaves rows that are cut out before and put back after
            for layer in self.towers.language_model.layers:
                hooks.append(layer.self_attn.register_forward_hook(lambda m, args, out: (out[0] * mask[..., None].to(out[0].dtype), *out[1:])))
        inputs = {k: batch[k] for k in ("input_ids", "pixel_values", "attention_mask")}
        context = self.towers(**inputs, use_cache=False).last_hidden_state.float()
        for hook in hooks:
            hook.remove()
        head, who = self.head, torch.zeros(1, dtype=torch.long)
        context = torch.cat([context, head.state_encoder(batch["state"], who)[:, None]], dim=1)
        real = (torch.arange(WIDTH) < self.d_robot).float()
        x = noise
        for k in range(self.n_step):
            time = head.time_pos_enc.pe[:, min(int(k / self.n_step * self.time_scale), 999)]
            h = head.action_encoder(x * real, who)
            h = h if self.r1 else h.float()
            for block in head.transformer_blocks:
                h = block(h, context, time)
            velocity = head.mlp_head(head.seq_pool_proj(head.norm_out(h).flatten(1)), who)
            x = x + 1.0 / self.n_step * velocity.view_as(x)
        return x


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
        import torch

        policy, draw = self.policy, torch.rand
        self.whole = policy.d_robot == noise.shape[-1]  # else x has columns that nothing reads
        torch.rand = lambda *shape, **options: (noise.reshape(shape) + 1) / 2  # of which the head makes 2 * rand - 1
        options = {"noise": noise} if isinstance(policy, Server) else {}
        try:
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=policy.published):
                chunk = policy.predict_action_chunk(dict(batch), **options)[0]
        finally:
            torch.rand = draw
        if self.whole:
            self.put(f"step.{self.step}.x", chunk)
        self.put("chunk", chunk[:, : policy.d_robot])
        return self.taps
