# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Plays recorded robot episodes through the C++ runtime and compares every action chunk with PyTorch's.

    python play.py --vla build/cpu/bin/vla
    python play.py --vla build/cpu/bin/vla --task faucet-open --text "close the faucet"      # another sentence

For each look at the scene it calls `vla run` with the picture, the robot's state, the sentence and the recorded noise,
and shows the picture, the predicted actions, the scripted expert's, the time and the largest difference to the chunk that
PyTorch computed in float32.  It ends with a verdict (exit code 0: every chunk matches) and a picture of each episode.

Actions: dx, dy, dz of the hand in hundredths of a metre per step of 12.5 ms; gripper: effort, positive closes.
"""
import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, Dict, List, Optional, Tuple

try:
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont
    from rich.columns import Columns
    from rich.console import Console, Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text
except ImportError as e:
    raise SystemExit(f"{e}. The demo needs three packages: pip install numpy pillow rich")

import runtime

HERE = Path(__file__).resolve().parent


# ---- reading and running -------------------------------------------------------------------------------------------


def read_episode(folder: Path) -> Dict[str, Any]:
    """episode.json with `expected` and `expert`, both (n, 16, 4) float32, and `folder` added."""
    try:
        episode = json.loads((folder / "episode.json").read_text())
        expected, expert = np.load(str(folder / "expected.npy")), np.load(str(folder / "expert.npy"))
    except OSError as e:
        raise SystemExit(f"{folder} is not a complete episode: {e}. Make episodes with record.py.")
    episode.update(expected=expected, expert=expert, folder=folder)
    return episode


def answer(vla: str, bundle: Path, episode: Dict[str, Any], i: int, text: str, threads: int) -> Dict[str, Any]:
    """The runtime's answer to look i, with `difference` (to PyTorch's chunk) and `wall_ms` (of the whole process) added."""
    look = episode["looks"][i]
    begin = time.perf_counter()
    frame, noise = episode["folder"] / look["frame"], episode["folder"] / look["noise"]
    got = runtime.run(vla, bundle, frame, np.asarray(look["state"], np.float32), text, noise, threads)
    got["wall_ms"] = 1e3 * (time.perf_counter() - begin)
    expected = episode["expected"][i]
    if got["actions"].shape != expected.shape:
        raise SystemExit(f"the bundle predicts {got['actions'].shape} actions, the episode holds {expected.shape}: "
                         "this is not the bundle of the checkpoint that recorded the episodes")
    difference = np.abs(got["actions"] - expected)
    got["difference"] = float(difference.max()) if np.isfinite(difference).all() else float("inf")
    return got


def compute_ms(got: Dict[str, Any]) -> float:
    """Milliseconds from picture, state and sentence to the chunk: all stages but the loading of the bundle."""
    return float(sum(v for stage, v in got["timing_ms"].items() if stage != "load"))


# ---- the terminal --------------------------------------------------------------------------------------------------


def half_blocks(path: Path, columns: int) -> Text:
    """The picture in colour: each character shows two pixels, one above the other."""
    pixels = np.asarray(Image.open(str(path)).convert("RGB").resize((columns, columns), Image.BICUBIC))
    text = Text()
    for y in range(0, columns - 1, 2):
        for above, below in zip(pixels[y], pixels[y + 1]):
            text.append("\u2580", style="rgb({},{},{}) on rgb({},{},{})".format(*above, *below))
        text.append("\n")
    text.rstrip()
    return text


def bar(value: float, width: int = 13) -> Text:
    """A value in [-1, 1] as a bar from the middle."""
    middle, at = width // 2, int(round(max(-1.0, min(1.0, value)) * (width // 2)))
    cells = ["\u2500"] * width
    for i in range(min(middle, middle + at), max(middle, middle + at) + 1):
        cells[i] = "\u2501"
    cells[middle] = "\u253c"
    return Text("".join(cells), style="green" if at > 0 else "magenta" if at < 0 else "dim")


def show(console: Console, episode: Dict[str, Any], i: int, got: Dict[str, Any], text: str, tolerance: Optional[float]) -> Panel:
    """One look: picture, sentence, actions beside the expert's, time and difference."""
    look, names = episode["looks"][i], episode["action_names"]
    table = Table(box=None, padding=(0, 1), header_style="dim")
    table.add_column("step", justify="right", style="dim")
    for name in names:
        table.add_column(name, justify="right")
        table.add_column("expert", justify="right", style="dim")
    for k in range(episode["execute"]):
        cells = [str(look["step"] + k)]
        for j in range(len(names)):
            cells += [f"{got['actions'][k, j]:+.2f}", f"{episode['expert'][i][k, j]:+.2f}"]
        table.add_row(*cells)
    move = Table(box=None, padding=(0, 1), show_header=False)
    for name, value in zip(names, got["actions"][: episode["execute"]].mean(axis=0)):
        move.add_row(Text(name, style="dim"), bar(float(value)), f"{value:+.2f}")
    state = ", ".join(f"{n} {v:.3f}" for n, v in zip(episode["state_names"], look["state"]))
    good = tolerance is None or got["difference"] <= tolerance
    facts = Text.assemble(
        ("state ", "dim"), state, "\n",
        ("chunk ", "dim"), (f"{compute_ms(got):.1f} ms", "bold"), f" ({got['wall_ms']:.0f} ms with starting the process and loading the bundle)\n",
        ("largest difference to PyTorch ", "dim"), (f"{got['difference']:.1e}", "bold green" if good else "bold red"),
        "" if tolerance is not None else "  (recorded with the other sentence)" if text != episode["sentence"] else "")
    body: Any = Group(Text(f"\u201c{text}\u201d", style="bold yellow"), "", table, "", "mean of the executed steps", move, "", facts)
    n = len(episode["looks"])
    title = f"{episode['task']}  look {i + 1} of {n}"
    if console.is_terminal and console.color_system:
        beside = console.width >= 120
        picture = half_blocks(episode["folder"] / look["frame"], min(48, console.width - 86) if beside else min(64, console.width - 4))
        body = Columns([picture, body], padding=(0, 2)) if beside else Group(picture, body)
    return Panel(body, title=title, title_align="left")


# ---- the picture ---------------------------------------------------------------------------------------------------

INK, FAINT, GRID, PAPER = (32, 36, 44), (122, 130, 142), (226, 229, 234), (255, 255, 255)
OURS, EXPERT, GOLDEN, GOOD, BAD = (19, 98, 196), (240, 140, 50), (10, 14, 20), (20, 130, 70), (200, 40, 40)
SCALE = 2  # drawn at twice the size, then reduced: smooth lines


class Sheet:
    """A canvas in final pixels."""

    def __init__(self, width: int, height: int) -> None:
        self.image = Image.new("RGB", (width * SCALE, height * SCALE), PAPER)
        self.draw = ImageDraw.Draw(self.image)

    def font(self, size: int) -> Any:
        try:
            return ImageFont.load_default(size=size * SCALE)
        except TypeError:  # Pillow before 10.1 has one small bitmap font only
            return ImageFont.load_default()

    def text(self, x: float, y: float, text: str, size: int = 13, fill: Tuple[int, int, int] = INK, anchor: str = "la") -> None:
        font = self.font(size)
        options = {"anchor": anchor} if hasattr(font, "getmask2") else {}
        self.draw.text((x * SCALE, y * SCALE), text, font=font, fill=fill, **options)

    def width(self, text: str, size: int) -> float:
        """Width of the text in final pixels."""
        font = self.font(size)
        return font.getlength(text) / SCALE if hasattr(font, "getlength") else 6.0 * len(text) / SCALE

    def line(self, points: List[Tuple[float, float]], fill: Tuple[int, int, int], width: float = 1.0) -> None:
        self.draw.line([(x * SCALE, y * SCALE) for x, y in points], fill=fill, width=max(1, int(width * SCALE)), joint="curve")

    def box(self, x0: float, y0: float, x1: float, y1: float, fill: Tuple[int, int, int]) -> None:
        self.draw.rectangle((x0 * SCALE, y0 * SCALE, x1 * SCALE, y1 * SCALE), fill=fill)

    def ring(self, x: float, y: float, r: float, outline: Tuple[int, int, int]) -> None:
        self.draw.ellipse(((x - r) * SCALE, (y - r) * SCALE, (x + r) * SCALE, (y + r) * SCALE), outline=outline, width=SCALE)

    def paste(self, path: Path, x: float, y: float, size: float) -> None:
        side = int(size * SCALE)
        self.image.paste(Image.open(str(path)).convert("RGB").resize((side, side), Image.LANCZOS), (int(x * SCALE), int(y * SCALE)))

    def save(self, path: Path) -> None:
        w, h = self.image.size
        self.image.resize((w // SCALE, h // SCALE), Image.LANCZOS).save(str(path), optimize=True)


def lighter(colour: Tuple[int, int, int], share: float) -> Tuple[int, int, int]:
    """The colour mixed with this share of white."""
    r, g, b = (int(c + (255 - c) * share) for c in colour)
    return (r, g, b)


def draw_episode(episode: Dict[str, Any], got: List[Dict[str, Any]], text: str, tolerance: Optional[float], path: Path) -> None:
    """Pictures on top, then one panel per action dimension along the steps, then time and difference per chunk."""
    n, execute, horizon, names = len(got), episode["execute"], episode["horizon"], episode["action_names"]
    wide = max(112, min(168, 1440 // n))  # pixels of one look, that is of `execute` steps
    left, right, top, tall, gap = 84, 30, 78, 104, 14
    width, curves = left + n * wide + right, top + wide + 30
    below = curves + len(names) * (tall + gap) + 14
    sheet = Sheet(max(width, 900), below + 128)

    sheet.text(left, 14, f"\u201c{text}\u201d", 22)
    worst, other = max(g["difference"] for g in got), text != episode["sentence"]
    verdict = f"largest difference to PyTorch {worst:.1e}" + (", which was told something else" if other else "")
    colour = INK if tolerance is None else GOOD if worst <= tolerance else BAD
    solved = f"{episode['task']}, unseen layout (seed {episode['seed']}), solved after {episode['solved_after_steps']} steps"
    sheet.text(left, 46, solved, 13, FAINT)
    sheet.text(left + sheet.width(solved, 13) + 18, 46, verdict, 13, colour)

    x_of = lambda step: left + (step / execute) * wide + wide / execute / 2  # noqa: E731  the middle of a step's cell
    for i, look in enumerate(episode["looks"][:n]):
        x = left + i * wide
        sheet.paste(episode["folder"] / look["frame"], x + 2, top, wide - 4)
        sheet.text(x + 4, top + wide, f"step {look['step']}, {look['step'] * episode['ms_per_step'] / 1e3:.1f} s", 11, FAINT)

    end = n * execute
    for j, name in enumerate(names):
        y0 = curves + j * (tall + gap)
        y_of = lambda v, y0=y0: y0 + tall / 2 - max(-1.25, min(1.25, float(v))) * tall / 2.5  # noqa: E731
        for v in (-1, 0, 1):
            sheet.line([(left, y_of(v)), (left + n * wide, y_of(v))], GRID, 1)
            sheet.text(left - 8, y_of(v), f"{v:+d}" if v else "0", 10, FAINT, "rm")
        for i in range(n + 1):
            sheet.line([(left + i * wide, y0), (left + i * wide, y0 + tall)], GRID, 1)
        sheet.text(16, y0 + tall / 2, name, 13, INK, "lm")
        for i in range(n):  # first what was predicted but replaced by the next look, so that it lies beneath
            start = episode["looks"][i]["step"]
            tail = [(x_of(start + k), y_of(got[i]["actions"][k, j])) for k in range(execute - 1, horizon) if start + k < end]
            if len(tail) > 1:
                sheet.line(tail, lighter(OURS, 0.72), 1.2)
        for i in range(n):
            start, steps = episode["looks"][i]["step"], range(execute)
            sheet.line([(x_of(start + k), y_of(episode["expert"][i][k, j])) for k in steps], EXPERT, 1.6)
            sheet.line([(x_of(start + k), y_of(got[i]["actions"][k, j])) for k in steps], OURS, 2)
            for k in steps:
                sheet.ring(x_of(start + k), y_of(episode["expected"][i][k, j]), 2.6, GOLDEN)

    peak = max(max(compute_ms(g) for g in got), 1e-9)
    sheet.text(16, below + 22, "ms", 13, INK, "lm")
    sheet.text(16, below + 70, "max diff", 13, INK, "lm")
    for i, g in enumerate(got):
        x, high = left + i * wide, 34 * compute_ms(g) / peak
        sheet.box(x + 14, below + 40 - high, x + wide - 14, below + 40, lighter(OURS, 0.55))
        sheet.text(x + wide / 2, below + 50, f"{compute_ms(g):.1f} ms", 11, INK, "mm")
        good = tolerance is None or g["difference"] <= tolerance
        sheet.text(x + wide / 2, below + 70, f"{g['difference']:.1e}", 11, INK if tolerance is None else GOOD if good else BAD, "mm")

    x, y = left, below + 104
    ours, asked = ("steps a robot would execute", f", \u201c{episode['sentence']}\u201d") if other else ("executed", "")
    for colour, label in ((OURS, f"vla.cpp, {ours}"), (lighter(OURS, 0.72), "replaced by the next look"), (EXPERT, f"scripted expert from the same state{asked}")):
        sheet.line([(x, y), (x + 26, y)], colour, 2.4)
        sheet.text(x + 34, y, label, 12, INK, "lm")
        x += 60 + sheet.width(label, 12)
    sheet.ring(x + 8, y, 3, GOLDEN)
    sheet.text(x + 20, y, f"PyTorch float32{asked}", 12, INK, "lm")
    sheet.save(path)


# ---- the demo ------------------------------------------------------------------------------------------------------


def main() -> int:
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--bundle", type=Path, default=HERE.parent.parent / "models" / "metaworld-tiny.gguf", metavar="FILE", help="the policy (default: the shipped models/metaworld-tiny.gguf)")
    ap.add_argument("--vla", default="vla", metavar="FILE", help="the runtime's binary (default: vla from the PATH)")
    ap.add_argument("--episodes", type=Path, default=HERE / "episodes", metavar="DIR", help="recorded by record.py (default: the ones beside this file)")
    ap.add_argument("--task", action="append", help="play only this episode; may be given again (default: all)")
    ap.add_argument("--text", help="say this instead of the recorded sentence; there is then nothing to match, and no verdict")
    ap.add_argument("--tolerance", type=float, default=1e-4, help="largest allowed difference to PyTorch's chunk, in action units (default 1e-4)")
    ap.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="where the pictures go (default out/demo)")
    ap.add_argument("--threads", type=int, default=1, help="of the runtime; 0 takes every core (default 1, enough for so small a policy)")
    ap.add_argument("--pause", type=float, default=0.0, metavar="SECONDS", help="wait after each look, to watch")
    a = ap.parse_args()

    console = Console()
    if not a.bundle.exists():
        raise SystemExit(f"no bundle at {a.bundle}. README.md beside {Path(__file__).name} says how to make it.")
    found = sorted(p.parent.name for p in a.episodes.glob("*/episode.json"))
    tasks = a.task or found
    if not found or not set(tasks) <= set(found):
        raise SystemExit(f"no such episode in {a.episodes}; there are: {', '.join(found) or 'none (make them with record.py)'}")
    a.out.mkdir(parents=True, exist_ok=True)

    tolerance = None if a.text else a.tolerance
    summary = Table("episode", "sentence", "chunks", "median ms", "largest difference", "", box=None, header_style="dim")
    matched, total, times, paths = 0, 0, [], []
    for task in tasks:
        episode = read_episode(a.episodes / task)
        text, got = a.text or episode["sentence"], []
        for i in range(len(episode["looks"])):
            if not console.is_terminal:
                print(f"{task} {i + 1}/{len(episode['looks'])}", flush=True)
            got.append(answer(a.vla, a.bundle, episode, i, text, a.threads))
            if console.is_terminal or i == 0:  # a log needs one panel per episode, a person wants to watch
                console.print(show(console, episode, i, got[-1], text, tolerance))
            time.sleep(a.pause)
        path = a.out / (f"{task}-other-sentence.png" if a.text else f"{task}.png")
        paths.append(str(path))
        draw_episode(episode, got, text, tolerance, path)
        worst, ms = max(g["difference"] for g in got), [compute_ms(g) for g in got]
        good = sum(g["difference"] <= a.tolerance for g in got)
        matched, total, times = matched + good, total + len(got), times + ms
        verdict = "" if tolerance is None else "[green]matches[/]" if good == len(got) else f"[red]{len(got) - good} differ[/]"
        summary.add_row(task, text, str(len(got)), f"{np.median(ms):.1f}", f"{worst:.1e}", verdict)

    console.print()
    console.print(summary)
    console.print(f"\nPictures: {', '.join(paths)}", soft_wrap=True, highlight=False)
    if tolerance is None:
        console.print(f"Another sentence was asked for, so the differences to the recorded chunks are its effect. Median {np.median(times):.1f} ms per chunk.")
        return 0
    ok = matched == total
    console.print(f"[bold {'green' if ok else 'red'}]{matched} of {total} chunks match PyTorch float32 within {a.tolerance:g}[/], "
                  f"median {np.median(times):.1f} ms per chunk of 16 actions.", soft_wrap=True)
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
