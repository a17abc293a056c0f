from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict

from worldenv_trl import keys
from worldenv_trl.data import read_lerobot, write_lerobot

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")


def make_rollouts(lengths=(6, 3, 1), steps: int = 6, size: int = 16) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    rows = len(lengths)
    mask = torch.arange(steps) < torch.tensor(lengths).unsqueeze(-1)
    image = torch.randint(0, 256, (rows, steps + 1, 3, size, size), generator=generator, dtype=torch.uint8)
    state = torch.randn(rows, steps + 1, 7, generator=generator)
    done = torch.arange(1, steps + 1) >= torch.tensor(lengths).unsqueeze(-1)
    words = NonTensorStack(*(NonTensorData(f"task {row % 2}", batch_size=[steps]) for row in range(rows)))
    td = TensorDict(
        {
            "observation": {"image": image[:, :-1], "state": state[:, :-1]},
            keys.ACTION: torch.randn(rows, steps, 7, generator=generator),
            keys.LOC: torch.randn(rows, steps, 2, 7, generator=generator).to(torch.bfloat16),
            keys.SIM_STATE: torch.randn(rows, steps, 5, generator=generator, dtype=torch.float64),
            keys.INSTRUCTION: words,
            keys.MASK: mask,
            "next": {
                "observation": {"image": image[:, 1:], "state": state[:, 1:]},
                "reward": torch.randn(rows, steps, 1, generator=generator),
                "done": done.unsqueeze(-1),
            },
        },
        [rows, steps],
    )
    return td


def assert_same(read: TensorDict, written: TensorDict) -> None:
    mask = written[keys.MASK]
    assert set(read.keys(True, True)) == set(written.keys(True, True))
    for key in written.keys(True, True):
        if key != keys.INSTRUCTION:
            assert read[key].dtype == written[key].dtype and read[key].shape == written[key].shape, key
            assert torch.equal(read[key][mask], written[key][mask]), key
    assert read[:, 0].get(keys.INSTRUCTION).tolist() == written[:, 0].get(keys.INSTRUCTION).tolist()


@pytest.mark.parametrize("video", [False, True])
def test_rollouts_come_back_bit_for_bit(tmp_path, video):
    if video:
        pytest.importorskip("av")
    rollouts = make_rollouts()
    folder = write_lerobot(rollouts, tmp_path / "set", video=video)
    assert_same(read_lerobot(folder), rollouts)
    assert_same(read_lerobot(folder, episodes=[1]), rollouts[1:2, :3])
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_the_files_are_laid_out_as_lerobot_says(tmp_path):
    rollouts = make_rollouts()
    folder = write_lerobot(rollouts, tmp_path / "set")
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == ("v3.0", 3, 10)
    assert (info["total_tasks"], info["splits"], info["fps"]) == (2, {"train": "0:3"}, 20)
    assert info["features"]["observation.images.image"] == {
        "dtype": "image",
        "shape": [16, 16, 3],
        "names": ["height", "width", "channels"],
    }
    table = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(table.column_names) == set(info["features"])
    assert table.column("index").to_pylist() == list(range(10))
    assert table.column("episode_index").to_pylist() == [0] * 6 + [1] * 3 + [2]
    assert table.column("task_index").to_pylist() == [0] * 6 + [1] * 3 + [0]
    assert table.column("next.done").to_pylist() == [False] * 5 + [True] + [False] * 2 + [True, True]
    assert np.allclose(table.column("timestamp").to_pylist()[:3], [0, 0.05, 0.1])
    assert np.array_equal(table.column("action").to_pylist()[6], rollouts[keys.ACTION][1, 0].tolist())
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"], e["length"]) for e in episodes] == [
        (0, 6, 6), (6, 9, 3), (9, 10, 1),
    ]  # fmt: skip
    assert episodes[1]["tasks"] == ["task 1"]
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert tasks.to_pylist() == [{"task_index": 0, "task": "task 0"}, {"task_index": 1, "task": "task 1"}]
    stats = json.loads((folder / "meta/stats.json").read_text())
    actions = rollouts[keys.ACTION][rollouts[keys.MASK]].double()
    assert np.allclose(stats["action"]["mean"], actions.mean(0)) and stats["action"]["count"] == [10]
    assert np.allclose(stats["action"]["std"], actions.std(0, correction=0))
    pixels = rollouts[keys.IMAGE][rollouts[keys.MASK]].double() / 255
    assert np.allclose(np.array(stats["observation.images.image"]["mean"]).ravel(), pixels.mean((0, 2, 3)))


def test_a_dataset_of_another_program_is_read(tmp_path):
    folder = write_lerobot(make_rollouts(), tmp_path / "set")
    for name in ("worldenv_trl.json", "worldenv_trl_final.parquet"):
        (folder / "meta" / name).unlink()
    rollouts, read = make_rollouts(), read_lerobot(folder)
    mask = rollouts[keys.MASK]
    for key in (keys.IMAGE, keys.STATE, keys.ACTION, ("next", "reward")):
        assert torch.equal(read[key][mask], rollouts[key][mask]), key
    assert torch.equal(read["next", *keys.STATE][0, :-1], rollouts["next", *keys.STATE][0, :-1])
    assert torch.equal(read["next", *keys.STATE][0, -1], rollouts[keys.STATE][0, -1])  # nothing was kept behind the end
    assert read["next", "done"].dtype == torch.bool


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path):
    folder = write_lerobot(make_rollouts(), tmp_path / "set")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write_lerobot(make_rollouts(), folder)
    broken = make_rollouts()
    broken["next", *keys.STATE] = broken["next", *keys.STATE] + 1  # not in place: root and next share memory
    with pytest.raises(ValueError, match=r"'state'\) before a step is not what it was after the one before"):
        write_lerobot(broken, folder, overwrite=True)
    with pytest.raises(ValueError, match="needs images and one 'action' an entry"):
        write_lerobot(make_rollouts().exclude(keys.ACTION), folder, overwrite=True)
    assert_same(read_lerobot(folder), make_rollouts())
    write_lerobot(make_rollouts()[:1], folder, overwrite=True)
    assert len(read_lerobot(folder)) == 1 and [path.name for path in tmp_path.iterdir()] == ["set"]


def test_what_is_no_lerobot_dataset_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no meta/info\.json"):
        read_lerobot(tmp_path)
    folder = write_lerobot(make_rollouts(), tmp_path / "set")
    with pytest.raises(ValueError, match="holds the episodes 0 to 2, not 7"):
        read_lerobot(folder, episodes=[7])
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    with pytest.raises(ValueError, match=r"format v2\.1, v3\.0 is read"):
        read_lerobot(folder)
    (folder / "meta/info.json").write_text(json.dumps({"codebase_version": "v3.0"}))
    with pytest.raises(ValueError, match="does not describe a LeRobot dataset"):
        read_lerobot(folder)
    (folder / "meta/info.json").write_text(json.dumps(info))
    (folder / "data/chunk-000/file-000.parquet").unlink()
    with pytest.raises(FileNotFoundError, match=r"lacks data/chunk-000/file-000\.parquet"):
        read_lerobot(folder)
