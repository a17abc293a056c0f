"""What an explored episode should have done, as far as others from the same initial state tell."""

from __future__ import annotations

import math

import pytest
import torch
from small_rollouts import make_episodes

from worldenv_trl import keys
from worldenv_trl.data import corrected_samples, policy_samples, until_reached


def taking(place, *, at=3, steps=8, reached=True, letting_go=None):
    """An episode that goes from x = 0 to ``place`` (m) until its hand closes at step ``at``, and stays there."""
    way = torch.linspace(0, 1, at + 1).clamp(max=1)
    way = torch.cat([way, torch.ones(steps - at)])
    actions = torch.zeros(steps, 7)
    actions[:at, 0] = place / at / keys.POSITION_STEP
    actions[:, 6] = -1.0
    actions[at:, 6] = 1.0
    if letting_go is not None:
        actions[letting_go:, 6] = -1.0
    return way * place, actions, torch.full((steps + 1,), False) | (reached & (torch.arange(steps + 1) >= steps))


def episodes_of(*made, contexts=None):
    steps = max(len(actions) for _, actions, _ in made)
    out = make_episodes([steps] * len(made))
    out["states"].zero_()
    for row, (x, actions, success) in enumerate(made):
        out["states"][row, :, 0], out["actions"][row], out["success"][row] = x, actions, success
    out.entries[keys.CONTEXT_ID] = torch.tensor(contexts or [5] * len(made)).unsqueeze(-1)
    return out


def leads_to(episodes, samples):
    """x (m) of where each sample's chunk ends up, at the change of the gripper at step 3."""
    here = episodes["states"][samples["episode"], samples[keys.NUM_STEPS].squeeze(-1), 0]
    return here + samples[keys.CHUNK][..., 0].sum(-1) * keys.POSITION_STEP


def test_every_rollout_is_led_to_where_a_success_took_hold():
    episodes = episodes_of(taking(0.06, reached=True), taking(0.03, reached=False), taking(0.09, reached=False))
    samples = corrected_samples(episodes, torch.ones(3), chunk_length=4)
    assert samples["episode"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert samples[keys.NUM_STEPS].squeeze(-1).tolist() == [0, 1, 2] * 3
    assert leads_to(episodes, samples).tolist() == pytest.approx([0.06] * 9, abs=1e-6)
    assert samples[keys.WAYPOINT][:, 0].tolist() == pytest.approx([0.06] * 9)
    alone = policy_samples(episodes, chunk_length=4)  # where nothing was missing nothing is changed
    torch.testing.assert_close(samples[keys.CHUNK][:3], alone[keys.CHUNK][:3])
    assert torch.equal(samples[keys.CHUNK][..., 1:], alone[keys.CHUNK][[0, 1, 2, 8, 9, 10, 16, 17, 18]][..., 1:])


def test_what_comes_after_the_gripper_s_change_is_not_imitated():
    episodes = episodes_of(taking(0.06), taking(0.03, reached=False))
    padded = corrected_samples(episodes, torch.ones(2), chunk_length=8)[keys.ACTION_IS_PAD]
    assert padded.tolist() == [[step > 4 for step in range(first, first + 8)] for first in (0, 1, 2)] * 2


def test_the_least_noisy_successes_tell_and_they_together_their_mean():
    failed = taking(0.04, reached=False)
    episodes = episodes_of(taking(0.05), taking(0.06), taking(0.07), failed)
    samples = corrected_samples(episodes, torch.tensor([2.0, 0.5, 0.5, 0.0]), chunk_length=4)
    assert leads_to(episodes, samples).tolist() == pytest.approx([0.065] * 12, abs=1e-6)


def test_nothing_is_told_of_another_initial_state_or_of_what_nobody_solved():
    made = taking(0.06), taking(0.03, reached=False), taking(0.02, reached=False)
    samples = corrected_samples(episodes_of(*made, contexts=[5, 6, 6]), torch.ones(3), chunk_length=4)
    assert samples["episode"].unique().tolist() == [0]
    assert len(corrected_samples(episodes_of(made[1]), torch.ones(1), chunk_length=4)) == 0


def test_who_was_too_far_away_is_left_out():
    episodes = episodes_of(taking(0.06), taking(0.0, reached=False), taking(-0.03, reached=False))
    assert corrected_samples(episodes, torch.ones(3), 4)["episode"].unique().tolist() == [0, 1]
    assert corrected_samples(episodes, torch.ones(3), 4, reach=0.05)["episode"].unique().tolist() == [0]


def test_where_a_thing_is_let_go_is_told_as_well():
    episodes = episodes_of(taking(0.06, letting_go=6), taking(0.06, reached=False, letting_go=6))
    episodes["states"][0, 4:, 0] = torch.linspace(0.06, 0.10, 5)  # carries it 2 cm on by step 6
    samples = corrected_samples(episodes, torch.ones(2), chunk_length=3)
    second = samples[samples[keys.NUM_STEPS].squeeze(-1) >= 3]
    assert (
        second["episode"].tolist() == [0, 0, 0, 1, 1, 1] and second[keys.NUM_STEPS].flatten().tolist() == [3, 4, 5] * 2
    )
    wanted = episodes["states"][0, 6, 0].item()
    assert second[keys.WAYPOINT][:, 0].tolist() == pytest.approx([wanted] * 6)
    began = second[[3]]  # of the failure, which stays where it is
    moved = 0.06 + began[keys.CHUNK][..., 0].sum(-1) * keys.POSITION_STEP
    assert moved.item() == pytest.approx(wanted, abs=1e-6)


def test_a_success_that_regrasps_tells_nothing():
    episodes = episodes_of(taking(0.06, letting_go=5))
    episodes["actions"][0, 7, 6] = 1.0  # closes again
    assert len(corrected_samples(episodes, torch.zeros(1), chunk_length=4)) == 0


def test_episodes_end_three_steps_after_the_goal_is_reached():
    episodes = make_episodes([8, 8, 8])
    episodes["success"] = torch.arange(9) >= torch.tensor([[2], [7], [99]])
    assert until_reached(episodes)["length"].flatten().tolist() == [5, 8, 8]
    assert episodes["length"].flatten().tolist() == [8, 8, 8]


@pytest.mark.parametrize(
    ("noise", "options", "message"),
    [
        (torch.ones(2), {}, r"noise must be \[1\], one number for each episode, got \[2\]"),
        (torch.full((1,), math.nan), {}, "noise must be numbers, 1 of 1 are NaN"),
        (torch.ones(1), {"reach": math.nan}, "reach positive, got 8 and nan"),
        (torch.ones(1), {"chunk_length": 0}, "chunk_length must be at least 1"),
        (torch.ones(1), {"reach": 0.0}, "reach positive, got 8 and 0.0"),
    ],
)
def test_bad_input_is_refused(noise, options, message):
    with pytest.raises(ValueError, match=message):
        corrected_samples(episodes_of(taking(0.06)), noise, **options)
