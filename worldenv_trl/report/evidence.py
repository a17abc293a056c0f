"""What a report is made of: the record of a run, and what was measured on its models."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch.nn.functional as F
from torch import Tensor

from worldenv_trl.report.table import read_metrics

__all__ = ["KINDS", "Clip", "Evidence", "RunRecord", "choose_clips", "count_kinds", "machine_versions"]

KINDS = {
    "failure": "The goal is not reached, and imagination agrees",
    "false stop": "Imagination calls it done, the physics does not",
    "missed stop": "The physics reaches the goal, imagination does not see it",
    "success": "Both reach the goal",
}


@dataclass(frozen=True)
class Clip:
    """One episode in both worlds, T steps: the same first frame and the same actions."""

    task: str
    policy: str
    context_id: int
    real_frames: Tensor  # uint8 [T + 1, 3, V H, W], V cameras one above the other
    imagined_frames: Tensor  # uint8 [T + 1, 3, V H, W]
    real_scores: Tensor  # [T + 1], R(o_1:t, g)
    imagined_scores: Tensor  # [T + 1]
    gripper: Tensor  # [T + 1], opening in [0, 1]
    moving_psnr: Tensor  # [T + 1], dB; NaN while nothing has moved
    reached: int  # step at which the physics reaches the goal, -1 if never
    imagined_stop: int  # step at which the reflector stops imagination, -1 if never
    threshold: float  # of the reflector on imagined frames
    late: int = 2  # steps by which the physics may come after the stop

    @property
    def kind(self) -> str:
        if self.imagined_stop < 0:
            return "failure" if self.reached < 0 else "missed stop"
        return "success" if 0 <= self.reached <= self.imagined_stop + self.late else "false stop"

    @property
    def parting(self) -> int:
        """Step from which imagination shows something else; -1 if none before the episode is decided.

        Then the mean colour of some patch, an eighth of the image wide, is off by more than 40 of 255 for three steps
        in a row: less is blur, not another course of events.
        """
        size = max(2, self.real_frames.shape[-1] // 8)
        pooled = [F.avg_pool2d(x.float(), size, stride=size // 2) for x in (self.real_frames, self.imagined_frames)]
        apart = (pooled[0] - pooled[1]).abs().amax((1, 2, 3)) > 40
        decided = max(self.reached, self.imagined_stop)
        apart = apart[: decided + 1] if decided >= 0 else apart
        if len(apart) < 3:
            return -1
        runs = apart.unfold(0, 3, 1).all(1)
        return int(runs.long().argmax()) if bool(runs.any()) else -1

    def events(self) -> list[tuple[int, str]]:
        """What happens when, in order: (step, words)."""
        found = [(step, f"the gripper {words}") for step, words in self._gripper()]
        if self.parting >= 0:
            found.append((self.parting, "imagination parts from the physics"))
        real_peak, peak = (int(scores[1:].argmax()) + 1 for scores in (self.real_scores, self.imagined_scores))
        if self.reached >= 0:
            found.append((self.reached, "the physics reaches the goal"))
        else:
            found.append((real_peak, f"R on real frames peaks at {self.real_scores[real_peak]:.2f}; no goal"))
        if self.imagined_stop >= 0:
            found.append((self.imagined_stop, "the reflector stops imagination"))
        else:
            words = f"R on imagined frames peaks at {self.imagined_scores[peak]:.2f} (stops above {self.threshold:g})"
            found.append((peak, words))
        return sorted(found)

    def story(self) -> str:
        """The events in a sentence."""
        return "; ".join(f"step {step}: {words}" for step, words in self.events())

    def _gripper(self) -> list[tuple[int, str]]:
        closed = self.gripper < 0.5
        changes = (closed[1:] != closed[:-1]).nonzero().squeeze(-1) + 1
        return [(step, "closes" if bool(closed[step]) else "opens") for step in changes.tolist()[:3]]


@dataclass(frozen=True)
class Evidence:
    """What was measured on a run's models.

    ``honesty``: rows (``policy``, ``task`` and the figures of :func:`~worldenv_trl.metrics.honesty`) of open-loop
    pairs; ``waves``: the same for LOOP's own imagined rollouts, replayed in the physics (``iteration``); ``drift``: the
    tensors of :func:`~worldenv_trl.metrics.drift` by policy; ``scores``: (probability, label) of frames by ``real`` and
    ``imagined``; ``rules``: (threshold, consecutive) of the two.
    """

    clips: Sequence[Clip] = ()
    counts: dict[str, dict[str, dict[str, int]]] = field(default_factory=dict)  # policy -> task -> kind -> episodes
    honesty: Sequence[dict[str, Any]] = ()
    waves: Sequence[dict[str, Any]] = ()
    drift: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    scores: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    rules: dict[str, tuple[float, int]] = field(default_factory=dict)
    episodes: int = 0
    missing: Sequence[str] = ()  # what could not be measured, and why
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class RunRecord:
    """What a run folder says of itself."""

    path: Path
    lines: list[dict[str, Any]]
    config: dict[str, Any]
    versions: dict[str, str]
    seconds: dict[str, float]
    run_versions: tuple[dict[str, str], ...] = ()
    """What the run began with and, where they differ, what continued it; ``versions`` are this machine's."""
    begun: dict[str, Any] = field(default_factory=dict)
    """The ``run`` whose ``stages`` it began with; empty for a run of its own."""

    @classmethod
    def read(cls, path: str | Path) -> RunRecord:
        """Reads ``config.yaml`` and ``metrics.jsonl``; the latter may be missing yet.

        Raises:
            FileNotFoundError: for a path that is no run folder.
            ValueError: for a ``config.yaml`` that holds no settings.
        """
        import yaml

        path = Path(path)
        if not path.is_dir() or not (path / "config.yaml").is_file():
            what = "does not exist" if not path.exists() else "is no run folder: it holds no config.yaml"
            raise FileNotFoundError(f"{path} {what}; give the --run-dir of recipes/world_env.py")
        lines = read_metrics(path) if (path / "metrics.jsonl").is_file() else []
        lines = [line for line in lines if isinstance(line, dict) and "stage" in line]
        seconds = {line["stage"]: line["seconds"] for line in lines if "seconds" in line}
        try:
            config = yaml.safe_load((path / "config.yaml").read_text())
        except yaml.YAMLError as error:
            config = str(error).splitlines()[0]
        if not isinstance(config, dict):
            raise ValueError(
                f"{path / 'config.yaml'} holds no settings ({config}); the run that wrote it can write it again"
            )
        begun = _noted(path / "begun.json")
        begun = begun if isinstance(begun, dict) else {}
        return cls(path, lines, config, machine_versions(), seconds, _noted_versions(path), begun)

    def series(self, stage: str, key: str) -> tuple[list[float], list[float]]:
        """Steps and values of a logged quantity."""
        found = [(x["step"], x[key]) for x in self.lines if x["stage"] == stage and "step" in x and key in x]
        return [step for step, _ in found], [value for _, value in found]

    def stages(self, prefix: str) -> list[str]:
        return [name for name in dict.fromkeys(line["stage"] for line in self.lines) if name.startswith(prefix)]


def _noted(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):  # of a run before it was noted
        return None


def _noted_versions(path: Path) -> tuple[dict[str, str], ...]:
    noted = _noted(path / "versions.json")
    return tuple(each for each in noted if isinstance(each, dict)) if isinstance(noted, list) else ()


def machine_versions() -> dict[str, str]:
    """Python, the packages that decide what a run comes to, here and now."""
    from importlib.metadata import PackageNotFoundError, version
    from platform import python_version

    found = {"python": python_version()}
    for name in ("worldenv_trl", "torch", "torchrl", "tensordict", "mujoco", "dm-control", "numpy", "av"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def choose_clips(shown: Sequence[Clip], count: int) -> list[Clip]:
    """``count`` clips of each kind: those of the first one's policy first, tasks in turn."""
    chosen = []
    for kind in ("failure", "false stop", "missed stop", "success"):
        turn: Counter[tuple[str, str]] = Counter()
        ranked = []
        for place, clip in enumerate(clip for clip in shown if clip.kind == kind):
            turn[clip.policy, clip.task] += 1
            ranked.append((clip.policy != shown[0].policy, turn[clip.policy, clip.task], place, clip))
        chosen += [clip for *_, clip in sorted(ranked, key=lambda entry: entry[:3])[:count]]
    return chosen


def count_kinds(shown: Sequence[Clip], policy: str) -> dict[str, dict[str, int]]:
    """How often each kind of episode occurs in each task."""
    found: dict[str, Counter[str]] = {}
    for clip in shown:
        if clip.policy == policy:
            found.setdefault(clip.task, Counter())[clip.kind] += 1
    return {task: dict(kinds) for task, kinds in found.items()}
