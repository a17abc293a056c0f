"""ImaginedEnv against a world model whose frames are known in closed form: resets, steps and ends."""

from __future__ import annotations

import pytest
import torch
from imagined_worlds import FK, SIZE, TWO, C, CountingWorldModel, given, make_contexts, make_env, with_chunk
from tensordict.nn import TensorDictModule
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from worldenv_trl import keys
from worldenv_trl.envs import ImaginedEnv, TabletopEnv, chunked
from worldenv_trl.keys import (
    CHUNK,
    CONTEXT_ID,
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
    WRIST_IMAGE,
)
from worldenv_trl.record import read_rollouts, recorded
from worldenv_trl.row_share import row_share
from worldenv_trl.scenes import list_tasks

FRAMES = keys.frames_key("agentview")
WRIST_FRAMES = keys.frames_key("wrist")


@pytest.mark.parametrize("proprio", ["commanded", "measured"])
def test_specs_hold(proprio):
    check_env_specs(make_env(proprio=proprio), seed=0)


@pytest.mark.parametrize("cameras", [["agentview"], ["wrist"], ["wrist", "from the left", "agentview"]])
def test_specs_hold_for_any_cameras(cameras):
    env = make_env(world_model=CountingWorldModel(cameras))
    check_env_specs(env, seed=0)
    assert env.cameras == tuple(cameras) and env.image_size == SIZE
    entries = {keys.image_entry(camera) for camera in cameras}
    assert set(env.reset()["observation"].keys()) == {*entries, "state"}


def test_specs_hold_when_the_last_chunk_is_cut():
    check_env_specs(make_env(max_steps=2 * C + 1), seed=0)


def test_specs_hold_under_transforms():
    check_env_specs(TransformedEnv(make_env(), StepCounter()), seed=0)


# -------------------------------------------------------------------------------------------------------- resets


def test_a_reset_repeats_each_context_over_its_group_and_shows_it_exactly():
    td = make_env().reset()
    contexts = make_contexts()
    for group in range(2):
        index = int(td[CONTEXT_ID][group, 0]) - 100
        for rollout in range(3):
            for key in (IMAGE, WRIST_IMAGE, STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID):
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


def test_a_row_reset_alone_restarts_the_context_of_its_group():
    env = make_env()
    start = env.reset()
    td = env.step(with_chunk(start.clone()))["next"]
    reset = torch.zeros(2, 3, 1, dtype=torch.bool)
    reset[1, 2] = True
    again = env.reset(td.clone().set("_reset", reset), set_state=False)
    for key in (IMAGE, WRIST_IMAGE, STATE, KINEMATIC_STATE, CONTEXT_ID, NUM_STEPS):
        assert torch.equal(again[key][1, 2], start[key][1, 2]), key
        assert torch.equal(again[key][0], td[key][0]), key
    after = env.step(with_chunk(again))["next"]
    assert after[NUM_STEPS].flatten().tolist() == [2 * C] * 5 + [C]


def test_a_row_reset_alone_begins_its_video_anew():
    env = make_env()
    start = env.reset()
    td = env.step(with_chunk(start.clone()))["next"]
    reset = torch.zeros(2, 3, 1, dtype=torch.bool)
    reset[1, 2] = True
    env.step(with_chunk(env.reset(td.set("_reset", reset), set_state=False)))
    asked = env.world_model.requests[-1]["memory", "frames", "wrist_image"].unflatten(0, (2, 3))
    assert torch.equal(asked[1, 2], start[WRIST_IMAGE][1, 2].expand(2, -1, -1, -1))


def test_a_group_reset_as_a_whole_gets_the_next_context():
    env = make_env()
    start = env.reset()
    reset = torch.zeros(2, 3, 1, dtype=torch.bool)
    reset[1] = True
    again = env.reset(start.clone().set("_reset", reset), set_state=False)
    seen = set(start[CONTEXT_ID].flatten().tolist())
    assert torch.equal(again[CONTEXT_ID][0], start[CONTEXT_ID][0])
    assert len(set(again[CONTEXT_ID][1].flatten().tolist())) == 1 and int(again[CONTEXT_ID][1, 0]) not in seen


def test_given_contexts_are_where_rollouts_begin():
    env = make_env()
    picks = [[4, 0, 2], [1, 1, 3]]
    td = env.reset(given(env, picks), set_state=True)
    assert (td[CONTEXT_ID].squeeze(-1) - 100).tolist() == picks
    for key in (IMAGE, WRIST_IMAGE, STATE, KINEMATIC_STATE, TASK_ID):
        assert torch.equal(td[key], make_contexts()[key][torch.tensor(picks)]), key
    texts = [["push" if pick % 2 else "pull" for pick in row] for row in picks]
    assert [[td[INSTRUCTION][g][n] for n in range(3)] for g in range(2)] == texts


def test_given_contexts_without_a_goal_get_that_of_their_task():
    env = make_env(1, 2)
    td = env.reset(given(env, [[3, 2]]).exclude(INSTRUCTION), set_state=True)
    assert td[INSTRUCTION][0][0] == "push" and td[INSTRUCTION][0][1] == "pull"


def test_given_contexts_are_put_into_the_rows_that_are_reset():
    env = make_env()
    td = env.step(with_chunk(env.reset()))["next"]
    reset = torch.zeros(2, 3, dtype=torch.bool)
    reset[0, 1] = reset[1, 0] = True
    start, new = td.exclude(INSTRUCTION).clone(), given(env, [[4] * 3, [4] * 3])
    for key in (IMAGE, WRIST_IMAGE, STATE, KINEMATIC_STATE, TASK_ID, CONTEXT_ID):
        start[key][reset] = new[key][reset]
    again = env.reset(start.set("_reset", reset.unsqueeze(-1)), set_state=True)
    assert torch.equal(again[CONTEXT_ID].squeeze(-1) == 104, reset | (td[CONTEXT_ID].squeeze(-1) == 104))
    after = env.step(with_chunk(again, seed=2))["next"]
    assert torch.equal(after[NUM_STEPS].squeeze(-1), torch.where(reset, C, 2 * C))
    now = torch.where(reset, 40, td[IMAGE][:, :, 0, 0, 0].long())  # red of the fifth context is 40
    assert torch.equal(after[FRAMES][:, :, 0, 0, 0, 0].long(), now + 1)


# --------------------------------------------------------------------------------------------------------- steps


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


@pytest.mark.parametrize(("image", "frames"), [(IMAGE, FRAMES), (WRIST_IMAGE, WRIST_FRAMES)])
def test_the_observation_is_the_last_frame_of_the_chunk(image, frames):
    env = make_env()
    after = env.step(with_chunk(env.reset()))["next"]
    assert torch.equal(after[image], after[frames][:, :, -1])
    assert after[frames].shape == (2, 3, C, 3, SIZE, SIZE)


def test_the_state_is_the_last_one_of_the_chunk():
    env = make_env()
    after = env.step(with_chunk(env.reset()))["next"]
    assert torch.equal(after[STATE], after[STATES][:, :, -1])
    assert torch.equal(after[KINEMATIC_STATE], after[KINEMATIC_STATES][:, :, -1])
    assert after[STEP_MASK].all() and (after[NUM_STEPS] == C).all()
    assert not after["reward"].any() and not after["terminated"].any()


def test_only_active_rows_reach_the_world_model_and_the_others_stand_still():
    env = make_env()
    td = env.step(with_chunk(env.reset()))["next"]
    active = torch.tensor([[True, False, False], [False, True, True]])
    with_chunk(td, seed=2).set("_step", active)
    after = env.step(td.clone())["next"]
    assert len(env.world_model.requests[-1]) == 3
    for key in (IMAGE, WRIST_IMAGE, STATE, KINEMATIC_STATE, NUM_STEPS):
        assert torch.equal(after[key][~active], td[key][~active]), key
        assert not torch.equal(after[key][active], td[key][active]), key
    assert not after[STEP_MASK][~active].any() and not after[FRAMES][~active].any()


def test_rows_that_stood_still_go_on_as_if_nothing_had_happened():
    env = make_env()
    td = env.step(with_chunk(env.reset()))["next"]
    active = torch.tensor([[True, False, False], [False, True, True]])
    after = env.step(with_chunk(td, seed=2).set("_step", active))["next"]
    resumed = env.step(with_chunk(after, seed=3))["next"]
    assert torch.equal(resumed[FRAMES][:, :, 0, 0, 0, 0], after[IMAGE][:, :, 0, 0, 0] + 1)


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
    assert torch.equal(td[IMAGE], td[FRAMES][:, :, 1]) and torch.equal(td[WRIST_IMAGE], td[WRIST_FRAMES][:, :, 1])
    assert torch.equal(td[KINEMATIC_STATE], td[KINEMATIC_STATES][:, :, 1])


def test_rows_at_the_end_are_not_imagined_further():
    env = make_env(max_steps=C)
    td = env.step(with_chunk(env.reset()))["next"]
    after = env.step(with_chunk(td, seed=2))["next"]
    assert len(env.world_model.requests) == 1 and after["truncated"].all()
    for key in (IMAGE, STATE, NUM_STEPS):
        assert torch.equal(after[key], td[key]), key
    assert not after[STEP_MASK].any()


def test_a_rollout_ends_when_every_row_is_truncated():
    env = make_env()
    policy = TensorDictModule(lambda state: torch.zeros(*state.shape[:-1], C, 7), in_keys=[STATE], out_keys=[CHUNK])
    rollout = env.rollout(10, policy, break_when_all_done=True, break_when_any_done=False)
    assert rollout.shape == (2, 3, 3)
    assert rollout["next", "truncated"][..., -1, 0].all() and not rollout["next", "truncated"][..., :-1, 0].any()


# ------------------------------------------------------------------------------------------------ other envs, files


def test_physics_and_imagination_have_the_same_interface():
    physics_env = TabletopEnv(list_tasks("starter")[0], 6, image_size=SIZE, cameras=TWO, seed=0)
    real = chunked(physics_env, C, frames=True)
    start = real.reset()
    env = ImaginedEnv(CountingWorldModel(), FK, start, [2, 3], max_steps=C)

    def leaves(spec):
        entries = {key: spec[key] for key in spec.keys(True, True)}
        return {key: (tuple(leaf.shape[len(spec.shape) :]), leaf.dtype) for key, leaf in entries.items()}

    physics, imagination = leaves(real.observation_spec), leaves(env.observation_spec)
    shared = set(physics) - {SUCCESS}
    assert {key: imagination[key] for key in shared} == {key: physics[key] for key in shared}
    assert set(imagination) - set(physics) == {NOISE_SEED}
    assert env.action_keys == real.action_keys == [CHUNK]
    assert env.full_action_spec[CHUNK].shape[-2:] == real.full_action_spec[CHUNK].shape[-2:] == (C, 7)
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
    read = read_rollouts(tmp_path / "a.mcap")["next"]
    for key in (FRAMES, WRIST_FRAMES, IMAGE, WRIST_IMAGE, NOISE_SEED, KINEMATIC_STATES, STEP_MASK):
        assert torch.equal(read[key], rollouts["next"][key]), key
    for decision, asked in enumerate(world_model.requests[:3]):
        assert torch.equal(read[NOISE_SEED][:, decision], asked[NOISE_SEED])
        painted = world_model(asked)
        for key in (FRAMES, WRIST_FRAMES):
            assert torch.equal(painted[key], read[key][:, decision])


def test_processes_that_share_the_groups_imagine_what_one_does():
    whole_env = make_env(groups=4)
    shares = [make_env(groups=2) for _ in range(2)]
    for _ in range(3):  # from one pass over the contexts into the next
        whole = whole_env.step(with_chunk(whole_env.reset()))
        parts = []
        for rank, env in enumerate(shares):
            with row_share(rank, 2):
                first = env.reset()
            chunk = whole[CHUNK][2 * rank : 2 * rank + 2]
            parts.append(env.step(first.set(CHUNK, chunk)))
        assert torch.equal(torch.cat([part[CONTEXT_ID] for part in parts]), whole[CONTEXT_ID])
        assert torch.equal(torch.cat([part["next", NOISE_SEED] for part in parts]), whole["next", NOISE_SEED])
        assert torch.equal(torch.cat([part["next", FRAMES] for part in parts]), whole["next", FRAMES])
