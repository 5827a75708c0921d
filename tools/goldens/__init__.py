# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Golden cases: tiny random checkpoints that a seed describes, and what the reference computes with them.

tests/golden/ keeps observations and the recorded taps.  Checkpoints and bundles are made from the seeds, by numpy alone and with the
same bytes on every machine, into build/goldens/ (`python tools/goldens`).
"""

import functools
import importlib
import pkgutil


@functools.cache
def families():
    """Architecture -> the module that knows its cases, its checkpoint and its reference: the one that states its CASES."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__) if found.name != "__main__"]
    return {name.split("/")[0]: module for module in modules for name in getattr(module, "CASES", ())}


def family(arch):
    return families()[arch]


def all_cases():
    """Every case by its name, `arch/name`."""
    return {name: case for module in families().values() for name, case in module.CASES.items()}
