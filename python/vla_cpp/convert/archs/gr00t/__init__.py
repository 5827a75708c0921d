# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the releases of GR00T share: a language model of the Qwen3 family, an action head with rows of its own for each robot, the
files that describe those robots. What is specific to a release is in gr00t_n1_<release>.py.
"""
