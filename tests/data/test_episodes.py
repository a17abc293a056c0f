from __future__ import annotations

import pytest
import torch
from small_rollouts import CAMERAS, make_episodes, same
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.data import Episodes


def values(episodes: Episodes, camera: str, episode, frame) -> list:
    return episodes.frames(camera, torch.tensor(episode), torch.tensor(frame))[..., 1, 2, 3].tolist()


def test_entries_are_read_by_name():
    episodes = make_episodes([3, 5])
    assert len(episodes) == 2 and episodes["length"].flatten().tolist() == [3, 5]
    assert "success" in episodes and "frames" not in episodes
    episodes["score"] = torch.zeros(2, 6)
    assert episodes["score"].shape == (2, 6)


def test_episodes_know_their_cameras_their_size_and_their_texts():
    episodes = make_episodes([3, 5], size=16)
    assert episodes.cameras == CAMERAS and episodes.image_size == 16
    assert episodes.instructions == ["goal 0", "goal 1"]


def test_frames_up_to_the_end_belong_to_an_episode():
    assert make_episodes([1, 3]).alive.tolist() == [[True, True, False, False], [True] * 4]


def test_a_frame_is_found_by_its_episode_and_number():
    episodes = make_episodes([3, 5])
    assert values(episodes, "agentview", [0, 1, 1], [2, 0, 5]) == [2, 50, 55]
    assert values(episodes, "wrist", [0, 1, 1], [2, 0, 5]) == [9, 57, 62]


def test_episodes_and_numbers_are_broadcast():
    shown = make_episodes([3, 5]).frames("agentview", torch.tensor([[0], [1]]), torch.arange(4))
    assert shown.shape == (2, 4, 3, 8, 8) and shown.dtype == torch.uint8
    assert shown[..., 0, 0, 0].tolist() == [[0, 1, 2, 3], [50, 51, 52, 53]]


def test_past_its_end_an_episode_shows_its_last_frame():
    assert values(make_episodes([3, 5]), "agentview", [0, 0, 1], [3, 5, 40]) == [3, 3, 55]


def test_frames_of_all_cameras_are_recalled_at_once():
    episodes = make_episodes([3, 5])
    shown = episodes.recall(torch.tensor([[0], [1]]), torch.tensor([[1, 2], [3, 9]]))
    assert shown.shape == (2, 2)
    assert shown["frames", "image"][..., 0, 0, 0].tolist() == [[1, 2], [53, 55]]
    assert shown["frames", "wrist_image"][..., 0, 0, 0].tolist() == [[8, 9], [60, 62]]


@pytest.mark.parametrize(
    "rows",
    [
        slice(1, None, 2),
        torch.tensor([3, 1]),
        torch.tensor([False, True, False, True]),
        [1, 3],
        torch.tensor([], dtype=torch.int64),
    ],
    ids=["slice", "numbers", "mask", "list", "none"],
)
def test_some_of_the_episodes_show_the_frames_they_had(rows):
    episodes = make_episodes([3, 5, 2, 4])
    some, wanted = episodes[rows], torch.arange(4)[rows].tolist()
    assert len(some) == len(wanted) and some.instructions == [f"goal {row}" for row in wanted]
    assert some[keys.CONTEXT_ID].flatten().tolist() == [100 + row for row in wanted]
    places = torch.arange(len(some))
    shown = some.frames("wrist", places, torch.ones_like(places))[:, 0, 0, 0].tolist()
    assert shown == [50 * row + 8 for row in wanted]


def test_some_of_the_episodes_share_their_frames():
    episodes = make_episodes([3, 5, 2, 4])
    frames, first = episodes[2:].video
    assert frames is episodes.video[0] and first.tolist() == [10, 13]


def test_each_episode_may_begin_anywhere_among_the_frames():
    whole = make_episodes([3, 5])
    turned = Episodes(whole.entries.flip(0), ["b", "a"], whole.video[0], first=torch.tensor([4, 0]))
    assert values(turned, "agentview", [0, 1], [1, 1]) == [51, 1]


def test_frames_may_be_put_in_place_of_others():
    episodes = make_episodes([3, 5])
    other = TensorDict({keys.frames_key("wrist"): torch.full((10, 3, 4, 4), 9, dtype=torch.uint8)}, batch_size=[10])
    changed = episodes.with_video(other, kinematic_states=torch.zeros(2, 6, 20))
    assert changed.cameras == ("wrist",) and changed.image_size == 4
    assert not changed["kinematic_states"].any() and episodes["kinematic_states"].any()
    assert values(changed, "wrist", [0, 1], [0, 5]) == [9, 9] and changed.instructions == episodes.instructions


def test_episodes_may_be_seen_through_some_of_their_cameras():
    episodes = make_episodes([3, 5])
    wrist = episodes.through(["wrist"])
    assert wrist.cameras == ("wrist",) and values(wrist, "wrist", [1], [4]) == [61]
    assert set(wrist.recall(torch.tensor([0]), torch.tensor([0]))["frames"].keys()) == {"wrist_image"}
    assert episodes.cameras == CAMERAS
    with pytest.raises(ValueError, match="show agentview, wrist, not behind"):
        episodes.through(["wrist", "behind"])


def test_sets_of_one_store_are_one_store_again():
    episodes = make_episodes([3, 5, 2])
    together = Episodes.cat([episodes[2:], episodes[:2]])
    assert together.video[0] is episodes.video[0] and together.video[1].tolist() == [10, 0, 4]


def test_sets_of_one_store_seen_through_the_same_camera_are_one_store_again():
    episodes = make_episodes([3, 5, 2])
    together = Episodes.cat([part.through(["wrist"]) for part in (episodes[2:], episodes[:2])])
    assert len(together.video[0]) == 13 and together.video[1].tolist() == [10, 0, 4]


def test_sets_of_several_stores_show_their_own_frames():
    first, second = make_episodes([3, 5]), make_episodes([2, 7], first_value=100)
    together = Episodes.cat([first, second[1:], first[1:]])
    assert len(together) == 4 and together.instructions == ["goal 0", "goal 1", "goal 1", "goal 1"]
    assert values(together, "agentview", [[0], [1], [2], [3]], [1, 6, 9]) == [
        [1, 3, 3],
        [51, 55, 55],
        [151, 156, 157],
        [51, 55, 55],
    ]
    shown = together.recall(torch.tensor([2, 0]), torch.tensor([0, 1]))["frames", "wrist_image"][:, 0, 0, 0]
    assert shown.tolist() == [157, 8]


def test_sets_of_several_stores_may_be_chosen_from_and_put_together_again():
    first, second = make_episodes([3, 5]), make_episodes([2, 7], first_value=100)
    again = Episodes.cat([Episodes.cat([first, second])[torch.tensor([3, 0])], second[:1]])
    assert values(again, "agentview", [0, 1, 2], [1, 1, 1]) == [151, 1, 101]


def test_sets_are_padded_to_the_longest():
    together = Episodes.cat([make_episodes([2]), make_episodes([5], first_value=100)])
    assert together["actions"].shape == (2, 5, 7) and together["states"].shape == (2, 6, 7)
    assert not together["actions"][0, 2:].any()
    assert together["states"][0, :, 0].tolist() == [0, 1, 2, 2, 2, 2]
    assert together["success"].tolist() == [[False] * 2 + [True] * 4, [False] * 5 + [True]]


def test_the_frames_of_several_stores_are_not_one_video():
    together = Episodes.cat([make_episodes([2]), make_episodes([2])])
    with pytest.raises(ValueError, match="come from several stores: fill one from all recordings"):
        _ = together.video


def test_a_set_without_episodes_adds_nothing():
    episodes = make_episodes([3, 5])
    assert same(Episodes.cat([episodes[:0], episodes]), episodes)


def test_sets_of_episodes_that_do_not_fit_are_refused():
    episodes = make_episodes([2])
    unlabelled = Episodes(episodes.entries.exclude("success"), episodes.instructions, episodes.video[0])
    with pytest.raises(ValueError, match="success labels"):
        Episodes.cat([episodes, unlabelled])
    with pytest.raises(ValueError, match="agentview, wrist at 8 px and agentview, wrist at 16 px"):
        Episodes.cat([episodes, make_episodes([2], size=16)])
    with pytest.raises(ValueError, match="agentview, wrist at 8 px and agentview at 8 px"):
        Episodes.cat([episodes, make_episodes([2], cameras=["agentview"])])
    for nothing in ([], [episodes[:0]]):
        with pytest.raises(ValueError, match="no episodes to put together"):
            Episodes.cat(nothing)


def test_texts_and_frames_that_are_too_few_are_refused():
    episodes = make_episodes([3, 5])
    with pytest.raises(ValueError, match="2 episodes need as many instructions, got 1"):
        Episodes(episodes.entries, ["one"], episodes.video[0])
    with pytest.raises(ValueError, match="the episodes need 10 frames, there are 9"):
        Episodes(episodes.entries, episodes.instructions, episodes.video[0][:9])


def test_a_frame_before_the_first_is_refused():
    with pytest.raises(ValueError, match="frame -1 of episode 1"):
        make_episodes([3, 5]).frames("agentview", torch.tensor([0, 1]), torch.tensor([0, -1]))
