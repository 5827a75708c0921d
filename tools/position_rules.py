# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Reference data for the rule that turns a patch into a row of the position table (docs/bundle.md, vision.position_rule).

    python tools/position_rules.py

The reference computes that row in floating point, so precision and release decide which row a patch gets.  This writes
- tests/golden/positions.json: per (grid, table) the row index along one axis, as transformers computes it for float32 and
  for bfloat16 pixels; a patch (r, c) gets row index[r] * table + index[c].  Its boundaries come from torch.arange, whose
  last digits depend on how many numbers the machine computes at once.  Pairs for which that decides an index are listed
  under "machine_dependent" and have no table.
- tests/golden/smolvla/one_view/position_rules.gguf: for each rule the rows of that case, and its chunk for 1 to 16 solver
  steps: how far the wrong rows move the actions.
"""
import json
import sys
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "python"))
from goldens import recorder as golden  # noqa: E402
from goldens.build import make  # noqa: E402

SQUARE = range(1, 65)  # grids that fill their table
PARTIAL = (1, 2, 3, 4, 5, 6, 8, 12, 14, 16, 20, 24, 27, 32)  # grids read from a table of another size
STEPS = (1, 2, 4, 8, 16)
DTYPES = ("float32", "bfloat16")
WIDTHS = (1, 4, 8, 16)  # numbers in a vector of torch's arange


def reference_index(grid, table, dtype):
    """Row index along one axis, out of transformers' own module: patches of one pixel, `table` of them to a side."""
    import torch
    from transformers.models.smolvlm.modeling_smolvlm import SmolVLMVisionConfig, SmolVLMVisionEmbeddings

    config = SmolVLMVisionConfig(hidden_size=1, image_size=table, patch_size=1)
    module, seen = SmolVLMVisionEmbeddings(config).to(getattr(torch, dtype)), []
    module.position_embedding.register_forward_pre_hook(lambda m, ids: seen.append(ids[0][0].view(grid, grid)))
    pixels = torch.zeros(1, 3, grid, grid, dtype=getattr(torch, dtype))
    try:
        module(pixels, torch.ones(1, grid, grid, dtype=torch.bool))
    except IndexError:  # a row beyond the table: the reference itself fails
        return None
    index = seen[0][0]
    assert torch.equal(seen[0], index[:, None] * table + index[None]), "the rule is not the same along both axes"
    return index.tolist()


def boundaries(table, width):
    """torch.arange(1 / table, 1, 1 / table) in float32 on a machine that computes `width` numbers at once (1: one by one).

    A whole pair of vectors starts from a base rounded to float32; what is left over is computed in double, one by one.
    """
    step = 1.0 / table
    out = np.array([step + step * i for i in range(int(np.ceil((1.0 - step) / step)))])
    if width > 1:
        for base in range(0, len(out) - len(out) % (2 * width), width):
            out[base:base + width] = float(np.float32(step + step * base)) + step * np.arange(width)
    return out.astype(np.float32)


def emulated_index(grid, table, dtype, width):
    """The same arithmetic with the boundaries of another machine."""
    import torch

    step = 1.0 / torch.tensor([grid])
    coordinates = torch.clamp(torch.arange(grid, dtype=torch.float32) * step, max=1.0 - 1e-6)
    limits = torch.from_numpy(boundaries(table, width))
    return torch.bucketize(coordinates.to(getattr(torch, dtype)), limits, right=True).tolist()


def axis_tables():
    """Tables that every machine computes alike, and the pairs that it depends on the machine to compute."""
    pairs = sorted({(n, n) for n in SQUARE} | {(n, t) for n in PARTIAL for t in PARTIAL})
    tables, dependent = [], []
    for grid, table in pairs:
        by_width = [[emulated_index(grid, table, d, w) for d in DTYPES] for w in WIDTHS]
        here = [reference_index(grid, table, d) for d in DTYPES]
        inside = [i if max(i) < table else None for i in by_width[0]]
        if any(w != by_width[0] for w in by_width):
            dependent.append([grid, table])
            assert any(here == w for w in by_width), f"{grid} of {table}: no width matches this machine"
        else:
            assert here == inside, f"{grid} of {table}: the arithmetic here is not the reference's"
            tables.append({"grid": grid, "table": table} | dict(zip(DTYPES, here)))
    return tables, dependent


def shifted(grid):
    """The rule of transformers 4.55 in float32: coordinates are scaled by 1 - 1e-6, so each falls below its boundary."""
    import torch

    coordinates = torch.arange(grid, dtype=torch.float32) / grid * (1.0 - 1e-6)
    index = torch.bucketize(coordinates, torch.arange(1 / grid, 1.0, 1 / grid), right=True)
    assert index.tolist() == [max(i - 1, 0) for i in range(grid)]
    return index


def chunks(case, rule_ids):
    """{steps: chunk} in float32 with the given rows, as (horizon, d_action)."""
    import torch

    torch.set_num_threads(1)
    policy, before, _ = golden.load(case / "checkpoint")
    table = policy.model.vlm_with_expert.get_vlm_model().vision_model.embeddings.position_embedding
    table.register_forward_pre_hook(lambda m, ids: rule_ids[None])
    noise, out = torch.from_numpy(np.load(case / "noise.npy"))[None], {}
    for steps in STEPS:
        policy.config.num_steps = steps
        batch = before(golden.read_observation(case))
        out[steps] = policy.predict_action_chunk(batch, noise=noise)[0].numpy()
    return out


def write_rules(case):
    """position_rules.gguf of a case whose grid fills its table."""
    import torch

    policy, _, _ = golden.load(case / "checkpoint")
    grid = policy.model.vlm_with_expert.get_vlm_model().vision_model.embeddings.num_patches_per_side
    axes = {f"bucketize_{d}": torch.tensor(reference_index(grid, grid, d)) for d in DTYPES}
    axes["bucketize_shifted"] = shifted(grid)
    tensors = {}
    results = {rule: chunks(case, (a[:, None] * grid + a[None]).flatten()) for rule, a in axes.items()}
    right = results["bucketize_float32"]
    for rule, a in axes.items():
        tensors[f"{rule}.position_ids"] = (a[:, None] * grid + a[None]).flatten().float().numpy()
        tensors |= {f"{rule}.steps.{steps}.chunk": chunk for steps, chunk in results[rule].items()}
        moved = [np.abs(results[rule][s] - right[s]).max() / np.abs(right[s]).max() for s in STEPS]
        print(rule, "moves the chunk, by steps:", ", ".join(f"{s}: {m:.1e}" for s, m in zip(STEPS, moved)))
    golden.write_taps(case / "position_rules.gguf", tensors, golden__versions=golden.versions())


def main():
    golden.open_reference()
    warnings.filterwarnings("ignore")
    tables, dependent = axis_tables()
    lines = ",\n".join("  " + json.dumps(t, separators=(",", ":")) for t in tables)
    head = f'{{"versions": {json.dumps(golden.versions())},\n "machine_dependent": {json.dumps(dependent)},\n "tables": [\n'
    (ROOT / "tests/golden/positions.json").write_text(head + lines + "\n]}\n")
    square = [t for g, t in dependent if g == t]
    print(f"{len(tables)} tables, {len(dependent)} pairs depend on the machine; square ones: {square}")
    write_rules(make() / "smolvla/one_view")


if __name__ == "__main__":
    main()
