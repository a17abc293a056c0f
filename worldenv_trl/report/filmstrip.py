"""A film strip: what was seen and imagined every few steps, and below it, on the same axis, the reflector's curve."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from html import escape

import torch
from torch import Tensor

from worldenv_trl.report.evidence import Clip
from worldenv_trl.report.svg import path_of
from worldenv_trl.report.video import image_uri, side_by_side, video_uri

__all__ = ["clip_card", "strip_svg"]

_LEFT, _WIDTH, _FRAME, _CURVE = 84, 1036, 96, 110
FPS = 10


def clip_card(clip: Clip, number: int, every: int = 8) -> str:
    """An article with the video of both worlds, the strip, and what happens when; ``every`` steps a frame."""
    length = len(clip.real_frames) - 1
    uri = video_uri(side_by_side(clip.real_frames, clip.imagined_frames), fps=FPS, scale=3)
    values = {
        "real": _rounded(clip.real_scores),
        "imagined": _rounded(clip.imagined_scores),
        "gripper": _rounded(clip.gripper),
        "psnr": _rounded(clip.moving_psnr, 1),
    }
    title = escape(f"{clip.task}, context {clip.context_id}")
    steps = "".join(
        f'<li><button type="button" data-step="{step}">{step}</button> {escape(words)}</li>'
        for step, words in clip.events()
    )
    return f"""
<article class="clip" id="clip-{number}" data-fps="{FPS}" data-last="{length}" data-values='{json.dumps(values)}'>
<header><h4>{escape(clip.task)}</h4><p class="meta">{escape(clip.policy)} · context {clip.context_id}</p></header>
<div class="clip-body">
<figure class="player">
<video src="{uri}" muted loop playsinline controls preload="auto"
aria-label="{title}: physics left, imagination right"></video>
<figcaption><span class="key real">physics</span><span class="key imagined">imagination</span></figcaption>
</figure>
<div class="side">
<ol class="events" aria-label="what happens at which step">{steps}</ol>
<div class="transport" hidden><button type="button" class="play" aria-label="play">▶</button>
<input type="range" min="0" max="{length}" value="0" aria-label="step of {title}"></div>
<p class="readout">step 0</p>
</div>
</div>
<div class="scroll" tabindex="0" role="group" aria-label="film strip of {title}">{strip_svg(clip, number, every)}</div>
</article>"""


def strip_svg(clip: Clip, number: int, every: int = 8) -> str:
    """Two rows of frames (physics, imagination), each above its step, and R on both over the threshold.

    ``number`` names the clip on its page. Several cameras stand one above the other.
    """
    steps = len(clip.real_frames) - 1
    shown = list(range(0, steps + 1, every))
    x0, x1 = _LEFT + _FRAME / 2, _WIDTH - 12 - _FRAME / 2
    tall = clip.real_frames.shape[-2] / clip.real_frames.shape[-1]
    top = 2 * (tall * _FRAME + 4) + 22
    height = top + _CURVE + 42

    def px(step: float) -> float:
        return x0 + step / steps * (x1 - x0)

    def py(value: float) -> float:
        return top + (1 - value) * _CURVE

    out = [f'<svg class="strip" viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escape(clip.story())}" '
           f'data-x0="{px(0):.2f}" data-x1="{px(steps):.2f}">']  # fmt: skip
    size = min(_FRAME, (x1 - x0) / max(1, len(shown) - 1) - 3)
    for row, (name, colour, frames) in enumerate(
        (("physics", "real", clip.real_frames), ("imagined", "imagined", clip.imagined_frames))
    ):
        y = row * (tall * _FRAME + 4) + tall * (_FRAME - size) / 2
        out.append(f'<text class="value {colour}" x="{x0 - size / 2 - 8:.1f}" y="{y + tall * size / 2 + 4:.1f}" '
                   f'text-anchor="end">{name}</text>')  # fmt: skip
        sheet = image_uri(torch.cat(list(frames[shown]), -1))  # one image for the row, cut by the view box below
        image = (
            f'<image id="{name}-{number}" href="{sheet}" width="{len(shown)}" height="1" preserveAspectRatio="none"/>'
        )
        use = f'<use href="#{name}-{number}"/>'
        for index, step in enumerate(shown):
            out.append(
                f'<svg x="{px(step) - size / 2:.1f}" y="{y:.1f}" width="{size:.1f}" height="{tall * size:.1f}" '
                f'viewBox="{index} 0 1 1" preserveAspectRatio="none">'
                f"{use if index else image}</svg>"
            )
    for value in (0, 0.5, 1):
        out.append(f'<line class="grid" x1="{x0}" x2="{x1}" y1="{py(value)}" y2="{py(value)}"/>')
        out.append(f'<text class="tick" x="{x0 - 7}" y="{py(value) + 4}" text-anchor="end">{value:g}</text>')
    for step in shown:
        out.append(f'<text class="tick" x="{px(step):.1f}" y="{top + _CURVE + 16}" text-anchor="middle">{step}</text>')
    out.append(f'<text class="axis" x="{x0 - 34}" y="{py(0.5) + 4}" text-anchor="end">R</text>')
    out.append(f'<text class="axis" x="{(x0 + x1) / 2}" y="{height - 4}" text-anchor="middle">env step (20 Hz)</text>')
    out.append(f'<line class="threshold" x1="{x0}" x2="{x1}" y1="{py(clip.threshold)}" y2="{py(clip.threshold)}"/>')
    out.append(f'<text class="axis" x="{x1 + 4}" y="{py(clip.threshold) + 4:.1f}">stop</text>')
    for name, colour, values in (
        ("gripper opening", "plain thin", clip.gripper),
        ("R on real frames", "real", clip.real_scores),
        ("R on imagined frames", "imagined", clip.imagined_scores),
    ):
        points = [(px(step), py(float(value))) for step, value in enumerate(values)]
        out.append(f'<path class="line {colour}" d="{path_of(points)}"><title>{name}</title></path>')
    out += _events(clip, px, top)
    out.append(f'<line class="cursor" x1="{px(0)}" x2="{px(0)}" y1="0" y2="{top + _CURVE}"/>')
    return "".join([*out, "</svg>"])


def _events(clip: Clip, px: Callable[[float], float], top: float) -> list[str]:
    """Marks of what happens: the goal, the stop, where the videos part; words that would overlap share a line less."""
    events = [
        (clip.reached, "goal", "good"),
        (clip.imagined_stop, "stop", "imagined"),
        (clip.parting, "parts", "bad"),
    ]
    out: list[str] = []
    taken: list[float] = []
    for step, words, colour in sorted(event for event in events if event[0] >= 0):
        x = px(step)
        level = 0 if all(abs(x - other) > 66 for other in taken) else 1
        x_text = x + (4 if level == 0 else -4)
        anchor = "start" if level == 0 else "end"
        taken.append(x)
        out.append(f'<line class="event {colour}" x1="{x:.1f}" x2="{x:.1f}" y1="{top - 14}" y2="{top + _CURVE}"/>')
        out.append(f'<text class="value {colour}" x="{x_text:.1f}" y="{top - 5}" text-anchor="{anchor}">'
                   f'{words} {step}</text>')  # fmt: skip
    return out


def _rounded(values: Tensor, digits: int = 2) -> list[float | None]:
    return [round(value, digits) if math.isfinite(value) else None for value in values.tolist()]
