# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

from hypothesis import settings

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).resolve().parents[2] / "python")]

# The same examples in every run, and nothing written into the tree; VLA_EXAMPLES=10000 looks further.
settings.register_profile("vla", derandomize=True, database=None, deadline=None)
settings.load_profile("vla")
