"""Initial states that stand for the others, against all choices there are."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from worldenv_trl.scenes import (
    SceneBatch,
    ScriptedExpert,
    goal_places,
    layout_distances,
    load_task,
    spread_states,
    usual_states,
)


def cost(states: np.ndarray, chosen) -> float:
    return float((layout_distances(states, states[list(chosen)]) ** 2).min(1).sum())


@pytest.mark.parametrize("seed", range(5))
def test_close_to_the_best_of_all_choices(seed: int) -> None:
    states = np.random.default_rng(seed).normal(size=(14, 3)) * [1.0, 0.2, 5.0]
    costs = sorted(cost(states, chosen) for chosen in itertools.combinations(range(14), 3))
    found = spread_states(states, 3)
    assert found == sorted(set(found)) and len(found) == 3
    assert cost(states, found) <= 1.15 * costs[0]  # of 364 choices: exchanges may end in a local optimum
    exchanged = [
        cost(states, [*found[:place], other, *found[place + 1 :]])
        for place in range(3)
        for other in set(range(14)) - set(found)
    ]
    assert cost(states, found) <= min(exchanged) + 1e-9


def test_each_cluster_has_one() -> None:
    centres = np.array([[0, 0], [9, 0], [0, 9], [9, 9]], float)
    states = (centres[:, None] + np.random.default_rng(0).normal(size=(4, 6, 2)) * 0.3).reshape(-1, 2)
    assert [row // 6 for row in spread_states(states, 4)] == [0, 1, 2, 3]


def test_all_and_one() -> None:
    states = np.arange(5.0)[:, None]
    assert spread_states(states, 5) == [0, 1, 2, 3, 4]
    assert spread_states(states, 1) == [2]  # the one in the middle


def test_states_that_are_all_alike_are_still_chosen_once_each() -> None:
    assert len(set(spread_states(np.ones((4, 2)), 3))) == 3


@pytest.mark.parametrize("count", [0, 4])
def test_more_or_fewer_than_there_are(count: int) -> None:
    with pytest.raises(ValueError, match=f"from 1 to 3, the number of states, got {count}"):
        spread_states(np.arange(3.0)[:, None], count)


def test_distances_are_in_standard_deviations_and_how_things_settle_does_not_count() -> None:
    states = np.array([[0.0, 1e-6, 3.0], [2.0, 0.0, 3.0]])  # deviations 1, 5e-7 and 0
    np.testing.assert_allclose(layout_distances(states, states), [[0, 2], [2, 0]])
    np.testing.assert_allclose(layout_distances(states, states[:1], 10 * states), [[0], [0.2]])
    assert layout_distances(states[:, 1:], states[:, 1:]).tolist() == [[0, 0], [0, 0]]


@pytest.mark.parametrize(
    ("states", "others", "name"),
    [
        (np.ones(3), np.ones((2, 3)), "places"),
        (np.ones((2, 3)), np.ones((2, 4)), "others"),
        (np.ones((2, 3)), np.ones((0, 3)), "others"),
    ],
)
def test_other_shapes_are_named(states: np.ndarray, others: np.ndarray, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be"):
        layout_distances(states, others)


def test_of_a_task_the_things_that_its_goal_names_count() -> None:
    task = load_task("starter/put_the_bowl_on_the_plate")
    states, held_out = task.init_states("train", 40), task.init_states("test", 40)
    places, others = goal_places(task, states), goal_places(task, held_out)
    (bowl_x, bowl_y, *_), (plate_x, plate_y, *_) = places[:, :3].T, places[:, 3:].T
    assert (bowl_x.std() > 0.01) and (bowl_y.std() > 0.01) and (plate_x.std() > 0.01) and (plate_y.std() > 0.01)
    assert np.abs(bowl_y.mean() - plate_y.mean()) > 0.1  # one to the left, one to the right
    nearest = layout_distances(others, places[spread_states(places, 5)], places).min(1)
    assert nearest.mean() < 0.9 * layout_distances(others, places[:5], places).min(1).mean()


def test_what_lies_around_does_not_count() -> None:
    """Six things on the floor and a basket: the milk and the basket are named."""
    task = load_task("object/put_the_milk_in_the_basket")
    states = task.init_states("train", 3)
    assert goal_places(task, states).shape == (3, 6)
    drawer = load_task("starter/open_the_top_drawer")
    assert goal_places(drawer, drawer.init_states("train", 3)).shape == (3, 3)


def test_the_places_are_those_of_the_scene() -> None:
    task = load_task("object/put_the_milk_in_the_basket")
    states = task.init_states("test", 2)
    scene = SceneBatch(task, 1, cameras=())
    for row in (0, 1):
        scene.reset(np.array([0]), states[row : row + 1])
        bodies = [task.build().body(name).id for name in ("milk_1/", "basket_1/")]
        np.testing.assert_allclose(goal_places(task, states)[row], scene.xpos[0, bodies].ravel())


def sides_taken(task, states: np.ndarray) -> np.ndarray:
    """On which side of its middle the expert closes its fingers on the bowl: 0 to 3, quarter turns from x."""
    scene, expert = SceneBatch(task, len(states), cameras=()), ScriptedExpert(task)
    scene.reset(np.arange(len(states)), states)
    bowl, sides, open_since = scene.model.body("bowl_1/").id, np.full(len(states), -1), np.zeros(len(states), bool)
    for _ in range(60):
        action = expert(scene)
        open_since |= action[:, 6] < 0
        closing = (action[:, 6] > 0) & open_since & (sides < 0)
        x, y = (scene.measured_state()[:, :2] - scene.xpos[:, bowl, :2]).T
        sides[closing] = (np.round(np.arctan2(y, x) / (np.pi / 2)).astype(int) % 4)[closing]
        scene.step(action)
    return sides


def test_usual_states_are_those_where_the_expert_does_what_it_does_in_others() -> None:
    task = load_task("goal/open_the_top_drawer_and_put_the_bowl_inside")
    states = task.init_states("train", 40)
    sides = sides_taken(task, states)
    counts = np.bincount(sides)
    assert sorted(counts[counts > 0].tolist()) == [2, 13, 25]
    for share, least in ((0.04, 2), (0.1, 13), (0.5, 25)):
        np.testing.assert_array_equal(usual_states(task, states, share), counts[sides] >= least)


def test_what_nothing_has_to_be_picked_up_for_is_always_usual() -> None:
    for name in ("goal/open_the_top_drawer", "goal/push_the_plate_to_the_front_of_the_stove"):
        task = load_task(name)
        assert usual_states(task, task.init_states("train", 3), 1.0).all()
