# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Python side of vla.cpp. The base package needs numpy only; `vla_cpp.convert` needs the extra `convert`."""

__version__ = "0.1.0"
