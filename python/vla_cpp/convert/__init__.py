# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts checkpoints into bundles (docs/converting.md). Needs the extra: pip install './python[convert]'."""

from .archs import Options
from .bundle import read_bundle
from .conversion import Summary, convert_checkpoint
from .errors import Code, ConvertError

__all__ = ["Code", "ConvertError", "Options", "Summary", "convert_checkpoint", "read_bundle"]
