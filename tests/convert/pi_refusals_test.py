# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What LeRobot checkpoints of π0 and π0.5 are refused for."""

import numpy as np
import pytest

from tiny_pi import LM, TinyPi
from vla_cpp.convert.errors import Code

KINDS = pytest.mark.parametrize("kind", ["pi0", "pi05"])


@KINDS
def test_missing_extra_and_misshapen_tensors_are_named_at_once(converter, kind):
    tiny = TinyPi(kind)
    del tiny.tensors["model.action_in_proj.bias"]
    tiny.tensors["model.extra"] = np.zeros(2, np.float32)
    tiny.tensors["model.action_out_proj.weight"] = np.zeros((2, 2), np.float32)
    tiny.tensors[LM + "layers.2.mlp.up_proj.weight"] = np.zeros((2, 2), np.float32)
    error = converter.refusal(tiny)
    assert len(error.problems) == 4 and "the language model's layers are 0 to 1" in error.message()


def without(name):
    return lambda tiny: tiny.stats.pop(name)


def setting(**values):
    return lambda tiny: tiny.config.update(values)


def dims(variant, **values):
    return lambda tiny: tiny.dims[variant].update(values)


REFUSED = {
    "statistics of observation.state: q01: expected 6 numbers for QUANTILES, found none": without("observation.state.q01"),
    "statistics of action: q99: expected 5 numbers": without("action.q99"),
    "config.json: use_visual_memory: expected False": setting(use_visual_memory=True),
    "config.json: brand_new: expected a key of PI05Config": setting(brand_new=1),
    "config.json: image_resolution: expected two equal sides": setting(image_resolution=[28, 42]),
    "config.json: image_resolution: expected two equal sides from": setting(image_resolution=[7, 7]),
    "config.json: paligemma_variant: expected gemma_2b or gemma_300m": setting(paligemma_variant="gemma_2b_lora"),
    "config.json: dtype: expected float32 or bfloat16": setting(dtype="float16"),
    "config.json: rtc_config: expected none": setting(rtc_config={"execution_horizon": 0}),
    "config.json: n_action_steps: expected at most chunk_size 4": setting(n_action_steps=5),
    "config.json: use_relative_actions: expected False": setting(use_relative_actions=True),
    "config.json: max_action_dim: expected at least": setting(max_action_dim=3),
    "dims.json: gemma_300m: depth: expected that of the language model": dims("gemma_300m", depth=3),
    "dims.json: gemma_2b: layers: expected one of": dims("gemma_2b", layers=3),
    "dims.json: vision: num_attention_heads: expected a divisor": dims("vision", num_attention_heads=4),
    "dims.json: gemma_2b: head_dim: expected an even number": dims("gemma_2b", head_dim=5),
    "config.json: image_resolution: expected the image_size of dims.json": dims("vision", image_size=224),
    "dims.json: tower: expected": lambda tiny: tiny.dims.update(tower={}),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_checkpoint_of_pi05_is_refused_by_name(converter, message):
    tiny = TinyPi("pi05")
    REFUSED[message](tiny)
    assert message in converter.refusal(tiny).message()


def swap(first, second):
    def change(tiny):
        steps = tiny.pre["steps"]
        i, j = (next(k for k, step in enumerate(steps) if step["registry_name"] == name) for name in (first, second))
        steps[i], steps[j] = steps[j], steps[i]

    return change


def enable(name, value=True):
    return lambda tiny: tiny.step(name)["config"].update(enabled=value)


DISCRETIZE = "pi05_prepare_state_tokenizer_processor_step"
ORDERS = {
    "expected normalization before it and tokenization after it": swap(DISCRETIZE, "normalizer_processor"),
    "expected the state of the robot, before normalization": swap("relative_actions_processor", "normalizer_processor"),
    "absolute_actions_processor: enabled: expected True": enable("relative_actions_processor"),
    "absolute_actions_processor: enabled: expected False": enable("absolute_actions_processor"),
    "relative_actions_processor: enabled: expected True or False": enable("relative_actions_processor", "yes"),
    "steps: expected " + DISCRETIZE: lambda tiny: tiny.pre["steps"].remove(tiny.step(DISCRETIZE)),
    "and not the other family's": lambda tiny: tiny.pre["steps"].insert(0, {"registry_name": "pi0_new_line_processor"}),
}


@pytest.mark.parametrize("message", ORDERS)
def test_pipelines_that_the_recipe_cannot_follow_are_refused(converter, message):
    tiny = TinyPi("pi05")
    ORDERS[message](tiny)
    assert message in converter.refusal(tiny).message()


def test_absolute_actions_without_the_step_that_makes_them_relative_are_refused(converter):
    tiny = TinyPi("pi0").relative()
    tiny.pre["steps"].remove(tiny.step("relative_actions_processor"))
    assert "enabled: expected False as the relative_actions_processor has it" in converter.refusal(tiny).message()


def test_relative_actions_beyond_the_state_are_refused(converter):
    tiny = TinyPi("pi0").relative()
    tiny.config["input_features"]["observation.state"]["shape"] = [3]
    tiny.stats.update({name: value[:3] for name, value in tiny.stats.items() if name.startswith("observation.state.")})
    assert "a state with a number for each of the 5 actions" in converter.refusal(tiny).message()


def test_pi0s_newline_is_required_and_smolvlas_is_not_pi0s(converter):
    tiny = TinyPi("pi0")
    tiny.step("pi0_new_line_processor")["registry_name"] = "smolvla_new_line_processor"
    assert "smolvla_new_line_processor" in converter.refusal(tiny).message()


def test_without_pipelines_a_checkpoint_is_of_the_old_layout(converter):
    tiny = TinyPi("pi0")
    tiny.pre = tiny.post = None
    error = converter.refusal(tiny)
    assert error.code == Code.UNSUPPORTED and "save it again" in error.message()


def test_weights_that_are_not_finite_are_refused(converter):
    tiny = TinyPi("pi05")
    tiny.tensors["model.time_mlp_in.weight"][1, 2] = np.inf
    assert "finite numbers" in converter.refusal(tiny).message()


def test_position_rows_of_pi_follow_no_precision(converter):
    error = converter.refusal(TinyPi("pi05"), position_precision="float32")
    assert error.code == Code.USAGE and "--position-precision: expected a SmolVLA checkpoint, found type pi05" in error.message()
