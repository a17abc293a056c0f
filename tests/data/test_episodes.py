from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.data import concatenate_episodes, episodes_from_rollouts


def step_rollouts(lengths: list[int], steps: int, size: int = 8, seed: int = 0) -> TensorDict:
    """Rollouts [R, T] of single actions; observations and actions are random, finished rows go on with rubbish."""
    generator = torch.Generator().manual_seed(seed)
    rows = len(lengths)
    image = torch.randint(0, 256, (rows, steps + 1, 3, size, size), generator=generator, dtype=torch.uint8)
    state = torch.randn(rows, steps + 1, 7, generator=generator)
    kinematic = torch.randn(rows, steps + 1, 20, generator=generator)
    success = torch.rand(rows, steps + 1, 1, generator=generator) < 0.3
    done = torch.arange(1, steps + 1) >= torch.tensor(lengths).unsqueeze(-1)

    def observed(part: slice) -> dict:
        return {
            "observation": {"image": image[:, part], "state": state[:, part]},
            keys.KINEMATIC_STATE: kinematic[:, part],
            keys.SUCCESS: success[:, part],
            keys.TASK_ID: torch.arange(rows).view(rows, 1, 1).expand(rows, steps, 1),
            keys.CONTEXT_ID: 100 + torch.arange(rows).view(rows, 1, 1).expand(rows, steps, 1),
        }

    return TensorDict(
        {
            **observed(slice(0, -1)),
            keys.ACTION: 2 * torch.randn(rows, steps, 7, generator=generator),
            "next": {**observed(slice(1, None)), "done": done.unsqueeze(-1)},
        },
        batch_size=[rows, steps],
    )


def decision_rollouts(executed: list[list[int]], chunk: int = 3, size: int = 8, success: bool = False) -> TensorDict:
    """Rollouts [R, D] of chunks of which ``executed[row][decision]`` steps were executed; 0 after the end."""
    generator = torch.Generator().manual_seed(3)
    counts = torch.tensor(executed)
    rows, decisions = counts.shape
    shape = (rows, decisions, chunk)
    frames = torch.randint(0, 256, (*shape, 3, size, size), generator=generator, dtype=torch.uint8)
    states, kinematic = torch.randn(*shape, 7, generator=generator), torch.randn(*shape, 20, generator=generator)
    last = (counts - 1).clamp(min=0)
    row, decision = torch.meshgrid(torch.arange(rows), torch.arange(decisions), indexing="ij")

    def final(values: torch.Tensor, first: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        after = values[row, decision, last]
        return torch.cat([first.unsqueeze(1), after[:, :-1]], 1), after

    image = final(frames, torch.zeros(rows, 3, size, size, dtype=torch.uint8))
    state, kin = final(states, torch.ones(rows, 7)), final(kinematic, torch.ones(rows, 20))
    ids = torch.zeros(rows, decisions, 1, dtype=torch.int64)
    common = {keys.TASK_ID: ids, keys.CONTEXT_ID: ids}
    out = TensorDict(
        {
            "observation": {"image": image[0], "state": state[0]},
            keys.KINEMATIC_STATE: kin[0],
            **common,
            keys.CHUNK: 2 * torch.randn(*shape, 7, generator=generator),
            keys.MASK: counts > 0,
            "next": {
                "observation": {"image": image[1], "state": state[1]},
                keys.KINEMATIC_STATE: kin[1],
                **common,
                keys.FRAMES: frames,
                keys.STATES: states,
                keys.KINEMATIC_STATES: kinematic,
                keys.STEP_MASK: torch.arange(chunk) < counts.unsqueeze(-1),
            },
        },
        batch_size=[rows, decisions],
    )
    if success:
        reached = torch.rand(rows, decisions, 1, generator=generator) < 0.5
        out[keys.SUCCESS] = torch.cat([torch.zeros_like(reached[:, :1]), reached[:, :-1]], 1)
        out["next", keys.SUCCESS] = reached
    return out


def test_single_steps_become_frames_from_the_reset_on():
    lengths = [4, 6, 1]
    rollouts = step_rollouts(lengths, steps=7)
    episodes = episodes_from_rollouts(rollouts)
    assert episodes["length"].flatten().tolist() == lengths
    assert episodes["frames"].shape == (3, 7, 3, 8, 8)  # the longest has 6 steps
    for row, length in enumerate(lengths):
        for name, key in (("frames", keys.IMAGE), ("states", keys.STATE), ("kinematic_states", keys.KINEMATIC_STATE)):
            assert torch.equal(episodes[name][row, 0], rollouts[key][row, 0])
            for step in range(length):
                assert torch.equal(episodes[name][row, step + 1], rollouts["next"].get(key)[row, step])
        assert torch.equal(episodes["actions"][row, :length], rollouts[keys.ACTION][row, :length].clamp(-1, 1))
        assert torch.equal(episodes["success"][row, 1 : length + 1], rollouts["next", keys.SUCCESS][row, :length, 0])
    assert episodes[keys.TASK_ID].flatten().tolist() == [0, 1, 2]
    assert episodes[keys.CONTEXT_ID].flatten().tolist() == [100, 101, 102]


def test_past_the_end_the_last_observation_repeats_and_actions_are_zero():
    episodes = episodes_from_rollouts(step_rollouts([2, 5], steps=5))
    for name in ("frames", "states", "kinematic_states", "success"):
        for step in (3, 4, 5):
            assert torch.equal(episodes[name][0, step], episodes[name][0, 2])
    assert not episodes["actions"][0, 2:].any()


def test_a_mask_takes_precedence_over_done():
    rollouts = step_rollouts([5, 5], steps=5)
    rollouts[keys.MASK] = torch.arange(5) < torch.tensor([[2], [3]])
    assert episodes_from_rollouts(rollouts)["length"].flatten().tolist() == [2, 3]


def test_batch_dimensions_are_flattened():
    rollouts = step_rollouts([3, 4, 5, 2], steps=5)
    flat, grouped = episodes_from_rollouts(rollouts), episodes_from_rollouts(rollouts.reshape(2, 2, 5))
    assert (flat == grouped).all()


def test_a_stop_inside_a_chunk_ends_the_episode_there():
    executed = [[3, 2, 0], [3, 3, 3], [1, 0, 0]]
    rollouts = decision_rollouts(executed)
    episodes = episodes_from_rollouts(rollouts)
    assert episodes["length"].flatten().tolist() == [5, 9, 1]
    for row, counts in enumerate(executed):
        wanted = [(decision, step) for decision, count in enumerate(counts) for step in range(count)]
        for place, (decision, step) in enumerate(wanted):
            assert torch.equal(episodes["frames"][row, place + 1], rollouts["next", keys.FRAMES][row, decision, step])
            assert torch.equal(episodes["states"][row, place + 1], rollouts["next", keys.STATES][row, decision, step])
            chunk = rollouts[keys.CHUNK][row, decision, step].clamp(-1, 1)
            assert torch.equal(episodes["actions"][row, place], chunk)
    assert "success" not in episodes.keys()  # noqa: SIM118


def test_a_decision_knows_success_at_its_last_executed_step():
    executed = [[3, 2, 0], [3, 3, 1]]
    rollouts = decision_rollouts(executed, success=True)
    episodes = episodes_from_rollouts(rollouts)
    for row, counts in enumerate(executed):
        known, place = False, 0
        for decision, count in enumerate(counts):
            for step in range(count):
                place += 1
                if step == count - 1:
                    known = bool(rollouts["next", keys.SUCCESS][row, decision])
                assert bool(episodes["success"][row, place]) == known


def test_a_rollout_without_a_step_keeps_its_reset():
    rollouts = step_rollouts([3, 3], steps=3)
    rollouts[keys.MASK] = torch.tensor([[True] * 3, [False] * 3])
    episodes = episodes_from_rollouts(rollouts)
    assert episodes["length"].flatten().tolist() == [3, 0]
    assert (episodes["frames"][1] == rollouts[keys.IMAGE][1, 0]).all()


def test_chunks_without_their_frames_are_refused():
    rollouts = decision_rollouts([[3, 3]])
    del rollouts["next", keys.FRAMES]
    with pytest.raises(ValueError, match=r"chunked\(env, frames=True\)"):
        episodes_from_rollouts(rollouts)


def test_missing_entries_are_named():
    rollouts = step_rollouts([2], steps=2)
    del rollouts[keys.KINEMATIC_STATE]
    with pytest.raises(ValueError, match=keys.KINEMATIC_STATE):
        episodes_from_rollouts(rollouts)


def test_rollouts_in_which_nothing_happened_are_refused():
    rollouts = step_rollouts([2], steps=2)
    rollouts[keys.MASK] = torch.zeros(1, 2, dtype=torch.bool)
    with pytest.raises(ValueError, match="no executed step"):
        episodes_from_rollouts(rollouts)


def test_concatenated_episodes_are_padded_like_one_set():
    whole = step_rollouts([3, 6, 2, 5], steps=6)
    together = episodes_from_rollouts(whole)
    apart = concatenate_episodes([episodes_from_rollouts(whole[:1]), episodes_from_rollouts(whole[1:])])
    assert (together == apart).all()


def test_sets_of_episodes_that_do_not_fit_are_refused():
    labelled = episodes_from_rollouts(step_rollouts([2], steps=2))
    with pytest.raises(ValueError, match="success labels"):
        concatenate_episodes([labelled, labelled.exclude("success")])
    with pytest.raises(ValueError, match="different sizes"):
        concatenate_episodes([labelled, episodes_from_rollouts(step_rollouts([2], steps=2, size=16))])
    with pytest.raises(ValueError, match="no episodes"):
        concatenate_episodes([])
