# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Hooks of `json.loads` that refuse invalid or ambiguous JSON. Both raise ValueError."""

from collections import Counter


def no_constant(name):
    """For `parse_constant`: refuses NaN and infinities, which are not JSON."""
    raise ValueError("the number {} is not JSON".format(name))


def unique_names(pairs):
    """For `object_pairs_hook`: refuses an object in which a name occurs twice."""
    (name, count), *_ = Counter(name for name, _ in pairs).most_common(1) or [("", 0)]
    if count > 1:
        raise ValueError("the name {} stands twice".format(name))
    return dict(pairs)
