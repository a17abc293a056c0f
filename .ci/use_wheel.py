"""What a user does first with an installed worldenv_trl: a batch of scenes, a recording, what it holds, a replay."""

import tempfile
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import torch

import worldenv_trl
from worldenv_trl.envs import ExpertPolicy, TabletopEnv
from worldenv_trl.record import MCAPLogger, RolloutWriter, provenance, read_rollouts, replay
from worldenv_trl.record.view import show_layout
from worldenv_trl.report import RunRecord, write_report
from worldenv_trl.scenes import list_suites, list_tasks, load_task

where = Path(worldenv_trl.__file__).parent
assert "site-packages" in where.parts, f"worldenv_trl comes from {where}, not from the wheel"
assert (files("worldenv_trl") / "py.typed").is_file(), "py.typed is not in the wheel: type checkers see no types"

for suite in list_suites():
    for task in list_tasks(suite):
        load_task(task)  # every task's file is there

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    env = TabletopEnv("starter/open_the_top_drawer", num_envs=4, image_size=64, seed=0, with_sim_state=True)
    rollouts = env.rollout(24, ExpertPolicy(env), break_when_any_done=False)
    assert rollouts.shape == (4, 24) and rollouts["observation", "image"].float().std() > 10, "the scenes are blank"
    about = provenance(env)
    with RolloutWriter(folder / "demo.mcap", **about) as writer:
        writer.write(rollouts)
    env.close()
    again = read_rollouts(folder / "demo.mcap")
    for key in ("action", ("observation", "image"), ("next", "observation", "image")):
        assert torch.equal(again[key], rollouts[key]), f"{key} was not read back as it was"
    told = replay(folder / "demo.mcap", mode="physics", rollout=0)
    print(told)
    (folder / "run").mkdir()
print(f"worldenv_trl {version('worldenv_trl')} from its wheel: 4 scenes, 24 steps, recorded, read and replayed")
