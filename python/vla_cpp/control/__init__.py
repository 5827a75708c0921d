# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Executes action chunks on a robot: when to request a chunk, which row to command, what to do when a chunk is late (docs/control.md)."""

from .blend import Blend, CrossFade, Ensemble
from .episodes import Episode, EpisodeWriter
from .interpolate import Interpolator
from .limits import Column, Limiter, Limits
from .loop import ChunkLoop, RealTimeChunking
from .schedule import Action, ChunkSchedule

__all__ = ["Action", "Blend", "ChunkLoop", "ChunkSchedule", "Column", "CrossFade", "Ensemble", "Episode", "EpisodeWriter", "Interpolator", "Limiter", "Limits", "RealTimeChunking"]
