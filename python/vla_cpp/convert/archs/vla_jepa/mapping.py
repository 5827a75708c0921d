# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Keys of the network and names, storage and shapes of every tensor of VLA-JEPA: Qwen3-VL as in GR00T N1.7, and the layers of GR00T's head
for a single robot."""

from __future__ import annotations

from typing import Dict, List, TypeVar

from ...bundle import Key
from ...layers import Rows, linear, table
from .. import Dropped, Weight
from ..gr00t import head, qwen3_vl
from ..gr00t.plan import network_keys_of
from .config import Sizes

QWEN, HEAD = "model.qwen.model.", "model.action_model."
GROOT_QWEN = "backbone.model."  # GR00T's prefix of Qwen3-VL
Row = TypeVar("Row", Weight, Dropped)


def network_keys(s: Sizes) -> List[Key]:
    """Keys of the network. Unlike GR00T's, the head has no self-attention over the features."""
    keys = network_keys_of(qwen3_vl, s, {"policy": dict(n_future=s.n_embodied, n_embodied=s.n_embodied)})
    return [key for key in keys if not key.name.startswith("vl.")]


def weights(s: Sizes) -> Rows:
    """Rows of all tensors. In the reference the head is always float32, whatever the backbone's type."""
    backbone = [_moved(row, GROOT_QWEN, QWEN)._replace(in_bf16=s.in_bf16) for row in qwen3_vl.weights(s)]
    return [*backbone, *(row._replace(keep_f32=True) for row in _head(s))]


def _moved(row: Row, theirs: str, ours: str) -> Row:
    """A row of GR00T's mapping, with the prefix `theirs` of the checkpoint's name replaced by `ours`."""
    assert row.source.startswith(theirs)
    return row._replace(source=ours + row.source[len(theirs) :])


def _head(s: Sizes) -> Rows:
    d, encoder = s.d_dit, HEAD + "action_encoder."
    rows = [_moved(row, head.HEAD, HEAD) for row in head.transformer_rows(s)]
    if s.d_state:
        rows += linear("state_in", HEAD + "state_encoder.layer1", s.d_hidden, s.d_state)
        rows += linear("state_out", HEAD + "state_encoder.layer2", d, s.d_hidden)
    return [
        *rows,
        *linear("action_in", encoder + "layer1", d, s.d_action),
        *linear("action_mix", encoder + "layer2", d, 2 * d),
        *linear("action_token", encoder + "layer3", d, d),
        *table("action_position", HEAD + "position_embedding.weight", s.n_position, d),
        *table("future", HEAD + "future_tokens.weight", s.n_embodied, d),
        *linear("decode_in", HEAD + "action_decoder.layer1", s.d_hidden, s.d_hidden),
        *linear("decode_out", HEAD + "action_decoder.layer2", s.d_action, s.d_hidden),
    ]


def dropped(s: Sizes) -> List[Dropped]:
    return [
        *(_moved(row, GROOT_QWEN, QWEN) for row in qwen3_vl.dropped(s)),
        *(Dropped(name, shape, "world model, which learns beside the policy") for name, shape in s.world_model.items()),
    ]


def hints(s: Sizes) -> Dict[str, str]:
    return {
        QWEN + "model.language_model.layers.": "num_hidden_layers of the backbone is {}".format(s.lm.n_layer),
        QWEN + "model.visual.blocks.": "depth of the backbone is {}".format(s.vision.n_layer),
        HEAD + "model.transformer_blocks.": "action_num_layers is {}".format(s.n_dit_layer),
        HEAD + "state_encoder.": "state_dim is 0",
        "model.video_": "config.json has no world model: enable_world_model, freeze_qwen",
    }
