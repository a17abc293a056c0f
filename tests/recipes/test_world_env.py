"""The command line and the whole loop, at the smallest scale."""

from __future__ import annotations

import dataclasses
import shutil
import signal

import pytest
import torch

import world_env
from checks import check_config
from config import GOAL_TASKS, PRESETS, SFT, Adapt, Demonstrate, Evaluate, Explore, PostTrain, Reflector, WorldModel
from episodes import demonstrations_and_exploration
from imagination import contexts_of
from parts import COMPACT, Part
from run import Run
from run_folder import RunFolder
from stages import open_run, parse, plan, rerun
from train_world_model import train_world_model
from world_env import run_all
from worldenv_trl import keys
from worldenv_trl.envs import context_id
from worldenv_trl.record import read_rollouts
from worldenv_trl.scenes.catalogue import SUITES_FOLDER


def test_presets_parse_and_single_settings_are_overridden():
    config = parse(["smoke", "--seed", "3", "--post-train.clip-epsilon", "0.2"])
    assert (config.seed, config.post_train.clip_epsilon, config.explore) == (3, 0.2, PRESETS["smoke"][1].explore)


def test_later_rounds_start_from_the_policy_of_the_round_before():
    names = [stage.name for stage in plan(dataclasses.replace(PRESETS["smoke"][1], rounds=2))]
    assert names.index("post_train") < names.index("explore_2") < names.index("post_train_2") < names.index("evaluate")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tasks": ("starter/open_the_top_drawr",)}, "did you mean 'starter/open_the_top_drawer'"),
        ({"tasks": ()}, "name at least one task"),
        ({"max_steps": 20}, "multiple of chunk_length=8, got 20"),
        ({"post_train": PostTrain(env="robot")}, "'robot'"),
        ({"image_size": 8}, "image_size"),
        ({"image_size": 50}, "multiple of 16 px"),
        ({"image_size": 0, "sft": SFT(shift_px=0)}, "image_size must be a multiple of 16 px from 32 to 4096, got 0"),
        ({"image_size": 100000}, "image_size must be a multiple of 16 px from 32 to 4096, got 100000"),
        ({"cameras": ()}, "cameras is empty: name at least one"),
        ({"sft": SFT(depth=0)}, "depth must be at least 1, got 0"),
        ({"sft": SFT(vision_blocks=(2, 16))}, r"blocks must be ascending numbers of 0 to 15, .* got \(2, 16\)"),
        ({"tasks": GOAL_TASKS[:1] * 2}, "names a task twice"),
        ({"rounds": 0}, "rounds must be at least 1, got 0"),
        ({"world_model": WorldModel(failure_share=1.5)}, "world_model.failure_share must lie between 0 and 1, got 1.5"),
        ({"reflector": Reflector(path_epochs=-1.0)}, "reflector.path_epochs must be at least 0 and finite, got -1.0"),
        (
            {"reflector": Reflector(path_epochs=1.0), "cameras": ("wrist",)},
            "reflector.path_epochs needs a camera that is fixed in the world, got cameras wrist",
        ),
        ({"train_states": 0}, "train_states must be at least 1, got 0"),
        ({"num_threads": 0}, "num_threads must be at least 1"),
        ({"demonstrate": Demonstrate(states="far")}, "demonstrate.states must be one of first, spread, got 'far'"),
        ({"demonstrate": Demonstrate(51, states="spread")}, "demonstrate.episodes_per_task must be at most 50, train_"),
        ({"demonstrate": Demonstrate(episodes_per_task=0)}, "demonstrate.episodes_per_task must be at least 1"),
        ({"explore": Explore(scale_factors=())}, "explore.scale_factors"),
        ({"explore": Explore(scale_factors=(0.0, 1.0, 0.0))}, "explore.scale_factors names a factor twice, 0, 1, 0"),
        (
            {"post_train": PostTrain(env="tabletop"), "adapt": Adapt(steps=10)},
            "adapt.steps is of imagination: it must be 0 where post_train.env is tabletop, got 10",
        ),
        ({"post_train": PostTrain(env="tabletop"), "rounds": 2}, "rounds is of imagination: it must be 1 .* got 2"),
        (
            {"post_train": PostTrain(ratio_level="token")},
            "ratio_level must be step or chunk for OFTPolicy, which does not",
        ),
        ({"post_train": PostTrain(ratio_level="foo")}, "ratio_level must be one of step, chunk, token, got 'foo'"),
        ({"explore": Explore(noise="pink")}, "explore.noise must be one of step, chunk, got 'pink'"),
        ({"post_train": PostTrain(noise="pink")}, "post_train.noise must be one of step, chunk, got 'pink'"),
        (
            {"post_train": PostTrain(noise="chunk", ratio_level="chunk")},
            "post_train.ratio_level must be step with post_train.noise='chunk', where each step has its chunk's ratio",
        ),
        ({"post_train": PostTrain(group_size=1)}, "group_size must be at least 2"),
        ({"post_train": PostTrain(averaging=-0.1)}, "post_train.averaging must lie between 0 and 1, got -0.1"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"checkpoint_minutes": -1.0}, "checkpoint_minutes must be at least 0 and finite, got -1.0"),
        ({"chunk_length": 0}, "chunk_length must be at least 1, got 0"),
        ({"explore": Explore(num_envs=2)}, "explore.num_envs must be at least 3, one for each task, got 2"),
        ({"post_train": PostTrain(env="tabletop", groups=2)}, "post_train.groups must be at least 3, one for each"),
        ({"post_train": PostTrain(minibatch_size=0)}, "post_train.minibatch_size must be at least 1"),
        ({"post_train": PostTrain(false_alarm_rate=1.0)}, r"post_train.false_alarm_rate must lie in \(0, 1\), got 1"),
        ({"evaluate": Evaluate(num_envs=0)}, "evaluate.num_envs must be at least 1"),
        ({"reflector": Reflector(threshold=1.5)}, r"reflector.threshold must be in \(0, 1\), got 1.5"),
        ({"sft": SFT(place_shift_m=0.06)}, "sft.place_shift_m must lie between 0 and 0.035, got 0.06: farther"),
        ({"sft": SFT(decision_share=1.1)}, "sft.decision_share must lie between 0 and 1, got 1.1"),
        ({"sft": SFT(aim_weight=-1.0)}, "sft.aim_weight must be at least 0 and finite, got -1"),
        ({"sft": SFT(aim_weight=0.5)}, "sft.aim_weight needs sft.shift_px 0, got 2"),
        ({"sft": SFT(scene_shift_m=0.3)}, "sft.scene_shift_m must lie between 0 and 0.2, got 0.3: farther"),
        (
            {"sft": SFT(shift_px=64, aim_weight=0.0)},
            "sft.shift_px must be at least 0 and less than image_size, 64, got 64",
        ),
        ({"sft": SFT(lr=float("nan"))}, "sft.lr must be above 0 and finite, got nan"),
        ({"sft": SFT(dim=0)}, "the policy cannot be made of these settings: dim must be a positive multiple"),
        ({"world_model": WorldModel(width=0)}, "the world model cannot be made of these settings: width times every"),
        ({"sft": SFT(dim=126)}, "the policy cannot be made of these settings: dim must be a positive multiple"),
        ({"world_model": WorldModel(patch=8)}, "the world model cannot be made of these settings: patch must leave"),
        ({"world_model": WorldModel(denoise_steps=9)}, "num_denoise_steps must lie between 1 and 4, got 9"),
        ({"reflector": Reflector(prefixes=0)}, "the reflector cannot be made of these settings: .*prefixes"),
    ],
)
def test_bad_settings_fail_before_any_work_starts(change, message):
    with pytest.raises(ValueError, match=message):
        check_config(dataclasses.replace(PRESETS["smoke"][1], **change))


def test_what_the_compact_parts_refuse_is_no_matter_for_other_parts():
    config = dataclasses.replace(PRESETS["smoke"][1], image_size=32)  # too small for the compact world model
    check_config(config, dataclasses.replace(COMPACT, world_model=Part(make=pytest.fail, load=pytest.fail)))


def test_the_command_names_a_bad_setting_in_one_line(tiny):
    with pytest.raises(SystemExit, match="error: unknown task 'goal/close_the_door'"):
        run_all(dataclasses.replace(tiny, tasks=("goal/close_the_door",)))
    assert not tiny.run_dir.exists()


def test_the_whole_loop_runs_writes_its_files_and_continues_where_it_stopped(tiny, capsys, monkeypatch):
    monkeypatch.setattr("demonstrate.check_solved", lambda *_: None)  # 16 steps are too few for the expert
    threads = torch.get_num_threads()
    run_all(tiny)
    folder = RunFolder(tiny.run_dir)
    assert all(folder.done(stage.name) for stage in plan(tiny))
    assert {path.name for path in (tiny.run_dir / "checkpoints").iterdir()} >= {
        "sft",
        "world_model",
        "reflector",
        "post_train",
    }
    assert all((tiny.run_dir / "plots" / f"{name}.png").exists() for name in ("losses", "evaluation"))
    _, explored = demonstrations_and_exploration(Run(tiny, folder), 1)
    contexts = contexts_of(explored, tiny.cameras)[keys.CONTEXT_ID].flatten().tolist()
    assert contexts == [context_id(0, "train", index) for index in range(4)]  # exploration visits every one
    wave = read_rollouts(folder.rollouts("post_train_000"))
    steps = wave["next", keys.STEP_MASK]
    assert wave[keys.RATIO][steps].gt(0).all() and wave[keys.CLIPPED].dtype == torch.bool
    assert wave[keys.CHUNK].shape[-2:] == (8, 7)
    told = capsys.readouterr()
    assert "physics" in told.out and "missing in the report" not in told.out
    assert "the report could not be written" not in told.err
    assert "Signal is the correlation" in (tiny.run_dir / "report.html").read_text()

    (tiny.run_dir / "stages" / "evaluate").unlink()
    before = folder.checkpoint("post_train").joinpath("model.safetensors").stat().st_mtime_ns
    run_all(tiny)
    assert "post_train: finished, skipped" in capsys.readouterr().out
    assert folder.checkpoint("post_train").joinpath("model.safetensors").stat().st_mtime_ns == before

    # A lost output, or an earlier stage that ran again, makes a stage unfinished.
    shutil.rmtree(folder.checkpoint("reflector"))
    rerun("train_world_model", train_world_model, open_run(tiny))
    run_all(tiny)
    printed = capsys.readouterr().out
    assert "explore: finished, skipped" in printed and "world_model: finished, skipped" in printed
    assert "reflector: finished" not in printed and "post_train: finished" not in printed
    torch.set_num_threads(threads)


def test_an_interrupt_ends_with_one_line_even_if_a_library_turns_it_into_an_error(tiny, monkeypatch, capsys):
    def struck(*_):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            raise RuntimeError("converting a tensordict to boolean") from error

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setitem(world_env.WORKS, "demonstrate", struck)
    with pytest.raises(SystemExit) as ended:
        run_all(tiny)
    assert ended.value.code == 130
    assert "interrupted in stage demonstrate: the same command continues" in capsys.readouterr().err
    assert not RunFolder(tiny.run_dir).done("demonstrate")
    assert signal.getsignal(signal.SIGINT) is before


def test_one_task_under_two_names_is_refused(tiny, tmp_path):
    text = (SUITES_FOLDER / "starter" / "open_the_top_drawer.bddl").read_text()
    for name in ("one", "two"):
        (tmp_path / f"{name}.bddl").write_text(text + f"; {name}\n")
    names = tuple(str(tmp_path / f"{name}.bddl") for name in ("one", "two"))
    with pytest.raises(ValueError, match=r"names a task twice: .*one.bddl and .*two.bddl say the same"):
        check_config(dataclasses.replace(tiny, tasks=names))


def test_a_stage_without_its_input_names_the_stage_to_run(tiny):
    run = open_run(tiny)
    with pytest.raises(SystemExit, match=r"error: .*demonstrations.mcap does not exist: run the stage 'demonstrate'"):
        rerun("sft", world_env.WORKS["sft"], run)


def test_thorough_is_improve_on_a_suite_with_more_training():
    improve, thorough = (PRESETS[name][1] for name in ("improve", "thorough"))
    changed = {
        item.name for item in dataclasses.fields(improve) if getattr(improve, item.name) != getattr(thorough, item.name)
    }
    assert changed == {"run_dir", "tasks", "max_steps", "demonstrate", "sft", "evaluate"}
    assert dataclasses.replace(thorough.demonstrate, episodes_per_task=2) == improve.demonstrate
    assert dataclasses.replace(thorough.sft, steps=improve.sft.steps) == improve.sft
    assert thorough.sft.steps == 3 * improve.sft.steps and len(thorough.tasks) == 10
    check_config(dataclasses.replace(thorough, sft=dataclasses.replace(thorough.sft, vision_blocks=())))
