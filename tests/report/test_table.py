"""The table and plots of a run folder."""

from __future__ import annotations

import json

import pytest

from worldenv_trl.report import plot_run, summary_table


def line(policy, success, low, high, **extra):
    return {
        "stage": "evaluate", "protocol": "physics", "policy": policy, "task": "all", "success": success,
        "low": low, "high": high, "episodes": 100,
    } | extra  # fmt: skip


@pytest.fixture
def run_dir(tmp_path):
    lines = [
        {"stage": "sft", "step": 0, "l1": 0.5},
        {"stage": "sft", "step": 50, "l1": 0.1},
        {"stage": "post_train", "step": 0, "return": 0.3, "real_success": 0.4, "imagined_success": 0.6},
        line("sft", 0.5, 0.40, 0.60),
        line("post_train", 0.7, 0.60, 0.78),
        {"stage": "evaluate", "protocol": "physics", "task": "all", "paired": True, "p_value": 0.0123},
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(item) + "\n" for item in lines))
    return tmp_path


def test_the_table_shows_both_policies_the_change_and_the_p_value(run_dir):
    row = summary_table(run_dir).splitlines()[-1]
    assert "50.0 [40.0, 60.0] n=100" in row
    assert "70.0 [60.0, 78.0] n=100" in row
    assert "+20.0" in row
    assert "0.012" in row


def test_a_line_cut_short_by_a_crash_is_left_out(run_dir):
    whole = summary_table(run_dir)
    with (run_dir / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "evaluate", "pol')
    assert summary_table(run_dir) == whole


def test_plots_are_drawn_for_what_was_measured(run_dir):
    written = plot_run(run_dir)
    assert {path.name for path in written} == {"losses.png", "imagined_and_real_success.png", "evaluation.png"}
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)


def test_a_success_that_lies_beside_its_rounded_interval_is_drawn(run_dir):
    line = {"stage": "evaluate", "protocol": "physics", "policy": "sft", "task": "goal/open_the_top_drawer"}
    with (run_dir / "metrics.jsonl").open("a") as file:
        for success, low, high in ((1.0, 0.94, 1 - 1e-16), (0.0, 1e-17, 0.06)):
            file.write(json.dumps(line | {"success": success, "low": low, "high": high, "episodes": 60}) + "\n")
    assert "evaluation.png" in {path.name for path in plot_run(run_dir)}


def test_a_folder_without_metrics_is_named_in_the_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="not a run folder"):
        summary_table(tmp_path)
