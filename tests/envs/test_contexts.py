"""The order in which groups get their contexts, with weights of the tasks."""

from __future__ import annotations

import math

import pytest
import torch
from imagined_worlds import make_contexts, make_env

from worldenv_trl.envs.contexts import ContextOrder
from worldenv_trl.keys import TASK_ID


def test_a_task_with_a_small_weight_comes_so_seldom_and_not_all_at_once():
    contexts = make_contexts(20)
    contexts[TASK_ID] = torch.arange(20)[:, None] % 5  # four of each
    order = ContextOrder(contexts, {0: 0.2, 1: 0.2, 3: 0.2})
    drawn = order.draw(260)
    tasks = [place % 5 for place in drawn]
    assert [tasks.count(task) for task in range(5)] == [20, 20, 100, 20, 100]
    light = [sum(task in (0, 1, 3) for task in tasks[at : at + 26]) for at in range(len(tasks) - 25)]
    assert set(light) <= {4, 5, 6, 7, 8}
    assert all(drawn.count(place) == 25 for place in range(20) if place % 5 in (2, 4))
    assert all(1 <= drawn.count(place) <= 10 for place in range(20) if place % 5 in (0, 1, 3))


def test_an_order_goes_on_from_its_state():
    order, other = (ContextOrder(make_contexts(9), {1: 0.3}) for _ in range(2))
    order.seed(3)
    order.draw(7)
    other.load_state_dict(order.state_dict())
    expected = order.draw(30)
    assert other.draw(30) == expected
    other.seed(4)
    other.draw(7)
    assert other.draw(30) != expected


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({2: 1.0}, r"task_weights names task 2; the contexts are of tasks \[0, 1\]"),
        ({1: 0.0}, "the weight of task 1 must be positive, got 0.0"),
        ({0: math.nan}, "the weight of task 0 must be positive, got nan"),
        ({0: math.inf}, "the weight of task 0 must be positive, got inf"),
    ],
)
def test_weights_that_are_none_are_refused(weights, message):
    with pytest.raises(ValueError, match=message):
        make_env(task_weights=weights)
