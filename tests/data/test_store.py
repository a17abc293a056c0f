"""Recordings read once into memory-mapped frames, and what may happen to these."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from pathlib import Path

import pytest
import torch
from small_rollouts import decision_rollouts, same, step_rollouts
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.data import Episodes, episodes_from_rollouts, fill_store, open_store, store
from worldenv_trl.record import RolloutWriter, read_rollouts

LENGTHS = [3, 5, 1, 4, 2]


def record(path: Path, *rollouts) -> Path:
    with RolloutWriter(path) as writer:
        for part in rollouts:
            writer.write(part)
    return path


@pytest.fixture
def steps(tmp_path) -> Path:
    return record(tmp_path / "demonstrations.mcap", step_rollouts(LENGTHS, steps=5))


@pytest.fixture
def decisions(tmp_path) -> Path:
    return record(tmp_path / "explore.mcap", decision_rollouts([[3, 2, 0], [3, 3, 3], [1, 0, 0]], success=True))


def read(path: Path) -> Episodes:
    """Straight from the recording."""
    return episodes_from_rollouts(read_rollouts(path))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ------------------------------------------------------------------------------------------------- what is there


def test_a_store_holds_what_each_recording_holds_bit_for_bit(tmp_path, steps, decisions):
    parts = fill_store(tmp_path / "store", [steps, decisions])
    for part, path in zip(parts, (steps, decisions), strict=True):
        assert same(Episodes.cat([part]), padded(read(path), part))


def padded(episodes: Episodes, like: Episodes) -> Episodes:
    """``episodes`` with as many steps as ``like``: a store pads all to the longest of all its recordings."""
    return Episodes.cat([episodes, like[:1]])[: len(episodes)]


def test_a_store_that_is_opened_is_the_one_that_was_filled(tmp_path, steps, decisions):
    filled = fill_store(tmp_path / "store", [steps, decisions])
    opened = open_store(tmp_path / "store", [steps, decisions])
    assert [len(part) for part in opened] == [5, 3]
    assert all(same(*pair) for pair in zip(filled, opened, strict=True))


def test_goals_tasks_and_contexts_are_kept(tmp_path, steps):
    (part,) = fill_store(tmp_path / "store", [steps])
    assert part.instructions == [f"goal {row}" for row in range(5)]
    assert part[keys.TASK_ID].flatten().tolist() == [0, 1, 2, 3, 4]
    assert part[keys.CONTEXT_ID].flatten().tolist() == [100, 101, 102, 103, 104]


@pytest.mark.parametrize("at_once", [1, 2, 4])
def test_how_many_rollouts_are_read_at_once_changes_nothing(tmp_path, steps, decisions, at_once, monkeypatch):
    whole = fill_store(tmp_path / "whole", [steps, decisions])
    monkeypatch.setattr(store, "_AT_ONCE", at_once)
    parts = fill_store(tmp_path / "parts", [steps, decisions])
    assert all(same(*pair) for pair in zip(whole, parts, strict=True))


def test_several_writes_of_different_lengths_are_one_recording(tmp_path):
    path = record(tmp_path / "a.mcap", step_rollouts([3, 5], steps=5), step_rollouts([9, 2, 4], steps=9, seed=1))
    (part,) = fill_store(tmp_path / "store", [path])
    assert same(part, read(path)) and part["length"].flatten().tolist() == [3, 5, 9, 2, 4]


@pytest.mark.filterwarnings("ignore:.*truncated")
def test_what_a_damaged_recording_has_lost_is_not_taken_from_the_next(tmp_path):
    cut = record(tmp_path / "cut.mcap", *[step_rollouts(LENGTHS, steps=5) for _ in range(4)])
    whole = record(tmp_path / "whole.mcap", step_rollouts(LENGTHS, steps=5))
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 3 // 10])
    first, second = fill_store(tmp_path / "store", [cut, whole])
    assert 0 < len(read(cut)) < 10 and same(first, read(cut)) and same(second, read(whole))


def test_all_recordings_share_one_set_of_frames_on_disk(tmp_path, steps, decisions):
    parts = fill_store(tmp_path / "store", [steps, decisions])
    together = Episodes.cat(parts)
    assert together.video[0] is parts[0].video[0]
    for value in together.video[0].values(True, True):
        assert Path(value.untyped_storage().filename).is_relative_to(tmp_path / "store" / "frames")


def test_small_entries_are_in_memory(tmp_path, steps):
    (part,) = fill_store(tmp_path / "store", [steps])
    assert not any(value.untyped_storage().filename for value in part.entries.values(True, True))


def test_a_store_that_is_filled_again_is_replaced(tmp_path, steps, decisions):
    fill_store(tmp_path / "store", [steps])
    fill_store(tmp_path / "store", [decisions])
    (part,) = open_store(tmp_path / "store", [decisions])
    assert len(part) == 3 and not (tmp_path / "store.partial").exists()


def test_recordings_are_only_read(tmp_path, steps, decisions):
    before = steps.read_bytes(), decisions.read_bytes()
    fill_store(tmp_path / "store", [steps, decisions])
    assert (steps.read_bytes(), decisions.read_bytes()) == before


def test_memory_that_is_given_back_changes_no_value(tmp_path, steps):
    (part,) = fill_store(tmp_path / "store", [steps])
    row, step = torch.arange(5).unsqueeze(-1), torch.arange(6)
    before = part.frames("wrist", row, step)
    store.release(part.video[0])
    assert torch.equal(part.frames("wrist", row, step), before)


def test_tensors_in_memory_are_not_given_back(steps):
    frames = read(steps).video[0]
    before = frames.clone()
    store.release(frames)
    assert (frames == before).all()


# -------------------------------------------------------------------------------------------------- what may happen


def refused(folder: Path, recordings: list[Path]) -> str:
    """The one line that opening says; the recordings are as before, and filling makes the store anew."""
    before = [path.read_bytes() for path in recordings]
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        open_store(folder, recordings)
    assert "fill_store makes it anew from the recordings" in str(caught.value) and "\n" not in str(caught.value)
    assert [path.read_bytes() for path in recordings] == before
    parts = fill_store(folder, recordings)
    assert all(same(part, padded(read(path), part)) for part, path in zip(parts, recordings, strict=True))
    return str(caught.value)


def test_where_there_is_no_store_it_says_so(tmp_path, steps):
    assert f"no episode store at {tmp_path / 'store'}" in refused(tmp_path / "store", [steps])


def test_a_store_of_other_recordings_is_refused(tmp_path, steps, decisions):
    fill_store(tmp_path / "store", [steps])
    message = refused(tmp_path / "store", [steps, decisions])
    assert "belongs to other recordings, demonstrations.mcap, not demonstrations.mcap, explore.mcap" in message


def test_recordings_in_another_order_are_others(tmp_path, steps, decisions):
    fill_store(tmp_path / "store", [steps, decisions])
    assert "belongs to other recordings" in refused(tmp_path / "store", [decisions, steps])


def test_a_recording_that_changed_since_is_noticed(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    steps.unlink()
    record(steps, step_rollouts(LENGTHS, steps=5, seed=1))
    assert "demonstrations.mcap as they were before they changed" in refused(tmp_path / "store", [steps])


def test_a_recording_that_moved_is_still_the_same(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    (tmp_path / "elsewhere").mkdir()
    moved = shutil.move(steps, tmp_path / "elsewhere")
    assert len(open_store(tmp_path / "store", [moved])[0]) == 5


def test_a_recording_that_is_gone_is_named(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    steps.unlink()
    with pytest.raises(FileNotFoundError, match=r"demonstrations\.mcap"):
        open_store(tmp_path / "store", [steps])


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("part", ["frames", "entries"])
def test_a_file_that_was_cut_short_is_noticed(tmp_path, steps, part, share):
    fill_store(tmp_path / "store", [steps])
    file = max((tmp_path / "store" / part).rglob("*.memmap"), key=lambda path: path.stat().st_size)
    with file.open("r+b") as opened:
        opened.truncate(int(share * file.stat().st_size))
    assert "is cut short" in refused(tmp_path / "store", [steps])


def test_a_file_that_is_gone_is_noticed(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    next((tmp_path / "store" / "frames").rglob("*.memmap")).unlink()
    assert "is cut short" in refused(tmp_path / "store", [steps])


def test_a_manifest_that_was_cut_short_is_noticed(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    manifest = tmp_path / "store" / "episodes.json"
    manifest.write_bytes(manifest.read_bytes()[:-20])
    assert "is cut short" in refused(tmp_path / "store", [steps])


@pytest.mark.parametrize("content", ["[]", "{}", "null", '{"format": 1}', "\udcff"])
def test_a_manifest_that_is_something_else_is_noticed(tmp_path, steps, content):
    fill_store(tmp_path / "store", [steps])
    (tmp_path / "store" / "episodes.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    assert "is cut short" in refused(tmp_path / "store", [steps])


def test_a_store_of_another_format_is_named(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    manifest = tmp_path / "store" / "episodes.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"format": 7}))
    assert "has format 7, not 1" in refused(tmp_path / "store", [steps])


def test_a_store_that_was_not_finished_is_none(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    (tmp_path / "store" / "episodes.json").unlink()
    assert "no episode store" in refused(tmp_path / "store", [steps])


def test_a_crash_while_filling_leaves_the_old_store(tmp_path, steps, decisions, monkeypatch):
    fill_store(tmp_path / "store", [steps])
    before = contents(tmp_path / "store")

    def crash(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(store, "concatenated", crash)
        fill_store(tmp_path / "store", [steps, decisions])
    assert contents(tmp_path / "store") == before and same(open_store(tmp_path / "store", [steps])[0], read(steps))
    assert "belongs to other recordings" in refused(tmp_path / "store", [steps, decisions])
    assert not (tmp_path / "store.partial").exists()


def test_a_full_disk_is_noticed_before_frames_are_written(tmp_path, steps, monkeypatch):
    fill_store(tmp_path / "store", [steps])
    before = contents(tmp_path / "store")
    usage = namedtuple("usage", "total used free")
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "disk_usage", lambda _: usage(10, 0, 10))
        with pytest.raises(OSError, match=r"the frames of the episodes take .* GB, .* has .* GB free"):
            fill_store(tmp_path / "store", [steps])
    assert contents(tmp_path / "store") == before
    assert same(fill_store(tmp_path / "store", [steps])[0], read(steps))


def test_recordings_of_other_cameras_or_sizes_are_refused(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    for name, other in (
        ("small.mcap", step_rollouts(LENGTHS, steps=5, size=4)),
        ("one.mcap", step_rollouts(LENGTHS, steps=5, cameras=["agentview"])),
    ):
        with pytest.raises(ValueError, match="frames of different cameras or sizes"):
            fill_store(tmp_path / "store", [steps, record(tmp_path / name, other)])
    assert same(open_store(tmp_path / "store", [steps])[0], read(steps))


def test_recordings_with_and_without_labels_are_refused(tmp_path, steps):
    unlabelled = record(tmp_path / "imagined.mcap", decision_rollouts([[3, 2]]))
    with pytest.raises(ValueError, match="success labels"):
        fill_store(tmp_path / "store", [steps, unlabelled])


@pytest.mark.parametrize("on_disk", [True, False])
def test_more_frames_than_there_is_room_for_are_refused_and_the_first_stay(tmp_path, on_disk):
    sink = store.FrameSink(3, tmp_path / "frames" if on_disk else None)
    frames = TensorDict({keys.frames_key("agentview"): torch.full((2, 3, 8, 8), 7, dtype=torch.uint8)}, [2])
    sink.add(frames)
    with pytest.raises(ValueError, match="room for 3 frames, 2 are there: 2 do not fit"):
        sink.add(frames + 1)
    assert len(sink.frames) == 2 and bool((sink.frames[keys.frames_key("agentview")] == 7).all())


def test_no_recordings_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no rollouts in no recordings"):
        fill_store(tmp_path / "store", [])


def test_a_recording_that_is_not_there_is_named_and_the_old_store_stays(tmp_path, steps):
    fill_store(tmp_path / "store", [steps])
    with pytest.raises(FileNotFoundError, match=r"nowhere\.mcap"):
        fill_store(tmp_path / "store", [steps, tmp_path / "nowhere.mcap"])
    assert same(open_store(tmp_path / "store", [steps])[0], read(steps))


def test_one_recording_named_twice_is_refused(tmp_path, steps):
    with pytest.raises(ValueError, match="each once"):
        fill_store(tmp_path / "store", [steps, steps])
