# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The command `vla-convert`: arguments in, exit code out; decides nothing about numbers."""

from __future__ import annotations

import argparse
import sys
from contextlib import contextmanager
from dataclasses import fields

from .. import __version__
from ..printable import printable
from .archs import Options, names
from .conversion import STORED, Summary, convert_checkpoint
from .errors import Code, ConvertError
from .files import missing_extra

DESCRIPTION = """\
Converts a Vision-Language-Action policy, as LeRobot, openpi or the authors of Evo-1, GR00T or BitVLA save it, into one self-contained GGUF
bundle for the vla runtime: weights, tokenizer, image recipe, statistics, feature names. Architectures: {archs}.
It refuses what it does not fully understand, and lists all problems at once."""

EPILOG = """\
Without --dtype the stored type is kept if all matrices share it; mixed types become f32, which is exact. --dtype stored
keeps the type of each, which is exact too: matrices of bf16 are then computed in bf16, as PyTorch does, the others in f32.

--position-precision: the reference computes the rows of the vision position table in the precision of its tower, and that
is bfloat16 when config.json says load_vlm_weights: true or the backbone's vision_config says bfloat16, else float32. The
two agree for grids whose side is a power of two. 'shifted' reproduces transformers 4.55 to 4.57.

A checkpoint of Evo-1's authors needs --variant, --views, --max-views and --masked-rows: r1 is their code before 9 April 2026, r2 the
code since (steps, time index, pixel rounding and state padding differ); --masked-rows is zero_attention if the policy ran with
flash-attn, which the authors ask for. docs/converting.md tells how to find out.

Exit codes: 0 done, 1 a fault of the converter, 2 usage, 3 damaged or contradictory checkpoint, 6 not supported, 9 files that cannot
be read or written."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:
        self.exit(int(Code.USAGE), "error: arguments: {}; see {} --help\n".format(message, self.prog))


def build_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="vla-convert",
        description=DESCRIPTION.format(archs=", ".join(names())),
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "checkpoint", metavar="CHECKPOINT", help="folder with config.json and weights, or hub:OWNER/NAME@REVISION"
    )
    add("-o", "--out", metavar="OUT.gguf", required=True, help="the bundle to write; appears only when it is complete")
    add(
        "--backbone",
        metavar="DIR",
        default="",
        help="folder with the backbone's config.json and tokenizer.json, where they live elsewhere, or hub:OWNER/NAME@REVISION",
    )
    add(
        "--dtype",
        choices=("f32", "bf16", "f16", STORED),
        default="",
        help="storage of matrices and tables; vectors and statistics are always f32",
    )
    add(
        "--dataset-info",
        metavar="INFO.json",
        default="",
        help="meta/info.json of the LeRobot data set: names of state and action numbers, control rate",
    )
    add(
        "--identity-stats",
        metavar="FEATURE",
        action="append",
        default=[],
        help="let FEATURE (observation.state or action) pass unnormalized when its statistics are missing",
    )
    add(
        "--state-bound",
        metavar="N",
        type=float,
        help="report a normalized state value beyond N in every answer, or refuse it with --strict-state; the runtime's default is 10",
    )
    add(
        "--position-precision",
        choices=("float32", "bfloat16", "shifted"),
        default="",
        help="rule for the rows of the vision position table; see below",
    )
    add(
        "--variant",
        metavar="NAME",
        default="",
        help="openpi: the training configuration, e.g. pi05_droid; Evo-1's authors: the revision of their code, r1 or r2; GR00T N1.5: the"
        " data config, by name or as a JSON file",
    )
    _add_evo1(parser)
    _add_gr00t(parser)
    add("--force", action="store_true", help="overwrite OUT.gguf")
    add("--quiet", action="store_true", help="no progress bar and no summary")
    add("--version", action="version", version="vla-convert " + __version__)
    return parser


def _add_evo1(parser: argparse.ArgumentParser) -> None:
    about = "what their folder (config.json, norm_stats.json, *.pt) does not state; see below"
    add = parser.add_argument_group("checkpoints of Evo-1's authors", about).add_argument
    add("--stats", metavar="ARM/DATASET", default="", help="the entry of norm_stats.json to normalize with, where there are several")
    add(
        "--views",
        metavar="A,B,...",
        type=lambda text: text.split(","),
        default=(),
        help="names of the cameras, in the order of the prompt's view slots",
    )
    add("--max-views", metavar="N", type=int, default=0, help="view slots of the prompt; the authors' server has 3")
    add(
        "--masked-rows",
        choices=("zero_attention", "causal_attention"),
        default="",
        help="what attention wrote into masked rows, which the action head reads: zeros with flash-attn",
    )


def _add_gr00t(parser: argparse.ArgumentParser) -> None:
    about = "a checkpoint holds several robots; --variant, --camera-size, --gripper-sign and --dataset-info take TAG=VALUE,... where these differ"
    add = parser.add_argument_group("checkpoints of GR00T", about).add_argument
    add(
        "--embodiment",
        metavar="TAG",
        default="",
        help="tag of the robot in processor_config.json; required. A,B,... puts several into one bundle, all every one that has"
        " statistics",
    )
    add(
        "--camera-size",
        metavar="WxH",
        default="",
        help="camera resolution, for a pipeline that keeps the aspect ratio; square by default",
    )
    add(
        "--gripper-sign",
        metavar="KEY",
        default="",
        help="map the action KEY to -1 above 0.5 and to 1 elsewhere, as LIBERO's simulator expects its gripper",
    )
    add(
        "--letterbox",
        action="store_true",
        help="pad images to squares even if the checkpoint does not say so, as the authors' servers have done since March 2026",
    )


@contextmanager
def _progress(quiet: bool):
    """A bar on stderr while it is a terminal; nothing otherwise, so that logs stay readable."""
    if quiet or not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description:<32.32}", markup=False), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda what, done, total: bar.update(task, description=printable(what), completed=done, total=total)


def report(summary: Summary) -> str:
    """The summary as text, a line per fact."""
    lines = [
        "wrote {}: {}, {} tensors, {}, {:,} bytes".format(
            summary.path, summary.arch, summary.n_tensor, summary.dtype, summary.n_bytes
        )
    ]
    error, tensor = summary.rounding
    if summary.dtype != "f32":
        lines.append(
            "  rounding  "
            + ("none: every number is exact" if error == 0 else "largest error {:.3g}, in {}".format(error, tensor))
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
    options = Options(**{field.name: getattr(args, field.name) for field in fields(Options)})
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
        return 130  # what shells report for an interrupt; the unfinished file is gone
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
