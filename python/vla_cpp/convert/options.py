# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Options for facts that a checkpoint does not state. Each layout declares its options; `vla-convert` collects them."""

from __future__ import annotations

from typing import Any, Callable, NamedTuple, Tuple


class Option(NamedTuple):
    """A command-line option. If it is not given, the checkpoint decides. Layouts may share an option, each with its own help."""

    flag: str  # --max-views; the attribute of archs.Options is max_views
    help: str
    metavar: str = ""
    default: Any = ""  # False: a flag; a tuple: may be given several times
    choices: Tuple[str, ...] = ()
    read: Callable[[str], Any] = str

    @property
    def name(self) -> str:
        return self.flag[2:].replace("-", "_")

    def arguments(self) -> dict:
        """Keyword arguments of argparse's add_argument."""
        if self.default is False:
            return {"action": "store_true"}
        if self.choices:
            return {"choices": self.choices, "default": self.default}
        if self.default == () and self.read is str:
            return {"metavar": self.metavar, "action": "append", "default": []}
        return {"metavar": self.metavar, "type": self.read, "default": self.default}


HUB = "hub:OWNER/NAME@REVISION"
STORED = "stored"  # --dtype: every matrix keeps its stored type
CODES = ("int8", "int4")  # --dtype: quantized by `vla quantize`
COMMON = (
    Option(
        "--backbone",
        "folder with the backbone's config.json and tokenizer.json, where they live elsewhere, or hub:OWNER/NAME@REVISION",
        "DIR",
    ),
    Option("--base", "the policy that a LoRA adapter was trained on, where adapter_config.json names no folder, or LeRobot's GR00T, or " + HUB, "DIR"),
    Option(
        "--dtype", "storage of matrices and tables; vectors and statistics are always f32", choices=("f32", "bf16", "f16", STORED, *CODES)
    ),
    Option(
        "--vla",
        "the runtime, which opens the bundle before it gets its name and whose refusal is one of the conversion; by default VLA_BINARY, the one"
        " beside this package or that on PATH, if there is one. none: the bundle is not opened",
        "PROGRAM",
    ),
    Option("--dataset-info", "meta/info.json of the LeRobot data set: names of state and action numbers, control rate", "INFO.json"),
    Option(
        "--units",
        "of all numbers of state and action, or of those named (a number, or observation.state or action for all of its numbers): rad, deg, m, ...;"
        " clients are told, and statistics that do not go with them are noted",
        "UNIT | NAME=UNIT,...",
    ),
    Option(
        "--state-bound",
        "report a normalized state value beyond N in every answer, or refuse it with --strict-state; the runtime's default is 10",
        "N",
        None,
        read=float,
    ),
)
IDENTITY_STATS = Option(
    "--identity-stats", "let FEATURE (observation.state or action) pass unnormalized when its statistics are missing", "FEATURE", ()
)
POSITION_PRECISION = Option(
    "--position-precision", "rule for the rows of the vision position table; see below", choices=("float32", "bfloat16", "shifted")
)


WIDTHS = Option(
    "--widths",
    "which is right where features of config.json and statistics contradict each other; by default the statistics for a state that the"
    " policy pads, and otherwise a refusal",
    choices=("config", "statistics"),
)
DOMAIN = Option(
    "--embodiment",
    "X-VLA: number of the domain, that of the preprocessor by default; A,B,... puts several into one bundle, all every one",
    "TAG",
)
ACTION_TOKENIZER = Option(
    "--action-tokenizer",
    "π0-FAST: folder of the tokenizer of actions, where it is not action_tokenizer/ inside the checkpoint, or " + HUB,
    "DIR",
)


def variant(what: str) -> Option:
    return Option("--variant", what, "NAME")


def stats(what: str) -> Option:
    return Option("--stats", what, "NAME")


def views(what: str) -> Option:
    """The option --views: names separated by commas. `what`: its help."""
    return Option("--views", what, "A,B,...", (), read=lambda text: text.split(","))
