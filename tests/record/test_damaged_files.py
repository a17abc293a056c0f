from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import textwrap
import warnings

import pytest
import torch
from tensordict import NonTensorData, TensorDict

from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter, read_attachments, read_metadata, read_rollouts
from worldenv_trl.record import mcap_file as writer_module


def make_rollouts(rows: int = 4, steps: int = 10, size: int = 32) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (rows, steps + 1, 3, size, size), generator=generator, dtype=torch.uint8)
    return TensorDict(
        {
            "observation": {"image": image[:, :-1]},
            keys.ACTION: torch.randn(rows, steps, 7, generator=generator),
            keys.INSTRUCTION: NonTensorData("do it", batch_size=[rows, steps]),
            "next": {"observation": {"image": image[:, 1:]}, "reward": torch.ones(rows, steps, 1)},
        },
        batch_size=[rows, steps],
    )


def record(path, *rollouts: TensorDict) -> None:
    with RolloutWriter(path, metadata={"seed": 1}) as writer:
        for part in rollouts:
            writer.write(part)


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
    with pytest.warns(UserWarning, match="at least 0 more"):
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


def test_a_killed_process_leaves_what_it_wrote(tmp_path):
    script = textwrap.dedent(
        """
        import sys, time, torch
        from tensordict import TensorDict
        from worldenv_trl.record import RolloutWriter
        writer = RolloutWriter(sys.argv[1])
        for index in range(100):
            image = torch.randint(0, 256, (4, 16, 3, 64, 64), dtype=torch.uint8)
            writer.write(TensorDict({"observation": {"image": image}}, [4, 16]))
            print(index, flush=True)
        """
    )
    target = tmp_path / "a.mcap"
    process = subprocess.Popen([sys.executable, "-c", script, str(target)], stdout=subprocess.PIPE, text=True)
    for line in process.stdout:
        if int(line) == 5:
            os.kill(process.pid, signal.SIGKILL)
            break
    process.wait()
    assert not target.exists()
    with pytest.raises(FileNotFoundError, match=r"unfinished recording is in .*a\.partial\.mcap"):
        read_rollouts(target)
    with pytest.warns(UserWarning, match="truncated"):
        read = read_rollouts(tmp_path / "a.partial.mcap")
    assert int(read[keys.MASK].sum()) >= 5 * 64


def test_changed_bytes_are_noticed(tmp_path):
    record(tmp_path / "a.mcap", make_rollouts())
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 0x40
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.mcap is damaged behind byte"):
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
    monkeypatch.setattr(writer_module.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(OSError, match=r"MiB free: make room"):
        writer.write(make_rollouts(8))
    writer.write(make_rollouts(1, 1, 16))
    writer.close()
    assert len(read_rollouts(tmp_path / "a.mcap")) == 1


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
