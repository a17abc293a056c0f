"""Groups in the physics, and what imagination tells of them, at the smallest scale."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest
import torch
from tensordict import TensorDict
from test_benchmarks import benchmark

from dreamt_groups import dreamt_groups, in_order
from group_views import AHEAD, DREAMT, FIGURES, IMAGINED, REAL, RuledReflector, curve, views
from parts import make_policy, make_reflector, make_world_model
from real_groups import Draw, RealGroups, real_groups
from run import Run, write_rules
from run_folder import RunFolder
from two_worlds import relive
from worldenv_trl.envs import context_id
from worldenv_trl.metrics import group_correlations
from worldenv_trl.record import read_rollouts
from worldenv_trl.reflectors import Reflector, StopRule

DRAW = Draw(contexts=4, group_size=2, scale_factor=1.0, noise="step", seed=0)


@pytest.fixture
def run(tiny):
    """A run of two tasks with untrained parts."""
    import config

    settings = dataclasses.replace(tiny, tasks=config.GOAL_TASKS[1:], world_model=config.WorldModel(width=16))
    run = Run(settings, RunFolder(settings.run_dir))
    run.folder.open(settings)
    torch.manual_seed(0)
    parts = {"sft": make_policy, "world_model": make_world_model, "reflector": make_reflector}
    for name, make in parts.items():
        make(settings).save_pretrained(run.folder.checkpoint(name))
    write_rules(run.folder.checkpoint("reflector"), {"real": StopRule(), "imagined": StopRule()})
    return run


def command(run, **settings):
    signal = benchmark("group_signal")
    defaults = {"contexts": 4, "group_size": 2, "resamples": 20}
    return signal.main(signal.Settings(run.folder.path, **defaults | settings))


def with_outcomes(groups: RealGroups, reached: list[int]) -> RealGroups:
    """The same rollouts, reaching the goal at these frames; -1 never."""
    frames = torch.arange(groups.episodes["success"].shape[1])
    groups.episodes["success"] = torch.stack([(frames >= first) & (first >= 0) for first in reached])
    return groups


def test_groups_are_drawn_once_and_share_their_initial_states(run, tmp_path):
    policy = run.policy("sft")
    groups = real_groups(run, policy, DRAW, tmp_path / "groups")
    assert groups.task_id.tolist() == [0, 0, 1, 1] and groups.success.shape == (4, 2)
    ids = [context_id(task, "train", index) for task in (0, 1) for index in (0, 3)]
    assert groups.context_id.tolist() == ids
    states, actions = groups.grouped(groups.episodes["states"]), groups.grouped(groups.episodes["actions"])
    assert (states[:, 0, 0] == states[:, 1, 0]).all() and (actions[:, 0] != actions[:, 1]).any((1, 2)).all()
    assert (groups.episodes["length"] == run.config.max_steps).all()  # nothing but the step limit ends them
    recording = tmp_path / "groups" / "groups.mcap"
    before = recording.stat().st_mtime_ns
    again = real_groups(run, policy, DRAW, tmp_path / "groups")
    assert recording.stat().st_mtime_ns == before and (again.episodes.entries == groups.episodes.entries).all()
    assert len(read_rollouts(recording)) == 8
    for other in (dataclasses.replace(DRAW, seed=1), dataclasses.replace(DRAW, contexts=2)):
        with pytest.raises(ValueError, match=r"were drawn with another (seed|contexts)"):
            real_groups(run, policy, other, tmp_path / "groups")
    with pytest.raises(ValueError, match="were drawn with another policy"):
        real_groups(run, make_policy(run.config), DRAW, tmp_path / "groups")


class FirstPixel(Reflector):
    """R is the red of a frame's first pixel."""

    def begin(self, frames, instructions):
        score = frames["agentview"][:, 0, 0, 0].float() / 255
        return TensorDict({"score": score}, batch_size=[len(score)])

    def extend(self, state, frames):
        scores = frames["agentview"][:, :, 0, 0, 0].float() / 255
        return TensorDict({"score": scores[:, -1]}, batch_size=[len(scores)]), scores


def test_views_hold_returns_of_the_reflector_and_success_of_the_physics(run, tmp_path):
    groups = with_outcomes(real_groups(run, run.policy("sft"), DRAW, tmp_path), [3, -1, -1, -1, 5, 6, -1, 9])
    assert groups.mixed.tolist() == [True, False, False, True]
    judge = RuledReflector(FirstPixel(), {"real": StopRule(0.99, 1), "imagined": StopRule(0.01, 2)})
    seen, ahead = views(judge, run.world_model(), run.kinematics, groups)
    assert list(seen) == [REAL, AHEAD, IMAGINED]
    last = groups.episodes.frames("agentview", torch.arange(8), torch.tensor(run.config.max_steps))[:, 0, 0, 0] / 255
    assert not seen[REAL].stopped.any() and torch.equal(seen[REAL].returns.flatten(), last)
    assert torch.equal(seen[REAL].done, groups.success)
    assert seen[IMAGINED].correlations.isfinite().tolist() == groups.mixed.tolist()
    later = curve(judge, run.world_model(), run.kinematics, groups, (seen[AHEAD], ahead), (1, 2))
    for shown, view in ((1, seen[IMAGINED]), (2, seen[AHEAD])):  # two chunks are all
        expected = group_correlations(view.returns, groups.success)
        assert torch.allclose(later[shown], expected, equal_nan=True)


def test_what_is_dreamt_begins_where_the_groups_do_and_is_labelled_by_the_physics(run, tmp_path):
    groups, folder = real_groups(run, run.policy("sft"), DRAW, tmp_path), tmp_path / "dreams"
    dreams = dreamt_groups(run, run.policy("sft"), run.world_model(), groups, DRAW, folder)
    assert torch.equal(dreams.context_id, groups.context_id) and torch.equal(dreams.task_id, groups.task_id)
    rows, first, later = torch.arange(8), torch.tensor(0), torch.tensor(5)
    lived, dreamt = groups.episodes, dreams.episodes
    assert torch.equal(dreamt.frames("agentview", rows, first), lived.frames("agentview", rows, first))
    assert (dreamt.frames("agentview", rows, later) != lived.frames("agentview", rows, later)).flatten(1).any(1).all()
    poses = run.kinematics.rollout(lived["kinematic_states"][:, 0], dreamt["actions"])
    assert torch.allclose(dreamt["kinematic_states"][:, 1:], poses, atol=1e-5)
    assert torch.equal(dreamt["success"], relive(run, dreamt))
    actions = dreams.grouped(dreamt["actions"])
    assert (actions[:, 0] != actions[:, 1]).flatten(1).any(1).all()  # of a group, too
    before = (folder / "dreams.mcap").stat().st_mtime_ns
    for overwrite in (False, True):
        again = dreamt_groups(run, run.policy("sft"), run.world_model(), groups, DRAW, folder, overwrite).episodes
        assert torch.equal(again["actions"], dreamt["actions"])
        assert torch.equal(again.frames("agentview", rows, later), dreamt.frames("agentview", rows, later))
        assert ((folder / "dreams.mcap").stat().st_mtime_ns != before) == overwrite
    with pytest.raises(ValueError, match="were drawn with another world_model"):
        dreamt_groups(run, run.policy("sft"), make_world_model(run.config), groups, DRAW, folder)


def test_groups_that_end_in_another_order_are_put_in_theirs(run, tmp_path):
    groups = real_groups(run, run.policy("sft"), DRAW, tmp_path)
    mixed = groups.episodes[torch.tensor([4, 5, 0, 1, 6, 7, 2, 3])]
    assert torch.equal(in_order(mixed, groups)["actions"], groups.episodes["actions"])


def test_the_command_leaves_its_figures(run, capsys):
    out = command(run)
    report = json.loads(out.read_text())
    assert out == run.folder.path / "signal" / "sft" / "world_model-reflector.json"
    assert report["groups"]["all"]["groups"] == 4 and list(report["views"]) == [REAL, AHEAD, IMAGINED]
    assert list(report["views"][IMAGINED]) == list(report["curve"]) == ["all", *run.config.tasks]
    assert list(report["views"][REAL]["all"]) == list(FIGURES) and list(report["curve"]["all"]) == ["1", "2"]
    assert "| real frames | all |" in (shown := capsys.readouterr().out) and "calibration error" in shown
    other = shutil.copytree(run.folder.checkpoint("world_model"), run.folder.path / "elsewhere")
    again = command(run, against=out, world_model=str(other), dreamt=True)
    report = json.loads(again.read_text())
    assert list(report["views"]) == [REAL, AHEAD, IMAGINED, DREAMT] and "dreamt_success" in report["groups"]["all"]
    assert "real success | of actions dreamt |" in (shown := capsys.readouterr().out) and "| dreamt | all |" in shown
    assert again == out.with_name(f"elsewhere_{report['models']['world_model']['hash'][:8]}-reflector.json")
    assert set(report["gain"]) == {"all", *run.config.tasks}


def test_nothing_is_imagined_for_a_judge_that_looks_at_no_video(run, monkeypatch):
    by_path = dataclasses.replace(run.config.reflector, path_epochs=0.1)
    shutil.rmtree(run.folder.checkpoint("reflector"))
    make_reflector(dataclasses.replace(run.config, reflector=by_path)).save_pretrained(
        run.folder.checkpoint("reflector")
    )
    write_rules(run.folder.checkpoint("reflector"), {"real": StopRule(), "imagined": StopRule()})
    monkeypatch.delattr("group_views.imagine_episodes")
    report = json.loads(command(run).read_text())
    assert list(report["views"]) == [REAL, IMAGINED] and list(report["curve"]["all"]) == ["1"]
    errors = {name: each["all"]["calibration_error"] for name, each in report["views"].items()}
    assert errors[REAL] != errors[IMAGINED]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"contexts": 3}, "contexts must be a multiple of the run's 2 tasks, got 3"),
        ({"contexts": 10}, "contexts must be at most 8"),
        ({"group_size": 1}, "group_size must be at least 2, got 1"),
        ({"scale_factor": 0.0}, "scale_factor must be positive, got 0.0"),
        ({"shown_chunks": (1,)}, "--shown-chunks must be at least 2, got 1"),
        ({"resamples": 0}, "--resamples must be at least 1, got 0"),
        ({"policy": "post_train"}, "post_train does not exist"),
        ({"world_model": "world_model_2"}, "world_model_2 does not exist: run the stage 'train_world_model'"),
        ({"reflector": "world_model"}, "holds VideoWorldModel, not CompactReflector"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is_drawn(settings, message, run):
    with pytest.raises(SystemExit, match=f"^error: .*{message}"):
        command(run, **settings)
    assert not (run.folder.path / "signal").exists()


def test_a_folder_that_is_no_run_or_no_report_is_refused(run, tmp_path):
    with pytest.raises(SystemExit, match="is no run folder"):
        benchmark("group_signal").main(benchmark("group_signal").Settings(tmp_path))
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(SystemExit, match="holds no figures of group_signal"):
        command(run, against=tmp_path / "other.json")
