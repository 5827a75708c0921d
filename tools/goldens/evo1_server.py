# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the server of Evo-1's authors computes for one request.

It is written down here on transformers' own InternVL and Qwen2 and LeRobot's copy of the action head, since the authors'
towers are code that comes with the weights.  The checkpoint does not say which revision of the server it is for, how its
language model treated masked rows, and what its views are called: `convert.json` beside the checkpoint does.  The server
swaps the channels of what it receives, and clients that want RGB seen send BGR: frames are RGB here, nothing is swapped.
"""
import json
import types
from pathlib import Path

import numpy as np

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
WIDTH = 24  # numbers of state and action that the authors' server knows
REVISIONS = {"r1": (32, 1000), "r2": (50, 999)}  # steps, and the factor from time to a row of the table
STATISTICS = {"bounds": ("min", "max"), "bounds_q99": ("q01", "q99"), "normal": ("mean", "std")}


def read_options(checkpoint):
    return json.loads((Path(checkpoint).parent / "convert.json").read_text())


def read_dims(checkpoint):
    """Two literals of the authors' code, which dims.json replaces for other sizes."""
    file = checkpoint / "dims.json"
    return {"language_layers": 14, "prompt_tokens": 1024} | (json.loads(file.read_text()) if file.is_file() else {})


def towers_from_config(config):
    """transformers' InternVL, eager, with weights from no file."""
    import transformers

    config._attn_implementation = "eager"
    return transformers.InternVLModel._from_config(config)


def native_config(chat, image_token):
    """transformers' configuration of a backbone whose own code is not loaded."""
    from transformers import InternVLConfig

    vision, text, ratio = chat["vision_config"], dict(chat["llm_config"]), chat["downsample_ratio"]
    side, patch = chat["force_image_size"], vision["patch_size"]
    same = ("hidden_size", "num_hidden_layers", "num_attention_heads", "intermediate_size", "norm_type", "layer_norm_eps",
            "hidden_act")
    vision = {k: vision[k] for k in same} | {"attention_bias": vision["qkv_bias"], "use_qk_norm": vision["qk_normalization"],
                                             "image_size": [side, side], "patch_size": [patch, patch]}
    text.pop("rope_scaling")  # dynamic, which begins beyond max_position_embeddings
    return InternVLConfig(vision_config=vision, text_config=text, image_token_id=image_token, downsample_ratio=ratio,
                          image_seq_length=int((side // patch * ratio) ** 2), tie_word_embeddings=False)


def construct(checkpoint):
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
    same = ("embed_dim", "hidden_dim", "horizon", "per_action_dim", "num_heads", "num_layers", "dropout", "num_categories",
            "state_dim", "state_hidden_dim")
    head = FlowmatchingActionHead(action_dim=config["horizon"] * config["per_action_dim"], **{k: config[k] for k in same})
    return torch.nn.ModuleDict({"towers": towers, "head": head})


# Names of transformers' towers and LeRobot's head -> those of the authors' file, where q, k and v are one tensor.
RENAMES = (
    ("towers.vision_tower.", "embedder.model.vision_model."), ("towers.multi_modal_projector.layer_norm", "embedder.model.mlp1.0"),
    ("towers.multi_modal_projector.linear_1", "embedder.model.mlp1.1"), ("towers.multi_modal_projector.linear_2", "embedder.model.mlp1.3"),
    ("towers.language_model.", "embedder.model.language_model.model."), ("head.", "action_head."),
    (".cls_token", ".class_embedding"), (".position_embeddings", ".position_embedding"),
    (".patch_embeddings.projection", ".patch_embedding"), (".encoder.layer.", ".encoder.layers."), (".lambda_", ".ls"),
    (".layernorm_before", ".norm1"), (".layernorm_after", ".norm2"), (".attention.projection_layer", ".attn.proj"),
    (".attention.q_proj", ".attn.qkv"), (".attention.k_proj", ".attn.qkv"), (".attention.v_proj", ".attn.qkv"))


def places(names):
    """Name in the authors' file -> the modules' names whose values it holds, one after the other."""
    out = {}
    for name in names:
        stored = name
        for old, new in RENAMES[:6]:
            stored = new + stored[len(old) :] if stored.startswith(old) else stored
        if name.startswith("towers.vision_tower."):
            for old, new in RENAMES[6:]:
                stored = stored.replace(old, new)
        out.setdefault(stored, []).append(name)
    return out


def stacked(tensors):
    """Tensors by the modules' names -> those of the authors' file."""
    return {stored: np.concatenate([tensors[n] for n in parts]) for stored, parts in places(tensors).items()}


def load(checkpoint):
    """(server, preprocessor, postprocessor) of a folder in the authors' layout, in float32."""
    import torch

    weights = torch.load(checkpoint / "mp_rank_00_model_states.pt", weights_only=True)["module"]
    modules = construct(checkpoint)
    values = modules.state_dict()
    stored = places(values)
    if stored.keys() != weights.keys():
        raise ValueError(f"{checkpoint}: names differ: {sorted(stored.keys() ^ weights.keys())}")
    for name, parts in stored.items():
        for part, value in zip(parts, weights[name].split([len(values[p]) for p in parts]), strict=True):
            values[part].copy_(value)
    server = Server(checkpoint, modules.eval())
    return server, server.before, server.after


class Server:
    """The authors' server, one request at a time."""

    def __init__(self, checkpoint, modules):
        from transformers import AutoTokenizer

        self.config = types.SimpleNamespace(type="evo1")
        options, config = read_options(checkpoint), json.loads((checkpoint / "config.json").read_text())
        self.towers, self.head, self.options = modules["towers"], modules["head"], options
        self.masked_rows, self.r1 = options["masked_rows"], options["variant"] == "r1"
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
        frames += [None] * (self.options["max_views"] - len(frames))
        pixels = torch.stack([self.pixels(f) for f in frames])
        n_view, n_token = len(frames), self.towers.config.image_seq_length
        views = (f"Image-{i + 1}: <img>{'<IMG_CONTEXT>' * n_token}</img>\n" for i in range(n_view))
        prompt = "".join(views) + batch["task"].strip()
        words = self.tokenizer([prompt], return_tensors="pt", padding="max_length", truncation=True, max_length=self.n_token)
        ids, mask = words["input_ids"], words["attention_mask"].clone()
        context = (ids[0] == self.towers.config.image_token_id).nonzero()[:, 0].view(n_view, n_token)
        for rows, frame in zip(context, frames, strict=True):
            if frame is None:
                mask[0, rows] = 0
        state = self.state(batch["observation.state"])[None]
        return {"pixel_values": pixels, "input_ids": ids, "attention_mask": mask, "state": state}

    def pixels(self, frame):
        """(3, side, side) as the tower reads it: bfloat16.  An absent view is black."""
        import cv2
        import torch

        side = self.towers.config.vision_config.image_size[0]
        image = np.zeros((side, side, 3), np.uint8)
        if frame is not None:
            image = cv2.resize((frame * 255).round().byte().permute(1, 2, 0).numpy(), (side, side))
        x = torch.from_numpy(image).permute(2, 0, 1).float().div(255)
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
        if self.normalization == "normal":
            return chunk * (high + 1e-8) + low
        return (chunk + 1.0) / 2.0 * (high - low + 1e-8) + low

    def context(self, ids, pixels, mask):
        """Every row of the prompt behind the language model, (1, n_token, d)."""

        def without_masked_rows(module, args, out):
            return out[0] * mask[..., None].to(out[0].dtype), *out[1:]

        hooks = []
        if self.masked_rows == "zero_attention":  # flash attention cuts out rows that are masked, and puts zeros back
            hooks = [layer.self_attn.register_forward_hook(without_masked_rows) for layer in self.towers.language_model.layers]
        rows = self.towers(input_ids=ids, pixel_values=pixels, attention_mask=mask, use_cache=False).last_hidden_state
        for hook in hooks:
            hook.remove()
        return rows.float()

    def predict_action_chunk(self, batch):
        """(1, horizon, WIDTH), normalized."""
        import torch

        head, who = self.head, torch.zeros(1, dtype=torch.long)
        context = self.context(batch["input_ids"], batch["pixel_values"], batch["attention_mask"])
        context = torch.cat([context, head.state_encoder(batch["state"], who)[:, None]], dim=1)
        real = (torch.arange(WIDTH) < self.d_robot).float()
        x = torch.rand(1, head.horizon, WIDTH) * 2 - 1
        for k in range(self.n_step):
            time = head.time_pos_enc.pe[:, min(int(k / self.n_step * self.time_scale), 999)]
            h = head.action_encoder(x * real, who)
            h = h if self.r1 else h.float()
            for block in head.transformer_blocks:
                h = block(h, context, time)
            velocity = head.mlp_head(head.seq_pool_proj(head.norm_out(h).flatten(1)), who)
            x = x + 1.0 / self.n_step * velocity.view_as(x)
        return x
