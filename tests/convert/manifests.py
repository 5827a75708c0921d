# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the runtime declares of an architecture at its published size, and comparisons of a mapping with it."""

import functools
import json
import os
import subprocess

import pytest

from vla_cpp.convert import batch_norm


def vla():
    """The built program, named by VLA_BINARY or where the build puts it."""
    built = os.path.join(os.path.dirname(__file__), "..", "..", "build", "cpu", "bin", "vla")
    path = os.environ.get("VLA_BINARY", built)
    if not os.path.exists(path):
        pytest.skip("no vla program; build it or name it by VLA_BINARY")
    return path


@functools.lru_cache
def manifest(arch):
    return json.loads(subprocess.run([vla(), "inspect", "--manifest", arch], capture_output=True, check=True).stdout)


def as_mapped(row):
    return list(row.shape), row.kind


def check_parameters(arch, rows, declared=as_mapped):
    """Names, shapes and storage of every weight."""
    theirs = {row["name"]: (row["shape"], row["storage"]) for row in manifest(arch)["parameters"]}
    assert {row.target: declared(row) for row in rows} == theirs


def check_keys(arch, keys, chosen=()):
    """Every key that the runtime reads, with its published value. chosen: names of those that a checkpoint decides."""
    ours = {key.name: key.value for key in keys}
    for name, value in manifest(arch)["config"].items():
        if name not in chosen:
            assert ours[name] == (pytest.approx(value, rel=1e-6) if isinstance(value, float) else value), name


def sources(mapping, sizes):
    """Shapes of all tensors of a checkpoint that a mapping reads or drops, with those of the batch norms that it folds."""
    out = {row.source: row.stored for row in [*mapping.weights(sizes), *mapping.dropped(sizes)]}
    for row in mapping.weights(sizes):
        out |= batch_norm.shapes(row.batch_norm, row.stored[0]) if row.batch_norm else {}
    return out
