# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The command `vla-convert`: parses arguments and returns the exit code; it makes no decision about numbers."""

from __future__ import annotations

import argparse
import sys
from contextlib import contextmanager
from typing import Dict, List

from .. import __version__
from ..printable import printable
from .archs import LAYOUTS, Options, authors, declared, names
from .conversion import Summary, convert_checkpoint
from .errors import Code, ConvertError
from .files import missing_extra
from .options import COMMON

DESCRIPTION = """\
Converts a checkpoint of a Vision-Language-Action policy into one self-contained GGUF bundle for the vla runtime: weights, tokenizer,
image recipe, statistics, feature names. Architectures: {archs}.
Checkpoints are those of {layouts}.
It refuses what it does not fully understand, and lists all problems at once."""

EPILOG = """\
Without --dtype the stored type is kept if all matrices share it; mixed types become f32, which is exact. --dtype stored
keeps the type of each, which is exact too: matrices of bf16 are then computed in bf16, as PyTorch does, the others in f32.
--dtype int8 and int4 convert so too, into a folder beside OUT.gguf, and then run `vla quantize` (VLA_BINARY, or the program
of this package) on the result; `vla quantize --judge` on a bundle chooses codes by how far the actions move.

--position-precision: the reference computes the rows of the vision position table in the precision of its tower, and that
is bfloat16 when config.json says load_vlm_weights: true or the backbone's vision_config says bfloat16, else float32. The
two agree for grids whose side is a power of two. 'shifted' reproduces transformers 4.55 to 4.57.

{layouts}

Exit codes: 0 done, 1 a fault of the converter, 2 usage, 3 damaged or contradictory checkpoint, 6 not supported, 9 files that cannot
be read or written."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:
        self.exit(int(Code.USAGE), "error: arguments: {}; see {} --help\n".format(message, self.prog))


def build_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="vla-convert",
        description=DESCRIPTION.format(
            archs=", ".join(names()), layouts=", ".join(layout.name for layout in (*LAYOUTS.values(), *authors().values()))
        ),
        epilog=EPILOG.format(layouts="\n\n".join(layout.about for layout in authors().values() if layout.about)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("checkpoint", metavar="CHECKPOINT", help="folder with config.json and weights, or hub:OWNER/NAME@REVISION")
    add("-o", "--out", metavar="OUT.gguf", required=True, help="the bundle to write; appears only when it is complete")
    for option in COMMON:
        add(option.flag, help=option.help, **option.arguments())
    some = parser.add_argument_group("options of some checkpoints", "what these do not state; of others they are refused").add_argument
    for option, helps in declared():
        some(option.flag, help=_merged(helps), **option.arguments())
    add("--force", action="store_true", help="overwrite OUT.gguf")
    add("--quiet", action="store_true", help="no progress bar and no summary")
    add("--version", action="version", version="vla-convert " + __version__)
    return parser


def _merged(helps: Dict[str, str]) -> str:
    """One help text, "openpi: ...; GR00T N1.6, GR00T N1.7: ...", from the help of each layout."""
    layouts: Dict[str, List[str]] = {}
    for layout, text in helps.items():
        layouts.setdefault(text, []).append(layout)
    return "; ".join("{}: {}".format(", ".join(names), text) for text, names in layouts.items())


@contextmanager
def _progress(quiet: bool):
    """A progress bar if stderr is a terminal; nothing otherwise, so that logs stay readable."""
    if quiet or not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:<32.32}", markup=False), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda what, done, total: bar.update(task, description=printable(what), completed=done, total=total)


def report(summary: Summary) -> str:
    """The summary as text, one line per fact."""
    lines = [
        "wrote {}: {}, {} tensors, {}, {:,} bytes".format(
            summary.path, summary.arch, summary.n_tensor, summary.codes or summary.dtype, summary.n_bytes
        )
    ]
    error, tensor = summary.rounding
    if summary.codes:
        lines.append("  rounding  {} codes of {}; vla inspect shows what became of each matrix".format(summary.codes, summary.dtype))
    elif summary.dtype != "f32":
        lines.append(
            "  rounding  " + ("none: every number is exact" if error == 0 else "largest error {:.3g}, in {}".format(error, tensor))
        )
    margin, tensor = summary.ternary
    if tensor:
        unsure = ": WARNING, so near it depends on how a mean was rounded" if margin < 1e-6 else ""
        lines.append("  ternary   the codes change {:.2g} from the nearest number, in {}{}".format(margin, tensor, unsure))
    for reason, tensors in summary.dropped.items():
        lines.append(
            "  dropped   {} ({})".format(
                tensors[0] if len(tensors) == 1 else "{} tensors such as {}".format(len(tensors), tensors[0]), reason
            )
        )
    return "\n".join(printable(line) for line in lines + ["  note      " + note for note in summary.notes])


def main(argv=None) -> int:
    args = build_parser().parse_args(argv)
    options = Options(**{name: getattr(args, name) for name in vars(Options())})
    try:
        with _progress(args.quiet) as progress:
            summary = convert_checkpoint(args.checkpoint, args.out, options, args.force, progress)
    except ConvertError as error:
        print("error: " + error.message(), file=sys.stderr)
        return int(error.code)
    except ImportError as error:
        print("error: " + missing_extra(str(error.name)).message(), file=sys.stderr)
        return int(Code.USAGE)
    except KeyboardInterrupt:
        return 130  # the exit code of shells for an interrupt; the unfinished file is removed
    except Exception as error:  # noqa: BLE001 - the user gets one line and an exit code for bugs too
        print(
            "error: vla-convert: {}: {}; this is a fault of the converter, please report it".format(
                type(error).__name__, printable(str(error))
            ),
            file=sys.stderr,
        )
        return int(Code.INTERNAL)
    if not args.quiet:
        print(report(summary))
    return 0


if __name__ == "__main__":
    sys.exit(main())
