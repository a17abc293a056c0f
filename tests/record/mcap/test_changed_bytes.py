"""Whatever byte of a recording is changed, at most one chunk is lost, and it is said."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import torch
from mcap.reader import make_reader
from recordings import NoiseEnv, make_rollouts
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.record import (
    RolloutWriter,
    list_rollouts,
    read_attachments,
    read_metadata,
    read_rollouts,
    recorded,
    repair,
)
from worldenv_trl.record.mcap.file import McapFile
from worldenv_trl.record.mcap.scan import McapScan
from worldenv_trl.record.view.shown import shown_rollouts

ENTRIES = (keys.IMAGE, keys.ACTION, ("next", *keys.IMAGE), ("next", "reward"))


def written(path: Path) -> TensorDict:
    rollouts = make_rollouts(6, 5, 16)
    with RolloutWriter(path, metadata={"seed": 1}, attachments={"note": "hello " * 30}) as writer:
        for part in rollouts.split(3):
            writer.write(part)
    return rollouts


def streamed(path: Path) -> TensorDict:
    env = recorded(NoiseEnv(6), path, metadata={"seed": 1}, attachments={"note": "hello " * 30})
    rollouts = env.rollout(5, break_when_any_done=False)
    env.close()
    return rollouts


def changed(data: bytes, place: int, path: Path) -> None:
    damaged = bytearray(data)
    damaged[place] ^= 1 << place % 8
    path.write_bytes(damaged)


def read_quietly(path: Path) -> tuple[dict[int, TensorDict], list[str]]:
    """Complete rollouts by number, and what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        infos, rollouts = list_rollouts(path), read_rollouts(path)
    by_number = {
        info.number: rollout
        for info, rollout in zip(
            (i for i in infos if i.length), (r for r in rollouts if r[keys.MASK].any()), strict=True
        )
    }
    return by_number, [str(warning.message) for warning in caught]


@pytest.mark.parametrize("make", [written, streamed])
def test_any_changed_byte_costs_at_most_one_rollout(tmp_path, make):
    path = tmp_path / "a.mcap"
    rollouts = make(path)
    data = path.read_bytes()
    chunks = McapScan(path).chunks
    outside = [p for p in range(chunks[0].position) if p % 7 == 0] + list(range(chunks[-1].data.stop, len(data), 41))
    for place in outside + list(range(chunks[0].position, chunks[-1].data.stop, 1499)):
        changed(data, place, path)
        read, said = read_quietly(path)
        assert len(read) >= 5, place
        assert len(read) == 6 or any("rollout" in line for line in said), place
        for number, rollout in read.items():
            assert all(torch.equal(rollout[key], rollouts[number][key]) for key in ENTRIES), (place, number)
        assert read_metadata(path) == {"seed": 1}, place
        notes = read_attachments(path)
        assert notes == {"note": b"hello " * 30} or (not notes and "damaged attachment 'note'" in said[0]), place


def test_without_an_index_a_damaged_record_is_passed_over(tmp_path):
    path = tmp_path / "a.mcap"
    rollouts = written(path)
    data = path.read_bytes()
    third = McapScan(path).chunks[2]
    data = data[: McapScan(path).chunks[-1].data.stop]  # as a writer leaves it that was killed
    for place in (0, 3, 9, 20, third.position, third.position + 1, third.position + 5, third.position + 40):
        changed(data, place, path)
        read, said = read_quietly(path)
        assert set(read) >= {0, 1, 3, 4}, place
        assert any("damaged" in line or "truncated" in line for line in said), place
        for number, rollout in read.items():
            assert torch.equal(rollout[keys.IMAGE], rollouts[number][keys.IMAGE]), (place, number)


@pytest.mark.parametrize("place", [0, 8, 9, 30, 40])
def test_a_file_that_others_cannot_open_is_read_and_repaired(tmp_path, place):
    path = tmp_path / "a.mcap"
    rollouts = written(path)
    data = bytearray(path.read_bytes())
    data[place : place + 9] = b"\xff" * 9
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=r"damaged.*: 30 complete steps were read, all that it announces"):
        read = read_rollouts(path)
    assert all(torch.equal(read[key], rollouts[key]) for key in ENTRIES)
    target = repair(path).target
    with open(target, "rb") as file:
        assert make_reader(file).get_summary().statistics.attachment_count == 2
    read, said = read_quietly(target)
    assert len(read) == 6 and not said
    assert read_metadata(target) == {"seed": 1} and read_attachments(target) == {"note": b"hello " * 30}


def test_bytes_that_hide_where_a_chunk_ends_lose_nothing_while_there_is_an_index(tmp_path):
    path = tmp_path / "a.mcap"
    rollouts = written(path)
    chunk = McapScan(path).chunks[2]
    data = bytearray(path.read_bytes())
    data[chunk.position : chunk.position + 9] = b"\xff" * 9
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=r"is damaged at byte \d+, where other programs may stop: 30 complete"):
        assert torch.equal(read_rollouts(path)[keys.IMAGE], rollouts[keys.IMAGE])


def test_what_follows_the_end_and_a_damaged_index_are_not_called_truncation(tmp_path):
    path = tmp_path / "a.mcap"
    rollouts = written(path)
    data = path.read_bytes()
    for damaged, said in (
        (data + b"junk", "has 4 bytes behind its end: 30 complete steps were read, all that it announces"),
        (data[:-60] + b"?" * 10 + data[-50:], "has a damaged index: 30 complete steps were read, all that it"),
        (data[:-60], "is truncated: 30 complete steps were read, all that it announces"),
    ):
        path.write_bytes(damaged)
        with pytest.warns(UserWarning, match=said):
            assert torch.equal(read_rollouts(path)[keys.IMAGE], rollouts[keys.IMAGE])


def test_metadata_that_was_changed_comes_from_its_copy(tmp_path):
    path = tmp_path / "a.mcap"
    written(path)
    data = path.read_bytes()
    assert data.count(b'"seed"') <= 1
    path.write_bytes(
        data.replace(b"\x04\x00\x00\x00seed\x01\x00\x00\x001", b"\x04\x00\x00\x00seed\x01\x00\x00\x002", 1)
    )
    assert path.read_bytes() != data
    assert read_metadata(path) == {"seed": 1}
    with pytest.warns(UserWarning, match=r"has damaged metadata \(their copy was read\)"):
        read_rollouts(path)


def test_a_rollout_keeps_its_number_when_one_before_it_is_lost(tmp_path):
    path = tmp_path / "a.mcap"
    rollouts = streamed(path)
    chunk = McapScan(path).chunks[2]
    changed(path.read_bytes(), chunk.data.start + 60, path)
    with pytest.warns(UserWarning, match="25 complete steps were read, at least 5 more of rollout 2 are missing"):
        read_rollouts(path)
    for number in (0, 1, 3, 4, 5):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read = read_rollouts(path, rollouts=number)
        assert torch.equal(read[0]["next", *keys.IMAGE], rollouts[number]["next", *keys.IMAGE])
    with pytest.raises(ValueError, match=r"holds no rollouts that were asked for: .* is damaged behind byte"):
        read_rollouts(path, rollouts=2)
    target = repair(path).target
    assert [shown.number for shown in shown_rollouts(target)] == [0, 1, 3, 4, 5]
    assert [shown.number for shown in shown_rollouts(target, slice(3))] == [0, 1, 3]


def test_a_recorder_s_file_that_was_filtered_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    streamed(path)
    scan = McapScan(path)
    for number, dropped in enumerate((lambda n, t: n == 1, lambda n, t: n == 3 and t == "/step")):
        file, kept = McapFile(tmp_path / f"filtered_{number}.mcap"), 0
        for record in scan.metadata:
            file.write_metadata(record.name, record.metadata)
        for chunk in scan.chunks:
            for place, (channel, rollout, time, data) in enumerate(scan.messages(chunk)):
                topic = scan.channels[channel].topic
                if dropped(rollout, topic) and place % 2:
                    continue
                schema = scan.schemas[scan.channels[channel].schema_id]
                file.add(file.channel(topic, schema.name, schema.data), time, bytes(data), rollout)
                kept += 1
        file.close()
        assert kept
        with pytest.raises(ValueError, match=r"of 30 steps were found\. It was filtered or edited; read the original"):
            read_rollouts(tmp_path / f"filtered_{number}.mcap")


def test_a_repair_never_writes_over_the_damaged_file(tmp_path):
    path = tmp_path / "a.mcap"
    written(path)
    partial = tmp_path / "b.partial.mcap"
    partial.write_bytes(path.read_bytes()[:-500])
    before = partial.read_bytes()
    for overwrite in (False, True):
        with pytest.raises(ValueError, match=r"b\.mcap is written it has the name of the damaged file"):
            repair(partial, tmp_path / "b.mcap", overwrite=overwrite)
    assert partial.read_bytes() == before and not (tmp_path / "b.mcap").exists()
    assert repair(partial).target.name == "b.repaired.mcap"
