"""Which stages count as finished when one of them runs again, alone or because what it made is gone."""

from __future__ import annotations

import shutil

import pytest

from resumable import Resumable
from run_folder import RunFolder
from stages import open_run, plan, rerun, run_stages


class Works:
    """Stages that leave their output and a line in the metrics, and note that they have run."""

    def __init__(self, config):
        self.ran, self.makes = [], {stage.kind: stage.makes for stage in plan(config)}

    def __getitem__(self, kind):
        def work(run, **options):
            self.ran.append(kind)
            made = run.folder.path / self.makes[kind]
            made.parent.mkdir(exist_ok=True)
            made.mkdir(exist_ok=True) if not made.suffix else made.touch()
            run.folder.log(kind, figure=len(self.ran))

        return work


@pytest.fixture
def finished(tiny):
    """A run of which all stages are finished, and what they did."""
    run, works = open_run(tiny), Works(tiny)
    run_stages(run, works)
    assert works.ran == [stage.kind for stage in plan(tiny)]
    works.ran.clear()
    return run, works


def names(run, done=True):
    return [stage.name for stage in plan(run.config) if run.folder.done(stage.name) is done]


def test_a_stage_that_cannot_begin_leaves_all_as_finished_as_it_was(finished, capsys):
    run, works = finished
    before = run.folder.metrics_path.read_text()

    def refused(run, **options):
        raise OSError(5, "cut short", "demonstrations.mcap")

    with pytest.raises(SystemExit, match=r"demonstrations.mcap: cut short \(stage sft"):
        rerun("sft", refused, run)
    assert not names(run, done=False)
    assert sorted(run.folder.metrics_path.read_text().splitlines()) == sorted(before.splitlines())
    run_stages(run, works)
    assert not works.ran and "to be run again" not in capsys.readouterr().out


def test_what_is_taken_over_from_another_run_stays_so_too(finished, tiny, tmp_path):
    folder = RunFolder(tmp_path / "other")
    folder.open(tiny, begin=None)
    folder.note("begun", {"from": "elsewhere", "stages": ["demonstrate", "sft"]})
    with folder.stage("sft"):
        pass
    folder.note("begun", {"from": "elsewhere", "stages": ["demonstrate", "sft"]})
    with pytest.raises(KeyboardInterrupt), folder.stage("sft"):
        raise KeyboardInterrupt
    assert folder.done("sft") and folder.noted("begun")["stages"] == ["demonstrate", "sft"]


def test_a_stage_that_has_begun_anew_is_unfinished_until_it_is_over(finished, capsys):
    run, works = finished

    def interrupted(run, **options):
        for step in Resumable(run, "steps", 3, minutes=0.0):
            if step == 1:
                raise OSError(5, "no more", "disk")

    with pytest.raises(SystemExit, match="no more"):
        rerun("sft", interrupted, run)
    assert names(run, done=False) == ["sft"]  # what learned from it before is still of the checkpoint that is there
    run_stages(run, works)
    assert works.ran == [stage.kind for stage in plan(run.config)][1:]
    assert "explore, world_model, reflector, post_train, evaluate learned from what sft made before" in (
        capsys.readouterr().out
    )


def test_stages_after_one_that_ran_alone_are_to_be_run_again(finished):
    run, works = finished
    rerun("train_world_model", works["train_world_model"], run)
    assert names(run, done=False) == ["reflector", "post_train", "evaluate"]


def test_an_output_that_is_gone_is_said_and_made_again_and_all_that_learned_from_it(finished, capsys):
    run, works = finished
    shutil.rmtree(run.folder.checkpoint("world_model"))
    run_stages(run, works)
    assert works.ran == ["train_world_model", "train_reflector", "post_train", "evaluate"]
    assert "world_model was finished, and" in capsys.readouterr().err
