"""What a user does first with an installed worldenv_trl: a batch of scenes, a recording, what it holds, a replay."""

import json
import sys
import tempfile
from importlib.metadata import files, version
from pathlib import Path

import torch

import worldenv_trl
from worldenv_trl.envs import ExpertPolicy, TabletopEnv
from worldenv_trl.record import RolloutWriter, provenance, read_rollouts, replay
from worldenv_trl.record.view import foxglove_layout
from worldenv_trl.report import RunRecord, write_report
from worldenv_trl.scenes import list_suites, list_tasks, load_task

where = Path(worldenv_trl.__file__).parent
assert "site-packages" in where.parts, f"worldenv_trl comes from {where}, not from the wheel"
tracked = set(sys.argv[1:])
missing = sorted(tracked - {str(file) for file in files("worldenv_trl") or ()})
assert tracked and not missing, f"the wheel lacks {missing}: see package-data in pyproject.toml"
tasks = [load_task(task) for suite in list_suites() for task in list_tasks(suite)]

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    env = TabletopEnv("starter/open_the_top_drawer", 4, image_size=64, seed=0, with_sim_state=True)
    rollouts = env.rollout(24, ExpertPolicy(env), break_when_any_done=False)
    assert rollouts.shape == (4, 24)
    assert rollouts["observation", "image"].float().std() > 10, "the scenes are blank"
    with RolloutWriter(folder / "demo.mcap", **provenance(env)) as writer:
        writer.write(rollouts)
    env.close()
    again = read_rollouts(folder / "demo.mcap")
    for key in ("action", ("observation", "image"), ("next", "observation", "image")):
        assert torch.equal(again[key], rollouts[key]), f"{key} was not read back as it was"
    told = replay(folder / "demo.mcap", mode="physics")
    assert told.exact, f"the replay is not exact: {told}"
    assert foxglove_layout(folder / "demo.mcap")
    (folder / "config.yaml").write_text("tasks: [starter/open_the_top_drawer]\n")
    (folder / "metrics.jsonl").write_text(json.dumps({"stage": "sft", "step": 0, "l1": 1.0}) + "\n")
    write_report(RunRecord.read(folder), folder / "report.html")

print(
    f"worldenv_trl {version('worldenv_trl')} from its wheel: {len(tasks)} tasks; 4 x 24 steps recorded, read, replayed"
)
