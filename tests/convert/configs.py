# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes that an architecture reads of a checkpoint, which may have a config alone."""

from vla_cpp.convert.archs import Options
from vla_cpp.convert.checkpoint import Checkpoint
from vla_cpp.convert.errors import Problems


def of_config(config, tensors=(), folder=""):
    """A checkpoint without weights. tensors: names of those that it would have."""
    return Checkpoint("published", str(folder), "", config, dict.fromkeys(tensors), {}, {}, None)


def sizes_of(read_sizes, checkpoint):
    problems = Problems("test")
    sizes = read_sizes(checkpoint, Options(), problems)
    problems.raise_any()
    return sizes
