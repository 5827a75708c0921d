# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The common part of GR00T's releases: a language model of the Qwen3 family, an action head with separate rows per robot, and the files that
describe the robots. gr00t_n1_<release>.py has the specific part of each release.
"""
