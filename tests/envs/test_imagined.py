"""ImaginedEnv against a world model whose frames are known in closed form."""

from __future__ import annotations

import pytest
import torch
from tensordict import NonTensorStack, TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from worldenv_trl.envs import ImaginedEnv, TabletopEnv, chunked
from worldenv_trl.keys import (
    CHUNK,
    CONTEXT_ID,
    FRAMES,
    IMAGE,
    INSTRUCTION,
    KINEMATIC_STATE,
    KINEMATIC_STATES,
    NOISE_SEED,
    NUM_STEPS,
    STATE,
    STATES,
    STEP_MASK,
    SUCCESS,
    TASK_ID,
)
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.record import read_rollouts, recorded
from worldenv_trl.robot import panda
from worldenv_trl.scenes import list_tasks

SIZE, C = 16, 4
FK = ForwardKinematics()


class CountingWorldModel(TensorDictModuleBase):
    """Red counts the frames, green is noise of the row's seed, blue the newest remembered red. Keeps its requests."""

    in_keys = [("memory", "frames"), "poses", "noise_seed"]  # noqa: RUF012
    out_keys = [FRAMES]  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.requests: list[TensorDict] = []

    def memory_indices(self, t: torch.Tensor) -> torch.Tensor:
        return torch.stack([t // 2, t], -1)

    def forward(self, tensordict: TensorDict) -> TensorDict:
        self.requests.append(tensordict.clone())
        newest = tensordict["memory", "frames"][:, -1, 0, 0, 0].long()
        frames = torch.zeros(*tensordict.shape, C, 3, SIZE, SIZE, dtype=torch.uint8)
        frames[:, :, 0] = (newest[:, None] + torch.arange(1, C + 1)).to(torch.uint8)[..., None, None]
        for row, seed in enumerate(tensordict["noise_seed"].flatten().tolist()):
            generator = torch.Generator().manual_seed(seed)
            frames[row, :, 1] = torch.randint(256, (C, SIZE, SIZE), generator=generator, dtype=torch.uint8)
        frames[:, :, 2] = newest.to(torch.uint8)[:, None, None, None]
        return tensordict.set(FRAMES, frames)


def make_contexts(count: int = 5) -> TensorDict:
    generator = torch.Generator().manual_seed(3)
    q = torch.as_tensor(panda.HOME_Q, dtype=torch.float32) + 0.05 * torch.randn(count, 7, generator=generator)
    kinematic_state = FK.initial_state(q)
    images = torch.randint(256, (count, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8)
    images[:, 0] = (10 * torch.arange(count, dtype=torch.uint8))[:, None, None]
    contexts = TensorDict(
        {
            "observation": {"image": images, "state": FK.state(kinematic_state, "commanded")},
            KINEMATIC_STATE: kinematic_state,
            TASK_ID: torch.arange(count)[:, None] % 2,
            CONTEXT_ID: 100 + torch.arange(count)[:, None],
        },
        batch_size=[count],
    )
    contexts.set(INSTRUCTION, NonTensorStack(*["push" if i % 2 else "pull" for i in range(count)]))
    return contexts


def make_env(groups: int = 2, rollouts: int = 3, *, count: int = 5, **kwargs) -> ImaginedEnv:
    kwargs = {"max_steps": 3 * C, "seed": 0, "chunk_length": C} | kwargs
    return ImaginedEnv(CountingWorldModel(), FK, make_contexts(count), [groups, rollouts], **kwargs)


def with_chunk(td: TensorDict, scale: float = 0.5, seed: int = 1) -> TensorDict:
    chunk = scale * torch.randn(*td.shape, C, 7, generator=torch.Generator().manual_seed(seed))
    return td.set(CHUNK, chunk)


def given(env: ImaginedEnv, picks: list[list[int]]) -> TensorDict:
    return make_contexts()[torch.tensor(picks)].reshape(env.batch_size)


@pytest.mark.parametrize("proprio", ["commanded", "measured"])
def test_specs_hold(proprio):
    check_env_specs(make_env(proprio=proprio), seed=0)


def test_specs_hold_when_the_last_chunk_is_cut():
    check_env_specs(make_env(max_steps=2 * C + 1), seed=0)


def test_specs_hold_under_transforms():
    check_env_specs(TransformedEnv(make_env(), StepCounter()), seed=0)


def test_a_reset_repeats_each_context_over_its_group_and_shows_it_exactly():
    td = make_env().reset()
    contexts = make_contexts()
    for group in range(2):
        index = int(td[CONTEXT_ID][group, 0]) - 100
        for rollout in range(3):
            for key in (IMAGE, STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID):
                assert torch.equal(td[key][group, rollout], contexts[key][index])
            assert td[INSTRUCTION][group][rollout] == contexts[INSTRUCTION][index]
    assert not td[STEP_MASK].any() and not td[NUM_STEPS].any() and not td["done"].any()


def test_contexts_are_drawn_without_replacement_while_possible():
    env = make_env(groups=2, count=5)
    drawn = [env.reset()[CONTEXT_ID][:, 0, 0].tolist() for _ in range(5)]
    assert all(len(set(pair)) == 2 for pair in drawn)
    flat = [index for pair in drawn for index in pair]
    assert sorted(flat[:5]) == sorted(flat[5:]) == list(range(100, 105))


def test_more_groups_than_contexts_repeat_them_evenly():
    ids = make_env(groups=7, count=3).reset()[CONTEXT_ID][:, 0, 0].tolist()
    assert sorted(ids.count(i) for i in (100, 101, 102)) == [2, 2, 3]


def test_the_tasks_take_turns_in_every_draw():
    env = make_env(groups=2, count=6)
    drawn = [env.reset() for _ in range(6)]
    assert all(sorted(td[TASK_ID][:, 0, 0].tolist()) == [0, 1] for td in drawn)
    flat = [index for td in drawn for index in td[CONTEXT_ID][:, 0, 0].tolist()]
    assert flat[:6] != flat[6:] and sorted(flat[:6]) == sorted(flat[6:]) == list(range(100, 106))


def test_the_seed_decides_contexts_and_noise():
    def wave(seed):
        env = make_env(seed=seed)
        return [env.step(with_chunk(env.reset()))["next"] for _ in range(2)]

    first, same, other = wave(4), wave(4), wave(5)
    assert all(torch.equal(a[FRAMES], b[FRAMES]) for a, b in zip(first, same, strict=True))
    assert not torch.equal(first[0][FRAMES], other[0][FRAMES])
    env = make_env(seed=9)
    env.set_seed(4)
    assert torch.equal(env.step(with_chunk(env.reset()))["next", FRAMES], first[0][FRAMES])


def test_states_are_the_forward_kinematics_of_the_clipped_chunk():
    env = make_env()
    td = with_chunk(env.reset(), scale=3.0)
    sent = td[CHUNK].clone()
    after = env.step(td)["next"]
    expected = FK.rollout(td[KINEMATIC_STATE], sent.clamp(-1, 1))
    assert torch.equal(td[CHUNK], sent)
    assert torch.allclose(after[KINEMATIC_STATES], expected, atol=1e-6)
    assert torch.allclose(after[STATES], FK.state(expected, "commanded"), atol=1e-6)
    assert torch.allclose(env.world_model.requests[0]["poses"], FK.pose(expected).flatten(0, 1), atol=1e-6)
    padded = env.world_model.requests[0]["padded_actions"]
    assert torch.equal(padded[..., :7], sent.clamp(-1, 1).flatten(0, 1)) and not padded[..., 7:].any()


def test_the_observation_is_the_last_frame_of_the_chunk():
    env = make_env()
    after = env.step(with_chunk(env.reset()))["next"]
    assert torch.equal(after[IMAGE], after[FRAMES][:, :, -1])
    assert torch.equal(after[STATE], after[STATES][:, :, -1])
    assert torch.equal(after[KINEMATIC_STATE], after[KINEMATIC_STATES][:, :, -1])
    assert after[STEP_MASK].all() and (after[NUM_STEPS] == C).all()
    assert not after["reward"].any() and not after["terminated"].any()


def test_the_world_model_remembers_the_frames_it_asked_for():
    env = make_env()
    td = env.reset()
    first, video, poses = td[IMAGE], [td[IMAGE][:, :, None]], [FK.pose(td[KINEMATIC_STATE])[:, :, None]]
    for decision in range(3):
        td = env.step(with_chunk(td, seed=decision))["next"]
        request = env.world_model.requests[-1]
        t = decision * C
        before, before_poses = torch.cat(video, 2).flatten(0, 1), torch.cat(poses, 2).flatten(0, 1)
        assert torch.equal(request["memory", "frames"], before[:, [t // 2, t]])
        assert torch.allclose(request["memory", "poses"], before_poses[:, [t // 2, t]], atol=1e-6)
        assert torch.equal(request["memory", "reference"], first.flatten(0, 1))
        video.append(td[FRAMES])
        poses.append(FK.pose(td[KINEMATIC_STATES]))


def test_a_row_does_not_depend_on_the_other_rows():
    together, alone = make_env(3, 2), make_env(1, 2)
    a = together.reset(given(together, [[0, 0], [4, 4], [2, 2]]), set_state=True)
    b = alone.reset(given(alone, [[4, 4]]), set_state=True)
    for decision in range(3):
        with_chunk(a, seed=decision)
        b.set(CHUNK, a[CHUNK][1:2])
        a, b = together.step(a)["next"], alone.step(b)["next"]
        for key in (FRAMES, KINEMATIC_STATES, STATE, IMAGE):
            assert torch.equal(a[key][1:2], b[key]), key


def test_rollouts_of_a_group_have_different_noise_and_so_have_waves_of_one_context():
    env = make_env(1, 2, count=1)
    waves = [env.step(with_chunk(env.reset()))["next", FRAMES] for _ in range(2)]
    assert not torch.equal(waves[0][0, 0, :, 1], waves[0][0, 1, :, 1])
    assert not torch.equal(waves[0][0, 0, :, 1], waves[1][0, 0, :, 1])


def test_given_contexts_replay_with_the_same_noise():
    env = make_env(1, 2)
    start = given(env, [[3, 3]])
    first, second = (env.step(with_chunk(env.reset(start.clone(), set_state=True)))["next", FRAMES] for _ in range(2))
    assert torch.equal(first, second)


def test_only_active_rows_reach_the_world_model_and_the_others_stand_still():
    env = make_env()
    td = env.step(with_chunk(env.reset()))["next"]
    active = torch.tensor([[True, False, False], [False, True, True]])
    with_chunk(td, seed=2).set("_step", active)
    after = env.step(td.clone())["next"]
    assert len(env.world_model.requests[-1]) == 3
    for key in (IMAGE, STATE, KINEMATIC_STATE, NUM_STEPS):
        assert torch.equal(after[key][~active], td[key][~active]), key
        assert not torch.equal(after[key][active], td[key][active]), key
    assert not after[STEP_MASK][~active].any()
    # The frozen rows then go on as if nothing had happened.
    resumed = env.step(with_chunk(after, seed=3))["next"]
    assert torch.equal(resumed[FRAMES][:, :, 0, 2, 0, 0], after[IMAGE][:, :, 0, 0, 0])


def test_a_row_that_is_not_stepped_keeps_its_end():
    env = make_env()
    td = with_chunk(env.reset())
    td["done"][0, 0] = td["terminated"][0, 0] = True
    td.set("_step", ~td["done"].squeeze(-1))
    after = env.step(td)["next"]
    assert after["done"].flatten().tolist() == [True] + [False] * 5
    assert after["terminated"].flatten().tolist() == [True] + [False] * 5


def test_max_steps_cuts_the_last_chunk():
    env = make_env(max_steps=C + 2)
    td = env.step(with_chunk(env.reset()))["next"]
    assert not td["truncated"].any()
    td = env.step(with_chunk(td))["next"]
    assert td["truncated"].all() and td["done"].all() and not td["terminated"].any()
    assert td[STEP_MASK].flatten(0, 1).tolist() == [[True, True, False, False]] * 6
    assert (td[NUM_STEPS] == C + 2).all()
    assert torch.equal(td[IMAGE], td[FRAMES][:, :, 1])
    assert torch.equal(td[KINEMATIC_STATE], td[KINEMATIC_STATES][:, :, 1])


def test_a_rollout_ends_when_every_row_is_truncated():
    env = make_env()
    policy = TensorDictModule(lambda state: torch.zeros(*state.shape[:-1], C, 7), in_keys=[STATE], out_keys=[CHUNK])
    rollout = env.rollout(10, policy, break_when_all_done=True, break_when_any_done=False)
    assert rollout.shape == (2, 3, 3)
    assert rollout["next", "truncated"][..., -1, 0].all() and not rollout["next", "truncated"][..., :-1, 0].any()


def test_a_row_reset_alone_restarts_the_context_of_its_group():
    env = make_env()
    start = env.reset()
    td = env.step(with_chunk(start.clone()))["next"]
    reset = torch.zeros(2, 3, 1, dtype=torch.bool)
    reset[1, 2] = True
    again = env.reset(td.clone().set("_reset", reset), set_state=False)
    for key in (IMAGE, STATE, KINEMATIC_STATE, CONTEXT_ID, NUM_STEPS):
        assert torch.equal(again[key][1, 2], start[key][1, 2]), key
        assert torch.equal(again[key][0], td[key][0]), key
    after = env.step(with_chunk(again))["next"]
    assert after[NUM_STEPS].flatten().tolist() == [2 * C] * 5 + [C]


def test_a_group_reset_as_a_whole_gets_the_next_context():
    env = make_env()
    start = env.reset()
    reset = torch.zeros(2, 3, 1, dtype=torch.bool)
    reset[1] = True
    again = env.reset(start.clone().set("_reset", reset), set_state=False)
    seen = set(start[CONTEXT_ID].flatten().tolist())
    assert torch.equal(again[CONTEXT_ID][0], start[CONTEXT_ID][0])
    assert len(set(again[CONTEXT_ID][1].flatten().tolist())) == 1 and int(again[CONTEXT_ID][1, 0]) not in seen


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c[:0], "at least one initial state"),
        (lambda c: c.exclude(KINEMATIC_STATE), "lack the entries"),
        (lambda c: c.exclude(INSTRUCTION), "lack the entries"),
        (lambda c: c.set(IMAGE, c[IMAGE].float()), "must be uint8"),
        (lambda c: c.set(STATE, torch.zeros(5, 8)), r"must be \(5, 7\)"),
        (lambda c: c.set(STATE, c[STATE] + 0.5), "another robot"),
    ],
)
def test_unusable_contexts_are_refused(spoil, message):
    with pytest.raises(ValueError, match=message):
        ImaginedEnv(CountingWorldModel(), FK, spoil(make_contexts()), [1, 1], max_steps=C, chunk_length=C)


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (torch.zeros(2, 3, C, 6), "must be floats"),
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


def test_unusable_settings_are_refused():
    contexts = make_contexts()
    for size in ([4], [2, 0], [1, 2, 3]):
        with pytest.raises(ValueError, match="batch_size"):
            ImaginedEnv(CountingWorldModel(), FK, contexts, size, max_steps=C)
    world_model = CountingWorldModel()
    world_model.image_size = 2 * SIZE
    with pytest.raises(ValueError, match=f"frames of {2 * SIZE} px, the contexts' images are"):
        ImaginedEnv(world_model, FK, contexts, [1, 1], max_steps=C, chunk_length=C)
    with pytest.raises(ValueError, match="proprio"):
        make_env(proprio="true")
    with pytest.raises(ValueError, match="max_steps"):
        make_env(max_steps=0)
    with pytest.raises(ValueError, match="missing"):
        env = make_env(1, 1)
        env.reset(given(env, [[0]]).exclude(CONTEXT_ID), set_state=True)


def test_physics_and_imagination_have_the_same_interface():
    real = chunked(TabletopEnv(list_tasks("starter")[0], 6, image_size=SIZE, proprio="commanded", seed=0), C)
    start = real.reset()
    env = ImaginedEnv(CountingWorldModel(), FK, start, [2, 3], max_steps=C, chunk_length=C)

    def leaves(spec):
        entries = {key: spec[key] for key in spec.keys(True, True)}
        return {key: (tuple(leaf.shape[len(spec.shape) :]), leaf.dtype) for key, leaf in entries.items()}

    physics, imagination = leaves(real.observation_spec), leaves(env.observation_spec)
    shared = set(physics) - {SUCCESS}
    assert {key: imagination[key] for key in shared} == {key: physics[key] for key in shared}
    assert set(imagination) - set(physics) == {FRAMES, STATES, KINEMATIC_STATES, NOISE_SEED}
    assert env.action_keys == real.action_keys == [CHUNK]  # MultiAction leaves its spec's chunk length open (-1)
    assert env.full_action_spec[CHUNK].shape[-1] == real.full_action_spec[CHUNK].shape[-1] == 7
    assert leaves(env.full_done_spec) == leaves(real.full_done_spec)
    assert leaves(env.full_reward_spec) == leaves(real.full_reward_spec)
    # The same actions move the commanded state the same way.
    replay = env.reset(start.reshape(2, 3), set_state=True)
    chunk = 0.3 * torch.rand(6, C, 7, generator=torch.Generator().manual_seed(0))
    after = real.step(start.set(CHUNK, chunk))["next"]
    imagined = env.step(replay.set(CHUNK, chunk.view(2, 3, C, 7)))["next"]
    columns = [0, 1, 2, 6]
    assert torch.allclose(imagined[STATE].flatten(0, 1)[:, columns], after[STATE][:, columns], atol=1e-5)
    real.close()


def test_a_recording_holds_the_noise_seeds_that_paint_its_frames_again(tmp_path):
    env = recorded(make_env(), tmp_path / "a.mcap")
    rollouts = env.rollout(3, break_when_any_done=False).reshape(-1, 3)
    world_model = env.base_env.world_model
    env.close()
    read = read_rollouts(tmp_path / "a.mcap")
    for key in (FRAMES, IMAGE, NOISE_SEED, KINEMATIC_STATES, STEP_MASK):
        assert torch.equal(read["next", key] if isinstance(key, str) else read["next", *key], rollouts["next", key])
    assert torch.equal(read[CHUNK], rollouts[CHUNK])
    for decision, request in enumerate(world_model.requests):
        assert torch.equal(read["next", NOISE_SEED][:, decision], request["noise_seed"])
        assert torch.equal(world_model(request)[FRAMES], read["next", FRAMES][:, decision])
        if decision == 2:
            break
