from __future__ import annotations

import pytest
import torch
from small_rollouts import CAMERAS, make_episodes
from swaps.copying_world_model import CopyingConfig, CopyingWorldModel
from torchrl.data import ReplayBuffer

from worldenv_trl import keys, memmap
from worldenv_trl.data import Episodes, WindowBuffer, WindowSampler, predicted_poses, window_buffer
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.language import instructions_of
from worldenv_trl.row_share import row_share
from worldenv_trl.world_models import Window, request

C = 4
FK = ForwardKinematics()
IMAGE, WRIST = keys.frames_key("agentview"), keys.frames_key("wrist")


def world_model(cameras=CAMERAS, stride: int = 1, size: int = 8) -> CopyingWorldModel:
    """Remembers the newest frame and the one ``stride`` before."""
    return CopyingWorldModel(CopyingConfig(cameras=tuple(cameras), image_size=size, chunk_length=C, stride=stride))


def make_buffer(lengths: list[int], **options) -> WindowBuffer:
    return window_buffer(make_episodes(lengths), FK, world_model(), **{"seed": 0, "batch_size": 8, **options})


def drawn(buffer: WindowBuffer, batches: int = 1) -> torch.Tensor:
    """Episode and start of each window that is drawn: [n, 2]."""
    infos = [buffer.sample(return_info=True)[1] for _ in range(batches)]
    return torch.cat([torch.stack([info["episode"], info["start"]], -1) for info in infos])


def window_of(buffer: WindowBuffer, episode: int, start: int):
    """One window [1], looked up."""
    index, info = buffer.sampler.window(torch.tensor([episode]), torch.tensor([start]))
    return buffer.windows(buffer.storage[index], info)


# --------------------------------------------------------------------------------------------------------- poses


def test_poses_are_predicted_from_the_first_state_step_by_step():
    episodes = make_episodes([6, 3])
    poses = predicted_poses(episodes, FK)
    assert poses.shape == (2, 7, 13)
    for row in range(2):
        state = episodes["kinematic_states"][row, :1]
        for step in range(7):
            assert torch.allclose(poses[row, step], FK.pose(state)[0], atol=1e-5)
            if step < 6:
                state = FK(state, episodes["actions"][row, step : step + 1])


# ------------------------------------------------------------------------------------------------------- windows


def test_a_window_shows_the_reference_the_memory_of_every_chunk_and_what_follows():
    td = window_of(make_buffer([12, 9]), 1, 3)
    assert td["number"].tolist() == [[0, 2, 3, 6, 7, *range(4, 12)]]
    shown = [50 + min(number, 9) for number in (0, 2, 3, 6, 7, *range(4, 12))]
    assert td[IMAGE][0, :, 0, 0, 0].tolist() == shown
    assert td[WRIST][0, :, 2, 5, 5].tolist() == [value + 7 for value in shown]


def test_poses_of_a_window_go_with_its_frames():
    buffer = make_buffer([12, 9])
    poses = predicted_poses(make_episodes([12, 9]), FK)
    td = window_of(buffer, 1, 3)
    assert torch.equal(td["poses"][0], poses[1, td["number"][0].clamp(max=9)])


def test_actions_of_a_window_end_with_the_episode():
    episodes = make_episodes([12, 9])
    td = window_of(make_buffer([12, 9]), 1, 3)
    assert torch.equal(td["actions"][0, :6], episodes["actions"][1, 3:9]) and not td["actions"][0, 6:].any()
    assert td["step_mask"].tolist() == [[True] * 6 + [False] * 2]


def test_a_window_may_begin_with_the_last_frame_of_the_longest_episode():
    td = window_of(make_buffer([12, 9]), 0, 12)
    assert not td["step_mask"].any() and not td["actions"].any() and (td[IMAGE][0, 5:] == 12).all()


def test_a_window_tells_its_start_and_its_goal():
    td = make_buffer([12, 9], batch_size=5).sample()
    assert td.batch_size == (5,) and td["start"].shape == (5, 1) and td["actions"].shape == (5, 2 * C, 7)
    rows = td[IMAGE][:, 0, 0, 0, 0] // 50
    assert instructions_of(td) == [f"goal {row}" for row in rows.tolist()]


@pytest.mark.parametrize("chunks", [1, 2, 3])
def test_sampled_windows_equal_a_slow_gather(chunks):
    buffer, episodes = make_buffer([12, 3, 9], chunks=chunks, batch_size=16), make_episodes([12, 3, 9])
    poses = predicted_poses(episodes, FK)
    td, info = buffer.sample(return_info=True)
    for place, (row, start) in enumerate(zip(info["episode"].tolist(), info["start"].tolist(), strict=True)):
        window, length = Window(td[place : place + 1]), int(episodes["length"][row])
        for chunk in range(chunks):
            now = start + chunk * C
            for number in (0, max(0, now - 1), now, *range(now + 1, now + C + 1)):
                known = window.recall(torch.tensor([[number]]))
                seen = min(number, length)
                assert int(known[IMAGE][0, 0, 0, 0, 0]) == 50 * row + seen
                assert int(known[WRIST][0, 0, 0, 0, 0]) == 50 * row + seen + 7
                assert torch.equal(known["poses"][0, 0], poses[row, seen])
            for step in range(C):
                inside = now + step < length
                assert bool(td["step_mask"][place, chunk * C + step]) == inside
                wanted = episodes["actions"][row, now + step] if inside else torch.zeros(7)
                assert torch.equal(td["actions"][place, chunk * C + step], wanted)


def test_a_window_answers_everything_that_the_model_asks():
    model = world_model(stride=3)
    buffer = window_buffer(make_episodes([12, 9]), FK, model, chunks=3, seed=0)
    td = buffer.sample()
    window = Window(td)
    for chunk in range(3):
        now = window.start + chunk * C
        targets = window.recall(now.unsqueeze(-1) + torch.arange(1, C + 1))
        steps = slice(chunk * C, chunk * C + C)
        asked = request(model, window.recall, now, targets["poses"], window.actions[:, steps], instructions_of(td))
        row, length = td[IMAGE][:, 0, 0, 0, 0].long() // 50, torch.tensor([12, 9])
        newest = 50 * row + torch.minimum(now, length[row])
        assert torch.equal(asked["memory", "frames", "image"][:, -1, 0, 0, 0].long(), newest)


def test_a_window_holds_the_frames_of_the_models_cameras_alone():
    buffer = window_buffer(make_episodes([12, 9]), FK, world_model(["wrist"]), seed=0)
    assert set(buffer.sample()["frames"].keys()) == {"wrist_image"}


def test_windows_of_frames_on_disk_are_those_of_frames_in_memory(tmp_path, monkeypatch):
    """Although what they show of the files is given back after every sample."""
    monkeypatch.setattr(memmap, "_MOST", 0)
    episodes = make_episodes([12, 9])
    stored = episodes.with_video(episodes.video[0].memmap(tmp_path))
    buffers = [window_buffer(each, FK, world_model(), seed=0) for each in (episodes, stored)]
    for _ in range(3):
        in_memory, on_disk = (buffer.sample() for buffer in buffers)
        assert (in_memory == on_disk).all()


def test_a_start_outside_its_episode_is_refused():
    sampler = WindowSampler(make_episodes([12, 9]), world_model())
    with pytest.raises(ValueError, match="frame 10 of episode 1, which has frames 0 to 9"):
        sampler.window(torch.tensor([0, 1]), torch.tensor([10, 10]))
    with pytest.raises(ValueError, match="frame -1 of episode 0"):
        sampler.window(torch.tensor([0, 1]), torch.tensor([-1, 0]))


# --------------------------------------------------------------------------------------------------------- draws


def test_windows_come_from_a_replay_buffer_that_cannot_be_written():
    buffer = make_buffer([12, 9])
    assert isinstance(buffer, ReplayBuffer) and len(buffer) == 12 + 9 + 2
    with pytest.raises(RuntimeError):
        buffer.extend(buffer.storage[:2])


def test_every_start_is_drawn_and_no_other():
    buffer = make_buffer([12, 3, 0, 5], chunks=1, reset_share=0.0, batch_size=2000)
    assert len(buffer.sampler) == 9 + 1 + 0 + 2  # a start leaves room for a chunk, short episodes have one
    places = drawn(buffer)
    assert {tuple(place) for place in places.tolist()} == {*((0, start) for start in range(9)), (1, 0), (3, 0), (3, 1)}
    counts = torch.unique(places, dim=0, return_counts=True)[1]
    assert counts.min() > 2000 / 12 * 0.6


def test_windows_start_at_the_reset_more_often_when_asked():
    at_reset = (drawn(make_buffer([40], reset_share=0.5, batch_size=1000))[:, 1] == 0).float().mean()
    assert 0.4 < at_reset < 0.62


def make_outcomes() -> Episodes:
    """Task 0: three successes and a failure; task 1 only fails."""
    episodes = make_episodes([12, 12, 8, 12, 10])
    episodes[keys.TASK_ID] = torch.tensor([[0], [0], [0], [0], [1]])
    episodes["success"] = torch.zeros(5, 13, dtype=torch.bool)
    episodes["success"][:3, 5:] = True
    return episodes


def shares(failure_share: float | None) -> torch.Tensor:
    buffer = window_buffer(
        make_outcomes(), FK, world_model(), failure_share=failure_share, seed=0, batch_size=6000, chunks=1
    )
    return torch.bincount(drawn(buffer)[:, 0], minlength=5) / 6000


def test_without_a_share_every_start_is_as_likely():
    assert torch.allclose(shares(None), torch.tensor([9, 9, 5, 9, 7]) / 39, atol=0.03)


def test_failures_get_their_share_of_every_task():
    wanted = torch.cat([0.4 * torch.tensor([9, 9, 5]) / 23, torch.tensor([0.6, 1.0])]) / 2
    assert torch.allclose(shares(0.6), wanted, atol=0.03)


def test_a_share_of_none_or_all_failures_still_draws_something_of_every_task():
    assert torch.allclose(shares(1.0), torch.tensor([0, 0, 0, 0.5, 0.5]), atol=0.03)
    assert shares(0.0)[4] == 0 and abs(float(shares(0.0)[:3].sum()) - 1) < 1e-6


def test_draws_repeat_themselves_for_a_seed_and_only_for_it():
    first, again, other = (make_buffer([12, 9], seed=seed).sample() for seed in (4, 4, 5))
    assert (first == again).all() and not torch.equal(first["number"], other["number"])


def test_without_a_seed_draws_come_from_torchs_generator():
    places = []
    for seed in (4, 4, 5):
        torch.manual_seed(seed)
        places.append(drawn(make_buffer([12, 9], seed=None)))
    assert torch.equal(places[0], places[1]) and not torch.equal(places[0], places[2])


def test_other_draws_do_not_disturb_it():
    buffers = [make_buffer([12, 9]) for _ in range(2)]
    quiet = drawn(buffers[0], 3)
    disturbed = torch.cat([(torch.manual_seed(index), drawn(buffers[1]))[1] for index in range(3)])
    assert torch.equal(quiet, disturbed)


def test_a_buffer_restored_from_its_state_continues_the_same_draws():
    first = make_buffer([12, 9])
    first.sample()
    state = first.state_dict()
    expected = drawn(first, 3)
    second = make_buffer([12, 9], seed=7)
    second.load_state_dict(state)
    assert torch.equal(drawn(second, 3), expected)


def test_the_state_of_a_buffer_holds_no_frames():
    assert set(make_buffer([12, 9]).state_dict()) == {"sampler"}


def test_a_sampler_restored_from_its_state_continues_the_same_draws():
    first = make_buffer([12, 9])
    sampler = WindowSampler(make_episodes([12, 9]), world_model(), seed=9)
    sampler.load_state_dict(first.sampler.state_dict())
    assert torch.equal(sampler.sample(None, 8)[0], first.sampler.sample(None, 8)[0])


# ------------------------------------------------------------------------------------------------------- refusals


def test_episodes_that_the_model_cannot_see_are_refused():
    with pytest.raises(ValueError, match="the world model looks at 'wrist', the episodes show 'agentview' only"):
        window_buffer(make_episodes([12], cameras=["agentview"]), FK, world_model())
    with pytest.raises(ValueError, match="looks at frames of 8 px, the episodes' are 16 px"):
        window_buffer(make_episodes([12], size=16), FK, world_model())


def test_episodes_without_a_step_are_refused():
    for episodes in (make_episodes([5])[:0], make_episodes([5, 0])[1:]):
        with pytest.raises(ValueError, match="no executed step"):
            window_buffer(episodes, FK, world_model())


def test_episodes_of_several_stores_are_refused():
    with pytest.raises(ValueError, match="fill one from all recordings"):
        window_buffer(Episodes.cat([make_episodes([5]), make_episodes([5])]), FK, world_model())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunks": 0}, "chunks must be at least 1, got 0"),
        ({"reset_share": 1.5}, "reset_share must lie between 0 and 1, got 1.5"),
        ({"failure_share": 2}, "failure_share must lie between 0 and 1, got 2"),
    ],
)
def test_impossible_settings_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make_buffer([12], **options)


def test_a_share_of_failures_needs_labels():
    episodes = make_episodes([12])
    unlabelled = Episodes(episodes.entries.exclude("success"), episodes.instructions, episodes.video[0])
    with pytest.raises(ValueError, match="no success labels"):
        window_buffer(unlabelled, FK, world_model(), failure_share=0.5)


def test_processes_that_share_a_batch_draw_the_windows_of_one():
    whole = drawn(make_buffer([9, 4], batch_size=6, seed=3), batches=2)
    shares = []
    for rank in range(3):
        buffer = make_buffer([9, 4], batch_size=2, seed=3)
        with row_share(rank, 3):
            shares.append(drawn(buffer, batches=2).unflatten(0, (2, 2)))
    assert torch.equal(torch.cat(shares, 1).flatten(0, 1), whole)
