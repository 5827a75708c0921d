# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""How far the actions move with the number of solver steps, and with the wrong rows of the position table.

    python solver_steps.py --checkpoint checkpoint --vla ../../build/cpu/bin/vla --out out/solver_steps

For each number of steps T the recorded looks of episodes/ are predicted by PyTorch in float32 and by the runtime, with the
same noise. The runtime runs bundles of the same checkpoint that differ in vision.position_rule alone (docs/bundle.md): the one
that matches the reference, and the others. Two distances come out, as root mean square over all actions of all looks:
  to PyTorch at the same T      what the rule costs: rounding alone where it matches
  to PyTorch at the most steps  what stopping early costs
Writes table.md, table.json and a plot.
"""
import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Dict, List

from vla_cpp.eval import lerobot_reference as reference  # before lerobot
import numpy as np
from PIL import Image

from sim import CAMERA

import runtime

HERE = Path(__file__).resolve().parent
RULES = ("float32", "bfloat16", "shifted")


def read_looks(folder: Path) -> List[Dict[str, Any]]:
    """Every recorded look: frame file, state (4,), sentence, noise file."""
    looks = []
    for path in sorted(folder.glob("*/episode.json")):
        episode = json.loads(path.read_text())
        looks += [
            {"frame": path.parent / look["frame"], "noise": path.parent / look["noise"],
             "state": np.asarray(look["state"], np.float32), "text": episode["sentence"]}
            for look in episode["looks"]
        ]  # fmt: skip
    return looks


def pytorch(checkpoint: Path, looks: List[Dict[str, Any]], steps: int) -> np.ndarray:
    policy, before, after = reference.load(checkpoint)
    policy.config.num_steps = steps
    policy.model.config.num_steps = steps
    chunks = []
    for look in looks:
        frame = np.asarray(Image.open(look["frame"]).convert("RGB"))
        state = {"observation.state": look["state"]}
        chunks.append(reference.predict(policy, before, after, {CAMERA: frame}, state, look["text"], np.load(look["noise"])))
    return np.stack(chunks)


def make_bundle(checkpoint: Path, steps: int, rule: str, out: Path) -> Path:
    """Converts a copy of the checkpoint whose configuration asks for so many steps."""
    copy = out / f"checkpoint-{steps}"
    if not copy.exists():
        shutil.copytree(str(checkpoint), str(copy))
        config = json.loads((copy / "config.json").read_text())
        config["num_steps"] = steps
        (copy / "config.json").write_text(json.dumps(config))
    bundle = out / f"{rule}-{steps}.gguf"
    command = [sys.executable, "-m", "vla_cpp.convert.cli", str(copy), "-o", str(bundle), "--dtype", "bf16", "--position-precision", rule]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}:\n{done.stderr}")
    return bundle


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference, dtype=np.float64))))


def equal_rules(rows: List[Dict[str, Any]]) -> Dict[str, List[Dict[str, Any]]]:
    """Rows by rule; rules that read the same rows of the table on this grid are one, with both names."""
    groups: Dict[str, List[Dict[str, Any]]] = {}
    for rule in RULES:
        own = [row for row in rows if row["rule"] == rule]
        same = next((name for name, other in groups.items() if [r["to_same"] for r in other] == [r["to_same"] for r in own]), None)
        if same is not None:
            groups[f"{same} and {rule}"] = groups.pop(same)
        else:
            groups[rule] = own
    return groups


def plot(rows: List[Dict[str, Any]], scale: float, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    most = max(row["steps"] for row in rows)
    figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)
    before = [row for row in rows if row["steps"] < most]
    early = [row for row in before if row["rule"] == RULES[0]]
    axes.plot([r["steps"] for r in early], [r["to_most"] for r in early], "D:", color="#7a828e", label=f"stopping early: to PyTorch at T = {most}")
    for (name, own), style in zip(reversed(equal_rules(before).items()), ("^--", "o-", "s-.")):
        colour = {"^": "#e07b1f", "o": "#1362c4", "s": "#14824a"}[style[0]]
        label = f"position rule {name}: to PyTorch at the same T"
        axes.plot([r["steps"] for r in own], [r["to_same"] for r in own], style, color=colour, label=label)
    steps = [row["steps"] for row in early]
    axes.set_xscale("log", base=2)
    axes.set_xticks(steps, [str(t) for t in steps])
    axes.set_yscale("log")
    axes.set_xlabel("solver steps T")
    axes.set_ylabel("displacement of the actions, rms")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e2e5ea", linewidth=0.8)
    figure.suptitle(f"The runtime's actions (rms {scale:.2f}) against PyTorch's", fontsize=10.5, x=0.01, ha="left")
    figure.legend(frameon=False, fontsize=9, loc="outside lower left")
    figure.savefig(str(path), dpi=150)


def main() -> int:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--checkpoint", required=True, type=Path, metavar="DIR", help="of train.py")
    ap.add_argument("--vla", default="vla", metavar="FILE", help="the runtime (default: vla from the PATH)")
    ap.add_argument("--steps", default="1,2,4,8,10,16,32,64", help="solver steps; the largest is the truth that the others are held against (default 1,2,4,8,10,16,32,64)")
    ap.add_argument("--out", type=Path, default=Path("out/solver_steps"), metavar="DIR")
    a = ap.parse_args()
    from rich.progress import track

    a.out.mkdir(parents=True, exist_ok=True)
    all_steps = [int(text) for text in a.steps.split(",")]
    looks = read_looks(HERE / "episodes")
    expected = {steps: pytorch(a.checkpoint, looks, steps) for steps in track(all_steps, description="PyTorch")}
    scale, most = rms(expected[max(all_steps)]), max(all_steps)
    rows: List[Dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for steps in track(all_steps, description="runtime"):
            for rule in RULES:
                bundle = make_bundle(a.checkpoint, steps, rule, Path(folder))
                got = np.stack([runtime.run(a.vla, bundle, x["frame"], x["state"], x["text"], x["noise"], 1)["actions"] for x in looks])
                rows.append({"steps": steps, "rule": rule, "to_same": rms(got - expected[steps]), "to_most": rms(got - expected[most])})
    lines = [f"{len(looks)} looks; the actions themselves have an rms of {scale:.3f}.", "",
             "| T | rule | to PyTorch at the same T | to PyTorch at T = " + f"{most} |", "|---:|---|---:|---:|"]  # fmt: skip
    lines += [f"| {r['steps']} | {r['rule']} | {r['to_same']:.1e} | {r['to_most']:.1e} |" for r in rows]
    (a.out / "table.md").write_text("\n".join(lines) + "\n")
    (a.out / "table.json").write_text(json.dumps({"scale": scale, "rows": rows}, indent=1) + "\n")
    plot(rows, scale, a.out / "solver_steps.png")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
