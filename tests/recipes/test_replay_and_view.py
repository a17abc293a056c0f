"""The commands that replay and show recordings."""

from __future__ import annotations

import dataclasses
import json
import sys

import pytest
import torch
import tyro
from foxglove import Channel, Context, open_mcap
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import replay as replay_recipe
import view as view_recipe
from config import PRESETS, Explore, PostTrain
from physics import exploring_actor
from worldenv_trl import keys
from worldenv_trl.collectors import GroupCollector
from worldenv_trl.envs import ImaginedEnv, TabletopEnv
from worldenv_trl.kinematics import ForwardKinematics
from worldenv_trl.policies import OFTConfig, OFTPolicy
from worldenv_trl.record import RolloutWriter, provenance, read_metadata, read_rollouts
from worldenv_trl.world_models import VideoWorldModel, VideoWorldModelConfig

TASK = "starter/open_the_top_drawer"
SMALL = {"image_size": 32, "patch": 2, "width": 16, "multipliers": (1, 2), "blocks": (1, 1), "frame_channels": 8}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a physical and an imagined recording and two world models."""
    folder = tmp_path_factory.mktemp("run")
    env = TabletopEnv(TASK, 2, image_size=32, seed=0, max_steps=8, with_sim_state=True, proprio="commanded")
    torch.manual_seed(0)
    rollouts = next(iter(GroupCollector(env, None, groups_per_batch=2, group_size=1)))[:, 0]
    with RolloutWriter(folder / "rollouts" / "real.mcap", **provenance(env)) as writer:
        writer.write(rollouts)
    config = VideoWorldModelConfig.for_cameras(
        {"agentview": {env.tasks[0].language: env.tasks[0].camera("agentview")}}, **SMALL
    )
    for name in ("world_model", "world_model_2"):
        model = VideoWorldModel(config).eval()
        for parameter in model.parameters():
            parameter.data += 0.05 * torch.randn_like(parameter)
        model.save_pretrained(folder / "checkpoints" / name)
        if name == "world_model":
            world = ImaginedEnv(model, ForwardKinematics(), rollouts[:, 0], [2, 2], max_steps=16, seed=0)
            wave = next(iter(GroupCollector(world, None, groups_per_batch=2)))
            about = provenance(world, models={"world_model": model}, tasks=[TASK])
            with RolloutWriter(folder / "rollouts" / "dream.mcap", **about) as writer:
                writer.write(wave)
    env.close()
    return folder


def call(recipe, *arguments) -> int:
    return recipe.main(tyro.cli(recipe.Options, args=[str(argument) for argument in arguments]))


def test_a_replay_is_printed_in_words_and_kept_as_json(run, tmp_path, capsys):
    kept = tmp_path / "new" / "r.json"
    assert call(replay_recipe, run / "rollouts" / "real.mcap", "--rollout", 1, "--json", kept) == 0
    assert "bit-exact: sim_state" in capsys.readouterr().out
    assert json.loads(kept.read_text())["exact"] is True
    assert (run / "rollouts" / "real_rollout1_replay.mcap").exists()
    assert call(replay_recipe, run / "rollouts" / "real.mcap", "--rollout", 1) == 1
    assert "exists: pass --overwrite" in capsys.readouterr().err


def test_the_recorded_world_model_is_found_among_the_checkpoints(run, tmp_path, capsys):
    dream = run / "rollouts" / "dream.mcap"
    assert call(replay_recipe, dream, "--rollout", 3, "--target", tmp_path / "a.mcap") == 0
    assert "bit-exact" in capsys.readouterr().out
    other = ("--world-model", "world_model_2", "--target", tmp_path / "b.mcap", "--json", "-")
    assert call(replay_recipe, dream, "--rollout", 3, *other) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["exact"] is None and report["kind"] == "difference"
    assert any("is not the recorded one" in note for note in report["notes"])


def test_edits_of_several_options_are_joined(run, tmp_path):
    target = tmp_path / "a.mcap"
    edits = ("--edit", "3 gripper=-1", "--edit", "5-6 dx=0.5")
    assert call(replay_recipe, run / "rollouts" / "real.mcap", *edits, "--target", target) == 0
    assert set(read_metadata(target)["replay"]["branch"]["edits"]) == {"3", "5", "6"}
    assert float(read_rollouts(target)[keys.ACTION][0, 3, 6]) == -1


@pytest.fixture
def foreign(tmp_path):
    path, context = tmp_path / "foreign.mcap", Context()
    with open_mcap(path, context=context):
        Channel("/x", schema={"type": "object"}, context=context).log({"y": 1})
    return path


@pytest.mark.parametrize("recipe", [replay_recipe, view_recipe])
def test_other_files_are_refused_in_one_line(recipe, foreign, tmp_path, capsys, monkeypatch):
    (tmp_path / "text.mcap").write_text("not a recording")
    monkeypatch.setattr(view_recipe, "has_display", lambda: True)
    more = ("--viewer", "foxglove") if recipe is view_recipe else ()
    for path, words in (
        (tmp_path / "text.mcap", "is not an MCAP file"),
        (foreign, "was written by another program"),
        (tmp_path / "gone.mcap", "there is no file"),
    ):
        assert call(recipe, path, *more) == 1
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["foreign.mcap", "text.mcap"]


def test_no_display_and_no_rerun_are_said(run, capsys, monkeypatch, tmp_path):
    pytest.importorskip("rerun")
    real = run / "rollouts" / "real.mcap"
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        assert call(view_recipe, real) == 1
        assert "there is no display" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "rerun", None)
    for arguments in ((), ("--save", tmp_path / "a.rrd")):  # a missing display is not the first thing to mend
        assert call(view_recipe, real, *arguments) == 1
        assert "pip install 'worldenv_trl[viz]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_rollouts_are_saved_for_rerun_without_a_display(run, tmp_path, capsys, monkeypatch):
    pytest.importorskip("rerun")
    real = run / "rollouts" / "real.mcap"
    assert call(view_recipe, real, "--rollout", 1, "--save", tmp_path / "a.rrd") == 0
    assert (tmp_path / "a.rrd").stat().st_size > 1000 and len(list(tmp_path.iterdir())) == 1
    assert call(view_recipe, real, "--save", tmp_path / "a.rrd") == 1
    assert "pass --overwrite" in capsys.readouterr().err
    assert call(view_recipe, real, "--rollout", 9, "--save", tmp_path / "b.rrd") == 1
    assert "holds the rollouts 0 to 1, not 9" in capsys.readouterr().err
    monkeypatch.setattr(view_recipe, "MOST", 1)
    assert call(view_recipe, real, "--save", tmp_path / "c.rrd") == 0
    assert "the first 1 of 2 rollouts" in capsys.readouterr().out


def test_foxglove_gets_a_layout_of_the_recording(run, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    target = tmp_path / "new" / "layout.json"
    assert call(view_recipe, run / "rollouts" / "dream.mcap", "--viewer", "foxglove", "--save", target) == 0
    assert "Import from file" in capsys.readouterr().out
    assert "Plot!action" in json.loads(target.read_text())["configById"]


@pytest.mark.parametrize(
    ("stage", "settings", "noise"),
    [
        ("post_train", {"explore": Explore(noise="chunk")}, "step"),
        ("post_train_2", {"post_train": PostTrain(noise="chunk")}, "chunk"),
        ("explore", {"explore": Explore(noise="chunk")}, "chunk"),
        ("explore_2", {"post_train": PostTrain(noise="chunk")}, "step"),
    ],
)
def test_a_sampled_what_if_has_the_noise_of_the_stage_that_was_recorded(stage, settings, noise):
    policy = OFTPolicy(OFTConfig(("open the drawer",), image_size=32, dim=32))
    td = TensorDict(
        {"observation": {"image": torch.zeros(1, 3, 32, 32, dtype=torch.uint8), "state": torch.zeros(1, 7)}}
    )
    td = td.auto_batch_size_(1).set(keys.INSTRUCTION, "open the drawer")
    config = dataclasses.replace(PRESETS["improve"][1], **settings)
    exploring = exploring_actor(config, policy, config.post_train.scale_factor, noise)
    told = {"stage": stage, "config": json.loads(json.dumps(dataclasses.asdict(config), default=str))}
    recorded = replay_recipe.recorded_actor(policy, told)
    own = replay_recipe.recorded_actor(policy, {})
    with set_exploration_type(ExplorationType.RANDOM):
        chunks = []
        for actor in (exploring, recorded, own):
            torch.manual_seed(0)
            chunks.append(actor(td.copy())[keys.CHUNK])
    assert torch.equal(chunks[0], chunks[1])
    assert not torch.equal(chunks[0], chunks[2])
