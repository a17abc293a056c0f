"""Recorded actions imagined, with models whose frames are known in closed form."""

from __future__ import annotations

import shutil

import pytest
import torch
from small_rollouts import CAMERAS, make_episodes, same
from swaps.copying_world_model import CopyingConfig, CopyingWorldModel

from worldenv_trl import keys
from worldenv_trl.data import Episodes, imagine_episodes
from worldenv_trl.data.imagine import FrameSink
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.language import instructions_of

C = 4
FK = ForwardKinematics()
LENGTHS = [9, 3, 12, 8, 1]


class CountingWorldModel(CopyingWorldModel):
    """Red counts on from the newest remembered red, green is the seed's, blue the first remembered frame's red."""

    def __init__(self, config: CopyingConfig) -> None:
        super().__init__(config)
        self.requests = []

    def forward(self, tensordict):
        self.requests.append(tensordict.clone())
        later = torch.arange(1, C + 1)
        super().forward(tensordict)
        for camera in self.cameras:
            memory = tensordict["memory", "frames", keys.image_entry(camera)][:, :, 0, 0, 0]
            frames = tensordict[keys.frames_key(camera)]
            frames[:, :, 0] = (memory[:, -1:] + later)[..., None, None].to(torch.uint8)
            frames[:, :, 1] = (tensordict[keys.NOISE_SEED] % 251)[..., None, None].to(torch.uint8)
            frames[:, :, 2] = memory[:, :1, None, None]
        return tensordict


def counting(cameras=CAMERAS) -> CountingWorldModel:
    return CountingWorldModel(CopyingConfig(cameras=tuple(cameras), image_size=8, chunk_length=C, stride=2))


def imagined(model=None, lengths=LENGTHS, **options) -> Episodes:
    return imagine_episodes(model or counting(), make_episodes(lengths), FK, **options)


def colour(episodes: Episodes, camera: str, row: int, channel: int) -> list[int]:
    steps = torch.arange(int(episodes["length"][row]) + 1)
    return episodes.frames(camera, torch.tensor(row), steps)[:, channel, 0, 0].tolist()


def test_imagination_goes_on_from_the_first_frame_on_its_own_frames():
    episodes = imagined()
    for row, length in enumerate(LENGTHS):
        for camera, more in zip(CAMERAS, (0, 7), strict=True):
            assert colour(episodes, camera, row, 0) == [50 * row + more + step for step in range(length + 1)]


def test_what_the_model_remembers_is_what_it_painted():
    blue = colour(imagined(), "wrist", 2, 2)
    assert blue == [107] * 1 + [107] * 4 + [109] * 4 + [113] * 4  # the first frame is real: grey


def test_a_copying_model_shows_the_first_frame_to_the_end():
    episodes = imagined(CopyingWorldModel(CopyingConfig(CAMERAS, 8, C)))
    assert colour(episodes, "wrist", 2, 1) == [107] * 13


def test_everything_but_frames_and_kinematics_stays():
    episodes, real = imagined(), make_episodes(LENGTHS)
    assert episodes.instructions == real.instructions
    for name in ("actions", "states", "success", "length", keys.TASK_ID, keys.CONTEXT_ID):
        assert torch.equal(episodes[name], real[name])


def test_kinematic_states_are_predicted_open_loop():
    episodes, real = imagined(), make_episodes(LENGTHS)
    first = real["kinematic_states"][:, 0]
    assert torch.equal(episodes["kinematic_states"][:, 0], first)
    assert torch.allclose(episodes["kinematic_states"][:, 1:], FK.rollout(first, real["actions"]), atol=1e-6)


def test_the_model_is_asked_with_the_poses_actions_and_goals_of_the_recording():
    model = counting()
    imagined(model)
    real = make_episodes(LENGTHS)
    poses = FK.pose(FK.rollout(real["kinematic_states"][:, 0], real["actions"]))
    for decision, td in enumerate(model.requests):
        steps = slice(decision * C, decision * C + C)
        assert torch.allclose(td["poses"], poses[:, steps], atol=1e-6)
        assert torch.equal(td["padded_actions"][..., :7], real["actions"][:, steps])
        assert instructions_of(td) == real.instructions


class StumblingWorldModel(CountingWorldModel):
    """Counts one too far in every frame: what it remembers shows."""

    def forward(self, tensordict):
        super().forward(tensordict)
        for camera in self.cameras:
            tensordict[keys.frames_key(camera)][:, :, 0] += 1
        return tensordict


def stumbling() -> StumblingWorldModel:
    return StumblingWorldModel(CopyingConfig(cameras=CAMERAS, image_size=8, chunk_length=C, stride=2))


@pytest.mark.parametrize(("shown", "errors"), [(1, [1, 2, 3]), (2, [1, 1, 2]), (3, [1, 1, 1]), (None, [1, 1, 1])])
def test_chunks_that_are_shown_the_truth_remember_recorded_frames(shown, errors):
    episodes = imagined(stumbling(), shown_chunks=shown)
    for camera, more in zip(CAMERAS, (0, 7), strict=True):
        off = [error for error in errors for _ in range(C)]
        assert colour(episodes, camera, 2, 0)[1:] == [100 + more + 1 + step + off[step] for step in range(3 * C)]
        remembered = [100, 100 + C - 2, 100 + 2 * C - 2]  # two frames before the newest one
        drift = [0, *(off[C * chunk - 3] if shown is not None and chunk >= shown else 0 for chunk in (1, 2))]
        blue = [frame + more + error for frame, error in zip(remembered, drift, strict=True)]
        assert colour(episodes, camera, 2, 2)[1:] == [value for value in blue for _ in range(C)]


@pytest.mark.parametrize("shown", [1, 2, 3])
def test_chunks_that_were_painted_before_are_not_painted_again(shown):
    model = stumbling()
    ahead = imagined(model, shown_chunks=None)
    model.requests.clear()
    again = imagined(model, shown_chunks=shown, painted=ahead, rows_at_once=5)
    assert same(again, imagined(stumbling(), shown_chunks=shown)) and len(model.requests) == 3 - shown


def test_no_chunk_is_without_its_first_frame():
    with pytest.raises(ValueError, match="shown_chunks must be at least 1, got 0"):
        imagined(shown_chunks=0)
    with pytest.raises(ValueError, match="painted must be the same 5 episodes, got 4"):
        imagined(painted=make_episodes(LENGTHS[:4]))


@pytest.mark.parametrize("rows_at_once", [1, 2])
def test_how_many_episodes_are_imagined_at_once_changes_nothing(rows_at_once):
    assert same(imagined(rows_at_once=rows_at_once), imagined())


def test_noise_is_of_the_seed_the_episode_and_the_chunk():
    first, again, other = imagined(), imagined(), imagined(seed=1)
    assert same(first, again) and not same(first, other)
    seeds = {*colour(first, "agentview", 0, 1)[1::C], *colour(first, "agentview", 2, 1)[1::C]}
    assert len(seeds) == 3 + 3


def test_neighbouring_seeds_and_episodes_share_no_noise():
    models = {seed: counting() for seed in (0, 1, 2, 1009)}
    for seed, model in models.items():
        imagined(model, seed=seed)
    drawn = [asked[keys.NOISE_SEED].flatten() for model in models.values() for asked in model.requests]
    assert len(torch.cat(drawn).unique()) == len(torch.cat(drawn)) == 4 * 3 * len(LENGTHS)


def test_frames_on_disk_are_those_in_memory(tmp_path):
    stored = imagined(folder=tmp_path / "frames", rows_at_once=2)
    assert same(stored, imagined())
    assert all(value.untyped_storage().filename for value in stored.video[0].values(True, True))
    assert any((tmp_path / "frames").rglob("*.memmap"))


def test_there_are_frames_of_the_models_cameras_alone():
    episodes = imagined(counting(["wrist"]))
    assert episodes.cameras == ("wrist",) and colour(episodes, "wrist", 1, 0) == [57, 58, 59, 60]


def test_a_sink_shows_the_frames_that_it_was_given_and_no_others(tmp_path):
    frames = make_episodes(LENGTHS).video[0]
    for folder in (None, tmp_path):
        sink = FrameSink(2 * len(frames), folder)
        for part in frames.split(7):
            sink.add(part)
        assert len(sink.frames) == len(frames) and (sink.frames == frames).all()


@pytest.mark.parametrize("kept", [0, 1, 3])
def test_a_sink_goes_on_behind_the_frames_that_its_state_names(tmp_path, kept):
    frames = make_episodes(LENGTHS).video[0]
    sink, states, parts = FrameSink(2 * len(frames), tmp_path), [], frames.split(7)
    states.append(sink.state_dict())
    for part in parts:
        sink.add(part)
        states.append(sink.state_dict())
    again = FrameSink(2 * len(frames), tmp_path)
    again.load_state_dict(states[kept])
    assert not kept or len(again.frames) == 7 * kept
    for part in (frames + 1).split(7)[kept:]:  # others than were there
        again.add(part)
    assert (again.frames == torch.cat([frames[: 7 * kept], (frames + 1)[7 * kept :]])).all()
    last = FrameSink(2 * len(frames), tmp_path)
    last.load_state_dict(again.state_dict())
    assert (last.frames == again.frames).all()
    if kept < len(parts):
        with pytest.raises(ValueError, match="are cut short, damaged or gone"):
            last.load_state_dict(states[-1])  # of frames that were written over
        assert (last.frames == again.frames).all()


@pytest.mark.parametrize("damage", ["cut", "flip", "gone"])
def test_frames_that_are_no_longer_what_they_were_are_refused(tmp_path, damage):
    frames = make_episodes(LENGTHS).video[0]
    sink = FrameSink(len(frames), tmp_path)
    sink.add(frames)
    state = sink.state_dict()
    path = next(tmp_path.rglob("*.memmap"))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.unlink()
    if damage != "gone":
        path.write_bytes(data if damage == "flip" else data[:1000])
    with pytest.raises(ValueError, match="are cut short, damaged or gone"):
        FrameSink(len(frames), tmp_path).load_state_dict(state)


def test_frames_in_memory_cannot_be_continued():
    with pytest.raises(ValueError, match="go with the process: give the sink a folder"):
        FrameSink(3).state_dict()


def test_imagination_is_continued_with_the_batches_that_are_left(tmp_path):
    whole, states = imagined(rows_at_once=2), []

    def stopping(count, made):
        assert count == 3
        for batch in range(2):
            yield batch
            states.append(made.state_dict())
        raise KeyboardInterrupt

    def continued(count, made):
        made.load_state_dict(states[0])
        return range(1, count)

    with pytest.raises(KeyboardInterrupt):
        imagined(rows_at_once=2, folder=tmp_path, batches=stopping)
    model = counting()
    episodes = imagined(model, rows_at_once=2, folder=tmp_path, batches=continued)
    assert same(episodes, whole) and len(model.requests) == 2 * 3  # batches, chunks of the longest


def test_a_full_disk_is_noticed_before_frames_are_written(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(OSError, match=r"the frames of the episodes take .* GB free"):
        imagined(folder=tmp_path / "imagined")
    assert not list(tmp_path.rglob("*.memmap"))
