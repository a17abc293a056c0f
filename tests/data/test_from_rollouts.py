"""Rollouts of single actions and of chunks become the same kind of episodes."""

from __future__ import annotations

import pytest
import torch
from small_rollouts import CAMERAS, ENTRIES, decision_rollouts, same, step_rollouts

from worldenv_trl import keys
from worldenv_trl.data import Episodes, episodes_from_rollouts


def frame(episodes: Episodes, camera: str, row: int, step: int) -> torch.Tensor:
    return episodes.frames(camera, torch.tensor(row), torch.tensor(step))


def test_single_steps_become_frames_from_the_reset_on():
    lengths = [4, 6, 1]
    rollouts = step_rollouts(lengths, steps=7)
    episodes = episodes_from_rollouts(rollouts)
    assert episodes["length"].flatten().tolist() == lengths and episodes.cameras == CAMERAS
    assert len(episodes.video[0]) == 4 + 6 + 1 + 3  # none past the ends
    for row, length in enumerate(lengths):
        for camera, entry in zip(CAMERAS, ENTRIES, strict=True):
            assert torch.equal(frame(episodes, camera, row, 0), rollouts["observation", entry][row, 0])
            for step in range(length):
                shown = rollouts["next", "observation", entry][row, step]
                assert torch.equal(frame(episodes, camera, row, step + 1), shown)


def test_single_steps_become_states_and_actions_from_the_reset_on():
    lengths = [4, 6, 1]
    rollouts = step_rollouts(lengths, steps=7)
    episodes = episodes_from_rollouts(rollouts)
    assert episodes["actions"].shape == (3, 6, 7)  # the longest has 6 steps
    for row, length in enumerate(lengths):
        for name, key in (("states", keys.STATE), ("kinematic_states", keys.KINEMATIC_STATE)):
            assert torch.equal(episodes[name][row, 0], rollouts[key][row, 0])
            for step in range(length):
                assert torch.equal(episodes[name][row, step + 1], rollouts["next"].get(key)[row, step])
        assert torch.equal(episodes["actions"][row, :length], rollouts[keys.ACTION][row, :length].clamp(-1, 1))
        assert torch.equal(episodes["success"][row, 1 : length + 1], rollouts["next", keys.SUCCESS][row, :length, 0])


def test_every_episode_keeps_its_goal_task_and_context():
    episodes = episodes_from_rollouts(step_rollouts([4, 6, 1], steps=7))
    assert episodes[keys.TASK_ID].flatten().tolist() == [0, 1, 2]
    assert episodes[keys.CONTEXT_ID].flatten().tolist() == [100, 101, 102]
    assert episodes.instructions == ["goal 0", "goal 1", "goal 2"]


def test_past_the_end_the_last_observation_repeats_and_actions_are_zero():
    episodes = episodes_from_rollouts(step_rollouts([2, 5], steps=5))
    for step in (3, 4, 5):
        for name in ("states", "kinematic_states", "success"):
            assert torch.equal(episodes[name][0, step], episodes[name][0, 2])
        assert torch.equal(frame(episodes, "wrist", 0, step), frame(episodes, "wrist", 0, 2))
    assert not episodes["actions"][0, 2:].any()


def test_a_mask_takes_precedence_over_done():
    rollouts = step_rollouts([5, 5], steps=5)
    rollouts[keys.MASK] = torch.arange(5) < torch.tensor([[2], [3]])
    assert episodes_from_rollouts(rollouts)["length"].flatten().tolist() == [2, 3]


def test_without_done_everything_was_executed():
    rollouts = step_rollouts([2, 3], steps=4)
    del rollouts["next", "done"]
    assert episodes_from_rollouts(rollouts)["length"].flatten().tolist() == [4, 4]


def test_batch_dimensions_are_flattened():
    rollouts = step_rollouts([3, 4, 5, 2], steps=5)
    assert same(episodes_from_rollouts(rollouts), episodes_from_rollouts(rollouts.reshape(2, 2, 5)))


def test_a_camera_whose_later_images_are_unknown_is_left_out():
    rollouts = step_rollouts([3, 4], steps=5)
    del rollouts["next", "observation", "wrist_image"]
    assert episodes_from_rollouts(rollouts).cameras == ("agentview",)


def test_any_named_camera_is_kept_under_its_name():
    rollouts = step_rollouts([3, 4], steps=5, cameras=("agentview", "from the left"))
    assert episodes_from_rollouts(rollouts).cameras == ("agentview", "from the left")


def test_a_stop_inside_a_chunk_ends_the_episode_there():
    executed = [[3, 2, 0], [3, 3, 3], [1, 0, 0]]
    rollouts = decision_rollouts(executed)
    episodes = episodes_from_rollouts(rollouts)
    assert episodes["length"].flatten().tolist() == [5, 9, 1] and episodes.cameras == CAMERAS
    assert len(episodes.video[0]) == 5 + 9 + 1 + 3
    for row, counts in enumerate(executed):
        wanted = [(decision, step) for decision, count in enumerate(counts) for step in range(count)]
        for place, (decision, step) in enumerate(wanted):
            for camera, entry in zip(CAMERAS, ENTRIES, strict=True):
                shown = rollouts["next", keys.FRAMES, entry][row, decision, step]
                assert torch.equal(frame(episodes, camera, row, place + 1), shown)
            assert torch.equal(episodes["states"][row, place + 1], rollouts["next", keys.STATES][row, decision, step])
            chunk = rollouts[keys.CHUNK][row, decision, step].clamp(-1, 1)
            assert torch.equal(episodes["actions"][row, place], chunk)


def test_nobody_knows_success_in_imagination():
    assert "success" not in episodes_from_rollouts(decision_rollouts([[3, 2]]))


def test_decisions_give_the_images_of_the_cameras_whose_frames_they_hold():
    rollouts = decision_rollouts([[3, 2]])
    del rollouts["next", keys.FRAMES, "image"]
    assert episodes_from_rollouts(rollouts).cameras == ("wrist",)


def test_a_decision_knows_success_at_its_last_executed_step():
    rollouts = decision_rollouts([[3, 2, 0], [1, 3, 2], [3, 3, 1]], success=True)
    reached = torch.tensor([[False, True, True], [True, False, True], [False, False, False]]).unsqueeze(-1)
    rollouts["next", keys.SUCCESS] = reached
    rollouts[keys.SUCCESS] = torch.cat([torch.zeros_like(reached[:, :1]), reached[:, :-1]], 1)
    success = episodes_from_rollouts(rollouts)["success"].int().tolist()
    assert success[0] == [0, 0, 0, 0, 0, 1, 1, 1]  # repeated past the end
    assert success[1] == [0, 1, 1, 1, 0, 0, 1, 1]
    assert not any(success[2])


def test_a_rollout_without_a_step_keeps_its_reset():
    rollouts = step_rollouts([3, 3], steps=3)
    rollouts[keys.MASK] = torch.tensor([[True] * 3, [False] * 3])
    episodes = episodes_from_rollouts(rollouts)
    assert episodes["length"].flatten().tolist() == [3, 0]
    for step in range(4):
        assert torch.equal(frame(episodes, "agentview", 1, step), rollouts[keys.IMAGE][1, 0])
        assert torch.equal(episodes["states"][1, step], rollouts[keys.STATE][1, 0])


def test_chunks_without_their_frames_are_refused():
    rollouts = decision_rollouts([[3, 3]])
    del rollouts["next", keys.FRAMES]
    with pytest.raises(ValueError, match=r"chunked\(env, frames=True\)"):
        episodes_from_rollouts(rollouts)


@pytest.mark.parametrize("key", [keys.KINEMATIC_STATE, keys.CONTEXT_ID, keys.WRIST_IMAGE, ("next", *keys.STATE)])
def test_missing_entries_are_named(key):
    rollouts = step_rollouts([2], steps=2)
    del rollouts[key]
    with pytest.raises(ValueError, match=f"lack the entries.*{key if isinstance(key, str) else key[-1]}"):
        episodes_from_rollouts(rollouts)


@pytest.mark.parametrize("key", [keys.STATES, keys.STEP_MASK])
def test_missing_entries_of_decisions_are_named(key):
    rollouts = decision_rollouts([[3, 3]])
    del rollouts["next", key]
    with pytest.raises(ValueError, match=f"lack the entries.*{key}"):
        episodes_from_rollouts(rollouts)


def test_rollouts_without_a_goal_are_refused():
    rollouts = step_rollouts([2], steps=2)
    del rollouts[keys.INSTRUCTION]
    with pytest.raises(ValueError, match="language_instruction"):
        episodes_from_rollouts(rollouts)


def test_rollouts_without_images_are_refused():
    rollouts = step_rollouts([2], steps=2, cameras=())
    with pytest.raises(ValueError, match="lack images after each step"):
        episodes_from_rollouts(rollouts)


def test_rollouts_in_which_nothing_happened_are_refused():
    rollouts = step_rollouts([2], steps=2)
    rollouts[keys.MASK] = torch.zeros(1, 2, dtype=torch.bool)
    with pytest.raises(ValueError, match="no executed step"):
        episodes_from_rollouts(rollouts)
    with pytest.raises(ValueError, match="at least one step"):
        episodes_from_rollouts(rollouts[:0])


def test_concatenated_episodes_are_padded_like_one_set():
    whole = step_rollouts([3, 6, 2, 5], steps=6)
    together = episodes_from_rollouts(whole)
    apart = Episodes.cat([episodes_from_rollouts(whole[:1]), episodes_from_rollouts(whole[1:])])
    assert same(together, apart)
