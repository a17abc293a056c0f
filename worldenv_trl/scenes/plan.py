"""Which skills, in which order, bring about a goal."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from worldenv_trl.scenes import skills
from worldenv_trl.scenes.bddl import PREDICATES
from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.skills import Phase

__all__ = ["Stage", "plan_stages"]

_EDGE = 0.013  # from the middle of what stands on a region to the region's edge, m
_ORDER = {"TurnOn": 0, "TurnOff": 0, "Open": 1, "On": 2, "In": 2, "Close": 3}


@dataclass(frozen=True)
class Stage:
    """One skill: what it brings about (a predicate and its arguments), and its phases."""

    aim: tuple[str, ...]
    phases: list[Phase]


def plan_stages(task: FileTask, goal: Sequence[tuple[str, ...]]) -> list[Stage]:
    """Stages that reach ``goal``: levers first, then drawers are opened, things put away, drawers and doors closed.

    A drawer that is shut and that something has to go into is opened, whether the goal asks for it or not.

    Raises:
        TypeError: for a goal that is no sequence of predicates.
        ValueError: for a predicate or thing that is not there or that no skill is for, naming the task.
    """
    _check_goal(task, goal)
    asked = sorted(map(tuple, goal), key=lambda aim: _ORDER[aim[0]])
    places = Counter(aim[2] for aim in asked if aim[0] in ("On", "In"))
    opened = {first for predicate, first, *_ in task.problem.init if predicate == "Open"}
    stages: list[Stage] = []
    taken: Counter[str] = Counter()
    for aim in asked:
        predicate, first, *rest = aim
        if predicate in ("On", "In"):
            place = rest[0]
            owner, part = task.relations.part(place)
            if owner in task.entities and ("Open", part) in task.entities[owner].states and place not in opened:
                opened.add(place)
                _add(stages, task, ("Open", place))
            slot = _slot(task, owner, part, taken[place], places[place])
            taken[place] += 1
            _add(stages, task, aim, slot)
        else:
            if aim in task.problem.init or (predicate == "Open" and first in opened):
                continue
            if predicate == "Open":
                opened.add(first)
            _add(stages, task, aim)
    return stages


def _check_goal(task: FileTask, goal: Any) -> None:
    """Raises ``TypeError`` or ``ValueError`` for a goal that cannot be asked of the task's things."""
    example = "goal=[('On', 'bowl_1', 'plate_1')]"
    if isinstance(goal, str) or not isinstance(goal, Sequence):
        raise TypeError(f"goal must be a sequence of predicates such as {example}, got {goal!r}")
    if not goal:
        raise ValueError(f"no script for {task.name}: its goal is empty; name a predicate, as in {example}")
    known = [*task.problem.fixtures, *task.problem.objects, *task.problem.regions]
    for aim in goal:
        if isinstance(aim, str) or not isinstance(aim, Sequence) or not all(isinstance(word, str) for word in aim):
            raise TypeError(f"a goal's predicate is a tuple of words, as in {example}, got {aim!r} in {goal!r}")
        predicate, names = aim[0] if aim else "", aim[1:]
        if predicate not in _ORDER:
            message = f"no skill brings about {predicate}{_hint(predicate, _ORDER)}"
            raise ValueError(f"no script for {task.name}: {message}")
        if len(names) != PREDICATES[predicate.lower()][1]:
            message = f"{predicate} takes {PREDICATES[predicate.lower()][1]} name(s), got {tuple(aim)}"
            raise ValueError(f"no script for {task.name}: {message}")
        for name in names:
            if name not in known:
                raise ValueError(f"no script for {task.name}: it has no thing or region {name!r}{_hint(name, known)}")
        if predicate in ("On", "In") and (why := task.relations.why_not(*aim)):
            raise ValueError(f"no script for {task.name}: ({' '.join(aim)}): {why}")


def _hint(word: str, known: Iterable[str]) -> str:
    """Up to three of the ``known`` that are close to ``word``, or all of them, to end a message with."""
    alike = [other for other in known if other.lower() == word.lower()]
    close = alike or difflib.get_close_matches(word, known, n=3, cutoff=0.6)
    return f": did you mean {' or '.join(map(repr, close))}?" if close else f"; known are {', '.join(known)}"


def _add(stages: list[Stage], task: FileTask, aim: tuple[str, ...], slot: tuple[float, float] = (0.0, 0.0)) -> None:
    again = sum(len(stage.phases) for stage in stages)
    predicate, first, *rest = aim
    if predicate in ("On", "In"):
        flat = task.entities[first].grasp is None and task.relations.part(rest[0])[0] not in task.entities
        phases = (
            skills.push_to(task, first, rest[0], again)
            if flat
            else skills.pick_and_place(task, first, rest[0], again, slot)
        )
    else:
        thing, part = task.relations.part(first)
        if predicate == "Open":
            phases = skills.pull_open(task, thing, part, again)
        elif predicate == "Close":
            phases = skills.push_closed(task, thing, part, again)
        else:
            phases = skills.turn(task, thing, again, on=predicate == "TurnOn")
    stages.append(Stage(tuple(aim), phases))


def _slot(task: FileTask, owner: str, part: str, index: int, count: int) -> tuple[float, float]:
    """Where the ``index``-th of ``count`` things goes in a region that they share: side by side along its longer side.

    What stands on top may come close to the edge with its middle, what is inside may not.
    """
    if count == 1 or not part or owner not in task.entities:
        return 0.0, 0.0
    region = task.entities[owner].regions[part]
    half = np.array(region.half_size[:2])
    along = 0 if half[0] > half[1] else 1
    share = (2 * index + 1) / count - 1
    slot = [0.0, 0.0]
    slot[along] = float(share * count / (count - 1) * (half[along] - _EDGE) if region.on_top else share * half[along])
    return slot[0], slot[1]
