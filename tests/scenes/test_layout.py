"""Drawn initial states against what the task file asks for."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from worldenv_trl.scenes.bddl import parse_bddl, read_bddl
from worldenv_trl.scenes.layout import Layout
from worldenv_trl.scenes.settings import compile_scene, setting_of

TEXT = """
(define (problem tabletop) (:domain robosuite) (:language put the butter in the drawer)
  (:regions
    (cabinet_region (:target table_1) (:ranges ((-0.05 -0.28 -0.03 -0.26))) (:yaw_rotation ((3.14159265 3.14159265))))
    (free_region (:target table_1) (:ranges ((-0.1 0.0 0.1 0.2) (-0.2 0.0 -0.15 0.2))))
    (top_region (:target cabinet_1)) (top_side (:target cabinet_1)))
  (:fixtures table_1 - table cabinet_1 - wooden_cabinet)
  (:objects bowl_1 - bowl plate_1 - plate butter_1 - butter can_1 - alphabet_soup)
  (:init (On cabinet_1 table_1_cabinet_region) (On plate_1 table_1_free_region) (On bowl_1 plate_1)
         (Open cabinet_1_top_region) (In butter_1 cabinet_1_top_region) (On can_1 cabinet_1_top_side))
  (:goal (And (Close cabinet_1_top_region))))
"""
LIBERO = os.environ.get("WORLDENV_TRL_LIBERO_BDDL")


def drawn(problem, seed: int = 0):
    entities, model = compile_scene(problem)
    data = mujoco.MjData(model)
    Layout(problem, entities, model, origin=setting_of(problem).origin).draw(data, np.random.default_rng(seed))
    mujoco.mj_kinematics(model, data)
    return entities, model, data


def place(model, data, name: str) -> np.ndarray:
    return data.xpos[model.body(f"{name}/").id]


def test_things_start_in_their_rectangles_and_where_they_are_carried():
    problem = parse_bddl(TEXT)
    starts = []
    for seed in range(30):
        _, model, data = drawn(problem, seed)
        x, y, z = place(model, data, "plate_1") - (*setting_of(problem).origin, 0.0)
        assert (-0.1 <= x <= 0.1 or -0.2 <= x <= -0.15) and 0.0 <= y <= 0.2 and z == pytest.approx(0.001)
        starts.append(x < -0.12)
        above = place(model, data, "bowl_1") - place(model, data, "plate_1")
        assert above == pytest.approx((0, 0, 0.013), abs=1e-6)
        top = data.qpos[model.joint("cabinet_1/top").qposadr[0]]
        assert -0.16 <= top <= -0.14 and data.qpos[model.joint("cabinet_1/middle").qposadr[0]] == 0.0
        drawer = data.xpos[model.body("cabinet_1/top").id]
        butter = place(model, data, "butter_1")
        assert np.abs(butter - drawer)[:2].max() < 0.08 and abs(butter[2] - drawer[2]) < 0.03
        assert butter[1] > place(model, data, "cabinet_1")[1] + 0.05  # the drawer is pulled out towards +y
        assert place(model, data, "can_1")[2] == pytest.approx(0.207, abs=2e-3)
    assert 0 < sum(starts) < 30  # both rectangles are used


def test_a_seed_gives_the_same_state_and_another_one_another():
    problem = parse_bddl(TEXT)
    first, again, other = (drawn(problem, seed)[2].qpos for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("(On can_1 cabinet_1_top_side)", "", "<text>:8: 'can_1': it has no place in :init"),
        ("(On bowl_1 plate_1)", "(On bowl_1 plate_1) (On bowl_1 can_1)", "bowl_1 is placed twice"),
        (
            "(Open cabinet_1_top_region)",
            "(Open cabinet_1_top_region) (Close cabinet_1_top_region)",
            "the joint of cabinet_1_top_region is set twice in :init",
        ),
        ("(Open cabinet_1_top_region)", "(Open plate_1)", "plate_1 has no joint for Open"),
        (
            "(On plate_1 table_1_free_region) (On bowl_1 plate_1)",
            "(On plate_1 bowl_1) (On bowl_1 plate_1)",
            "stands on it in turn",
        ),
        ("- wooden_cabinet", "- wooden_cabnet", "<text>:7: 'cabinet_1': unknown category 'wooden_cabnet'"),
        (
            "(On can_1 cabinet_1_top_side)",
            "(On can_1 table_1)",
            ":10: .*table_1 is the workspace: name one of its regions",
        ),
        ("(On can_1 cabinet_1_top_side)", "(On table_1 can_1)", ":10: .*table_1 is a place: only objects and fixtures"),
        ("(:ranges ((-0.05 -0.28 -0.03 -0.26)))", "", ":9: .*has no .:ranges .* to place cabinet_1 in"),
        (
            "(On cabinet_1 table_1_cabinet_region)",
            "(On cabinet_1 plate_1)",
            "cabinet_1 is a fixture: it stands in a region of the workspace",
        ),
        (
            "cabinet_1 - wooden_cabinet)",
            "cabinet_1 - wooden_cabinet mug_1 - red_coffee_mug)",
            "'mug_1': .* :objects, not",
        ),
        ("(:objects bowl_1", "(:objects oven_1 - microwave bowl_1", "'oven_1': a microwave stands .* :fixtures, not"),
        ("bowl_1 - bowl plate_1", "bowl_1 green_bowl plate_1", ":8: 'green_bowl': a category as the name of a plate"),
        ("(:objects bowl_1", "(:objects panda - bowl bowl_1", "'panda': .* call it panda_1"),
        ("(:objects bowl_1", "(:objects a/b - bowl bowl_1", "'a/b': a name may not hold a slash"),
        (
            "problem tabletop",
            "problem libero_kitchen_tabletop_manipulation",
            ":7: 'table_1': the workspace is a table, but .* on a kitchen_table: write 'table_1 - kitchen_table', "
            "or another class: bench, tabletop, libero_tabletop_manipulation",
        ),
        ("table_1 - table", "table_1 - study_table", "is a study_table, but .*class: study, libero_study"),
        ("problem tabletop", "problem table_top", "<text>:2: 'table_top': unknown class .*did you mean 'tabletop'"),
    ],
)
def test_a_file_that_cannot_be_laid_out_is_refused(old, new, message):
    assert old in TEXT
    problem = parse_bddl(TEXT.replace(old, new))
    with pytest.raises(ValueError, match=message):
        drawn(problem)


def test_an_infeasible_placement_ends_with_an_error_that_names_the_region():
    text = TEXT.replace("((-0.1 0.0 0.1 0.2) (-0.2 0.0 -0.15 0.2))", "((-0.04 -0.27 -0.03 -0.26))")
    with pytest.raises(RuntimeError, match="table_1_free_region': plate_1 cannot be placed in it clear of cabinet_1"):
        drawn(parse_bddl(text))


@pytest.mark.skipif(not LIBERO, reason="set WORLDENV_TRL_LIBERO_BDDL to LIBERO's folder bddl_files")
@pytest.mark.parametrize("suite", ["libero_spatial", "libero_object", "libero_goal", "libero_10"])
def test_the_files_of_libero_can_be_laid_out(suite):
    files = sorted(Path(LIBERO, suite).glob("*.bddl"))
    assert len(files) == 10
    for file in files:
        _, _, data = drawn(read_bddl(file))
        assert np.isfinite(data.xpos).all()
