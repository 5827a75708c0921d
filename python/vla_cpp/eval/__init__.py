# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Closed-loop evaluation: simulators as adapters, episodes that can be repeated, tables with intervals. See docs/evaluation.md."""
