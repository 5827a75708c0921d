# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Golden cases: tiny random checkpoints that a seed describes, and what the reference computes with them.

tests/golden/ keeps observations and the recorded taps.  Checkpoints and bundles are made from the seeds, by numpy alone and with the
same bytes on every machine, into build/goldens/ (`python tools/goldens`).
"""

import importlib

# Architecture -> the module that knows its cases, its checkpoint and its reference.
FAMILIES = {"bitvla": "bitvla", "smolvla": "smolvla", "pi0": "pi", "pi05": "pi", "evo1": "evo1", "gr00t_n1_5": "gr00t_n1_5", "gr00t_n1_6": "gr00t_n1_6",
            "gr00t_n1_7": "gr00t_n1_7"}


def family(arch):
    return importlib.import_module(f"{__name__}.{FAMILIES[arch]}")


def all_cases():
    """Every case by its name, `arch/name`."""
    return {name: case for module in dict.fromkeys(FAMILIES.values()) for name, case in
            importlib.import_module(f"{__name__}.{module}").CASES.items()}
