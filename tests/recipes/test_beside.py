"""How far beside a path success lies, at the smallest scale: the physics' count, and what a judge says."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest
import torch
from small_run import SMALL
from tensordict import TensorDict
from test_benchmarks import benchmark

import config
from demonstrate import demonstrate
from parts import make_policy, make_reflector
from run import Run, write_rules
from stages import open_run
from worldenv_trl import keys
from worldenv_trl.reflectors import Reflector, StopRule

TASK = config.GOAL_TASKS[2:]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    """Demonstrations of the expert stand where exploration would: they succeed, and nothing beside them is there."""
    settings = dataclasses.replace(
        SMALL,
        run_dir=tmp_path_factory.mktemp("beside") / "run",
        tasks=TASK,
        max_steps=40,
        demonstrate=config.Demonstrate(episodes_per_task=4),
        explore=dataclasses.replace(SMALL.explore, episodes_per_task=4),
        reflector=dataclasses.replace(SMALL.reflector, holdout=0.75, path_epochs=0.1),
    )
    run = open_run(settings)
    demonstrate(run)
    shutil.copy(run.folder.rollouts("demonstrations"), run.folder.rollouts("explore"))
    torch.manual_seed(0)
    make_policy(settings).save_pretrained(run.folder.checkpoint("sft"))
    make_reflector(settings).save_pretrained(run.folder.checkpoint("reflector"))
    write_rules(run.folder.checkpoint("reflector"), {"real": StopRule(), "imagined": StopRule()})
    yield run
    run.close()


def command(run: Run, **settings) -> dict:
    module = benchmark("beside")
    return json.loads(module.main(module.Settings(run.folder.path, **settings)).read_text())


class Farther(Reflector):
    """R is how far the hand has come from where it began, in metres: a judge that is known."""

    def __init__(self) -> None:
        super().__init__(cameras=("agentview",), reads_path=True, reads_video=False)

    def begin(self, frames, instructions):
        first = frames["kinematic_states"][:, 7:10]
        return TensorDict({"first": first, "score": torch.zeros(len(first))}, batch_size=[len(first)])

    def extend(self, state, frames):
        scores = (frames["kinematic_states"][..., 7:10] - state["first"].unsqueeze(1)).norm(dim=-1)
        return state.copy().set("score", scores[:, -1]), scores


def test_where_nothing_is_moved_all_succeed_and_far_away_none(run, capsys):
    figures = command(run, distances=(0.0, 0.2), episodes_per_task=2, seed=1)  # seed 0 points into the table
    (task,) = TASK
    assert figures["all"] == figures[task]
    assert figures[task]["paths"] == 2
    assert [each["successes"] for each in figures[task]["at"].values()] == [2, 0]
    near, far = figures[task]["at"].values()
    assert near["R"] == near["R_of_successes"] and near["R_of_failures"] is None
    assert far["R"] == far["R_of_failures"] and far["R_of_successes"] is None
    shown = capsys.readouterr().out
    assert "| paths that succeed, the hand moved by | 0 cm | 20 cm |" in shown
    assert "physics | 1.00 [0.34, 1.00] | 0.00 [0.00, 0.66] |" in shown


def test_the_judge_is_given_the_moved_path(run):
    module = benchmark("beside")
    settings = module.Settings(run.folder.path, distances=(0.0, 0.05), episodes_per_task=3)
    successes = module.kept_out_successes(run, 3)
    assert len(successes) == 3 and bool(successes["success"].any(-1).all())
    states = successes["kinematic_states"][..., 7:10]
    figures = module.measure(run, Farther(), successes, settings)["all"]["at"]
    came = (states[:, -1] - states[:, 0]).norm(dim=-1).mean().item()
    assert figures["0"]["R"] == pytest.approx(came, abs=1e-3)
    assert 0 < abs(figures["0.05"]["R"] - came) <= 0.05
    assert torch.equal(successes["kinematic_states"][..., 7:10], states)  # nothing is changed in place
    alone = dataclasses.replace(settings, distances=(0.05,))  # a path goes the same way at every distance
    assert module.measure(run, Farther(), successes, alone)["all"]["at"]["0.05"] == figures["0.05"]


def test_actions_move_the_hand_by_what_is_asked():
    module, asked = benchmark("beside"), torch.tensor([[0.03, -0.06, 0.02], [0.0, 0.0, 0.0]])
    moved = module.moved_aside(torch.zeros(2, 20, 7), asked)
    torch.testing.assert_close(keys.POSITION_STEP * moved.sum(1)[:, :3], asked)
    assert not moved[..., 3:].any() and not moved[:, module.MOVED_IN :].any()
    assert module.moved_aside(torch.ones(1, 20, 7), torch.full((1, 3), 0.1)).max() == 1  # an action goes no further


def test_hands_are_moved_as_often_in_every_direction():
    towards = benchmark("beside").directions(4000, torch.Generator().manual_seed(0))
    torch.testing.assert_close(towards.norm(dim=-1), torch.ones(4000))
    # Of a direction in space every coordinate is uniform in [-1, 1] (Archimedes).
    for coordinate in towards.unbind(-1):
        assert all(abs((coordinate < bound).float().mean() - (1 + bound) / 2) < 0.03 for bound in (-0.5, 0.0, 0.5))


def test_what_cannot_be_measured_is_refused(run):
    module = benchmark("beside")
    for settings, message in (
        ({"episodes_per_task": 0}, "--episodes-per-task must be at least 1, got 0"),
        ({"distances": ()}, r"distances must be one or more, none negative, got \(\)"),
        ({"distances": (-0.1,)}, "none negative"),
        ({"reflector": "nothing"}, "nothing"),
    ):
        with pytest.raises(SystemExit, match=message):
            module.main(module.Settings(run.folder.path, **settings))


def test_a_judge_of_videos_is_refused(run, tmp_path):
    video = dataclasses.replace(run.config, reflector=dataclasses.replace(run.config.reflector, path_epochs=0.0))
    make_reflector(video).save_pretrained(tmp_path / "video")
    module = benchmark("beside")
    with pytest.raises(SystemExit, match="looks at videos"):
        module.main(module.Settings(run.folder.path, reflector=str(tmp_path / "video")))
