"""Where the expert's demonstrations begin, and how far from them held-out states lie."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from benchmark_module import benchmark
from small_run import SMALL

import config
from demonstrate import demonstrate
from evaluate import rolled
from run import Run
from stages import open_run
from worldenv_trl import keys
from worldenv_trl.context_ids import context_id
from worldenv_trl.record import read_rollouts
from worldenv_trl.scenes import goal_places, layout_distances, load_task, spread_states

TASKS = config.GOAL_TASKS[1:]


def demonstrated(path, states: str) -> Run:
    settings = dataclasses.replace(
        SMALL,
        run_dir=path,
        tasks=TASKS,
        max_steps=32,
        train_states=12,
        demonstrate=config.Demonstrate(episodes_per_task=2, states=states),
        evaluate=config.Evaluate(episodes_per_task=4, num_envs=4),
    )
    run = open_run(settings)
    demonstrate(run)
    return run


def places(name: str, split: str, count: int) -> np.ndarray:
    task = load_task(name)
    return goal_places(task, task.init_states(split, count))


def contexts(run: Run) -> list[int]:
    rollouts = read_rollouts(run.folder.rollouts("demonstrations"))
    return rollouts[keys.CONTEXT_ID][..., 0, 0].flatten().tolist()


def test_demonstrations_begin_at_the_first_states(tmp_path):
    run = demonstrated(tmp_path / "run", "first")
    assert contexts(run) == [context_id(task, "train", index) for task in (0, 1) for index in (0, 1)]


def test_or_at_those_that_are_spread(tmp_path):
    run = demonstrated(tmp_path / "run", "spread")
    chosen = [spread_states(places(task, "train", 12), 2) for task in TASKS]
    assert contexts(run) == [context_id(task, "train", row) for task, rows in enumerate(chosen) for row in rows]


def test_but_not_at_those_where_the_expert_does_what_it_hardly_ever_does(tmp_path, monkeypatch):
    rare = np.arange(12) % 3 == 0
    asked = []

    def usual(task, states, share):
        asked.append((len(states), share))
        return ~rare if task.name.endswith(TASKS[0].split("/")[1]) else np.arange(12) < 1  # too few of the second

    monkeypatch.setattr("demonstrate.usual_states", usual)
    run = demonstrated(tmp_path / "run", "spread")
    first, second = (places(task, "train", 12) for task in TASKS)
    rows = [np.flatnonzero(~rare)[spread_states(first[~rare], 2)].tolist(), spread_states(second, 2)]
    assert contexts(run) == [context_id(task, "train", row) for task, chosen in enumerate(rows) for row in chosen]
    assert asked == [(12, 0.25)] * 2


def test_success_by_distance_from_the_demonstrations(tmp_path, capsys):
    run = demonstrated(tmp_path / "run", "spread")
    run.parts.policy.make(run.config).save_pretrained(run.folder.checkpoint("sft"))
    success = rolled(run, "physics", "sft", None)
    coverage = benchmark("coverage")
    found = coverage.read_run(run.folder.path, ("sft",))
    trained, held_out = places(TASKS[0], "train", 12), places(TASKS[0], "test", 4)
    expected = layout_distances(held_out, trained[spread_states(trained, 2)], trained).min(1)
    np.testing.assert_allclose(found.distances[TASKS[0]], expected)
    assert found.success["sft", TASKS[0]].tolist() == success[TASKS[0]].tolist()
    capsys.readouterr()
    coverage.main(coverage.Settings((run.folder.path,), policies=("sft",), parts=2))
    table = capsys.readouterr().out.splitlines()
    near, far = np.sort(expected)[:2].mean(), np.sort(expected)[2:].mean()
    assert table[2] == f"| {TASKS[0]} | distance | {near:.2f} | {far:.2f} |"
    with pytest.raises(SystemExit, match=r"evaluate_physics_post_train.mcap does not exist: run the stage 'evaluate'"):
        coverage.main(coverage.Settings((run.folder.path,)))


def test_policies_on_different_states_are_not_compared(tmp_path):
    run = demonstrated(tmp_path / "run", "first")
    policy = run.parts.policy.make(run.config)
    for name, episodes in (("sft", 4), ("post_train", 2)):
        policy.save_pretrained(run.folder.checkpoint(name))
        fewer = dataclasses.replace(run.config, evaluate=config.Evaluate(episodes_per_task=episodes, num_envs=2))
        rolled(Run(fewer, run.folder), "physics", name, None)
    coverage = benchmark("coverage")
    with pytest.raises(SystemExit, match="sft, post_train were not evaluated on the same states"):
        coverage.main(coverage.Settings((run.folder.path,)))
    with pytest.raises(SystemExit, match="one of --policies at least"):
        coverage.main(coverage.Settings((run.folder.path,), policies=()))


def test_runs_with_other_demonstrations_are_not_taken_together(tmp_path):
    runs = [demonstrated(tmp_path / states, states) for states in ("first", "spread")]
    for run in runs:
        run.parts.policy.make(run.config).save_pretrained(run.folder.checkpoint("sft"))
        rolled(run, "physics", "sft", None)
        coverage = benchmark("coverage")
    with pytest.raises(SystemExit, match=r"spread has other demonstrations or held-out states than .*first"):
        coverage.main(coverage.Settings(tuple(run.folder.path for run in runs), policies=("sft",)))
