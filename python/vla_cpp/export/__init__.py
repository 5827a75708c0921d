# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Exports recordings of `vla serve --record` to file formats of other programs."""
