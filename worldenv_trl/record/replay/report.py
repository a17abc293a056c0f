"""What a replay found, in plain words and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from worldenv_trl.record.mcap.layout import to_bytes

__all__ = ["Divergence", "ReplayReport", "compare", "frame_psnr"]


@dataclass(frozen=True)
class Divergence:
    """The first env step at which a field differs, and by how much (largest absolute difference, its own unit)."""

    step: int
    field: str
    size: float
    detail: str = ""

    def __str__(self) -> str:
        return f"step {self.step}, {self.field}, by up to {self.size:.3g}{f' ({self.detail})' if self.detail else ''}"


@dataclass(frozen=True)
class ReplayReport:
    """What became of a replay.

    ``exact`` is True only if everything was compared with the very models and every compared bit is the same, False if
    something differs, and None where equality is not claimed: a what-if, another model, or another kind of replay.
    ``divergences`` are the first of each field, earliest first. ``psnr`` is the difference curve: dB of each compared
    frame, over the pixels of all cameras, by env step, infinite for equal frames.
    """

    source: Path
    rollout: int
    mode: str
    """``physics`` or ``imagination``."""
    kind: str
    """``exact``, ``difference`` or ``what-if``."""
    exact: bool | None
    first_step: int
    steps: int
    recorded_steps: int
    compared: tuple[str, ...]
    divergences: tuple[Divergence, ...]
    psnr: dict[int, float]
    outcome: dict[str, dict[str, Any]]
    """``recorded`` and ``replayed``: steps, and success or success_prob at the end where known."""
    branch: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    target: Path | None = None

    @property
    def first(self) -> Divergence | None:
        """The first divergence of all."""
        return self.divergences[0] if self.divergences else None

    def to_json(self) -> dict[str, Any]:
        """Plain values; infinite numbers as the text ``inf``."""
        out = asdict(self) | {
            "source": str(self.source.name),
            "target": None if self.target is None else self.target.name,
            "psnr": {str(step): value if math.isfinite(value) else "inf" for step, value in self.psnr.items()},
        }
        return json.loads(json.dumps(out, default=str))

    def __str__(self) -> str:
        name = f"{self.source.name}, rollout {self.rollout}"
        lines = [f"{name}: {self.kind} replay in {self.mode}, steps {self.first_step} to {self.steps}"]
        if self.kind == "what-if":
            lines.append(f"  branch at step {self.branch['step']}: {self.branch['change']}")
        seen = ", ".join(self.compared) or "nothing"
        if self.exact:
            lines.append(f"  bit-exact: {seen} are those of the recording at every step")
        elif self.first is None and self.kind == "what-if":
            lines.append(f"  no difference: the change has no effect on {seen}")
        elif self.first is None:
            lines.append(f"  no difference found in {seen}; equality is not claimed")
        else:
            word = "first difference" if self.exact is None else "DIVERGES first"
            lines.append(f"  {word}: {self.first}")
            lines += [f"  then: {each}" for each in self.divergences[1:]]
        if self.psnr and self.first is not None:
            lines.append(f"  frames: {_curve(self.psnr)}")
        for who in ("recorded", "replayed"):
            if self.outcome.get(who):
                lines.append(f"  {who}: " + ", ".join(f"{k} {_short(v)}" for k, v in self.outcome[who].items()))
        lines += [f"  note: {note}" for note in self.notes]
        if self.target is not None:
            lines.append(f"  written to {self.target}")
        return "\n".join(lines)


def compare(
    recorded: dict[str, tuple[Tensor, Tensor]],
    replayed: dict[str, tuple[Tensor, Tensor]],
    after: int = -1,
    state_parts: Sequence[tuple[str, int]] = (),
) -> tuple[list[Divergence], list[str]]:
    """First divergences of the fields that both show, earliest first, and the fields that were compared.

    Args:
        recorded, replayed: what :func:`~worldenv_trl.record.replay.source.observed` gives.
        after: only steps behind this one.
        state_parts: names and widths of what the physical state is made of.
    """
    found, names = [], []
    for name, (steps, values) in recorded.items():
        if name not in replayed:
            continue
        pairs = _pairs(steps, replayed[name][0], after)
        if not len(pairs):
            continue
        names.append(name)
        left, right = values[pairs[:, 0]], replayed[name][1][pairs[:, 1]]
        if left.shape != right.shape:  # the states of several tasks are padded to the longest
            width = min(left.shape[-1], right.shape[-1])
            left, right = left[..., :width], right[..., :width]
        # Bit patterns: -0 differs from 0 and NaN equals itself.
        differs = torch.from_numpy((to_bytes(left) != to_bytes(right)).any(-1))
        if not bool(differs.any()):
            continue
        place = int(differs.to(torch.uint8).argmax())
        apart = (left[place].double() - right[place].double()).abs()
        detail = f"{int(differs.sum())} of {len(differs)} steps differ"
        if left.ndim == 4:
            changed = int((apart.amax(0) > 0).sum())
            detail = f"of 255, in {changed} of {apart[0].numel()} pixels; {detail}"
        elif name == "sim_state" and state_parts:
            sizes = apart[: sum(width for _, width in state_parts)].split([width for _, width in state_parts])
            moved = {part: float(size.max()) for (part, _), size in zip(state_parts, sizes, strict=True)}
            detail = ", ".join(f"{part} {size:.3g}" for part, size in moved.items() if size) + f"; {detail}"
        found.append(Divergence(int(steps[pairs[place, 0]]), name, float(apart.nan_to_num(math.inf).max()), detail))
    return sorted(found, key=lambda each: each.step), names


def frame_psnr(
    recorded: dict[str, tuple[Tensor, Tensor]], replayed: dict[str, tuple[Tensor, Tensor]]
) -> dict[int, float]:
    """PSNR (dB) of each frame that both show, over the pixels of all their cameras, by env step."""
    from worldenv_trl.metrics import psnr  # metrics may read recordings themselves

    names = [name for name, (_, images) in recorded.items() if images.ndim == 4 and name in replayed]
    names = [name for name in names if recorded[name][1].shape[1:] == replayed[name][1].shape[1:]]
    found = [(_pairs(recorded[name][0], replayed[name][0], -1), name) for name in names]
    found = [(pairs, name) for pairs, name in found if len(pairs) and torch.equal(pairs, found[0][0])]
    if not found:
        return {}
    pairs = found[0][0]
    left = torch.cat([recorded[name][1][pairs[:, 0]] for _, name in found], -2)  # one below the other
    right = torch.cat([replayed[name][1][pairs[:, 1]] for _, name in found], -2)
    steps = recorded[found[0][1]][0][pairs[:, 0]]
    return dict(zip(steps.tolist(), psnr(right, left).tolist(), strict=True))


def _pairs(left: Tensor, right: Tensor, after: int) -> Tensor:
    """Places [n, 2] of the steps that both have."""
    places = {int(step): place for place, step in enumerate(right.tolist())}
    pairs = [(place, places[step]) for place, step in enumerate(left.tolist()) if step in places and step > after]
    return torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)


def _curve(values: dict[int, float]) -> str:
    steps = list(values)
    chosen = sorted({steps[round(place * (len(steps) - 1) / 5)] for place in range(6)})
    return "PSNR " + ", ".join(
        f"{values[step]:.1f} dB at step {step}" if math.isfinite(values[step]) else f"equal at step {step}"
        for step in chosen
    )


def _short(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)
