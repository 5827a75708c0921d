# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The layers of SmolVLA's action expert: their sizes, what each does in a step, and what the reference itself cannot run.

Reference: lerobot src/lerobot/policies/smolvla/smolvlm_with_expert.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, List

from ..section import ANY_INT, Section

if TYPE_CHECKING:
    from ._smolvla_sizes import Sizes


def expert_ff(d_model: int) -> int:
    """Width of the expert's MLP: four thirds of twice the width, cut to whole numbers and raised to a multiple of 256
    (smolvlm_with_expert.py: get_intermediate_size)."""
    return 256 * ((4 * int(2 * d_model / 3) + 255) // 256)


def is_cross(i_layer: int, mode: str, every: int) -> bool:
    """Whether the reference gives this index cross-attention; it asks with two kinds of index, see below."""
    return "cross" in mode and not (every > 0 and i_layer % every == 0)


def layer_kinds(n_layer: int, n_expert: int, mode: str, every: int) -> List[str]:
    """What the reference does in each language-model layer during a step (get_model_layers, forward)."""
    ratio = n_layer // n_expert
    return ["none" if i % ratio else "cross" if is_cross(i, mode, every) else "self" for i in range(n_layer)]


def read_expert(policy: Section, s: Sizes) -> None:
    multiplier, mode = policy.number("expert_width_multiplier"), policy.get("attention_mode")
    every = policy.count("self_attn_every_n_layers", ANY_INT)
    wanted = policy.count("num_expert_layers", ANY_INT)
    if not isinstance(mode, str):
        policy.bad("attention_mode", "a string")
        return
    s.d_expert = int(s.d_model * multiplier)
    s.d_expert_ff = expert_ff(s.d_expert)
    if s.d_expert < 2 or s.d_expert % 2:
        policy.bad(
            "expert_width_multiplier",
            "an even expert width, for the time embedding",
            "{} * {} = {}".format(s.d_model, multiplier, s.d_expert),
        )
    s.n_expert_layer = wanted if wanted > 0 else s.n_layer
    if s.n_layer % s.n_expert_layer:
        policy.bad(
            "num_expert_layers",
            "a divisor of the {} language-model layers".format(s.n_layer),
            hint="the reference asserts it",
        )
        return
    s.layer_kinds = layer_kinds(s.n_layer, s.n_expert_layer, mode, every)
    _check_expert_layers(policy, s, mode, every)


def _check_expert_layers(policy: Section, s: Sizes, mode: str, every: int) -> None:
    """The reference counts in expert layers when it builds k and v, and in language-model layers when it runs them, so with
    fewer expert layers the two can disagree; it also cannot run self-attention where the expert has no layer."""
    d_kv, ratio = s.n_head_kv * s.d_head, s.n_layer // s.n_expert_layer
    s.d_kv_in = [d_kv if is_cross(j, mode, every) else s.d_expert for j in range(s.n_expert_layer)]
    for i, kind in enumerate(s.layer_kinds):
        cross = is_cross(i, mode, every)
        if kind == "none" and not cross:
            policy.bad(
                "num_expert_layers",
                "an expert layer wherever self-attention runs",
                "none at layer {}".format(i),
                "the reference stops there: with fewer expert layers only cross-attention layers may lack one",
                unsupported=True,
            )
            return
        if kind != "none" and s.d_kv_in[i // ratio] != (d_kv if cross else s.d_expert):
            policy.bad(
                "num_expert_layers",
                "k and v of expert layer {} built for {}-attention".format(i // ratio, kind),
                "an input width of {}".format(s.d_kv_in[i // ratio]),
                "the reference cannot run this combination with self_attn_every_n_layers",
                unsupported=True,
            )
            return
