"""Which initial states stand for the others: where to demonstrate, and how far from a demonstration a state lies."""

from __future__ import annotations

import numpy as np

from worldenv_trl.scenes.files import FileTask
from worldenv_trl.scenes.simulation import SceneBatch
from worldenv_trl.scenes.skills.grips import way_taken

__all__ = ["goal_places", "layout_distances", "spread_states", "usual_states"]

_MOVES = 1e-3  # m: less is how things settle


def goal_places(task: FileTask, states: np.ndarray) -> np.ndarray:
    """Where the things that the goal names are in integration states ``[N, S]``: float64 ``[N, 3 K]`` (m).

    What else lies around is none of the task's business, and there may be much of it.

    Examples:
        >>> from worldenv_trl.scenes import load_task
        >>> task = load_task("starter/put_the_bowl_on_the_plate")
        >>> goal_places(task, task.init_states("train", 2)).shape  # bowl and plate
        (2, 6)
    """
    named = [task.relations.part(argument)[0] for _, *arguments in task.goal for argument in arguments]
    things = [thing for thing in dict.fromkeys(named) if thing in task.entities]
    scene = SceneBatch(task, len(states), cameras=())
    scene.reset(np.arange(len(states)), states)
    bodies = [scene.model.body(f"{thing}/").id for thing in things]
    return scene.xpos[:, bodies].reshape(len(states), -1).copy()


def usual_states(task: FileTask, states: np.ndarray, share: float) -> np.ndarray:
    """Bool ``[N]``: integration states ``[N, S]`` in which the expert takes what the goal moves as it does in others.

    It takes a thing another way where something stands in the hand's. One demonstration of what is hardly ever done,
    beside four of what is, teaches a policy to hesitate.

    Args:
        share: of the states; ways that are taken in fewer are not usual.

    Examples:
        >>> from worldenv_trl.scenes import load_task
        >>> task = load_task("starter/put_the_bowl_on_the_plate")
        >>> usual_states(task, task.init_states("train", 4), share=0.1)
        array([ True,  True,  True,  True])
    """
    scene = SceneBatch(task, len(states), cameras=())
    scene.reset(np.arange(len(states)), states)
    usual = np.ones(len(states), bool)
    for predicate, thing, *_ in task.goal:
        grasp = task.entities[thing].grasp if predicate in ("On", "In") else None
        if grasp is not None:
            ways = way_taken(scene, task, thing, grasp)
            usual &= (np.bincount(ways) / len(states) >= share)[ways]
    return usual


def layout_distances(places: np.ndarray, others: np.ndarray, spread_of: np.ndarray | None = None) -> np.ndarray:
    """How differently things lie: Euclidean, each coordinate in standard deviations.

    Coordinates that hardly differ (under 1 mm) do not count.

    Args:
        places: [N, P], as :func:`goal_places` gives them.
        others: [M, P].
        spread_of: [K, P], of which the deviations are taken; ``places`` when None.

    Returns:
        Float64 [N, M].

    Raises:
        ValueError: for arrays of other shapes.

    Examples:
        >>> places = np.array([[0.0, 5.0], [0.1, 5.0], [0.2, 5.0]])
        >>> layout_distances(places, places[:1])[:, 0].round(3)
        array([0.   , 1.225, 2.449])
    """
    reference = places if spread_of is None else spread_of
    for name, value in (("places", places), ("others", others), ("spread_of", reference)):
        if value.ndim != 2 or not len(value) or value.shape[1] != places.shape[-1]:
            raise ValueError(f"{name} must be [N, {places.shape[-1]}] with one row at least, got {list(value.shape)}")
    deviation = reference.std(0)
    varies = deviation > _MOVES
    if not varies.any():
        return np.zeros((len(places), len(others)))
    apart = (places[:, None, varies] - others[None, :, varies]) / deviation[varies]
    return np.sqrt(np.square(apart).sum(-1))


def spread_states(places: np.ndarray, count: int) -> list[int]:
    """The ``count`` of N states that all the others lie nearest to, in ascending order.

    They are the medoids that make the sum of squared :func:`layout_distances` least: chosen one by one, then exchanged
    one by one as long as that helps (PAM; Kaufman and Rousseeuw, Finding Groups in Data, 1990).

    Args:
        places: [N, P], as :func:`goal_places` gives them.

    Raises:
        ValueError: for a count that is not from 1 to N.

    Examples:
        >>> spread_states(np.array([[0.0], [0.1], [0.2], [5.0], [5.1], [5.2]]), 2)
        [1, 4]
    """
    if not 1 <= count <= len(places):
        raise ValueError(f"count must be from 1 to {len(places)}, the number of states, got {count}")
    cost = layout_distances(places, places) ** 2
    chosen: list[int] = []
    while len(chosen) < count:
        chosen.append(_best(cost, chosen))
    improved = True
    while improved:
        improved = False
        for place in range(count):
            others = chosen[:place] + chosen[place + 1 :]
            candidate = _best(cost, others)
            if _left(cost, [*others, candidate]) < _left(cost, chosen) - 1e-9:
                chosen[place], improved = candidate, True
    return sorted(chosen)


def _best(cost: np.ndarray, chosen: list[int]) -> int:
    """The state that, beside ``chosen``, leaves the others the least cost."""
    nearest = cost[chosen].min(0) if chosen else np.full(len(cost), np.inf)
    total = np.minimum(cost, nearest).sum(1)
    total[chosen] = np.inf
    return int(total.argmin())


def _left(cost: np.ndarray, chosen: list[int]) -> float:
    return float(cost[chosen].min(0).sum())
