# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the server of Evo-1's authors computes for one request, for golden_evo1.

It is written down here on transformers' own InternVL and Qwen2 and LeRobot's copy of the action head, since the authors'
towers are code that comes with the weights.  The checkpoint does not say which revision of the server it is for, how its
language model treated masked rows, and what its views are called: `convert.json` beside the checkpoint does.  The server
swaps the channels of what it receives, and clients that want RGB seen send BGR: frames are RGB here, nothing is swapped.
"""
import json
import types
from pathlib import Path

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


def tensors(modules):
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
            stacked = attention.q_proj, attention.k_proj, attention.v_proj
            yield f"{at}attn.qkv.{leaf}", [getattr(module, leaf).data for module in stacked]
            for name, module in alone.items():
                yield f"{at}{name}.{leaf}", [getattr(module, leaf).data]
    for name, value in towers.language_model.state_dict().items():
        yield f"embedder.model.language_model.model.{name}", [value]
    for name, value in head.state_dict().items():
        yield f"action_head.{name}", [value]


def load(checkpoint):
    """(server, preprocessor, postprocessor) of a folder in the authors' layout, in float32."""
    import torch

    weights = torch.load(checkpoint / "mp_rank_00_model_states.pt", weights_only=True)["module"]
    modules = construct(checkpoint)
    places = dict(tensors(modules))
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
        if self.normalization == "normal":
            return chunk * (high + 1e-8) + low
        return (chunk + 1.0) / 2.0 * (high - low + 1e-8) + low

    def context(self, ids, pixels, mask):
        """Every row of the prompt behind the language model, (1, n_token, d)."""

        def without_dead_rows(module, args, out):
            return out[0] * mask[..., None].to(out[0].dtype), *out[1:]

        hooks = []
        if self.dead_rows == "zero_attention":  # flash attention cuts out rows that are masked, and puts zeros back
            hooks = [layer.self_attn.register_forward_hook(without_dead_rows) for layer in self.towers.language_model.layers]
        rows = self.towers(input_ids=ids, pixel_values=pixels, attention_mask=mask, use_cache=False).last_hidden_state
        for hook in hooks:
            hook.remove()
        return rows.float()

    def predict_action_chunk(self, batch):
        """(1, horizon, WIDTH), normalised."""
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
