"""Chunked actions: one decision is exactly its steps, and a stop inside a chunk stops there."""

import dataclasses
import itertools

import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs.transforms import MultiAction, RewardSum, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from worldenv_trl.envs import ExpertPolicy, TabletopEnv, chunked
from worldenv_trl.keys import (
    ACTION,
    CHUNK,
    IMAGE,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    NUM_STEPS,
    SIM_STATE,
    STATE,
    STATES,
    STEP_MASK,
    SUCCESS,
    frames_key,
    image_key,
)
from worldenv_trl.robot import look_at
from worldenv_trl.scenes import load_task

DRAWER = "starter/open_the_top_drawer"
C = 4
FRAMES = frames_key("agentview")


def make(n=2, **options):
    options = {
        "image_size": 16,
        "seed": 0,
        "num_threads": 1,
        "with_sim_state": True,
        "init_state_mode": "cycle",
    } | options
    return TabletopEnv(DRAWER, n, **options)


def plan(steps, n):
    return torch.rand(steps, n, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1


def expert_plan(n, steps, first=0):
    """Actions [steps, n, 7] that open the drawer, and how many of them each row needs."""
    env = make(n, cameras=(), terminate_on_success=False, max_steps=steps, init_state_id=first)
    rollout = env.rollout(steps, ExpertPolicy(env))
    return rollout[ACTION].transpose(0, 1), rollout["next", SUCCESS].squeeze(-1).long().argmax(1) + 1


@pytest.mark.parametrize("frames", [False, True])
def test_specs_are_what_is_written(frames):
    env = chunked(make(3), C, frames=frames)
    check_env_specs(env)
    env.close()


def test_one_decision_is_its_steps_one_by_one():
    actions = plan(2 * C, 3)
    steps, single = make(3), []
    td = steps.reset()
    for action in actions:
        td = steps.step(td.set(ACTION, action))
        single.append(td["next"].clone())
        td = steps.step_mdp(td)
    env = chunked(make(3), C, frames=True)
    td = env.reset()
    assert not td[STEP_MASK].any()
    for decision in range(2):
        part = slice(decision * C, (decision + 1) * C)
        td = env.step(td.set(CHUNK, actions[part].transpose(0, 1)))
        out, last = td["next"], single[decision * C + C - 1]
        for key in (IMAGE, STATE, KINEMATIC_STATE, NUM_STEPS, SUCCESS, SIM_STATE, "reward", "done"):
            assert torch.equal(out[key], last[key]), key
        for whole, one in ((FRAMES, IMAGE), (STATES, STATE), (KINEMATIC_STATES, KINEMATIC_STATE)):
            assert torch.equal(out[whole], torch.stack([shown[one] for shown in single[part]], 1))
        assert out[STEP_MASK].all()
        td = env.step_mdp(td)


@pytest.mark.parametrize("n", [1, 3])
def test_a_success_inside_a_chunk_ends_there_with_its_reward(n):
    actions, needed = expert_plan(n, 40)
    length = int(needed.max()) + 3  # every row ends before the chunk does
    env = chunked(make(n), length, frames=True)
    out = env.step(env.reset().set(CHUNK, actions[:length].transpose(0, 1)))["next"]
    assert torch.equal(out[NUM_STEPS].flatten(), needed) and torch.equal(out[STEP_MASK].sum(1), needed)
    assert torch.equal(out[STEP_MASK], torch.arange(length) < needed[:, None])
    assert out["terminated"].all() and out["done"].all() and out[SUCCESS].all()
    assert torch.equal(out["reward"], torch.ones(n, 1))
    for row, count in enumerate(needed):
        assert torch.equal(out[FRAMES][row, count - 1], out[IMAGE][row])


def test_a_row_that_ended_waits_for_the_others_in_later_chunks():
    actions, needed = expert_plan(3, 48)
    env = chunked(make(3), C)
    decisions = -(-int(needed.max()) // C)
    chunks = iter(actions.unflatten(0, (-1, C)).permute(0, 2, 1, 3))
    rollout = env.rollout(decisions, lambda td: td.set(CHUNK, next(chunks)), break_when_all_done=True)
    done = rollout["next", "done"].squeeze(-1)
    valid = (done.cumsum(1) - done.long()) == 0
    executed = (rollout["next", STEP_MASK] & valid[..., None]).sum((1, 2))
    assert torch.equal(executed, needed)
    assert torch.equal((rollout["next", "reward"].squeeze(-1) * valid).sum(1), torch.ones(3))


def test_a_limit_that_is_no_multiple_of_the_chunk_truncates_inside_it():
    env = chunked(make(2, max_steps=6), C)
    rollout = env.rollout(5, lambda td: td.set(CHUNK, torch.zeros(2, C, 7)), break_when_all_done=True)
    assert rollout.shape == (2, 2)
    assert rollout["next", STEP_MASK][:, 1].tolist() == [[True, True, False, False]] * 2
    assert rollout["next", "truncated"][:, 1].all() and (rollout["next", NUM_STEPS][:, 1] == 6).all()


def test_a_partial_reset_clears_the_mask_of_its_rows_only_in_the_observation():
    env = chunked(make(2), C)
    td = env.rollout(2, lambda td: td.set(CHUNK, torch.zeros(2, C, 7)), auto_reset=True)[:, -1]["next"]
    td["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(td)
    assert after[NUM_STEPS].flatten().tolist() == [0, 2 * C] and not after[STEP_MASK][0].any()


@pytest.mark.filterwarnings("ignore:.*blew up")
@pytest.mark.parametrize("alone", [False, True], ids=["beside rows that go on", "alone"])
def test_a_row_whose_physics_blow_up_inside_a_chunk_is_done_after_it(alone):
    env, n = chunked(make(1 if alone else 3, cameras=()), C), 1 if alone else 3
    scene, row = env.base_env.scenes[0][0], n - 1
    td, zeros = env.reset(), torch.zeros(n, C, 7)
    step, calls = type(scene)._aim, []

    def spoiled(self, rows, *rest):
        before = step(self, rows, *rest)
        calls.append(rows.tolist())
        if len(calls) == 2:  # in the second of the chunk's steps
            self.qvel[row, -6:] = 1e8
        return before

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(scene), "_aim", spoiled)
        rollout = env.rollout(
            3, lambda td: td.set(CHUNK, zeros), tensordict=td, auto_reset=False, break_when_all_done=True
        )
    first = rollout["next"][row, 0]
    assert first[STEP_MASK].tolist() == [True, True, False, False] and first[NUM_STEPS].item() == 2
    assert first["done"] and first["truncated"] and not first["terminated"]
    others = [index for index in range(n) if index != row]
    assert calls == [list(range(n))] * 2 + [others] * (10 if others else 0)  # it is not stepped again
    if others:
        assert rollout["next", "done"].squeeze(-1).tolist() == [[False] * 3] * 2 + [[True] * 3]


@pytest.mark.filterwarnings("ignore:.*blew up")
def test_a_collected_row_begins_anew_after_its_physics_blew_up_inside_a_chunk():
    env = chunked(make(2, cameras=()), C)
    td = env.reset()
    env.base_env.scenes[0][0].qvel[1, -6:] = 1e8
    rollout = env.rollout(
        2, lambda td: td.set(CHUNK, torch.zeros(2, C, 7)), tensordict=td, auto_reset=False, break_when_any_done=False
    )
    assert rollout["next", "done"].squeeze(-1).tolist() == [[False, False], [True, False]]
    assert rollout[NUM_STEPS].squeeze(-1).tolist() == [[0, C], [0, 0]]
    assert rollout["next", NUM_STEPS].squeeze(-1).tolist() == [[C, 2 * C], [1, C]]


def test_frames_of_every_camera_are_collected():
    task = load_task(DRAWER)
    task = dataclasses.replace(
        task, cameras=(*task.cameras, look_at("sideview", (0.0, 0.8, 0.4), (0.0, 0.0, 0.1), 45.0))
    )
    names = ("agentview", "wrist", "sideview")
    env = chunked(TabletopEnv(task, 2, image_size=16, cameras=names, seed=0, num_threads=1), C, frames=True)
    check_env_specs(env)
    out = env.step(env.reset().set(CHUNK, plan(C, 2).transpose(0, 1)))["next"]
    assert (
        {entry for _, entry in map(frames_key, names)}
        == set(out["frames"].keys())
        == {"image", "wrist_image", "sideview"}
    )
    for name in names:
        frames = out[frames_key(name)]
        assert frames.shape == (2, C, 3, 16, 16) and frames.dtype == torch.uint8
        assert torch.equal(frames[:, -1], out[image_key(name)]) and frames.float().std() > 5
    env.close()


def test_without_images_only_states_are_collected():
    env = chunked(make(2, cameras=()), C, frames=True)
    out = env.step(env.reset().set(CHUNK, torch.zeros(2, C, 7)))["next"]
    assert "frames" not in out.keys() and out[STATES].shape == (2, C, 7)  # noqa: SIM118


def test_a_chunk_is_a_sample_without_bounds_and_the_env_clips_it():
    env = chunked(make(2, cameras=()), C)
    spec = env.full_action_spec[CHUNK]
    assert isinstance(spec, Unbounded) and spec.shape == (2, C, 7)
    large, one = (env.step(env.reset().set(CHUNK, torch.full((2, C, 7), value)))["next"] for value in (30.0, 1.0))
    assert torch.equal(large[STATE], one[STATE])


def test_the_chunk_s_length_is_read_through_transforms():
    env = chunked(make(2, cameras=()), C)
    wrapped = TransformedEnv(TransformedEnv(env, StepCounter()), RewardSum(), auto_unwrap=True)
    assert env.chunk_length == getattr(wrapped, "chunk_length", None) == C
    assert chunked(TransformedEnv(make(2, cameras=()), StepCounter()), 3).chunk_length == 3
    assert getattr(make(2, cameras=()), "chunk_length", None) is None
    assert getattr(TransformedEnv(make(2, cameras=()), StepCounter()), "chunk_length", None) is None
    check_env_specs(wrapped)


def test_chunks_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        chunked(make(1), 0)
    env = chunked(make(2), C)
    td = env.reset()
    for chunk in (torch.zeros(2, C + 1, 7), torch.zeros(2, C, 6), torch.zeros(2, C, 7, dtype=torch.int32)):
        with pytest.raises(ValueError, match=r"must be floats \[2, 4, 7\]"):
            env.step(td.clone().set(CHUNK, chunk))
    with pytest.raises(ValueError, match="NaN"):
        env.step(td.clone().set(CHUNK, torch.full((2, C, 7), torch.nan)))


def test_a_chunk_key_is_what_multi_action_reads():
    env = TransformedEnv(make(cameras=()), MultiAction.from_vla(stack_rewards=False))
    td = env.reset().set(CHUNK, torch.zeros(2, 3, 7))
    assert (env.step(td)["next", NUM_STEPS] == 3).all()


class Watching(Transform):
    """Looks at every image, as a reflector does."""

    def __init__(self):
        super().__init__(in_keys=[IMAGE])
        self.seen = []

    def _step(self, tensordict, next_tensordict):
        self.seen.append(next_tensordict[IMAGE].clone())
        return next_tensordict


def test_images_inside_a_chunk_are_drawn_for_who_looks_at_them():
    watching = Watching()
    env = chunked(TransformedEnv(make(2), watching), C)
    env.step(env.reset().set(CHUNK, plan(C, 2).transpose(0, 1)))
    assert len(watching.seen) == C
    assert all(not torch.equal(before, after) for before, after in itertools.pairwise(watching.seen))
    env.close()


@pytest.mark.parametrize("ends", ["together", "apart"])
def test_only_the_last_image_of_a_chunk_is_drawn_and_it_is_right(ends, monkeypatch):
    """Also of rows that end inside: where all do, and where one goes on."""
    (plan_of_one, needed), same = expert_plan(1, 60), {"init_state_mode": "fixed"}
    actions = plan_of_one.expand(-1, 2, -1).clone()
    if ends == "apart":
        actions[:, 1] = 0.1
    length = int(needed) + 1  # one chunk, inside which a row ends
    steps = make(2, **same)
    td = steps.reset()
    active = torch.ones(2, dtype=torch.bool)
    for action in actions[:length]:
        out = steps.step(td.set(ACTION, action).set("_step", active))["next"]
        active = active & ~out["done"].squeeze(-1)
        td = out.exclude("reward")
        if not active.any():
            break
    drawn = []
    pool = type(make(1)._pool)
    start = pool.start
    monkeypatch.setattr(pool, "start", lambda self, *rest: drawn.append(1) or start(self, *rest))
    env = chunked(make(2, **same), length)
    td = env.reset()
    drawn.clear()
    shown = env.step(td.set(CHUNK, actions[:length].transpose(0, 1)))["next"]
    assert len(drawn) == 1
    assert torch.equal(shown[IMAGE], out[IMAGE])
    assert shown["done"].any() and shown["done"].all() == (ends == "together")
    steps.close(), env.close()
