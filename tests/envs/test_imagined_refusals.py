"""What ImaginedEnv refuses, in clear words."""

from __future__ import annotations

import re

import pytest
import torch
from imagined_worlds import FK, SIZE, C, CountingWorldModel, given, make_contexts, make_env, with_chunk

from worldenv_trl import keys
from worldenv_trl.envs import ImaginedEnv
from worldenv_trl.keys import CHUNK, CONTEXT_ID, IMAGE, INSTRUCTION, KINEMATIC_STATE, STATE, WRIST_IMAGE


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c[:0], "at least one initial state"),
        (lambda c: c.reshape(5, 1), r"TensorDict \[K\] .* got batch size \[5, 1\]"),
        (lambda c: c.exclude(KINEMATIC_STATE), "lack the entries"),
        (lambda c: c.exclude(INSTRUCTION), "lack the entries"),
        (lambda c: c.exclude(WRIST_IMAGE), r"lack the entries .*wrist_image.*cameras=\('agentview', 'wrist'\)"),
        (lambda c: c.set(IMAGE, c[IMAGE].float()), "must be uint8"),
        (lambda c: c.set(WRIST_IMAGE, c[WRIST_IMAGE][..., :8, :8].clone()), r"wrist_image'\) must be uint8 .*8, 8\)"),
        (lambda c: c.set(STATE, torch.zeros(5, 8)), r"must be \(5, 7\)"),
        (lambda c: c.set(STATE, c[STATE] + 0.5), "another robot"),
    ],
)
def test_unusable_contexts_are_refused(spoil, message):
    with pytest.raises(ValueError, match=message):
        ImaginedEnv(CountingWorldModel(), FK, spoil(make_contexts()), [1, 1], max_steps=C)


def test_contexts_of_another_size_than_the_world_models_are_refused():
    with pytest.raises(ValueError, match=rf"must be uint8 \[K, 3, {2 * SIZE}, {2 * SIZE}\], as the world model paints"):
        ImaginedEnv(CountingWorldModel(size=2 * SIZE), FK, make_contexts(), [1, 1], max_steps=C)


def test_contexts_may_show_more_cameras_than_the_world_model_paints():
    env = ImaginedEnv(CountingWorldModel(["wrist"]), FK, make_contexts(), [1, 1], max_steps=C, seed=0)
    assert set(env.reset()["observation"].keys()) == {"wrist_image", "state"}


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (torch.zeros(2, 3, C, 6), "must be floats"),
        (torch.zeros(2, 3, 2 * C, 7), "must be floats"),
        (torch.zeros(2, 3, 7), "must be floats"),
        (torch.zeros(2, 3, C, 7, dtype=torch.int64), "must be floats"),
        (torch.full((2, 3, C, 7), float("nan")), "NaN"),
        (None, "no action chunk"),
    ],
)
def test_unusable_chunks_are_refused(chunk, message):
    env = make_env()
    td = env.reset()
    if chunk is not None:
        td.set(CHUNK, chunk)
    with pytest.raises(ValueError, match=message):
        env.step(td)


def test_a_row_that_is_not_stepped_may_hold_anything():
    env = make_env()
    td = with_chunk(env.reset())
    td[CHUNK][0, 0] = float("nan")
    active = torch.ones(2, 3, dtype=torch.bool)
    active[0, 0] = False
    assert env.step(td.set("_step", active))["next", STATE].isfinite().all()


@pytest.mark.parametrize("size", [8, [4], [2, 0], [1, 2, 3]])
def test_unusable_batch_sizes_are_refused(size):
    with pytest.raises(
        ValueError, match=re.escape(f"batch_size must be [contexts, rollouts of each], both at least 1, got {size}")
    ):
        ImaginedEnv(CountingWorldModel(), FK, make_contexts(), size, max_steps=C)


@pytest.mark.parametrize(("setting", "value"), [("proprio", "true"), ("max_steps", 0)])
def test_unusable_settings_are_refused(setting, value):
    with pytest.raises(ValueError, match=f"{setting} must be .*got '?{value}'?"):
        make_env(**{setting: value})


@pytest.mark.parametrize("key", [CONTEXT_ID, WRIST_IMAGE])
def test_given_contexts_must_be_complete(key):
    env = make_env(1, 1)
    with pytest.raises(ValueError, match=f"missing.*{key if isinstance(key, str) else key[-1]}"):
        env.reset(given(env, [[0]]).exclude(key), set_state=True)


def test_given_contexts_must_be_of_the_envs_size():
    env = make_env(1, 1)
    start = given(env, [[0]])
    start[WRIST_IMAGE] = start[WRIST_IMAGE][..., :8, :8]
    with pytest.raises(ValueError, match=re.escape("'wrist_image') is (3, 8, 8), not (3, 16, 16)")):
        env.reset(start, set_state=True)


class Careless(CountingWorldModel):
    """Paints one camera too few, or another kind of frames."""

    def __init__(self, spoil) -> None:
        super().__init__()
        self._spoil = spoil

    def forward(self, tensordict):
        return self._spoil(super().forward(tensordict))


@pytest.mark.parametrize(
    ("spoil", "got"),
    [
        (lambda td: td.exclude(keys.frames_key("wrist")), "nothing"),
        (lambda td: td.set(keys.frames_key("wrist"), td[keys.frames_key("wrist")].float()), "torch.float32 "),
        (lambda td: td.set(keys.frames_key("wrist"), td[keys.frames_key("wrist")][:, :2]), "torch.uint8 (6, 2, "),
    ],
)
def test_a_world_model_that_does_not_paint_what_it_should_is_named(spoil, got):
    env = make_env(world_model=Careless(spoil))
    expected = (
        f"the world model Careless must write ('frames', 'wrist_image') as uint8 (6, {C}, 3, {SIZE}, {SIZE}), got {got}"
    )
    with pytest.raises(ValueError, match=re.escape(expected)):
        env.step(with_chunk(env.reset()))
