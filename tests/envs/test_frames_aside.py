"""Frames of a wave, left out of its TensorDict or put into files."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from imagined_worlds import SIZE, TWO, C, make_env, with_chunk
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from worldenv_trl import keys
from worldenv_trl.envs import FramesAside

BOTH = [keys.frames_key(camera) for camera in TWO]


def aside_env(keep: bool, folder: Path | None = None) -> TransformedEnv:
    env = TransformedEnv(make_env(), FramesAside(folder))
    env.transform.keep = keep
    return env


def play(env: TransformedEnv, decisions: int = 3) -> list:
    td, shown = env.reset(), []
    for decision in range(decisions):
        td = env.step(with_chunk(td, seed=decision))["next"]
        shown.append(td.clone(False))
    return shown


@pytest.mark.parametrize("keep", [False, True])
def test_specs_hold(keep):
    env = aside_env(keep)
    check_env_specs(env, seed=0)
    assert keys.FRAMES not in env.observation_spec.keys()  # noqa: SIM118 - a spec is no dict


@pytest.mark.parametrize("keep", [False, True])
def test_a_wave_carries_no_frames(keep):
    env = aside_env(keep)
    rollout = env.rollout(3, break_when_any_done=False)
    assert keys.FRAMES not in rollout.keys() and keys.FRAMES not in rollout["next"].keys()  # noqa: SIM118
    assert rollout[keys.IMAGE].any() and rollout["next", keys.STATES].any()


def test_frames_that_were_kept_are_those_that_were_shown():
    bare, env = make_env(), aside_env(keep=True)
    shown = play(bare)
    play(env)
    frames = env.transform.frames()
    assert frames.shape == (2, 3, 3)
    for key in BOTH:
        assert frames[key].shape == (2, 3, 3, C, 3, SIZE, SIZE)
        assert torch.equal(frames[key], torch.stack([td[key] for td in shown], 2))


def test_everything_else_is_as_without_it():
    for one, other in zip(play(make_env()), play(aside_env(keep=True)), strict=True):
        assert (one.exclude(keys.FRAMES) == other).all()


def test_frames_that_were_not_kept_cannot_be_had():
    env = aside_env(keep=False)
    play(env)
    with pytest.raises(RuntimeError, match="set keep to True before the env is reset"):
        env.transform.frames()


@pytest.fixture
def scratch(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_kept_frames_are_on_disk_until_the_next_reset(scratch):
    env = aside_env(keep=True)
    play(env)
    before = set(scratch.rglob("*.memmap"))
    assert len(before) == 3 * len(BOTH)
    env.transform.keep = False
    env.reset()
    assert not list(scratch.iterdir())


def test_files_go_where_they_are_told(scratch, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("run")
    env = aside_env(True, elsewhere)
    play(env)
    assert list(elsewhere.rglob("*.memmap")) and not list(scratch.iterdir())


def test_a_full_disk_is_noticed_before_frames_are_written(scratch, monkeypatch):
    usage = shutil.disk_usage(scratch)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    env = aside_env(keep=True)
    with pytest.raises(OSError, match=r"the frames of a decision take .* GB free"):
        play(env)
    assert not list(scratch.rglob("*.memmap"))


def test_every_wave_keeps_its_own_frames(scratch):
    env = aside_env(keep=True)
    play(env)
    first = env.transform.frames()
    play(env, decisions=2)
    second = env.transform.frames()
    assert len(list(scratch.iterdir())) == 1 and second.shape == (2, 3, 2)
    assert not torch.equal(first[BOTH[0]][:, :, 0], second[BOTH[0]][:, :, 0])


def test_frames_that_were_had_outlive_the_wave(scratch):
    env = aside_env(keep=True)
    shown = play(env)
    frames = env.transform.frames()
    env.reset()
    images = torch.stack([td[keys.IMAGE] for td in shown], 2)
    assert torch.equal(frames[BOTH[0]][:, :, :, -1], images)


def test_rows_that_are_reset_alone_do_not_end_a_wave():
    env = aside_env(keep=True)
    td = env.step(with_chunk(env.reset()))["next"]
    reset = torch.zeros(2, 3, 1, dtype=torch.bool)
    reset[1, 2] = True
    td = env.reset(td.set("_reset", reset), set_state=False)
    assert keys.FRAMES not in td.keys()  # noqa: SIM118
    env.step(with_chunk(td))
    assert env.transform.frames().shape == (2, 3, 2)


def test_a_wave_that_is_to_be_kept_is_asked_for_before_it_begins():
    env = aside_env(keep=False)
    td = env.reset()
    env.transform.keep = True
    env.step(with_chunk(td))
    with pytest.raises(RuntimeError, match="no frames were kept"):
        env.transform.frames()
