"""A good file is never replaced by half of one: full disks, several writers, names that are taken."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import subprocess
import threading

import pytest
import torch
from test_damaged_files import NoiseEnv, assert_prefix, make_rollouts, record

from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter, read_rollouts, recorded, repair
from worldenv_trl.record.mcap import file


@contextlib.contextmanager
def files_of_at_most(size: int):
    """What the operating system does when a file may not grow any more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def tiny_disk(tmp_path):
    """A file system of 1 MiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if (
        os.name != "posix"
        or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True).returncode
    ):
        pytest.skip("this user may not mount a file system")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_writer_that_reaches_the_end_of_what_it_may_write_says_so_and_keeps_complete_rollouts(tmp_path):
    rollouts = make_rollouts(6, 20, 64)
    record(tmp_path / "a.mcap", rollouts[:1])
    before = (tmp_path / "a.mcap").read_bytes()
    writer = RolloutWriter(tmp_path / "a.mcap", overwrite=True)
    with files_of_at_most(700_000), pytest.raises(OSError, match=r"could not be written: files may not become larger"):
        for row in range(6):
            writer.write(rollouts[row : row + 1])
    assert (tmp_path / "a.mcap").read_bytes() == before
    with pytest.warns(UserWarning, match="truncated"):
        read = read_rollouts(tmp_path / "a.partial.mcap")
    assert assert_prefix(read, rollouts) >= 40
    done = repair(tmp_path / "a.partial.mcap")
    assert assert_prefix(read_rollouts(done.target), rollouts) >= 40


def test_a_full_disk_is_one_error_of_the_writer(tiny_disk):
    rollouts = make_rollouts(8, 20, 64)
    record(tiny_disk / "a.mcap", rollouts[:1])
    writer = RolloutWriter(tiny_disk / "b.mcap")
    with pytest.raises(OSError, match="make room") as caught:
        for row in range(8):
            writer.write(rollouts[row : row + 1])
    assert caught.value.errno == errno.ENOSPC
    assert len(read_rollouts(tiny_disk / "a.mcap")) == 1
    writer.close()
    with pytest.warns(UserWarning, match="truncated"):
        assert assert_prefix(read_rollouts(tiny_disk / "b.partial.mcap"), rollouts) >= 20


def test_a_disk_that_fills_up_is_one_error_of_the_recorder(tiny_disk):
    record(tiny_disk / "a.mcap", make_rollouts(1))
    env = recorded(NoiseEnv(8), tiny_disk / "b.mcap")
    with pytest.raises(OSError, match=r"b\.mcap could not be written: the disk is full, make room") as caught:
        for _ in range(20):
            env.rollout(10)
            env.transform.flush()
    assert caught.value.errno == errno.ENOSPC
    assert len(read_rollouts(tiny_disk / "a.mcap")) == 1 and not (tiny_disk / "b.mcap").exists()
    with pytest.warns(UserWarning, match="truncated"):
        assert read_rollouts(tiny_disk / "b.partial.mcap")[keys.MASK].sum() >= 80


def test_a_recorder_that_cannot_write_on_stops_the_env_with_one_error_and_keeps_what_is_complete(tmp_path):
    env = recorded(NoiseEnv(4), tmp_path / "a.mcap")
    shown = env.reset()
    steps = []
    with files_of_at_most(400_000), pytest.raises(OSError, match="files may not become larger"):
        for _ in range(200):
            shown["action"] = torch.zeros(4, 7)
            step, shown = env.step_and_maybe_reset(shown)
            steps.append(step)
            env.transform.flush()
    with pytest.raises(OSError, match="files may not become larger"):
        env.close()
    assert not (tmp_path / "a.mcap").exists()
    with pytest.warns(UserWarning, match="truncated"):
        read = read_rollouts(tmp_path / "a.partial.mcap")
    lengths = read[keys.MASK].sum(-1)
    assert int(lengths.min()) >= len(steps) - 2
    for place, step in enumerate(steps[: int(lengths.min())]):
        assert torch.equal(read[:, place]["next", *keys.IMAGE], step["next", *keys.IMAGE])


def test_recording_to_a_name_that_is_taken_is_refused_at_once(tmp_path):
    record(tmp_path / "a.mcap", make_rollouts(1))
    with pytest.raises(FileExistsError, match="overwrite=True"):
        recorded(NoiseEnv(2), tmp_path / "a.mcap")
    with pytest.raises(ValueError, match=r"must end in \.mcap"):
        recorded(NoiseEnv(2), tmp_path / "a.bag")
    (tmp_path / "b.partial.mcap").write_bytes(b"half of a recording")
    with pytest.raises(FileExistsError, match=r"unfinished recording is in .*recipes/repair\.py"):
        recorded(NoiseEnv(2), tmp_path / "b.mcap")
    with RolloutWriter(tmp_path / "c.mcap"), pytest.raises(FileExistsError, match="by another writer"):
        recorded(NoiseEnv(2), tmp_path / "c.mcap", overwrite=True)
    env = recorded(NoiseEnv(2), tmp_path / "a.mcap", overwrite=True)
    env.rollout(3)
    env.close()
    assert read_rollouts(tmp_path / "a.mcap").shape == (2, 3)


def test_a_recorder_whose_name_is_taken_meanwhile_says_so_when_it_is_closed(tmp_path):
    env = recorded(NoiseEnv(2), tmp_path / "a.mcap")
    env.rollout(3)
    (tmp_path / "a.mcap").write_bytes(b"precious")
    failed = []

    def close() -> None:
        with pytest.raises(FileExistsError) as caught:
            env.close()
        failed.append(str(caught.value))

    thread = threading.Thread(target=close, daemon=True)  # it once waited for ever
    thread.start()
    thread.join(timeout=30)
    assert "overwrite=True" in failed[0]
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"
    assert read_rollouts(tmp_path / "a.partial.mcap").shape == (2, 3)


def test_a_disk_that_fills_up_while_writing_leaves_what_is_complete(tmp_path, monkeypatch):
    rollouts = make_rollouts(4, 40, 64)
    record(tmp_path / "a.mcap", rollouts[:1])
    writer = RolloutWriter(tmp_path / "a.mcap", overwrite=True)
    writer.write(rollouts[:2])
    real, left = writer._file._writer._stream.write, 100_000

    class Full:
        def write(self, data):
            nonlocal left
            if len(data) > left:
                real(data[:left])
                raise OSError(errno.ENOSPC, "No space left on device")
            left -= len(data)
            return real(data)

        def __getattr__(self, name):
            return getattr(writer._file._file, name)

    writer._file._writer._stream = Full()
    with pytest.raises(OSError, match=r"a\.mcap could not be written: the disk is full.*a\.partial\.mcap"):
        writer.write(rollouts[2:])
    with pytest.raises(ValueError, match="closed"):
        writer.write(rollouts[2:])
    writer.close()
    assert len(read_rollouts(tmp_path / "a.mcap")) == 1  # the good file is untouched
    with pytest.warns(UserWarning, match="truncated"):
        read = read_rollouts(tmp_path / "a.partial.mcap")
    assert assert_prefix(read, rollouts) >= 80


def test_two_writers_on_one_path_are_refused(tmp_path):
    with RolloutWriter(tmp_path / "a.mcap") as writer:
        for overwrite in (False, True):
            with pytest.raises(FileExistsError, match=r"a\.mcap is being written by another writer"):
                RolloutWriter(tmp_path / "a.mcap", overwrite=overwrite)
        writer.write(make_rollouts(2))
    assert len(read_rollouts(tmp_path / "a.mcap")) == 2


def test_an_unfinished_recording_is_not_overwritten_by_accident(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), RolloutWriter(tmp_path / "a.mcap") as writer:
        writer.write(make_rollouts(2))
        raise RuntimeError("stop")
    with pytest.raises(FileExistsError, match=r"unfinished recording is in .*recipes/repair\.py"):
        RolloutWriter(tmp_path / "a.mcap")
    assert len(read_rollouts(tmp_path / "a.partial.mcap")) == 2
    RolloutWriter(tmp_path / "a.mcap", overwrite=True).close()


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    writer = RolloutWriter(tmp_path / "a.mcap")
    writer.write(make_rollouts(2))
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        writer.close()
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"
    assert len(read_rollouts(tmp_path / "a.partial.mcap")) == 2


def test_a_file_is_replaced_only_when_asked(tmp_path):
    record(tmp_path / "a.mcap", make_rollouts(1))
    with pytest.raises(FileExistsError, match="overwrite=True"):
        RolloutWriter(tmp_path / "a.mcap")
    with RolloutWriter(tmp_path / "a.mcap", overwrite=True) as writer:
        writer.write(make_rollouts(2))
        assert len(read_rollouts(tmp_path / "a.mcap")) == 1  # the old file stays until the new one is complete
    assert len(read_rollouts(tmp_path / "a.mcap")) == 2


def test_an_exception_leaves_the_partial_file_and_no_final_one(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), RolloutWriter(tmp_path / "a.mcap") as writer:
        writer.write(make_rollouts(2))
        raise RuntimeError("stop")
    assert not (tmp_path / "a.mcap").exists()
    assert len(read_rollouts(tmp_path / "a.partial.mcap")) == 2


def test_a_full_disk_is_noticed_before_writing(tmp_path, monkeypatch):
    writer = RolloutWriter(tmp_path / "a.mcap")
    usage = type("Usage", (), {"free": 100_000})
    monkeypatch.setattr(file.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(OSError, match=r"MiB free: make room"):
        writer.write(make_rollouts(8))
    writer.write(make_rollouts(1, 1, 16))
    writer.close()
    assert len(read_rollouts(tmp_path / "a.mcap")) == 1
