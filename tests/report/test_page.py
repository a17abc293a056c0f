"""The page as text; ``test_browser.py`` opens it."""

from __future__ import annotations

import dataclasses
import re

import pytest
import torch
from pages import clip, evidence, run_folder

from worldenv_trl.metrics import honesty
from worldenv_trl.report import Evidence, RunRecord, render_report, write_report
from worldenv_trl.report.judgement import calibration


def text_of(page: str) -> str:
    body = re.sub(r"<(style|script)>.*?</\1>", "", page, flags=re.S)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body))


def test_the_verdict_names_change_interval_and_p(tmp_path):
    text = text_of(render_report(RunRecord.read(run_folder(tmp_path / "run")), evidence()))
    assert "Post-training gains 20.0 points of held-out success" in text
    assert "50.0 % → 70.0 %" in text and "[+10.0, +30.0]" in text and "p = 3 · 10⁻⁴" in text


def test_a_loss_and_no_change_are_said_as_plainly(tmp_path):
    record = RunRecord.read(run_folder(tmp_path / "run"))
    paired = [line for line in record.lines if line.get("paired")]
    for line in paired:
        line |= {"difference": -0.2}
    assert "Post-training costs 20.0 points" in text_of(render_report(record))
    for line in paired:
        line |= {"p_value": 0.4}
    assert "has not changed measurably" in text_of(render_report(record))


def test_what_a_run_does_not_hold_yet_is_named(tmp_path):
    path = run_folder(tmp_path / "run", evaluated=False)
    text = text_of(render_report(RunRecord.read(path), Evidence(missing=["run the stage 'train_reflector' first"])))
    assert "Not evaluated yet" in text and "the stage evaluate has not finished" in text
    assert text.count("un the stage &#x27;train_reflector&#x27; first") == 4  # table, drift, calibration, film strips
    (path / "metrics.jsonl").unlink()
    assert "No stage has run yet" in text_of(render_report(RunRecord.read(path)))


def test_an_alarm_is_seen_at_the_top(tmp_path):
    text = text_of(render_report(RunRecord.read(run_folder(tmp_path / "run", alarm=True))))
    assert "honesty alarm fired at iteration 4" in text and "+30.0 points" in text and "−10.0" in text
    quiet = text_of(render_report(RunRecord.read(run_folder(tmp_path / "other"))))
    rise = "since the first probes imagined success has changed by +25.0 points, real success by +10.0"
    assert f"Honesty alarm silent {rise}" in quiet
    (once,) = [
        line for line in (tmp_path / "other" / "metrics.jsonl").read_text().splitlines() if '"step": 0, "ret' in line
    ]
    (tmp_path / "other" / "metrics.jsonl").write_text(once + "\n")
    assert "silent one probe, and nothing" in text_of(render_report(RunRecord.read(tmp_path / "other")))


def test_probes_are_shown_task_by_task_where_they_were_noted(tmp_path):
    record = RunRecord.read(run_folder(tmp_path / "run"))
    text = text_of(render_report(record))
    assert "The probes of post_train, task by task" in text
    assert "turn on the stove 25.0 35.0 50.0 45.0 +5.0" in text
    for line in record.lines:
        line.pop("real_success_starter/turn_on_the_stove", None)
    assert "task by task" not in text_of(render_report(record))


def test_shares_of_nothing_are_not_shown_as_none(tmp_path):
    never = torch.zeros(4, dtype=torch.bool)
    row = honesty(never, never, imagined_steps=never, real_steps=never)
    found = dataclasses.replace(evidence(), honesty=[{"policy": "post_train", "task": "all"} | row])
    text = text_of(render_report(RunRecord.read(run_folder(tmp_path / "run")), found))
    assert "Imagined successes that are real – of the stops on 4 held-out episodes; none is real" in text
    assert "all tasks 4 0.0 0.0 +0.0 [−32.7, +32.7] – – – –" in text


def test_nothing_is_fetched_and_names_cannot_break_out_of_the_page(tmp_path):
    record = RunRecord.read(run_folder(tmp_path / "run"))
    record.config["tasks"] = ["goal/<script>alert(1)</script>"]
    page = render_report(record, evidence())
    assert "<script>alert" not in page
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:|\#)[^"']*""", page)
    assert "@import" not in page and "url(" not in page


def test_a_report_replaces_an_older_one_only_when_it_is_whole(tmp_path, monkeypatch):
    record, path = RunRecord.read(run_folder(tmp_path / "run")), tmp_path / "report.html"
    write_report(record, path)
    before = path.read_text()
    monkeypatch.setattr("worldenv_trl.report.page.headline", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_report(record, path)
    assert path.read_text() == before and [p.name for p in tmp_path.glob("report*")] == ["report.html"]


@pytest.mark.parametrize("kind", ["success", "failure", "false stop", "missed stop"])
def test_an_episode_is_of_the_kind_that_its_stop_and_goal_make_it(kind):
    assert clip(kind).kind == kind


def test_the_story_says_what_happens_at_which_step():
    story = clip("false stop").story()
    assert "step 5: the gripper closes" in story
    assert "step 6: imagination parts from the physics" in story  # from step 6 on the square is gone
    assert "step 9: the reflector stops imagination" in story
    assert clip("success").parting == -1


def test_calibration_counts_what_is_true_in_every_bin():
    probability = torch.tensor([0.05, 0.02, 0.31, 0.38, 0.33, 1.0])
    label = torch.tensor([False, False, True, False, True, True])
    found = calibration(probability, label)
    assert [entry["n"] for entry in found] == [2, 3, 1]
    assert [entry["rate"] for entry in found] == pytest.approx([0, 2 / 3, 1])
    assert found[1]["mean"] == pytest.approx(0.34) and found[1]["low"] < 2 / 3 < found[1]["high"]


def test_a_path_that_is_no_run_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist; give the --run-dir"):
        RunRecord.read(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="is no run folder: it holds no config"):
        RunRecord.read(tmp_path)
