"""Learning curves: where success is measured, what is kept of it, intervals, and one measured for real."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from test_benchmarks import benchmark

from config import PRESETS
from corrupted_returns import Corruption
from evaluate import evaluate
from learning_curves import (
    VALIDATION_FROM,
    bootstrap_interval,
    common,
    describe,
    log_point,
    measured_iterations,
    measured_states,
    read_curve,
)
from parts import COMPACT
from physics import physics_waves_env, step_env
from post_train import post_train
from run_folder import RunFolder
from stages import open_run, rerun
from worldenv_trl import keys
from worldenv_trl.context_ids import parts_of
from worldenv_trl.scenes import load_task


@pytest.fixture
def config(tiny):
    return dataclasses.replace(tiny, cameras=())  # nothing is drawn


def test_no_stage_draws_a_validation_state(config):
    states = measured_states(config, 6)
    assert states == {"training": [0, 1, 2, 3], "validation": list(range(1000, 1006))}
    waves = physics_waves_env(config, 3, 2)
    explored = step_env(config, "train", 5)
    drawn = {
        parts_of(number)
        for env in (waves, explored)
        for _ in range(4)
        for number in env.reset()[keys.CONTEXT_ID].flatten().tolist()
    }
    assert drawn == {(0, "train", index) for index in range(config.train_states)}
    assert config.demonstrate.episodes_per_task <= config.train_states  # theirs are the first ones


def test_validation_states_are_neither_training_nor_held_out_ones():
    task, improve = load_task("starter/open_the_top_drawer"), PRESETS["improve"][1]
    last = measured_states(improve, 3)["validation"][-1]
    training = task.init_states("train", last + 1)
    held_out = task.init_states("test", improve.evaluate.episodes_per_task)
    rows = np.concatenate([training[VALIDATION_FROM:], training[: improve.train_states], held_out])
    assert len(np.unique(rows, axis=0)) == len(rows) == 3 + 150 + 200


def test_training_states_that_reach_the_validation_states_are_refused(config):
    with pytest.raises(
        ValueError, match=r"train_states .* must be at most 1000, where validation states begin, got 1001"
    ):
        measured_states(dataclasses.replace(config, train_states=1001), 5)


def test_measurements_grow_geometrically_and_end_with_the_last_iteration():
    assert measured_iterations(156, 2.0) == [0, 1, 2, 4, 8, 16, 32, 64, 128, 156]
    assert measured_iterations(5, 1.01) == [0, 1, 2, 3, 4, 5]
    assert measured_iterations(1, 2.0) == [0, 1]
    with pytest.raises(ValueError, match="growth must be above 1, got 1"):
        measured_iterations(5, 1.0)


def curve(path, success: list[list[int]], label: str = "truth", mode: str = "greedy"):
    """A curve of two tasks, states [K] of each point given for the first one; the second always succeeds."""
    folder = RunFolder(path)
    path.mkdir(parents=True)
    describe(folder, {"label": label})
    for number, reached in enumerate(success):
        outcomes = {"first": torch.tensor(reached).bool(), "second": torch.ones(2).bool()}
        for split in ("training", "validation"):
            log_point(folder, number, 16 * number, split, mode, outcomes)
    return folder


def test_a_curve_is_read_as_it_was_logged_but_for_a_point_cut_short(tmp_path):
    folder = curve(tmp_path / "curve", [[0, 1, 1], [1, 1, 0]])
    folder.log("learning", wave=0, success=0.5, **{"return": 0.4}, correlation=0.6, mixed_groups=3)
    line = {"rollouts": 32, "split": "training", "mode": "greedy", "task": "first", "outcomes": "111"}
    folder.log("learning", **line)
    read = read_curve(folder.path)
    assert read.label == "truth" and read.correlations == [(0.6, 3)]
    assert read.tasks["training"].tolist() == ["first"] * 3 + ["second"] * 2
    points = read.points["training", "greedy"]
    assert {rollouts: success.tolist() for rollouts, success in points.items()} == {
        0: [False, True, True, True, True],
        16: [True, True, False, True, True],
    }
    every = [line for line in folder.read_metrics() if line.get("task") == "all"]
    assert every[0]["success"] == pytest.approx(0.8) and every[0]["low"] < 0.8 < every[0]["high"]


def test_another_curve_in_the_same_folder_is_refused(tmp_path):
    folder = curve(tmp_path / "curve", [[0]])
    describe(folder, {"label": "truth"})
    with pytest.raises(ValueError, match="holds another curve"):
        describe(folder, {"label": "noise"})
    with pytest.raises(FileNotFoundError, match="holds no learning curve"):
        read_curve(tmp_path)


def test_seeds_meet_where_all_have_been_measured(tmp_path):
    whole, part = curve(tmp_path / "0", [[0, 1], [1, 1]]), curve(tmp_path / "1", [[0, 0]])
    curves = [read_curve(folder.path) for folder in (whole, part)]
    points = common(curves, "validation", "greedy")
    assert points.keys() == {0} and points[0].tolist() == [[False, True, True, True], [False, False, True, True]]
    assert common(curves, "validation", "sampled") == {}
    with pytest.raises(ValueError, match="different numbers of states"):
        common([curves[0], read_curve(curve(tmp_path / "2", [[0]]).path)], "training", "greedy")


def test_of_one_seed_the_bootstrap_is_the_binomial_interval_within_tasks():
    values = np.array([[True] * 60 + [False] * 40 + [True] * 100])
    strata = np.repeat([0, 1], 100)
    low, high = bootstrap_interval(values, strata, draws=20_000)
    # All of the second task succeeds: drawn apart, only the first one varies.
    deviation = 0.5 * (0.6 * 0.4 / 100) ** 0.5
    assert (low, high) == pytest.approx((0.8 - 1.96 * deviation, 0.8 + 1.96 * deviation), abs=0.004)


def test_of_several_seeds_the_bootstrap_draws_seeds_and_states():
    generator = np.random.default_rng(0)
    values = generator.random((3, 40)) < np.array([[0.3], [0.5], [0.9]])
    strata = np.repeat([0, 1], 20)
    means = []
    for _ in range(4000):  # the slow reference
        rows = generator.integers(3, size=3)
        columns = np.concatenate([generator.integers(20, size=20), 20 + generator.integers(20, size=20)])
        means.append(values[rows][:, columns].mean())
    found = bootstrap_interval(values, strata, draws=4000)
    assert found == pytest.approx(tuple(np.quantile(means, [0.025, 0.975])), abs=0.02)


def test_seeds_of_a_variant_share_a_line_of_the_table_and_a_colour(tmp_path, capsys):
    folders = [
        curve(tmp_path / "0", [[0, 0], [1, 1]]).path,
        curve(tmp_path / "1", [[0, 0], [1, 1]]).path,
        curve(tmp_path / "2", [[0, 0], [0, 0]], label="noise").path,
    ]
    plot = benchmark("learning_plot")
    plot.main(plot.Settings(tuple(folders), out=tmp_path / "plots" / "curves.png"))
    printed = capsys.readouterr().out
    assert "| truth | 2 | 16 | nan | training, greedy | 50.0 [50.0, 50.0] | 100.0 [100.0, 100.0] | +50.0" in printed
    assert "| noise | 1 | 16 | nan | validation, greedy | 50.0 [50.0, 50.0] | 50.0 [50.0, 50.0] | +0.0" in printed
    assert (tmp_path / "plots" / "curves.png").stat().st_size > 10_000


@pytest.fixture
def sft(tiny):
    """A run folder with an untrained policy."""
    config = dataclasses.replace(tiny, run_dir=tiny.run_dir.with_name("source"))
    torch.manual_seed(0)
    run = open_run(config)
    COMPACT.policy.make(config).save_pretrained(run.folder.checkpoint("sft"))
    return config.run_dir


def test_measuring_changes_nothing_of_what_loop_learns(tiny, sft):
    learning = benchmark("learning")
    two = dataclasses.replace(tiny.post_train, iterations=2)
    tiny = dataclasses.replace(tiny, post_train=two)
    # Nothing succeeds in 16 steps, so false successes are what there is to learn from.
    corruption = Corruption("optimism", false_success=(0.5,))
    settings = learning.Learning(sft, tiny, corruption=corruption, states=2)
    learning.main(settings)
    read = read_curve(tiny.run_dir)
    assert read.label == "optimism 0.5"
    assert read.points.keys() == {(s, m) for s in ("training", "validation") for m in ("greedy", "sampled")}
    assert all(list(points) == [0, 4, 8] for points in read.points.values())
    waves = [line for line in RunFolder(tiny.run_dir).read_metrics("learning") if "wave" in line]
    assert [line["wave"] for line in waves] == [0, 1] and sum(line["return"] for line in waves) > 0

    alone = dataclasses.replace(tiny, run_dir=tiny.run_dir.with_name("alone"))
    alone = dataclasses.replace(alone, post_train=dataclasses.replace(two, env="tabletop", probe_every=0))
    run = open_run(alone)
    run.folder.checkpoint("sft").symlink_to(sft / "checkpoints" / "sft")
    corrupted = learning.CorruptedReturns(corruption, alone.seed)
    rerun("post_train", lambda *a, **o: post_train(*a, **o, returns_of=corrupted), run)
    weights = [
        COMPACT.policy.load(config.run_dir / "checkpoints" / name).state_dict()
        for config, name in ((tiny, "post_train"), (alone, "post_train"), (tiny, "sft"))
    ]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
    moved = [
        name for name, value in weights[2].items() if name in weights[0] and not torch.equal(value, weights[0][name])
    ]
    assert moved


def test_a_finished_curve_can_be_evaluated_is_left_alone_and_another_one_refused(tiny, sft, capsys):
    learning = benchmark("learning")
    settings = learning.Learning(sft, tiny, states=1, sampled=False)
    learning.main(settings)
    learning.main(settings)
    assert "finished, skipped" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"^error: .* holds another curve"):
        learning.main(dataclasses.replace(settings, states=2))
    learned = dataclasses.replace(tiny.post_train, env="tabletop", probe_every=0)
    rerun("evaluate", evaluate, open_run(dataclasses.replace(tiny, post_train=learned)))
    assert RunFolder(tiny.run_dir).done("evaluate")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"corruption": Corruption("noise", 1.5)}, r"correlation must lie in \(0, 1\], got 1.5"),
        ({"growth": 1.0}, "growth must be above 1"),
        ({"states": 0}, "states must be at least 1"),
        ({"image_size": 96}, "was made with image_size=64, now 96"),
        ({"run_dir": "source"}, "name a folder for the curve alone"),
        ({"source": "nowhere"}, "run the stage 'sft' on this folder first"),
    ],
)
def test_what_cannot_be_measured_is_refused(tiny, sft, change, message):
    learning = benchmark("learning")
    config = dataclasses.replace(tiny, image_size=change.pop("image_size", 64))
    if "run_dir" in change:
        change, config = {}, dataclasses.replace(config, run_dir=sft)
    if "source" in change:
        change["source"] = sft.with_name("nowhere")
    settings = dataclasses.replace(learning.Learning(sft, config), **change)
    with pytest.raises(SystemExit, match=f"^error: .*{message}"):
        learning.main(settings)
    assert not tiny.run_dir.exists()


def test_a_preset_and_its_settings_are_given_as_for_the_recipes(tmp_path):
    arguments = ["improve", "--source", "a", "--run-dir", "b", "--seed", "3", "--post-train.iterations", "8"]
    settings = benchmark("learning").parse(
        [*arguments, "--corruption.kind", "noise", "--corruption.correlation", "0.6"]
    )
    assert (str(settings.source), str(settings.config.run_dir), settings.config.seed) == ("a", "b", 3)
    assert settings.config.post_train.iterations == 8 and settings.corruption == Corruption("noise", 0.6)


def test_the_rival_has_as_many_real_rollouts_as_exploration():
    improve = PRESETS["improve"][1]
    explore, scales = improve.explore, len(improve.explore.scale_factors)
    per_scale = -(-explore.episodes_per_task * len(improve.tasks) // scales)
    explored = scales * explore.num_envs * -(-per_scale // explore.num_envs)
    learned = improve.post_train
    assert explored == 8 * learned.groups * learned.group_size == 1536
