# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Hooks of `json.loads` that refuse what JSON does not have, or leaves open. Both raise ValueError."""

from collections import Counter


def no_constant(name):
    """As `parse_constant`: NaN and infinities are no numbers of JSON."""
    raise ValueError("the number {} is not JSON".format(name))


def unique_names(pairs):
    """As `object_pairs_hook`: an object has each name once."""
    (name, count), *_ = Counter(name for name, _ in pairs).most_common(1) or [("", 0)]
    if count > 1:
        raise ValueError("the name {} stands twice".format(name))
    return dict(pairs)
