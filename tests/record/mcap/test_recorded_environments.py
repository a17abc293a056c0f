from __future__ import annotations

import torch
from torchrl.envs.utils import step_mdp

from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.data import episodes_from_rollouts, policy_samples
from worldenv_trl.envs import TabletopEnv, chunked
from worldenv_trl.record import RolloutWriter, read_rollouts

TASKS = ["starter/open_the_top_drawer", "starter/turn_on_the_stove"]


def collect(frames: bool):
    env = TabletopEnv(TASKS, 4, image_size=32, seed=0, max_steps=6, with_sim_state=True)
    env = chunked(env, 4, frames=True) if frames else env
    torch.manual_seed(0)
    return next(iter(GroupCollector(env, None, groups_per_batch=4, group_size=1)))[:, 0]


def round_trip(path, rollouts):
    with RolloutWriter(path, metadata={"tasks": TASKS}) as writer:
        writer.write(rollouts)
    return read_rollouts(path)


def test_tabletop_rollouts_survive_the_file_step_by_step_and_chunk_by_chunk(tmp_path):
    for frames in (False, True):
        rollouts = collect(frames)
        read = round_trip(tmp_path / f"{frames}.mcap", rollouts)
        assert set(read.keys(True, True)) == set(rollouts.keys(True, True))
        mask = rollouts[keys.MASK]
        for key in rollouts.keys(True, True):
            assert torch.equal(read[key][mask], rollouts[key][mask]), key
        assert read[:, 0].get(keys.INSTRUCTION).tolist() == rollouts[:, 0].get(keys.INSTRUCTION).tolist()


def test_a_recorded_state_restarts_the_physics(tmp_path):
    rollouts = collect(frames=False)
    read = round_trip(tmp_path / "a.mcap", rollouts)
    env = TabletopEnv(TASKS, 4, image_size=32, seed=9, max_steps=6, with_sim_state=True)
    td = env.reset(read[:, 2].select(keys.SIM_STATE, keys.CONTEXT_ID, keys.NUM_STEPS), set_state=True)
    for step in (2, 3):
        td = env.step(td.set(keys.ACTION, read[keys.ACTION][:, step]))["next"]
        assert torch.equal(td[keys.SIM_STATE], rollouts["next", keys.SIM_STATE][:, step])
        assert torch.equal(td[keys.IMAGE], rollouts["next", keys.IMAGE][:, step])


def test_steps_and_chunks_of_the_same_actions_make_the_same_episodes():
    chunks = collect(frames=True)
    chunks[keys.CHUNK] = chunks[keys.CHUNK].clamp(-1, 1)
    by_chunk = episodes_from_rollouts(chunks)
    env = TabletopEnv(TASKS, 4, image_size=32, seed=0, max_steps=6, with_sim_state=True)
    td, steps = env.reset(), []
    for step in range(6):
        td = env.step(td.set(keys.ACTION, by_chunk["actions"][:, step]))
        steps.append(td)
        td = step_mdp(td, exclude_action=True)
    by_step = episodes_from_rollouts(torch.stack(steps, 1))
    for key in ("states", "kinematic_states", "actions", "length", keys.CONTEXT_ID):
        assert torch.equal(by_chunk[key], by_step[key]), key
    places = torch.arange(4)[:, None], torch.arange(7)
    assert torch.equal(by_chunk.frames("agentview", *places), by_step.frames("agentview", *places))
    assert len(policy_samples(by_step)) == int(by_step["length"].sum())
