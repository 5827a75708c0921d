# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Converts an opened checkpoint into a bundle: matches tensors, chooses a dtype, streams, reports."""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from typing import Callable, Dict, Iterator, List, Tuple

import numpy as np

from .. import __version__
from ..output import is_file, is_special
from . import archs, batch_norm, standardized
from .adapters import merge, stored_dtype
from .archs import MATRIX, SCALE, TABLE, TERNARY, Options, Plan, Weight
from .bundle import BUNDLE_VERSION, BundleWriter, Key, TensorInfo
from .checkpoint import GROOT, LEROBOT, Checkpoint, given_backbone, open_checkpoint
from .dtypes import BUNDLE_NAME, WEIGHTS, convert, from_f32, to_f32
from .embodiments import plan_robots
from .errors import Code, Problems, refuse
from .options import CODES, STORED
from .runtime import NONE, check, find, program, quantize
from .safetensors_file import Entry
from .ternary import quantize as quantize_ternary
from .units import add_units

Progress = Callable[[str, int, int], None]  # (name of what is written, bytes written, total bytes)


@dataclass
class Summary:
    """Results of a conversion that the user should know."""

    path: str
    arch: str
    dtype: str
    codes: str = ""  # int8 or int4, if `vla quantize` quantized the matrices of that dtype
    n_tensor: int = 0
    n_bytes: int = 0
    dropped: Dict[str, List[str]] = field(default_factory=dict)  # reason -> tensors
    notes: List[str] = field(default_factory=list)
    rounding: Tuple[float, str] = (0.0, "")  # largest |stored - original| and its tensor
    ternary: Tuple[float, str] = (1.0, "")  # smallest distance of a number from a threshold of its code, and its tensor


def convert_checkpoint(source: str, out: str, options: Options, force: bool = False, progress: Progress = lambda *_: None) -> Summary:
    """Writes `out`; if it fails, raises ConvertError and leaves no file behind."""
    _check_out(out, force)
    if options.dtype in CODES:
        return _convert_to_codes(source, out, options, force, progress)
    _check_state_bound(options)
    vla = find(options.vla)
    checkpoint = open_checkpoint(source, archs.told_by_files(), options.base)
    options = options.replaced(backbone=given_backbone(checkpoint, options.backbone))
    problems = Problems(checkpoint.name)
    if checkpoint.config.get("type") == GROOT:
        options = archs.groot_as_published(checkpoint, options)
    elif checkpoint.layout == LEROBOT:
        archs.told_by_tensors(checkpoint)
    archs.check_options(checkpoint.layout, checkpoint.config, options)
    arch = archs.arch_of(checkpoint, options.variant)
    checkpoint.robot = options.stats
    plan = plan_robots(archs.load(arch), checkpoint, options, problems)
    add_units(plan, options.units, checkpoint.notes, problems)
    if options.state_bound is not None:
        plan.keys.append(Key("observation.state_bound", "f32", options.state_bound))
    merge(checkpoint.tensors, checkpoint.adapter, checkpoint.notes, problems)
    dropped = _match(checkpoint, plan, problems)
    problems.raise_any()
    dtype = _choose_dtype(checkpoint, plan, options.dtype)
    if options.dtype == STORED:
        plan.weights = [weight._replace(keep_f32=weight.keep_f32 or not weight.in_bf16) for weight in plan.weights]
    summary = Summary(out, arch, dtype, dropped=dropped, notes=checkpoint.notes)
    _write(checkpoint, plan, summary, problems, progress, _opener(vla, options.vla == NONE, out, plan, summary))
    return summary


def _convert_to_codes(source: str, out: str, options: Options, force: bool, progress: Progress) -> Summary:
    """Converts to a temporary bundle of floats in a folder beside `out`, then quantizes it."""
    vla = program(options.vla)
    beside = None if is_special(out) else os.path.dirname(os.path.realpath(out))
    with tempfile.TemporaryDirectory(dir=beside, prefix=".vla-convert-") as folder:
        stored = os.path.join(folder, "stored.gguf")
        summary = convert_checkpoint(source, stored, options.replaced(dtype=""), progress=progress)
        progress("quantizing", 0, 1)
        quantize(vla, stored, out, options.dtype, force)
    summary.path, summary.n_bytes = out, os.path.getsize(out) if is_file(out) else 0
    summary.codes = options.dtype
    return summary


def _check_out(out: str, force: bool) -> None:
    if os.path.isdir(out):
        raise refuse("-o " + out, "a file name", "a folder", code=Code.USAGE)
    if is_file(out) and not force:
        raise refuse("-o " + out, "a name that is free", "an existing file", "--force overwrites it", Code.USAGE)
    if not os.path.isdir(os.path.dirname(os.path.abspath(out))):
        raise refuse("-o " + out, "an existing folder", "none", code=Code.IO)


def _check_state_bound(options: Options) -> None:
    if options.state_bound is not None and not 1 <= options.state_bound <= 1e9:
        raise refuse("--state-bound", "1 to 1e9", "{:g}".format(options.state_bound), code=Code.USAGE)


def _match(checkpoint: Checkpoint, plan: Plan, problems: Problems) -> Dict[str, List[str]]:
    """Compares the tensors that the configs require with those of the file; reports all missing, extra and misshapen ones together.
    Returns the dropped tensors by reason."""
    expected = {weight.source: weight.stored for weight in plan.weights}
    for weight in plan.weights:
        if weight.batch_norm:
            expected.update(batch_norm.shapes(weight.batch_norm, weight.stored[0]))
    optional = {row.source: row for row in plan.dropped}
    for source in expected:
        shared = checkpoint.aliases.get(source)
        if source not in checkpoint.tensors and shared in checkpoint.tensors:
            checkpoint.tensors[source] = checkpoint.tensors[shared] if shared in expected else checkpoint.tensors.pop(shared)
            checkpoint.notes.append("{}: stored once, as {}".format(source, shared))
    for source in sorted(set(expected) | set(checkpoint.tensors)):
        entry, shape = checkpoint.tensors.get(source), expected.get(source)
        if shape is None and source in optional:
            _check_dropped(source, entry, optional[source].stored, problems)
        else:
            _check_entry(source, entry, shape, plan, problems)
    dropped: Dict[str, List[str]] = {}
    for source, row in optional.items():
        if source in checkpoint.tensors:
            dropped.setdefault(row.reason, []).append(source)
    return dropped


def _check_dropped(source: str, entry, shape, problems: Problems) -> None:
    """Checks only the shape: a dropped tensor may have any dtype, e.g. an integer counter."""
    if entry.shape != shape:
        problems.add("tensor " + source, str(shape), str(entry.shape))


def _check_entry(source: str, entry, shape, plan: Plan, problems: Problems) -> None:
    where = "tensor " + source
    if entry is None:
        problems.add(where, str(shape), "none")
    elif shape is None:
        why = next((text for prefix, text in plan.hints.items() if source.startswith(prefix)), "no part of this policy reads it")
        problems.add(where, "no such tensor", "{} {}".format(entry.dtype, entry.shape), why)
    elif entry.shape != shape:
        problems.add(where, str(shape), str(entry.shape))
    elif entry.dtype not in WEIGHTS:
        problems.unsupported(where, " or ".join(WEIGHTS), entry.dtype, "save the policy in one of these")


def _choose_dtype(checkpoint: Checkpoint, plan: Plan, wanted: str) -> str:
    """The dtype of the matrices: the wanted one; else the stored dtype if all matrices share it; else f32, which is exact for every stored
    number. For `stored` and mixed types: the narrower dtype; float32 matrices stay float32."""
    if wanted not in ("", STORED):
        return wanted
    stored = Counter(
        "BF16" if weight.in_bf16 else stored_dtype(checkpoint.tensors[weight.source])
        for weight in plan.weights
        if weight.kind in (MATRIX, TABLE) and not weight.keep_f32
    )
    if len(stored) == 1:
        return BUNDLE_NAME[next(iter(stored))]
    mixed = ", ".join("{} {}".format(count, name) for name, count in sorted(stored.items()))
    narrower = [BUNDLE_NAME[name] for name in stored if name != "F32"]
    if wanted == STORED and len(narrower) == 1:
        return narrower[0]
    if wanted == STORED:
        raise refuse("--dtype stored", "float32 and one narrower type", mixed, "--dtype f32 is exact", Code.UNSUPPORTED)
    checkpoint.notes.append(
        "matrices are stored in mixed types ({}): written as f32, which is exact; so is --dtype stored, which keeps each "
        "type; --dtype bf16 halves the file".format(mixed)
    )
    return "f32"


def _tensor_dtype(weight: Weight, stored: str, dtype: str) -> str:
    if weight.kind == TERNARY:
        return "i8"
    exact = weight.kind not in (MATRIX, TABLE) or (weight.keep_f32 and (stored == "F32" or weight.pixels is not None))
    return "f32" if exact else dtype


def _opener(vla: str, silent: bool, out: str, plan: Plan, summary: Summary) -> Callable[[str], None]:
    """A function that opens the complete file with `vla`. If `vla` cannot, it adds a note, unless `silent`."""
    robots = next((list(key.value) for key in plan.keys if key.name == "embodiments"), [])

    def open_it(part: str) -> None:
        failure = check(vla, part, out, robots) if vla else "there is no vla here"
        if failure and not silent:
            summary.notes.append("not opened by the runtime ({}): vla inspect {} tells whether it runs".format(failure, out))

    return open_it


def _write(
    checkpoint: Checkpoint, plan: Plan, summary: Summary, problems: Problems, progress: Progress, opener: Callable[[str], None]
) -> None:
    keys = _identity_keys(checkpoint, summary) + plan.keys
    tensors = [
        TensorInfo(w.target, w.shape, _tensor_dtype(w, stored_dtype(checkpoint.tensors[w.source]), summary.dtype)) for w in plan.weights
    ]
    tensors += [TensorInfo(name, value.shape, "f64" if value.dtype == np.float64 else "f32") for name, value in plan.statistics.items()]
    total = sum(tensor.n_bytes for tensor in tensors)
    done = 0
    try:
        with BundleWriter(summary.path, keys, tensors, opener) as out:
            for weight, tensor in zip(plan.weights, tensors):
                progress(weight.target, done, total)
                _stream(checkpoint, weight, tensor, out, summary, problems)
                done += tensor.n_bytes
            for name, value in plan.statistics.items():
                out.write(name, value)
            progress("checksum", total, total)
            problems.raise_any()
    except OSError as error:
        raise refuse(summary.path, "a file that can be written", error.strerror or str(error), code=Code.IO)
    summary.n_tensor, summary.n_bytes = len(tensors), out.n_bytes


def _pieces(entry: Entry, weight: Weight) -> Iterator[np.ndarray]:
    """The numbers of one row of the mapping, in the bundle's order, in pieces; a rearranged tensor is a single piece."""
    if weight.first is not None:
        entry = entry.rows(weight.first, weight.shape[0])
    if weight.pick is None and not weight.transpose and not weight.regroup and not weight.axes:
        yield from entry.chunks()
        return
    axis, index = weight.pick or (0, 0)
    if weight.pick and axis == 0:
        entry, index = entry.rows(index, 1), 0
    whole = np.concatenate([*entry.chunks()]).reshape(entry.shape)
    if weight.pick:
        whole = whole.take(index, axis)
    if weight.axes:
        whole = whole.transpose(weight.axes)
    if weight.regroup:
        whole = whole.reshape(*whole.shape[:-1], -1, weight.regroup).swapaxes(-1, -2)
    yield (whole.T if weight.transpose else whole).ravel()


def _stream(checkpoint: Checkpoint, weight: Weight, tensor: TensorInfo, out: BundleWriter, summary: Summary, problems: Problems) -> None:
    entry = checkpoint.tensors[weight.source]
    if weight.kind in (TERNARY, SCALE):
        return _stream_ternary(entry, weight, out, summary, problems)
    finite, overflow = True, False
    pieces, stored = _pieces(entry, weight), entry.dtype
    if weight.batch_norm:
        pieces, stored = iter([batch_norm.folded(entry, weight.batch_norm, checkpoint.tensors)]), "F32"
    if weight.pixels:
        pieces, stored = iter([standardized.folded(entry, weight.pixels, checkpoint.tensors)]), "F32"
    for raw in pieces:
        part = convert(raw, stored, tensor.dtype)
        if weight.in_bf16:
            part = convert(from_f32(to_f32(raw, entry.dtype), "bf16"), "BF16", tensor.dtype)
        finite, overflow = finite and part.finite, overflow or part.overflow
        summary.rounding = max(summary.rounding, (part.error, tensor.name))
        out.write(tensor.name, part.data + np.float32(1) if weight.plus_one else part.data)
    if not finite:
        _not_finite(entry, problems)
    elif overflow:
        problems.add(
            "tensor {} ({})".format(entry.name, tensor.name),
            "numbers that {} can hold".format(tensor.dtype),
            "larger ones",
            "use --dtype " + ("bf16 or f32" if tensor.dtype == "f16" else "f32"),
            Code.UNSUPPORTED,
        )


def _stream_ternary(entry: Entry, weight: Weight, out: BundleWriter, summary: Summary, problems: Problems) -> None:
    found = quantize_ternary(entry)
    if weight.kind == TERNARY:
        out.write(weight.target, found.codes)
        summary.ternary = min(summary.ternary, (found.margin, weight.target))
        return
    out.write(weight.target, found.scale)
    if not np.isfinite(found.scale).all():
        _not_finite(entry, problems)


def _not_finite(entry: Entry, problems: Problems) -> None:
    hint = "the training run diverged or the file is damaged"
    problems.add("tensor " + entry.name, "finite numbers", "NaN or infinity", hint)


def _identity_keys(checkpoint: Checkpoint, summary: Summary) -> List[Key]:
    return [
        Key("general.architecture", "string", "vla"),
        Key("vla.arch", "string", summary.arch),
        Key("vla.bundle_version", "u32", BUNDLE_VERSION),
        Key("vla.dtype", "string", summary.dtype),
        Key("vla.source.name", "string", checkpoint.name),
        Key("vla.source.revision", "string", checkpoint.revision),
        Key("vla.source.converter", "string", "vla-cpp " + __version__),
        *([Key("vla.source.backbone", "string", checkpoint.backbone)] if checkpoint.backbone else []),
        *([Key("vla.degraded", "string[]", checkpoint.degraded)] if checkpoint.degraded else []),
    ]
