# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Films of episodes: what the camera saw, what was said, what was predicted, and how long that took. Needs Pillow."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, List, Optional, Sequence, Tuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .episode import Look, Outcome, Watcher

INK, FAINT, GRID, PAPER = (32, 36, 44), (122, 130, 142), (226, 229, 234), (255, 255, 255)
BLUE, PALE, GOOD, BAD = (19, 98, 196), (186, 209, 239), (20, 130, 70), (200, 40, 40)
CURVES = [(19, 98, 196), (224, 123, 31), (20, 130, 70), (150, 60, 160), (200, 40, 40), (90, 90, 90), (0, 150, 160), (160, 120, 0)]
WIDTH, HEIGHT, PICTURE = 960, 480, 400
EVERY = 2  # steps between two frames of a film


@dataclass
class Shot:
    """A moment of an episode: the frame then, and the chunk that was being executed."""

    step: int
    frame: np.ndarray
    look: Look


@dataclass
class Recorder:
    """Collects an episode for a film. `view` names the camera; `grab` returns its frame now."""

    view: str
    grab: Any
    shots: List[Shot] = field(default_factory=list)
    looks: List[Look] = field(default_factory=list)

    def watcher(self) -> Watcher:
        return Watcher(on_look=self.looks.append, on_step=self._on_step)

    def _on_step(self, step: int) -> None:
        look = self.looks[-1]
        if step == look.step:
            self.shots.append(Shot(step, look.observation.frames[self.view], look))
        elif (step - look.step) % EVERY == 0:
            self.shots.append(Shot(step, self.grab(), look))

    def finish(self, steps: int) -> None:
        """The last frame: how it ended."""
        self.shots.append(Shot(steps, self.grab(), self.looks[-1]))


def _font(size: int) -> Any:
    try:
        return ImageFont.load_default(size=size)
    except TypeError:  # Pillow before 10.1 has one small font only
        return ImageFont.load_default()


def _curves(draw: ImageDraw.ImageDraw, box: Tuple[int, int, int, int], look: Look, step: int, names: Sequence[str], executed: int) -> None:
    """The chunk in hand, one line per action; what is past is solid, what will be replaced is pale ground."""
    x0, y0, x1, y1 = box
    actions = look.answer.actions
    horizon, d_action = actions.shape
    reach = 1.06 * max(1.0, float(np.abs(actions).max()))
    at = lambda k: x0 + (x1 - x0) * k / max(1, horizon - 1)  # noqa: E731
    up = lambda v: (y0 + y1) / 2 - (y1 - y0) / 2 * float(v) / reach  # noqa: E731
    draw.rectangle((at(min(executed, horizon) - 1), y0, x1, y1), fill=(246, 247, 249))
    for value in (-1, 0, 1):
        draw.line([(x0, up(value)), (x1, up(value))], fill=GRID)
        draw.text((x0 - 6, up(value)), f"{value:+d}" if value else "0", font=_font(11), fill=FAINT, anchor="rm")
    for j in range(d_action):
        colour = CURVES[j % len(CURVES)]
        draw.line([(at(k), up(actions[k, j])) for k in range(horizon)], fill=colour, width=2)
        draw.text((x0 + 8 + 92 * j, y1 + 6), names[j][:12], font=_font(12), fill=colour)
    now = at(min(max(step - look.step, 0), horizon - 1))
    draw.line([(now, y0), (now, y1)], fill=INK, width=2)


def _latencies(draw: ImageDraw.ImageDraw, box: Tuple[int, int, int, int], looks: Sequence[Look], step: int, most: float, total: int) -> None:
    """A bar per replan so far."""
    x0, y0, x1, y1 = box
    wide = min(34.0, (x1 - x0) / max(1, total))
    for i, look in enumerate(looks):
        if look.step > step:
            break
        high = (y1 - y0 - 16) * look.answer.engine_ms / max(most, 1e-9)
        left = x0 + i * wide
        draw.rectangle((left + 2, y1 - high, left + wide - 2, y1), fill=BLUE if look.step + look.executed > step else PALE)
        draw.text((left + wide / 2, y1 - high - 2), f"{look.answer.engine_ms:.0f}", font=_font(10), fill=INK, anchor="mb")


def draw_frame(shot: Shot, looks: Sequence[Look], outcome: Outcome, names: Sequence[str], title: str, end: bool) -> Image.Image:
    """One image of the film, 960 x 480."""
    page = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
    draw = ImageDraw.Draw(page)
    page.paste(Image.fromarray(shot.frame).resize((PICTURE, PICTURE), Image.BICUBIC), (24, 56))
    draw.text((24, 16), f"“{outcome.sentence}”", font=_font(24), fill=INK)
    draw.text((WIDTH - 24, HEIGHT - 8), title, font=_font(12), fill=FAINT, anchor="rs")
    right = PICTURE + 84
    draw.text((right, 56), f"step {shot.step}, look {looks.index(shot.look) + 1}", font=_font(15), fill=INK)
    if end:
        told = f"solved after {outcome.steps} steps" if outcome.solved else f"not solved in {outcome.steps} steps"
        draw.text((WIDTH - 24, 56), told, font=_font(15), fill=GOOD if outcome.solved else BAD, anchor="ra")
    draw.text((right, 84), "the chunk that is being executed; grey: replaced by the next look", font=_font(12), fill=FAINT)
    _curves(draw, (right, 106, WIDTH - 24, 306), shot.look, shot.step, names, outcome.replan_every)
    draw.text((right, 340), "inference per look, ms", font=_font(12), fill=FAINT)
    most = max(look.answer.engine_ms for look in looks)
    _latencies(draw, (right, 356, WIDTH - 24, 444), looks, shot.step, most, len(looks))
    return page


def film(recorder: Recorder, outcome: Outcome, names: Sequence[str], title: str, path: Path, rate_hz: float) -> Path:
    """Writes PATH.mp4 where a video encoder is installed (imageio-ffmpeg), else PATH.gif, at half the robot's speed; returns
    which."""
    pages = [
        draw_frame(shot, recorder.looks, outcome, names, title, shot is recorder.shots[-1]) for shot in recorder.shots
    ]
    fps = max(5.0, rate_hz / EVERY / 2)
    pages += [pages[-1]] * int(1.5 * fps)
    return _mp4(pages, path.with_suffix(".mp4"), fps) or _gif(pages, path.with_suffix(".gif"), fps)


def _mp4(pages: List[Image.Image], path: Path, fps: float) -> Optional[Path]:
    try:
        import imageio_ffmpeg
    except ImportError:
        return None
    writer = imageio_ffmpeg.write_frames(str(path), (WIDTH, HEIGHT), fps=fps, quality=7, macro_block_size=8)
    writer.send(None)
    for page in pages:
        writer.send(np.asarray(page))
    writer.close()
    return path


def _gif(pages: List[Image.Image], path: Path, fps: float) -> Path:
    small = [page.resize((WIDTH * 2 // 3, HEIGHT * 2 // 3), Image.LANCZOS).convert("P", palette=Image.ADAPTIVE, colors=96) for page in pages]
    small[0].save(str(path), save_all=True, append_images=small[1:], duration=int(1000 / fps), loop=0, optimize=True)
    return path


def contact_sheet(recorder: Recorder, outcome: Outcome, names: Sequence[str], title: str, path: Path, columns: int = 3) -> None:
    """The looks of an episode on one page, as PNG: at most nine, evenly spread, and the end."""
    shots = [shot for shot in recorder.shots[:-1] if shot.step == shot.look.step]
    if len(shots) > 8:
        shots = [shots[round(i * (len(shots) - 1) / 7)] for i in range(8)]
    shots.append(recorder.shots[-1])
    rows = -(-len(shots) // columns)
    wide, high = 2 * WIDTH // 3, 2 * HEIGHT // 3
    page = Image.new("RGB", (columns * wide, rows * high), PAPER)
    for i, shot in enumerate(shots):
        image = draw_frame(shot, recorder.looks, outcome, names, title, shot is recorder.shots[-1])
        page.paste(image.resize((wide, high), Image.LANCZOS), ((i % columns) * wide, (i // columns) * high))
    page.save(str(path), optimize=True)
