# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Films of episodes: what the camera saw, what was said, what was predicted, and how long that took. Needs Pillow."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Callable, List, Optional, Sequence, Tuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..output import whole_file
from .episode import Look, Outcome, Watcher

INK, FAINT, GRID, PAPER = (32, 36, 44), (122, 130, 142), (226, 229, 234), (255, 255, 255)
BLUE, PALE, GOOD, BAD = (19, 98, 196), (186, 209, 239), (20, 130, 70), (200, 40, 40)
CURVES = [(19, 98, 196), (224, 123, 31), (20, 130, 70), (150, 60, 160), (200, 40, 40), (90, 90, 90), (0, 150, 160), (160, 120, 0)]
WIDTH, HEIGHT, PICTURE = 960, 480, 400
EVERY = 2  # steps between two frames of a film
HOLD = 0.7  # seconds that the end of a scene stays


@dataclass
class Shot:
    """A moment of an episode: the frame then, and the chunk that was being executed."""

    step: int
    frame: np.ndarray
    look: Look


@dataclass
class Recorder:
    """Collects an episode for a film. `grab` returns a picture of it now."""

    grab: Callable[[], np.ndarray]
    shots: List[Shot] = field(default_factory=list)
    looks: List[Look] = field(default_factory=list)

    def watcher(self) -> Watcher:
        return Watcher(on_look=self.looks.append, on_step=self._on_step)

    def _on_step(self, step: int) -> None:
        look = self.looks[-1]
        if (step - look.step) % EVERY == 0:
            self.shots.append(Shot(step, self.grab(), look))

    def finish(self, steps: int) -> None:
        """How it ended."""
        self.shots.append(Shot(steps, self.grab(), self.looks[-1]))


@dataclass
class Scene:
    """An episode with what was recorded of it."""

    recorder: Recorder
    outcome: Outcome
    names: Sequence[str]
    title: str

    def page(self, shot: Shot, times: bool = True) -> Image.Image:
        end = shot is self.recorder.shots[-1]
        return draw_frame(shot, self.recorder.looks, self.outcome, self.names, self.title, end, times)


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
    apart = min(92, (x1 - x0 - 8) // d_action)  # pixels from one name to the next
    for j in range(d_action):
        colour = CURVES[j % len(CURVES)]
        draw.line([(at(k), up(actions[k, j])) for k in range(horizon)], fill=colour, width=2)
        draw.text((x0 + 8 + apart * j, y1 + 6), names[j][: apart // 7], font=_font(12), fill=colour)
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


def draw_frame(shot: Shot, looks: Sequence[Look], outcome: Outcome, names: Sequence[str], title: str, end: bool, times: bool) -> Image.Image:
    """One image of the film, 960 x 480. `times`: with those of the looks, which are this machine's."""
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
    if not times:
        return page
    draw.text((right, 340), "inference per look, ms", font=_font(12), fill=FAINT)
    most = max(look.answer.engine_ms for look in looks)
    _latencies(draw, (right, 356, WIDTH - 24, 444), looks, shot.step, most, len(looks))
    return page


def film(scenes: Sequence[Scene], path: Path, rate_hz: float, gif: bool = False) -> Path:
    """Writes PATH.mp4 where a video encoder is installed (imageio-ffmpeg), else PATH.gif, at half the robot's speed; returns
    which. `gif`: PATH.gif too, of a third of the pictures and without times, for pages that play no video."""
    fps = max(5.0, rate_hz / EVERY / 2)
    shots = [(scene, shot) for scene in scenes for shot in scene.recorder.shots + scene.recorder.shots[-1:] * int(HOLD * fps)]
    if gif:
        _gif([scene.page(shot, times=False) for scene, shot in shots[::3]], path.with_suffix(".gif"), fps / 3)
    pages = [scene.page(shot) for scene, shot in shots]
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
    """All pictures share a palette, with the colours of curves in it, so that what stands still costs nothing."""
    small = [page.resize((WIDTH * 2 // 3, HEIGHT * 2 // 3), Image.LANCZOS) for page in pages]
    sample = Image.new("RGB", (small[0].width, 6 * small[0].height))
    for i in range(5):
        sample.paste(small[i * (len(small) - 1) // 4], (0, i * small[0].height))
    for i, colour in enumerate(CURVES):
        sample.paste(colour, (40 * i, 5 * small[0].height, 40 * i + 40, sample.height))
    palette = sample.quantize(96)
    drawn = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in small]
    with whole_file(path) as file:
        drawn[0].save(file, "GIF", save_all=True, append_images=drawn[1:], duration=int(1000 / fps), loop=0, optimize=True)
    return path


def contact_sheet(scene: Scene, path: Path, columns: int = 3) -> None:
    """The looks of an episode on one page, as PNG: at most nine, evenly spread, and the end."""
    shots = [shot for shot in scene.recorder.shots[:-1] if shot.step == shot.look.step]
    if len(shots) > 8:
        shots = [shots[round(i * (len(shots) - 1) / 7)] for i in range(8)]
    shots.append(scene.recorder.shots[-1])
    rows = -(-len(shots) // columns)
    wide, high = 2 * WIDTH // 3, 2 * HEIGHT // 3
    page = Image.new("RGB", (columns * wide, rows * high), PAPER)
    for i, shot in enumerate(shots):
        page.paste(scene.page(shot).resize((wide, high), Image.LANCZOS), ((i % columns) * wide, (i // columns) * high))
    with whole_file(path) as file:
        page.save(file, "PNG", optimize=True)
