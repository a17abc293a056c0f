"""One line for what a user can mend, a traceback for what a programmer must."""

from __future__ import annotations

import errno

import numpy as np
import pytest
import torch

import world_env
from command_line import expected, one_line_errors, refusals, writable
from demonstrate import check_solved
from run_folder import RunFolder
from stages import open_run, rerun
from worldenv_trl.pretrained import Pretrained
from worldenv_trl.reflectors import StopRule


def caught(work) -> Exception:
    try:
        work()
    except Exception as error:
        return error
    raise AssertionError("nothing was raised")


def test_what_our_checks_and_the_disk_say_is_expected(tmp_path):
    assert expected(caught(lambda: StopRule(threshold=3)))
    assert expected(caught(lambda: check_solved("a task", torch.tensor([True, False]))))
    assert expected(caught(lambda: Pretrained.from_pretrained(tmp_path / "nowhere")))
    assert expected(caught(lambda: (tmp_path / "gone").read_text()))
    assert expected(OSError(errno.ENOSPC, "no space left on device"))


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: np.zeros(3).reshape(2, 2),  # a library's ValueError
        lambda: torch.zeros(3) @ torch.zeros(4),  # a library's RuntimeError
        lambda: RunFolder("x").plot(),  # a TypeError
        lambda: open_run(None),  # an AttributeError inside ours
        lambda: StopRule(threshold="high"),
        lambda: (_ for _ in ()).throw(ValueError("of a part that is the user's own")),
        lambda: (_ for _ in ()).throw(BrokenPipeError(errno.EPIPE, "a process has died")),
    ],
)
def test_what_goes_wrong_in_the_program_keeps_its_traceback(mistake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    error = caught(mistake)
    assert not expected(error)
    with pytest.raises(type(error)), refusals():
        mistake()
    with pytest.raises(type(error)):
        one_line_errors(mistake)()


def test_ctrl_c_is_one_line(capsys):
    def interrupted():
        raise KeyboardInterrupt

    assert one_line_errors(interrupted)() == 130
    with pytest.raises(SystemExit, match="130"), refusals():
        interrupted()
    assert capsys.readouterr().err == "interrupted\n" * 2


def test_a_full_gpu_is_answered_with_the_settings_that_take_less(capsys):
    said = "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 23.5 GiB"

    def full() -> None:
        raise torch.OutOfMemoryError(said)

    assert one_line_errors(full)() == 1
    line = capsys.readouterr().err
    assert line.startswith("error: CUDA out of memory: smaller --sft.batch-size") and line.count("\n") == 1
    assert "gradient_checkpointing" in line


def test_a_value_error_of_python_itself_inside_our_code_is_no_check():
    code = compile("first, second = (1, 2, 3)", world_env.__file__, "exec")  # a line of ours that raises nothing itself
    error = caught(lambda: exec(code, {}))
    assert isinstance(error, ValueError) and not expected(error)


def test_a_damaged_file_ends_a_stage_with_one_line_and_the_traceback_is_kept(tiny):
    run = open_run(tiny)
    run.folder.rollouts("demonstrations").write_bytes(b"no recording at all")
    with pytest.raises(SystemExit) as ended:
        rerun("sft", world_env.WORKS["sft"], run)
    said = str(ended.value)
    assert said.startswith("error: ") and "demonstrations.mcap is not an MCAP file" in said and "\n" not in said
    assert "stage sft" in said and str(run.folder.path / "error.txt") in said
    kept = (run.folder.path / "error.txt").read_text()
    assert kept.startswith("Traceback") and "fine_tune" in kept
    assert not run.folder.done("sft")


def test_a_mistake_in_a_stage_keeps_its_traceback(tiny):
    def mistaken(run):
        np.zeros(3).reshape(2, 2)

    with pytest.raises(ValueError, match="reshape"):
        rerun("sft", mistaken, open_run(tiny))


def test_a_place_that_takes_no_file_is_named_before_the_work(tmp_path):
    (tmp_path / "file").write_text("kept")
    for out, error in (
        (tmp_path, "is a folder"),
        (tmp_path / "file" / "out.json", "file"),
        (tmp_path / "strip.xyz", "must end like a picture, for instance strip.png"),
    ):
        with pytest.raises((OSError, ValueError), match=error):
            writable(out, plot=out.suffix == ".xyz")
    assert writable(tmp_path / "new" / "out.json") == tmp_path / "new" / "out.json"
    assert list((tmp_path / "new").iterdir()) == []  # nothing is left there yet
    assert writable(tmp_path / "file").read_text() == "kept"
