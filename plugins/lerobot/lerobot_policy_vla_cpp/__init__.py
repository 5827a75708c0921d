# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`--policy.type=vla_cpp`: LeRobot's programs with vla.cpp as the engine. LeRobot imports this package by its name."""

from .configuration_vla_cpp import VlaCppConfig
from .modeling_vla_cpp import VlaCppPolicy
from .processor_vla_cpp import make_vla_cpp_pre_post_processors

__all__ = ["VlaCppConfig", "VlaCppPolicy", "make_vla_cpp_pre_post_processors"]
