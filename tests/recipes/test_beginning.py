"""A run that begins with another's stages: which come over, and that nothing else would have come of it."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys

import pytest
import yaml
from small_run import SMALL

import config
import stages
from beginning import DEPENDS_ON, beginning
from dry_run import dry_run, options
from post_train import post_train
from run import Run
from run_folder import RunFolder
from stages import open_run, plan, rerun
from world_env import run_all

WHOLE = dataclasses.replace(
    SMALL,
    max_steps=40,
    explore=config.Explore(episodes_per_task=8, num_envs=4, scale_factors=(0.0, 1.0)),
    reflector=dataclasses.replace(SMALL.reflector, path_epochs=0.1),
    adapt=config.Adapt(steps=2, episodes_per_task=2, batch_size=2),
    post_train=dataclasses.replace(SMALL.post_train, iterations=2, hold=1.0),
)
"""Every stage, and what is only done where it is asked for."""
STAGES = ["demonstrate", "sft", "explore", "world_model", "reflector", "adapted", "post_train"]


def changed(settings, **changes):
    """``section__name=value``, or ``name=value`` of the run."""
    for name, value in changes.items():
        section, _, rest = name.partition("__")
        if rest:
            value = dataclasses.replace(getattr(settings, section), **{rest: value})
        settings = dataclasses.replace(settings, **{section: value})
    return settings


def noting(value, note, prefix=""):
    """A dataclass of settings that notes the names of those that are read: not to copy it, or to refuse some."""
    names = {field.name for field in dataclasses.fields(value)}

    def read(self, name):
        if name in names and sys._getframe(1).f_globals["__name__"] not in ("dataclasses", "checks"):
            note(prefix + name)
        return object.__getattribute__(self, name)

    settings = {name: getattr(value, name) for name in names}
    for name, each in settings.items():
        if dataclasses.is_dataclass(each):
            settings[name] = noting(each, note, f"{prefix}{name}.")
    return type(type(value).__name__, (type(value),), {"__getattribute__": read})(**settings)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished run of all stages, and the settings that each has read."""
    settings, read = dataclasses.replace(WHOLE, run_dir=tmp_path_factory.mktemp("beginning") / "first"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("demonstrate.check_solved", lambda *_: None)

        def made(settings, folder, parts):
            return Run(noting(settings, lambda name: read.setdefault(folder.running, set()).add(name)), folder, parts)

        patch.setattr(stages, "Run", made)
        run_all(settings)
    return settings, read


def weights(settings, name):
    path = RunFolder(settings.run_dir).require_checkpoint(name, name)
    return {file.name: file.read_bytes() for file in sorted(path.rglob("*.safetensors"))}


def figures(settings):
    lines = RunFolder(settings.run_dir).read_metrics()
    return [{key: value for key, value in line.items() if "second" not in key} for line in lines]


def test_a_stage_reads_no_setting_that_could_change_unnoticed(whole):
    settings, read = whole
    known: set[str] = set()
    for stage in plan(settings)[:-1]:
        known |= set(DEPENDS_ON[stage.kind])
        used = {name for name in read[stage.name] if "." in name or name.startswith("scale_")}
        assert used and not {name for name in used if not {name, name.split(".")[0]} & known}, stage.name
        assert "rounds" not in read[stage.name]


@pytest.mark.parametrize(
    ("change", "last"),
    [
        ({"sft__steps": 4}, "demonstrate"),
        ({"explore__episodes_per_task": 9}, "sft"),
        ({"scale_floor": (0.1, 0.1, 0.1)}, "sft"),
        ({"explore__noise": "chunk"}, "sft"),
        ({"world_model__steps": 3}, "explore"),
        ({"reflector__threshold": 0.6}, "world_model"),
        ({"adapt__steps": 3}, "reflector"),
        ({"post_train__lora_rank": 8}, "reflector"),
        ({"post_train__scale_factor": 0.5}, "reflector"),
        ({"adapt__steps": 0}, "reflector"),
        ({"adapt__lr": 1e-5}, "reflector"),
        ({"post_train__hold_from": 0.5}, "reflector"),
        ({"post_train__probe_contexts": 3}, "adapted"),
        ({"post_train__hold": 0.0}, "reflector"),
        ({"post_train__draw": 1}, "adapted"),
        ({"post_train__noise": "chunk"}, "adapted"),
        ({"post_train__env": "tabletop"}, "explore"),  # of what is held
        ({"evaluate__episodes_per_task": 3}, "post_train"),
        ({"rounds": 2}, "post_train"),
        ({"rounds": 2, "world_model__refit_steps": 9}, "post_train"),
        ({"num_threads": 2, "checkpoint_minutes": 9.0}, "post_train"),
    ],
)
def test_what_comes_over_ends_where_a_setting_differs(whole, tmp_path, change, last):
    settings = dataclasses.replace(changed(whole[0], **change), run_dir=tmp_path / "new", begin_from=whole[0].run_dir)
    begun = beginning(settings, plan(settings), RunFolder(settings.run_dir))
    assert [stage.name for stage in begun.stages] == STAGES[: STAGES.index(last) + 1]
    assert not settings.run_dir.exists()


@pytest.mark.parametrize(
    ("off", "change"),
    [
        ("adapt.steps", {"adapt__lr": 1e-5, "adapt__batch_size": 3}),
        ("adapt.correct_steps", {"adapt__correct_lr": 1e-5}),
        ("post_train.hold", {"post_train__hold_from": 0.5}),
        ("post_train.probe_every", {"post_train__probe_contexts": 3}),
    ],
)
def test_a_setting_that_another_one_has_switched_off_keeps_nothing_back(whole, tmp_path, off, change):
    section, name = off.split(".")
    settings = changed(whole[0], run_dir=tmp_path / "source", **{f"{section}__{name}": 0})
    shutil.copytree(whole[0].run_dir, settings.run_dir)
    stored = yaml.safe_load((settings.run_dir / "config.yaml").read_text())
    stored[section][name] = 0
    (settings.run_dir / "config.yaml").write_text(yaml.safe_dump(stored))
    other = changed(settings, run_dir=tmp_path / "new", begin_from=settings.run_dir, **change)
    begun = beginning(other, plan(other), RunFolder(other.run_dir))
    assert [stage.name for stage in begun.stages] == [stage.name for stage in plan(settings)[:-1]]
    on = changed(other, **{f"{section}__{name}": 1})
    assert len(beginning(on, plan(on), RunFolder(on.run_dir)).stages) < len(begun.stages)


@pytest.mark.parametrize(
    ("gone", "last"),
    [
        ({"explore": {"imagined_share": 0.25}}, "sft"),
        ({"reflector": {"open_loop": True}}, "world_model"),
        ({"explore": {"imagined_share": 0.0}, "reflector": {"open_loop": False}}, "post_train"),
    ],
)
def test_what_was_done_by_a_setting_that_is_gone_does_not_come_over(whole, tmp_path, gone, last):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    stored = yaml.safe_load((source / "config.yaml").read_text())
    for section, values in gone.items():
        stored[section] |= values
    (source / "config.yaml").write_text(yaml.safe_dump(stored))
    settings = dataclasses.replace(whole[0], run_dir=tmp_path / "new", begin_from=source)
    begun = beginning(settings, plan(settings), RunFolder(settings.run_dir))
    assert [stage.name for stage in begun.stages] == STAGES[: STAGES.index(last) + 1]
    assert begun.why == "" if last == STAGES[-1] else begun.why.endswith("there and no setting any more")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "nothing of .*first can be taken, for demonstrate is of seed=0 there and 1 here"),
        ({"max_steps": 48}, "demonstrate is of max_steps=40 there and 48 here"),
        ({"demonstrate__episodes_per_task": 2}, "demonstrate.episodes_per_task=1 there and 2 here"),
        ({"begin_from": "nowhere"}, "nowhere is no run folder"),
    ],
)
def test_where_nothing_can_come_over_it_says_why_and_begins_nothing(whole, tmp_path, change, message):
    settings = dataclasses.replace(whole[0], run_dir=tmp_path / "new", begin_from=whole[0].run_dir)
    change = {name: tmp_path / value if name == "begin_from" else value for name, value in change.items()}
    with pytest.raises(SystemExit, match=f"error: begin_from: .*{message}"):
        open_run(changed(settings, **change))
    assert not settings.run_dir.exists()


def test_only_the_parts_that_come_over_must_be_known(whole, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    settings = changed(whole[0], run_dir=tmp_path / "new", begin_from=source, post_train__draw=1)
    for name in ("post_train", "adapted"):
        (source / "checkpoints" / name / "config.json").write_text(json.dumps({"class": "OtherPolicy"}))
        if name == "post_train":
            open_run(changed(settings, run_dir=tmp_path / "without")).close()
    with pytest.raises(SystemExit, match="adapted holds OtherPolicy, and the run's policy is OFTPolicy now"):
        open_run(settings)


def test_the_versions_that_made_it_are_kept(whole, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    (source / "versions.json").write_text(json.dumps([{"torch": "1.2.3"}]))
    settings = changed(whole[0], run_dir=tmp_path / "new", begin_from=source)
    open_run(settings).close()
    made, now = json.loads((settings.run_dir / "versions.json").read_text())
    assert made == {"torch": "1.2.3"} and now["torch"] != "1.2.3"


def test_what_a_user_keeps_beside_the_recordings_stays_there(whole, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    (source / "rollouts" / "post_train_000_rollout7_replay.mcap").touch()
    settings = dataclasses.replace(whole[0], run_dir=tmp_path / "new", begin_from=source)
    open_run(settings).close()
    copied = {path.name for path in (settings.run_dir / "rollouts").iterdir()}
    assert copied == {"demonstrations.mcap", "explore.mcap", "post_train_000.mcap", "post_train_001.mcap"}


def test_an_unfinished_stage_does_not_come_over(whole, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    RunFolder(source).forget("world_model")
    settings = dataclasses.replace(whole[0], run_dir=tmp_path / "new", begin_from=source)
    begun = beginning(settings, plan(settings), RunFolder(settings.run_dir))
    assert [stage.name for stage in begun.stages] == STAGES[:3] and "world_model is not finished there" in str(begun)


def test_a_recording_that_is_cut_off_does_not_come_over(whole, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    recording = RunFolder(source).rollouts("explore")
    recording.write_bytes(recording.read_bytes()[:-100])
    settings = dataclasses.replace(whole[0], run_dir=tmp_path / "new", begin_from=source)
    begun = beginning(settings, plan(settings), RunFolder(settings.run_dir))
    assert [stage.name for stage in begun.stages] == STAGES[:2]
    assert f"explore is cut off there: recipes/repair.py {recording} says" in str(begun)


def test_a_task_that_has_changed_since_stays_there(whole, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    (source / "tasks.json").write_text(json.dumps(dict.fromkeys(whole[0].tasks, "another")))
    with pytest.raises(SystemExit, match="open_the_top_drawer has changed since it was made"):
        open_run(dataclasses.replace(whole[0], run_dir=tmp_path / "new", begin_from=source))


def test_it_ends_where_a_run_of_its_own_would_have_ended(whole, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)
    other = changed(whole[0], post_train__head_lr=1e-2, post_train__draw=3)
    alone = dataclasses.replace(other, run_dir=tmp_path / "alone")
    begun = dataclasses.replace(other, run_dir=tmp_path / "begun", begin_from=whole[0].run_dir)
    run_all(alone)
    capsys.readouterr()
    run_all(begun)
    said = capsys.readouterr().out
    assert f"{', '.join(STAGES[:-1])}: as in {whole[0].run_dir} (post_train is of " in said
    assert "adapted: finished, skipped" in said and "post_train: finished" not in said
    for name in ("sft", "world_model", "adapted", "post_train"):
        assert weights(begun, name) == weights(alone, name) != {}
    assert weights(begun, "post_train") != weights(whole[0], "post_train")
    assert figures(begun) == figures(alone)
    noted = json.loads((begun.run_dir / "begun.json").read_text())
    assert noted == {"run": str(whole[0].run_dir.resolve()), "stages": STAGES[:-1]}
    for name in ("demonstrations", "explore"):
        copy, original = (RunFolder(each.run_dir).rollouts(name) for each in (begun, whole[0]))
        assert copy.read_bytes() == original.read_bytes()


def test_another_draw_is_other_random_numbers_for_loop_alone(whole, tmp_path):
    settings = dataclasses.replace(whole[0], begin_from=whole[0].run_dir)
    found = []
    for draw in (0, 0, 1):
        run = open_run(changed(settings, run_dir=tmp_path / str(len(found)), post_train__draw=draw))
        rerun("post_train", post_train, run)
        run.close()
        found.append(weights(run.config, "post_train"))
    assert found[0] == found[1] == weights(whole[0], "post_train") and found[2] != found[0]


def test_interrupted_while_it_copies_it_begins_again(whole, tmp_path, monkeypatch, capsys):
    settings = dataclasses.replace(
        changed(whole[0], post_train__draw=1), run_dir=tmp_path / "new", begin_from=whole[0].run_dir
    )
    copy, copied = shutil.copytree, []

    def interrupted(source, target, **more):
        if copied:
            raise KeyboardInterrupt
        copied.append(target)
        return copy(source, target, **more)

    monkeypatch.setattr(shutil, "copytree", interrupted)
    with pytest.raises(SystemExit):
        open_run(settings)
    assert f"not all of {whole[0].run_dir} has come over: the same command begins again" in capsys.readouterr().err
    assert RunFolder(settings.run_dir).is_new
    monkeypatch.setattr(shutil, "copytree", copy)
    open_run(settings).close()
    folder = RunFolder(settings.run_dir)
    assert [name for name in STAGES if folder.done(name)] == STAGES[:-1]
    assert weights(settings, "adapted") == weights(whole[0], "adapted")


def test_a_run_that_has_begun_goes_on_by_itself(whole, tmp_path):
    settings = dataclasses.replace(
        changed(whole[0], post_train__draw=1), run_dir=tmp_path / "new", begin_from=whole[0].run_dir
    )
    open_run(settings).close()
    folder = RunFolder(settings.run_dir)
    folder.forget("sft")
    open_run(settings).close()  # the same command: nothing is copied again
    open_run(dataclasses.replace(settings, begin_from=None)).close()
    own = [name for name in STAGES[:-1] if name != "sft"]
    assert not folder.done("sft") and folder.noted("begun")["stages"] == own  # what is made here is not taken over
    other = tmp_path / "other"
    shutil.copytree(whole[0].run_dir, other)
    with pytest.raises(SystemExit, match=f"new holds a run that did not begin with {other}: use another --run-dir"):
        open_run(dataclasses.replace(settings, begin_from=other))
    with pytest.raises(SystemExit, match="begin_from is the run_dir itself"):
        open_run(dataclasses.replace(settings, begin_from=settings.run_dir))


def test_once_it_has_begun_the_other_run_may_go(whole, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(whole[0].run_dir, source)
    settings = changed(whole[0], run_dir=tmp_path / "new", begin_from=source, post_train__draw=1)
    open_run(settings).close()
    shutil.rmtree(source)
    open_run(settings).close()
    assert RunFolder(settings.run_dir).done("adapted")


def test_stages_of_a_beginning_that_was_killed_are_not_those_of_other_settings(whole, tmp_path):
    settings = changed(whole[0], run_dir=tmp_path / "new", begin_from=whole[0].run_dir)
    open_run(settings).close()
    (settings.run_dir / "config.yaml").unlink()  # killed just before it is written
    open_run(changed(settings, begin_from=None, seed=5)).close()
    folder = RunFolder(settings.run_dir)
    assert not any(folder.done(name) for name in STAGES) and folder.noted("begun") == {}


def test_a_run_of_its_own_takes_nothing_over_later(whole, tiny):
    open_run(tiny).close()
    with pytest.raises(SystemExit, match="did not begin with"):
        open_run(dataclasses.replace(tiny, begin_from=whole[0].run_dir))


def test_the_plan_leaves_out_what_comes_over(whole, tmp_path, capsys):
    settings = dataclasses.replace(
        changed(whole[0], post_train__draw=1), run_dir=tmp_path / "new", begin_from=whole[0].run_dir
    )
    chosen = options().parse_args(["--dry-run", "--gpu", "H100"])
    assert dry_run(settings, chosen) == 0
    said = capsys.readouterr().out
    assert "reflector, adapted: as in" in said
    planned = [line.split()[0] for line in said.split("activations ", 1)[1].splitlines() if line]
    assert [name for name in planned if name in [*STAGES, "evaluate"]] == ["post_train", "evaluate"]
    assert not settings.run_dir.exists()
