"""TabletopEnv: specs, exact and independent rows, initial states in order, honest errors."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.transforms import MultiAction, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from worldenv_trl.envs import ExpertPolicy, TabletopEnv, context_id
from worldenv_trl.keys import (
    ACTION,
    CONTEXT_ID,
    IMAGE,
    INSTRUCTION,
    KINEMATIC_STATE,
    NUM_STEPS,
    SIM_STATE,
    STATE,
    SUCCESS,
    TASK_ID,
    WRIST_IMAGE,
)
from worldenv_trl.scenes import list_tasks, load_task
from worldenv_trl.scenes.catalogue import SUITES_FOLDER

TASKS = list_tasks("starter")
DRAWER, BOWL, STOVE = TASKS
SHOWN = (IMAGE, STATE, KINEMATIC_STATE, NUM_STEPS, SUCCESS, CONTEXT_ID, SIM_STATE, "reward", "done", "truncated")


def make(task=DRAWER, n=2, **options):
    return TabletopEnv(task, n, **({"image_size": 16, "seed": 0, "num_threads": 1, "with_sim_state": True} | options))


def actions(steps, n, seed=0):
    return torch.rand(steps, n, 7, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def play(env, plan, td=None):
    """Open-loop ``plan`` [T, n, 7]; the list of what each step showed."""
    td, shown = env.reset() if td is None else td, []
    for action in plan:
        td = env.step(td.set(ACTION, action))
        shown.append(td["next"].clone())
        td = env.step_mdp(td)
    return shown


def assert_equal_rows(a, b, keys=SHOWN):
    for key in keys:
        if key in a.keys(True, True):
            assert torch.equal(a[key], b[key]), key


# ----------------------------------------------------------------------------------------------------- specs


@pytest.mark.parametrize("task", [BOWL, TASKS], ids=["one task", "three tasks"])
@pytest.mark.parametrize("options", [{}, {"with_sim_state": False, "cameras": ("agentview", "wrist")}, {"cameras": ()}])
def test_specs_are_what_is_written(task, options):
    env = make(task, 3, **options)
    check_env_specs(env)
    env.close()


def test_specs_hold_under_torchrl_s_own_transforms():
    env = TransformedEnv(make(n=3), MultiAction.from_vla(stack_rewards=False)).append_transform(StepCounter(4))
    check_env_specs(env)
    env.close()


def test_shapes_dtypes_and_contents_of_a_reset():
    td = make(TASKS, 6, cameras=("agentview", "wrist")).reset()
    assert td[IMAGE].shape == td[WRIST_IMAGE].shape == (6, 3, 16, 16) and td[IMAGE].dtype == torch.uint8
    assert td[STATE].shape == (6, 7) and td[KINEMATIC_STATE].shape == (6, 20)
    assert td[TASK_ID].flatten().tolist() == [0, 1, 2] * 2
    assert td[INSTRUCTION] == [load_task(name).language for name in TASKS] * 2
    assert not td[SUCCESS].any() and not td["done"].any() and (td[NUM_STEPS] == 0).all()
    assert td[IMAGE].float().std() > 10  # something is drawn


# ----------------------------------------------------------------------------------------------------- rows


@pytest.mark.parametrize("task", TASKS)
def test_a_batch_of_sixteen_on_two_threads_is_sixteen_batches_of_one(task):
    plan = 0.6 * actions(6, 16)
    together = play(make(task, 16, num_threads=2, init_state_mode="cycle"), plan)
    for row in (0, 7, 15):
        alone = play(make(task, 1, init_state_mode="fixed", init_state_id=row), plan[:, row : row + 1])
        for many, one in zip(together, alone, strict=True):
            assert_equal_rows(many[row : row + 1], one)


def test_rows_of_a_mixed_batch_are_those_of_their_task_alone():
    plan = 0.6 * actions(5, 6)
    mixed = play(make(TASKS, 6, init_state_mode="cycle"), plan)
    for slot, task in enumerate(TASKS):
        alone = play(make(task, 2, task_ids=[slot], init_state_mode="cycle"), plan[:, slot::3])
        for many, one in zip(mixed, alone, strict=True):
            size = one[SIM_STATE].shape[-1]
            assert_equal_rows(many[slot::3], one, [key for key in SHOWN if key != SIM_STATE])
            assert torch.equal(many[SIM_STATE][slot::3, :size], one[SIM_STATE])
            assert not many[SIM_STATE][slot::3, size:].any()


def test_rows_that_are_not_stepped_show_what_they_showed():
    env = make(BOWL, 4)
    plan = actions(3, 4)
    before = play(env, plan[:2])[-1]
    td = env.step_mdp(TensorDict({"next": before, ACTION: plan[2]}, [4]))
    active = torch.tensor([True, False, False, True])
    after = env.step(td.set(ACTION, plan[2]).set("_step", active))["next"]
    assert_equal_rows(after[~active], before[~active])
    assert (after[NUM_STEPS][active] == 3).all() and not torch.equal(after[SIM_STATE][0], before[SIM_STATE][0])


def test_a_partial_reset_leaves_the_other_rows_alone():
    env = make(BOWL, 4)
    before = play(env, actions(3, 4))[-1]
    mask = torch.tensor([[False], [True], [False], [True]])
    after = env.reset(before.clone().set("_reset", mask))
    kept = ~mask.squeeze(-1)
    assert_equal_rows(after[kept], before[kept], (IMAGE, STATE, KINEMATIC_STATE, NUM_STEPS, SIM_STATE))
    assert (after[NUM_STEPS][mask] == 0).all()
    assert not torch.equal(after[IMAGE][1], before[IMAGE][1])
    reference = play(make(BOWL, 4), actions(4, 4))[-1]
    assert_equal_rows(play(env, actions(4, 4)[3:], after)[-1][kept], reference[kept])


def test_what_was_returned_is_not_overwritten_later():
    env = make(n=2)
    first = env.reset()
    copy = first.clone()
    play(env, actions(3, 2), first.clone())
    assert_equal_rows(first, copy, (IMAGE, STATE, KINEMATIC_STATE, NUM_STEPS, SIM_STATE, SUCCESS))


# ----------------------------------------------------------------------------------------------------- reset


@pytest.mark.parametrize("task", [BOWL, TASKS], ids=["one task", "three tasks"])
def test_a_sim_state_from_the_middle_continues_exactly(task):
    env, plan = make(task, 3, max_steps=9), 0.7 * actions(9, 3)
    shown = play(env, plan)
    again = env.reset(shown[3].clone(), set_state=True)
    assert_equal_rows(again, shown[3], (IMAGE, STATE, KINEMATIC_STATE, NUM_STEPS, SUCCESS, CONTEXT_ID, SIM_STATE))
    for one, two in zip(shown[4:], play(env, plan[4:], again), strict=True):
        assert_equal_rows(one, two)
    assert shown[-1]["truncated"].all()


def test_a_state_is_honoured_through_transforms():
    env = TransformedEnv(make(n=2), StepCounter(50))
    start = env.reset()
    env.rollout(4)
    again = env.reset(start.clone(), set_state=True)
    assert_equal_rows(again, start, (IMAGE, STATE, KINEMATIC_STATE, SIM_STATE, CONTEXT_ID))


def test_a_context_id_alone_names_the_initial_state():
    env = make(STOVE, 3, task_ids=[2], with_sim_state=False, init_state_mode="cycle")
    wanted = torch.tensor([context_id(2, "train", 7), context_id(2, "test", 60), context_id(2, "train", 0)])
    td = env.reset(TensorDict({CONTEXT_ID: wanted.unsqueeze(-1)}, [3]), set_state=True)
    assert td[CONTEXT_ID].flatten().tolist() == wanted.tolist()
    other = make(STOVE, 1, init_split="test", init_state_mode="fixed", init_state_id=60).reset()
    assert torch.equal(td[IMAGE][1:2], other[IMAGE]) and torch.equal(td[KINEMATIC_STATE][1:2], other[KINEMATIC_STATE])


def test_the_tasks_numbers_are_those_that_the_run_gives_them():
    env = make([STOVE, DRAWER], 4, cameras=(), task_ids=(7, 3), init_state_mode="cycle")
    td = env.reset()
    assert env.task_ids == (7, 3) and [task.name for task in env.tasks] == [STOVE, DRAWER]
    assert td[TASK_ID].flatten().tolist() == [7, 3, 7, 3]
    assert td[CONTEXT_ID].flatten().tolist() == [context_id(task, "train", i) for i in (0, 1) for task in (7, 3)]
    again = env.reset(td.clone(), set_state=True)
    assert torch.equal(again[CONTEXT_ID], td[CONTEXT_ID])


def test_a_state_that_happens_to_be_there_is_not_honoured():
    env = make(DRAWER, 1, init_state_mode="cycle")
    first = env.reset()
    assert env.reset(first.clone())[CONTEXT_ID].item() == first[CONTEXT_ID].item() + 1


def test_given_initial_states_are_used_with_their_numbers():
    states = load_task(DRAWER).init_states("test", 5)[3:]
    env = make(DRAWER, 3, init_states=states, context_ids=[11, 12], init_state_mode="cycle")
    td = env.reset()
    assert td[CONTEXT_ID].flatten().tolist() == [11, 12, 11]
    assert torch.equal(td[SIM_STATE], torch.from_numpy(states[[0, 1, 0]]))


# ----------------------------------------------------------------------------------------------------- initial states


def ids(env, resets):
    return torch.stack([env.reset()[CONTEXT_ID].flatten() for _ in range(resets)])


def test_cycle_gives_every_state_its_turn_wave_after_wave():
    env = make(DRAWER, 4, cameras=(), init_state_mode="cycle", init_state_count=10, init_split="test")
    assert ids(env, 3).flatten().tolist() == [context_id(0, "test", i % 10) for i in range(12)]


def test_random_draws_every_state_once_before_any_twice():
    drawn = ids(make(DRAWER, 5, cameras=(), init_state_count=10), 4).reshape(2, 10)
    assert all(sorted(epoch.tolist()) == [context_id(0, "train", i) for i in range(10)] for epoch in drawn)
    assert drawn[0].tolist() != drawn[1].tolist()


def test_the_order_of_states_is_a_function_of_the_seed_only():
    many, few = make(DRAWER, 8, cameras=()), make(DRAWER, 2, cameras=())
    order = ids(many, 1).flatten()
    assert torch.equal(order, ids(few, 4).flatten())
    many.set_seed(1)
    assert not torch.equal(order, ids(many, 1).flatten())
    many.set_seed(0)
    assert torch.equal(order, ids(many, 1).flatten())


def test_the_order_of_states_follows_from_the_task_whatever_its_number_and_company():
    alone = ids(make(STOVE, 6, cameras=()), 2)
    numbered = ids(make(STOVE, 6, cameras=(), task_ids=[5]), 2)
    beside = ids(make([BOWL, STOVE], 12, cameras=()), 2)[:, 1::2]
    assert torch.equal(numbered - context_id(5, "train", 0), alone)
    assert torch.equal(beside - context_id(1, "train", 0), alone)
    assert not torch.equal(ids(make(DRAWER, 6, cameras=()), 2), alone)  # another task, another order


def test_the_rows_of_a_group_share_their_initial_state_and_task():
    env = make([BOWL, STOVE], 12, group_repeats=3)
    for _ in range(2):
        td = env.reset().reshape(4, 3)
        for key in (CONTEXT_ID, TASK_ID, SIM_STATE, IMAGE):
            assert (td[key] == td[key][:, :1]).all()
        assert len(td[CONTEXT_ID][:, 0].unique()) == 4


def test_a_full_reset_brings_groups_back_together_after_partial_ones():
    env = make(DRAWER, 4, cameras=(), group_repeats=2)
    env.reset()
    env.reset(TensorDict({"_reset": torch.tensor([True, False, False, False])[:, None]}, [4]))
    numbers = env.reset()[CONTEXT_ID].reshape(2, 2)
    assert (numbers[:, 0] == numbers[:, 1]).all() and numbers[0, 0] != numbers[1, 0]


# ----------------------------------------------------------------------------------------------------- reward, ends


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_ends_an_episode_with_one_reward(task):
    env = make(task, 3, cameras=())
    rollout = env.rollout(80, ExpertPolicy(env), break_when_all_done=True)
    done = rollout["next", "done"].squeeze(-1)
    valid = (done.cumsum(1) - done.long()) == 0
    assert rollout["next", SUCCESS].any(1).all() and rollout["next", "terminated"].any(1).all()
    assert not rollout["next", "truncated"].any()
    assert torch.equal((rollout["next", "reward"].squeeze(-1) * valid).sum(1), torch.ones(3))
    assert torch.equal(rollout["next", NUM_STEPS].amax(1).flatten(), valid.sum(1))


def test_without_termination_rows_run_to_the_limit_and_reward_is_success():
    env = make(DRAWER, 2, cameras=(), terminate_on_success=False, max_steps=50)
    rollout = env.rollout(80, ExpertPolicy(env), break_when_all_done=True)
    assert rollout.shape == (2, 50)
    assert not rollout["next", "terminated"].any() and rollout["next", "truncated"][:, -1].all()
    assert torch.equal(rollout["next", "reward"], rollout["next", SUCCESS].float())
    assert rollout["next", SUCCESS][:, -1].all() and not rollout["next", SUCCESS][:, 0].any()


def blow_up(env, row):
    env.scenes[0][0].qvel[row, -6:] = 1e8


def test_physics_that_blow_up_end_their_own_row_only():
    env, calm = (TabletopEnv(BOWL, 3, image_size=32, seed=0, terminate_on_success=False) for _ in range(2))
    td, expected = env.reset(), calm.reset()
    scene = env.scenes[0][0]
    blow_up(env, 1)
    action = 0.3 * torch.ones(3, 7)
    with pytest.warns(UserWarning, match=r"put_the_bowl_on_the_plate: the physics of row 1 blew up at step 0 .*seed 0"):
        after = env.step(td.set("action", action))["next"]
    expected = calm.step(expected.set("action", action))["next"]
    assert after["truncated"].squeeze(-1).tolist() == after["done"].squeeze(-1).tolist() == [False, True, False]
    assert after["observation", "state"].isfinite().all()
    for row in (0, 2):
        assert torch.equal(after["observation", "image"][row], expected["observation", "image"][row])
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, batch_size=[3]))
    assert np.isfinite(scene.qpos).all() and np.abs(scene.qvel[1]).max() < 1


@pytest.mark.filterwarnings("ignore:.*blew up")
def test_an_end_stands_until_the_reset_whether_the_row_is_stepped_or_not():
    env = make(BOWL, 3, cameras=())
    td, still = env.reset(), torch.zeros(3, 7)
    blow_up(env, 1)
    for active in ([True, True, True], [True, False, False], [True, True, True]):
        td = env.step(td.set(ACTION, still).set("_step", torch.tensor(active)))["next"]
        for name in ("truncated", "done"):
            assert td[name].flatten().tolist() == [False, True, False]
        assert not td["terminated"].any()
    partial = env.reset(TensorDict({"_reset": torch.tensor([True, False, False])[:, None]}, [3]))
    assert partial["done"].flatten().tolist() == [False, True, False]
    assert not env.reset()["done"].any()
    assert not env.step(env.reset().set(ACTION, still))["next", "done"].any()


def test_going_on_after_success_can_undo_it():
    env = make(DRAWER, 4, cameras=(), init_state_mode="cycle", terminate_on_success=False)
    opened = env.rollout(64, ExpertPolicy(env), break_when_any_done=False)["next", "success"]
    assert opened.any(1).all()
    td, expert = env.reset(), ExpertPolicy(env)
    history = []
    for step in range(60):
        td = expert(td)
        if step and history[-1].any():  # some drawer is open: from now on all hands push back
            td["action"][:, :3] = torch.tensor([0.0, -0.6, 0.0])
        td = step_mdp(env.step(td))
        history.append(td["success"].squeeze(-1))
    history = torch.stack(history)  # World-Env Figure 6
    assert history.any() and not history[-1].any()


def test_proprio_is_the_accumulated_target_unless_the_measured_one_is_asked_for():
    env, measuring = make(DRAWER, 1, cameras=()), make(DRAWER, 1, cameras=(), proprio="measured")
    plan = torch.zeros(3, 1, 7)
    plan[..., 0], plan[..., 6] = 0.4, 1.0
    start = env.reset()
    end = play(env, plan, start.clone())[-1]
    moved = end[STATE] - start[STATE]
    assert torch.allclose(moved[0, :3], torch.tensor([0.06, 0, 0]), atol=1e-6)
    assert moved[0, 6].item() == pytest.approx(-0.6, abs=1e-6)
    assert torch.allclose(end[STATE][0, :3], end[KINEMATIC_STATE][0, 7:10])
    measured = play(measuring, plan)[-1]
    assert torch.equal(measured[SIM_STATE], end[SIM_STATE]) and not torch.equal(measured[STATE], end[STATE])


def test_actions_are_clipped():
    small, large = (play(make(n=1), [torch.full((1, 7), value)])[-1] for value in (1.0, 30.0))
    assert_equal_rows(small, large)


# ----------------------------------------------------------------------------------------------------- errors


def test_a_file_s_path_is_a_task():
    path = SUITES_FOLDER / "goal" / "open_the_top_drawer.bddl"
    env = make(path, cameras=())
    assert [task.language for task in env.tasks] == [load_task("goal/open_the_top_drawer").language]


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.zeros(2, 6), r"must be floats \[2, 7\], got torch.float32 \[2, 6\]"),
        (torch.zeros(2, 7, dtype=torch.int64), "got torch.int64"),
        (torch.full((2, 7), torch.nan), r"NaN or infinity in rows \[0, 1\]"),
    ],
)
def test_actions_that_cannot_be_are_refused_and_move_nothing(action, message):
    env = make(n=2, cameras=())
    td = env.reset()
    with pytest.raises(ValueError, match=message):
        env.step(td.clone().set(ACTION, action))
    assert np.array_equal(env.scenes[0][0].sim_state(), td[SIM_STATE].numpy())
    with pytest.raises(ValueError, match="no 'action'"):
        env.step(td.clone())


def test_states_that_cannot_be_are_refused():
    env = make(DRAWER, 1, cameras=(), max_steps=5)
    td = env.reset()
    with pytest.raises(ValueError, match="needs 'sim_state' or 'context_id'"):
        env.reset(TensorDict({TASK_ID: td[TASK_ID]}, [1]), set_state=True)
    with pytest.raises(ValueError, match="sim_state must be"):
        env.reset(TensorDict({SIM_STATE: td[SIM_STATE][:, :9]}, [1]), set_state=True)
    with pytest.raises(ValueError, match="says otherwise"):
        env.reset(td.clone().set(TASK_ID, td[TASK_ID] + 1), set_state=True)
    with pytest.raises(ValueError, match="names no initial state"):
        env.reset(TensorDict({CONTEXT_ID: torch.tensor([[200_003]])}, [1]), set_state=True)
    with pytest.raises(ValueError, match="past max_steps=5"):
        env.reset(td.clone().set(NUM_STEPS, td[NUM_STEPS] + 5), set_state=True)


def test_a_closed_env_says_so_whether_it_drew_or_not():
    for options in ({}, {"cameras": ()}):
        env = make(n=2, **options)
        td = env.reset()
        env.close()
        for call in (env.reset, lambda env=env: env.rollout(2), lambda env=env, td=td: env.rand_step(td)):
            with pytest.raises(RuntimeError, match=r"this TabletopEnv was closed.*: build another one"):
                call()
