"""The BDDL parser: what a file says, and where a wrong one is wrong."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from worldenv_trl.scenes.bddl import BDDLError, parse_bddl, read_bddl

TEXT = """
; a comment (with parentheses
(define (problem LIBERO_Tabletop_Manipulation)
  (:domain robosuite)
  (:language Put the Bowl in the top drawer)
  (:regions
    (bowl_start
      (:target main_table)
      (:ranges ((-0.1 0.0 0.1 0.2) (0.2 0.2 0.3 0.3)))
      (:yaw_rotation ((0.0 1.57))))
    (top_region (:target cabinet_1)))
  (:fixtures main_table - table
             cabinet_1 - Wooden_Cabinet)
  (:objects bowl_1 bowl_2 - bowl
            plate_1 - plate)
  (:obj_of_interest bowl_1 cabinet_1_top_region)
  (:init (On bowl_1 main_table_bowl_start) (Close cabinet_1_top_region))
  (:goal (And (In BOWL_1 cabinet_1_top_region) (close cabinet_1_top_region)))
)
"""


def test_every_block_is_read():
    problem = parse_bddl(TEXT)
    assert problem.kind == "libero_tabletop_manipulation"
    assert problem.language == "Put the Bowl in the top drawer"
    assert problem.fixtures == {"main_table": "table", "cabinet_1": "wooden_cabinet"}
    assert problem.objects == {"bowl_1": "bowl", "bowl_2": "bowl", "plate_1": "plate"}
    start = problem.regions["main_table_bowl_start"]
    assert start.target == "main_table" and start.yaw == (0.0, 1.57)
    assert start.ranges == ((-0.1, 0.0, 0.1, 0.2), (0.2, 0.2, 0.3, 0.3))
    assert problem.regions["cabinet_1_top_region"].ranges == ()
    assert problem.objects_of_interest == ("bowl_1", "cabinet_1_top_region")
    assert problem.init == (("On", "bowl_1", "main_table_bowl_start"), ("Close", "cabinet_1_top_region"))
    assert problem.goal == (("In", "bowl_1", "cabinet_1_top_region"), ("Close", "cabinet_1_top_region"))


def test_a_goal_of_one_predicate_needs_no_and():
    goal = "(:goal (And (In BOWL_1 cabinet_1_top_region) (close cabinet_1_top_region)))"
    assert parse_bddl(TEXT.replace(goal, "(:goal (TurnOn cabinet_1))")).goal == (("TurnOn", "cabinet_1"),)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("(In BOWL_1", "(Inn BOWL_1", 18, "'Inn': unknown predicate: did you mean 'In'"),
        ("(In BOWL_1", "(Inside BOWL_1", 18, "'Inside': unknown predicate"),
        ("(In BOWL_1", "(In BOWL_3", 18, "'BOWL_3': this is neither"),
        ("(In BOWL_1 cabinet_1_top_region)", "(In BOWL_1)", 18, "In takes 2 argument"),
        ("(-0.1 0.0 0.1 0.2)", "(-0.1 0.0 0.1)", 9, "list of 4 numbers"),
        ("(-0.1 0.0 0.1 0.2)", "(-0.1 0.0 wide 0.2)", 9, "'wide': expected a number"),
        ("(-0.1 0.0 0.1 0.2)", "(0.5 0.0 0.1 0.2)", 9, "x_low 0.5 > x_high 0.1"),
        ("(:target cabinet_1)", "(:traget cabinet_1)", 11, "':traget': a region knows"),
        ("(:target cabinet_1)", "(:traget cabinet_1)", 11, "did you mean ':target'"),
        ("(:target cabinet_1)", "(:target cabinte_1)", 11, "'top_region' is not declared: did you mean 'cabinet_1'"),
        (
            "(:target cabinet_1)",
            "(:target drawers)",
            16,
            "'drawers', the target of region 'top_region' on line 11, is not",
        ),
        (
            "((0.0 1.57))",
            "((0.0 90))",
            10,
            "'bowl_start' is in radians, within 2 pi either way; 90 degrees would be 1.571",
        ),
        ("((0.0 1.57))", "((-180 0.0))", 10, "'-180': the :yaw_rotation of region 'bowl_start' is in radians"),
        ("((0.0 1.57))", "((1.57 0.0))", 10, "'(1.57 0.0)': the :yaw_rotation of region 'bowl_start' is (low high)"),
        ("((0.0 1.57))", "((0.0 1.57) (0.0 1.0))", 10, "takes one (low high) of :yaw_rotation, got 2"),
        ("(:yaw_rotation ((0.0 1.57)))", "(:target plate_1)", 10, "a second (:target ...); the first is on line 8"),
        ("(:fixtures main", "(:fixture main", 12, "':fixture': unknown block: did you mean ':fixtures'"),
        ("(:fixtures main", "(fixtures main", 12, "'fixtures': unknown block: did you mean ':fixtures'"),
        ("bowl_1 bowl_2 - bowl", "bowl_1 - - bowl", 14, "instances are declared as"),
        ("plate_1 - plate", "plate_1 -plate", 15, "'-plate': put a space on either side of the dash"),
        ("plate_1 - plate", "plate_1 plate", 15, "write 'plate_1 - category'; after it stands 'plate', without a dash"),
        ("bowl_1 cabinet_1_top_region)\n", "bowl_3 cabinet_1_top_region)\n", 16, "'bowl_3': this is neither"),
        ("(:init", "(:start", 17, "':start': unknown block"),
        ("(:domain robosuite)", "(:domain robosuite) (:domain robosuite)", 4, "a second (:domain"),
        ("plate_1 - plate)", "plate_1)", 15, "'plate_1': this instance has no category"),
        ("plate_1 - plate", "bowl_1 - plate", 15, "'bowl_1': this name is declared twice"),
        ("robosuite)", "blocksworld)", 4, "must be robosuite"),
        ("(:language Put the Bowl in the top drawer)", "", 3, "(:language ...) is missing"),
        ("(:language Put the Bowl in the top drawer)", "(:language)", 5, "the instruction is empty"),
        ("  (:init", "  ) (:init", 17, "nothing may follow"),
        ("(:fixtures", "((:fixtures", 3, "never closed"),
    ],
)
def test_errors_name_file_line_and_token(old, new, line, message):
    assert old in TEXT
    with pytest.raises(BDDLError) as caught:
        parse_bddl(TEXT.replace(old, new), "mine.bddl")
    text = str(caught.value)
    assert text.startswith(f"mine.bddl:{line}:") and message in text


def test_files_that_are_no_task_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.bddl"):
        read_bddl(tmp_path / "nowhere.bddl")
    for name, content, message in (
        ("empty.bddl", b" ; nothing\n", "the file is empty"),
        ("binary.bddl", b"\xff\xfe\x00", "not a text file"),
        ("prose.bddl", b"hello", "starts with"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(BDDLError, match=message):
            read_bddl(path)


def test_a_region_whose_target_is_not_there_is_left_out():
    text = TEXT.replace("(top_region (", "(side (:target drainer_1)) (top_region (")
    assert "drainer_1_side" not in parse_bddl(text).regions


LIBERO = os.environ.get("WORLDENV_TRL_LIBERO_BDDL")


@pytest.mark.skipif(not LIBERO, reason="WORLDENV_TRL_LIBERO_BDDL does not name the folder of LIBERO's bddl_files")
def test_all_130_files_of_libero_are_read():
    files = sorted(Path(LIBERO).rglob("*.bddl"))
    assert len(files) == 130
    for path in files:
        problem = read_bddl(path)
        assert problem.goal and problem.init and problem.objects
