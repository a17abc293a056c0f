"""Which skills, in which order, bring about a goal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldenv_trl.scenes import skills
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
        ValueError: for a predicate or thing that no skill is for, naming the task.
    """
    asked = sorted(goal, key=lambda aim: _ORDER.get(aim[0], 9))
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
        elif predicate in _ORDER:
            if aim in task.problem.init or (predicate == "Open" and first in opened):
                continue
            if predicate == "Open":
                opened.add(first)
            _add(stages, task, aim)
        else:
            raise ValueError(f"no script for {task.name}: no skill brings about {predicate}")
    return stages


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
