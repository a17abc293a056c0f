from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

import convert
import repair
from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter, read_rollouts


def make_rollouts() -> TensorDict:
    image = torch.randint(0, 256, (3, 6, 3, 16, 16), dtype=torch.uint8)
    observed = [{"observation": {"image": image[:, part]}} for part in (slice(0, -1), slice(1, None))]
    td = TensorDict({**observed[0], keys.ACTION: torch.randn(3, 5, 7), "next": observed[1]}, [3, 5])
    return td.set(keys.INSTRUCTION, "do it").set(("next", keys.INSTRUCTION), "do it")


def test_recordings_go_to_lerobot_and_back(tmp_path, capsys):
    pytest.importorskip("pyarrow")
    with RolloutWriter(tmp_path / "a.mcap") as writer:
        writer.write(make_rollouts())
    assert convert.main(convert.Options(tmp_path / "a.mcap", tmp_path / "set")) == 0
    assert convert.main(convert.Options(tmp_path / "set", tmp_path / "b.mcap")) == 0
    assert "3 rollouts" in capsys.readouterr().out
    first, second = read_rollouts(tmp_path / "a.mcap"), read_rollouts(tmp_path / "b.mcap")
    assert set(first.keys(True, True)) == set(second.keys(True, True))
    for key in (keys.IMAGE, ("next", *keys.IMAGE), keys.ACTION, keys.MASK):
        assert torch.equal(first[key], second[key])
    assert convert.main(convert.Options(tmp_path / "a.mcap", tmp_path / "set")) == 1
    assert "pass --overwrite" in capsys.readouterr().err


def test_repair_says_what_it_saved_and_what_it_could_not(tmp_path, capsys):
    with RolloutWriter(tmp_path / "a.mcap") as writer:
        for _ in range(3):
            writer.write(make_rollouts())
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.mcap").write_text("no recording")
    options = repair.Options((tmp_path / "cut.mcap", tmp_path / "text.mcap"))
    assert repair.main(options) == 1
    said = capsys.readouterr()
    assert "cut.repaired.mcap" in said.out and "is truncated" in said.out
    assert "text.mcap is not an MCAP file" in said.err
    assert len(read_rollouts(tmp_path / "cut.repaired.mcap")) >= 3
