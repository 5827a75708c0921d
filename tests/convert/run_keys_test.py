# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What a checkpoint says of how it is run goes into the bundle, and into the summary."""

import pytest
from vla_cpp.convert.cli import main


def test_steps_camera_sizes_and_settings_of_real_time_chunking_are_kept(converter, tiny, capsys):
    tiny.config.update(n_action_steps=2, rtc_config={"enabled": True, "prefix_attention_schedule": "EXP", "max_guidance_weight": 5, "execution_horizon": 3})
    shapes = [tiny.config["input_features"][view]["shape"] for view in tiny.config["input_features"] if "images" in view]
    keys = converter.bundle(tiny).keys
    assert keys["action.n_action_steps"] == 2
    assert keys["observation.camera_sizes"] == [side for _, height, width in shapes for side in (width, height)]
    assert (keys["rtc.execution_horizon"], keys["rtc.schedule"], keys["rtc.max_guidance"]) == (3, "exp", 5.0)
    assert main([str(converter.folder), "-o", converter.out, "--force"]) == 0
    assert "n_action_steps: the checkpoint executes 2 of the" in capsys.readouterr().out


def test_what_a_checkpoint_does_not_say_has_no_key(converter, tiny):
    del tiny.config["n_action_steps"]
    tiny.config["chunk_size"] = 50  # the default of the steps is as many
    tiny.config["rtc_config"] = None
    keys = converter.bundle(tiny).keys
    assert not {"action.n_action_steps", "rtc.execution_horizon"} & set(keys)


@pytest.mark.parametrize("wrong", [True, {"execution_horizon": 0}, {"prefix_attention_schedule": "SOON"}, {"max_guidance_weight": "10"}])
def test_settings_that_are_none_are_refused(converter, tiny, wrong):
    tiny.config["rtc_config"] = wrong
    assert "rtc_config: expected none, or execution_horizon above 0" in converter.refusal(tiny).message()
