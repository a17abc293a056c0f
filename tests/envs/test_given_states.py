"""Initial states that the caller gives are checked when an env is built, not in its first reset."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worldenv_trl.envs import InitStates, TabletopEnv, context_id
from worldenv_trl.scenes import load_task

NAME = "starter/open_the_top_drawer"
STATES = load_task(NAME).init_states("train", 3)
BROKEN = STATES.copy()
BROKEN[1, 4], BROKEN[2, 0] = np.nan, np.inf


def build(states, context_ids=None):
    return TabletopEnv(NAME, 2, cameras=(), init_states=states, context_ids=context_ids, init_state_mode="cycle")


@pytest.mark.parametrize(
    ("states", "numbers", "error", "message"),
    [
        ("x", None, TypeError, "init_states must be numbers"),
        ([None], None, TypeError, "init_states must be numbers"),
        ([[1.0, 2.0], [3.0]], None, TypeError, "init_states cannot be read as an array"),
        (STATES.astype(complex), None, TypeError, "init_states must be numbers .* got complex128"),
        (STATES[:, :5], None, ValueError, rf"init_states must be \[K, {STATES.shape[1]}\] for {NAME}, .* got \[3, 5\]"),
        (STATES[None], None, ValueError, r"init_states must be .* got \[1, 3, "),
        (STATES[:0], None, ValueError, "at least one, got"),
        (BROKEN, None, ValueError, r"hold NaN or infinity in rows \[1, 2\]"),
        (STATES, [1.5, 2, 3], TypeError, r"context_ids must be whole numbers \[3\], got \[1.5, 2, 3\]"),
        (STATES, "abc", TypeError, "context_ids must be whole numbers"),
        (STATES, [1, 2], ValueError, "got 3 init_states and 2 context_ids"),
        (STATES, 1, ValueError, "got 3 init_states and 1 context_ids"),
        (STATES, [1, -2, 3], ValueError, "context_ids must be at least 0, or -1 .*, got -2"),
        (STATES, [7, 8, 7], ValueError, "context_id 7 names two different init_states, rows 0 and 2"),
    ],
)
def test_states_and_numbers_that_cannot_be_are_refused(states, numbers, error, message):
    with pytest.raises(error, match=message):
        build(states, numbers)


def test_one_state_and_a_state_named_twice_are_fine():
    assert build(STATES[0]).reset()["context_id"].flatten().tolist() == [-1, -1]
    again = build(torch.from_numpy(STATES[[0, 0]]), torch.tensor([[5], [5]]))
    assert again.reset()["context_id"].flatten().tolist() == [5, 5]


def test_what_was_given_is_not_held_on_to():
    given = STATES.copy()
    starts = InitStates(load_task(NAME), states=given, mode="cycle")
    given[:] = 0.0
    assert np.array_equal(starts.draw(1)[1], STATES[1])


@pytest.mark.parametrize("index", [-1, 50_000])
def test_a_number_that_would_be_another_s_is_refused(index):
    with pytest.raises(ValueError, match=rf"must be in \[0, 50000\), got {index}"):
        context_id(3, "train", index)
