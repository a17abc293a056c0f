from __future__ import annotations

import re
import warnings

import pytest
import torch
from mcap.reader import make_reader
from recordings import NoiseEnv, make_rollouts, record
from tensordict import NonTensorData, TensorDict

from worldenv_trl import keys
from worldenv_trl.record import (
    RolloutWriter,
    read_attachments,
    read_metadata,
    read_rollouts,
    recorded,
    repair,
)
from worldenv_trl.record.mcap.file import McapFile
from worldenv_trl.record.mcap.scan import McapScan


def assert_prefix(read: TensorDict, rollouts: TensorDict) -> int:
    """What was read are leading steps of the leading rollouts; returns how many."""
    mask = read[keys.MASK]
    flat = mask.flatten()
    done = int(flat.sum())
    assert flat[:done].all()
    want = rollouts[: len(read)]
    for key in (keys.IMAGE, keys.ACTION, ("next", *keys.IMAGE), ("next", "reward")):
        assert torch.equal(read[key][mask], want[key][mask])
        assert not read[key][~mask].any()
    return done


def test_a_file_cut_anywhere_gives_its_complete_steps(tmp_path):
    rollouts = make_rollouts(8, 20, 64)
    record(tmp_path / "whole.mcap", rollouts)
    data = (tmp_path / "whole.mcap").read_bytes()
    found = []
    for share in (0.3, 0.5, 0.7, 0.9):
        cut = tmp_path / f"cut_{share}.mcap"
        cut.write_bytes(data[: int(share * len(data))])
        with pytest.warns(UserWarning, match=r"truncated: \d+ complete steps"):
            found.append(assert_prefix(read_rollouts(cut), rollouts))
    # A cut loses what the compressor had not finished: at most 128 KiB, ten frames.
    assert all(count > share * 160 - 12 for count, share in zip(found, (0.3, 0.5, 0.7, 0.9), strict=True)), found
    only_summary_lost = tmp_path / "tail.mcap"
    only_summary_lost.write_bytes(data[:-20])
    with pytest.warns(UserWarning, match="160 complete steps were read, all that it announces"):
        assert assert_prefix(read_rollouts(only_summary_lost), rollouts) == 160


def test_a_file_cut_at_any_byte_is_read_with_a_warning_or_refused_clearly(tmp_path):
    record(tmp_path / "whole.mcap", make_rollouts(2, 3, 16))
    data = (tmp_path / "whole.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    read = 0
    for end in range(0, len(data), max(len(data) // 150, 1)):
        path.write_bytes(data[:end])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                read_rollouts(path)
            except ValueError as error:
                assert re.search("not an MCAP|holds no", str(error)), end
                continue
        assert any("truncated" in str(warning.message) for warning in caught), end
        read += 1
    assert read > 10


def test_groups_of_a_truncated_file_keep_their_shape(tmp_path):
    rollouts = make_rollouts(6, 20, 64)
    record(tmp_path / "whole.mcap", rollouts.reshape(3, 2, 20))
    data = (tmp_path / "whole.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    for share, groups in ((0.25, 1), (0.45, 2), (0.6, 2), (0.8, 3)):
        cut.write_bytes(data[: int(share * len(data))])
        with pytest.warns(UserWarning, match="truncated"):
            read = read_rollouts(cut)
        assert read.shape == (groups, 2, 20)
        assert_prefix(read.reshape(-1, 20), rollouts)


def test_changed_bytes_in_a_short_file_lose_one_rollout_and_nothing_else(tmp_path):
    rollouts = make_rollouts(20)
    record(tmp_path / "a.mcap", rollouts)
    assert (tmp_path / "a.mcap").stat().st_size < 1e6
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 0x40
    (tmp_path / "a.mcap").write_bytes(data)
    said = r"is damaged behind byte .*: 190 complete steps were read, at least 10 more of rollout 10 are missing"
    with pytest.warns(UserWarning, match=said):
        read = read_rollouts(tmp_path / "a.mcap")
    others = torch.arange(20) != 10
    assert read[keys.MASK].sum(-1).tolist() == [0 if row == 10 else 10 for row in range(20)]
    for key in (keys.IMAGE, keys.ACTION, ("next", *keys.IMAGE), ("next", "reward")):
        assert torch.equal(read[others][key], rollouts[others][key])
    done = repair(tmp_path / "a.mcap")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = read_rollouts(done.target)
    for key in (keys.IMAGE, keys.ACTION, keys.MASK):
        assert torch.equal(again[key], read[key])


def test_changed_bytes_of_a_recorder_cost_few_of_the_rows_that_run_side_by_side(tmp_path):
    env = recorded(NoiseEnv(16), tmp_path / "a.mcap")
    rollouts = env.rollout(12, break_when_any_done=False)
    env.close()
    chunks = McapScan(tmp_path / "a.mcap").chunks
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[chunks[3].data.start + 50] ^= 0x40
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.warns(UserWarning, match=r"168 complete .*, at least 24 more of rollouts 6 to 7 are missing"):
        read = read_rollouts(tmp_path / "a.mcap")
    kept = read[keys.ROW][:, 0, 0]
    assert kept.tolist() == [row for row in range(16) if row not in (6, 7)]
    assert torch.equal(read["next", *keys.IMAGE], rollouts[kept]["next", *keys.IMAGE])


def test_a_file_of_which_nothing_is_left_is_not_repaired(tmp_path):
    record(tmp_path / "a.mcap", make_rollouts(3))
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    for chunk in McapScan(tmp_path / "a.mcap").chunks:
        data[chunk.data.start + 50] ^= 0x40
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.mcap holds no complete .*nothing to save"):
        repair(tmp_path / "a.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_file_whose_only_chunk_is_damaged_is_refused(tmp_path):
    record(tmp_path / "a.mcap", make_rollouts(1))
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 0x40
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(ValueError, match=r"holds no rollouts: .*damaged behind byte"):
        read_rollouts(tmp_path / "a.mcap")


def test_repair_keeps_every_complete_message_and_the_damaged_file(tmp_path):
    rollouts = make_rollouts(8, 20, 64)
    with RolloutWriter(tmp_path / "whole.mcap", metadata={"seed": 1}, attachments={"note": "hello"}) as writer:
        writer.write(rollouts)
    with pytest.raises(ValueError, match="is whole"):
        repair(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    with pytest.warns(UserWarning, match="truncated"):
        before = read_rollouts(cut)
    done = repair(cut)
    assert done.target == tmp_path / "cut.repaired.mcap" and "truncated" in done.lost[0]
    assert cut.stat().st_size == len(data) // 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        after = read_rollouts(done.target)
    assert all(torch.equal(after[key], before[key]) for key in (keys.IMAGE, keys.ACTION, keys.MASK))
    assert read_metadata(done.target) == {"seed": 1} and read_attachments(done.target) == {"note": b"hello"}
    with open(done.target, "rb") as file:  # a whole file for others, too
        assert make_reader(file).get_summary().statistics.message_count == done.messages
    with pytest.raises(FileExistsError, match="overwrite=True"):
        repair(cut)
    with pytest.raises(ValueError, match="another name"):
        repair(cut, cut)
    (tmp_path / "empty.mcap").write_bytes(data[:400])
    with pytest.raises(ValueError, match=r"no complete step|written by another"):
        repair(tmp_path / "empty.mcap")


def test_a_missing_channel_is_named(tmp_path):
    record(tmp_path / "a.mcap", make_rollouts(2))
    for topic, said in (("/step", "0 of 20 steps"), ("/observation/image", "lacks images on /observation/image")):
        scan = McapScan(tmp_path / "a.mcap")
        messages = [message for chunk in scan.chunks for message in scan.messages(chunk)]
        file = McapFile(tmp_path / "b.mcap", overwrite=True)
        for each in scan.metadata:
            file.write_metadata(each.name, each.metadata)
        for number, sequence, time, data in messages:
            channel = scan.channels[number]
            if channel.topic != topic:
                schema = scan.schemas[channel.schema_id]
                file.add(file.channel(channel.topic, schema.name, schema.data), time, bytes(data), sequence)
        file.close()
        with pytest.raises(ValueError, match=said):
            read_rollouts(tmp_path / "b.mcap")


def test_a_later_format_is_refused(tmp_path):
    file = McapFile(tmp_path / "a.mcap")
    file.write_metadata("worldenv_trl.rollouts", {"version": "99"})
    file.close()
    with pytest.raises(ValueError, match=r"format version 99, this release reads up to \d: update"):
        read_rollouts(tmp_path / "a.mcap")


def test_other_files_are_refused(tmp_path):
    text = tmp_path / "notes.mcap"
    text.write_text("these are notes, not a recording")
    with pytest.raises(ValueError, match="is not an MCAP file"):
        read_rollouts(text)
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(ValueError, match="is not an MCAP file"):
        read_rollouts(tmp_path / "empty.mcap")
    import foxglove

    with foxglove.open_mcap(tmp_path / "foreign.mcap", context=foxglove.Context()):
        pass
    for read in (read_rollouts, read_metadata, read_attachments):
        with pytest.raises(ValueError, match="written by another program"):
            read(tmp_path / "foreign.mcap")


def test_missing_files_and_empty_folders_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*gone\.mcap"):
        read_rollouts(tmp_path / "gone.mcap")
    with pytest.raises(FileNotFoundError, match=r"no \.mcap file in the folder"):
        read_rollouts(tmp_path)
    with pytest.raises(FileNotFoundError, match="no file matches"):
        read_rollouts(str(tmp_path / "*.mcap"))


def test_a_recording_without_rollouts_is_refused(tmp_path):
    record(tmp_path / "a.mcap")
    with pytest.raises(ValueError, match="holds no rollouts"):
        read_rollouts(tmp_path / "a.mcap")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda td: td.set("thing", NonTensorData(object(), batch_size=td.batch_size)),
            "must hold one text",
        ),
        (lambda td: td.set(keys.MASK, torch.tensor([[True, False] * 5] * 4)), "has holes"),
        (lambda td: td[:, :0], "at least one entry"),
    ],
)
def test_rollouts_that_cannot_be_recorded_are_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        record(tmp_path / "a.mcap", change(make_rollouts()))


def test_text_that_changes_within_a_rollout_is_refused(tmp_path):
    rollouts = make_rollouts(1, 2)
    rollouts[keys.INSTRUCTION] = (
        torch.stack([TensorDict({"x": NonTensorData(word)}) for word in ("one", "two")]).get("x").unsqueeze(0)
    )
    with pytest.raises(ValueError, match="constant within a rollout"):
        record(tmp_path / "a.mcap", rollouts)


def test_other_suffixes_are_refused(tmp_path):
    for name in ("a.bag", "a.partial.mcap"):
        with pytest.raises(ValueError, match=r"must end in \.mcap"):
            RolloutWriter(tmp_path / name)
