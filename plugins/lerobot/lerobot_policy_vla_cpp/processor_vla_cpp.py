# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Processors that leave numbers alone: the bundle tokenizes, resizes, normalizes and unnormalizes by itself."""

from typing import Any

from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    RenameObservationsProcessorStep,
    make_policy_processor_pipelines,
)

from .configuration_vla_cpp import VlaCppConfig


def make_vla_cpp_pre_post_processors(config: VlaCppConfig, dataset_stats: Any = None) -> tuple[Any, Any]:
    """(before, after): renames, a batch dimension and the device before; the CPU after. dataset_stats are not used."""
    before = [RenameObservationsProcessorStep(rename_map={}), AddBatchDimensionProcessorStep(), DeviceProcessorStep(config.device)]
    return make_policy_processor_pipelines(input_steps=before, output_steps=[DeviceProcessorStep("cpu")])
