from __future__ import annotations

import json
from dataclasses import dataclass

import pytest
import torch
from mcap.reader import make_reader

from worldenv_trl.record import MCAPLogger
from worldenv_trl.record.mcap.protobuf import image_data


def messages(path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(message.data)
    return found


def test_scalars_are_plottable_messages(tmp_path):
    pool = pytest.importorskip("google.protobuf.descriptor_pool").DescriptorPool()
    from google.protobuf import descriptor_pb2, message_factory

    logger = MCAPLogger("run", tmp_path)
    logger.log_scalar("train/reward", 0.25, step=3)
    logger.log_scalar("train/reward", torch.tensor(0.5))
    logger.log_metrics({"loss": torch.tensor(1.5), "clip": 2}, step=7)
    logger.shutdown()
    with open(tmp_path / "run.mcap", "rb") as file:
        summary = make_reader(file).get_summary()
    schema = next(s for s in summary.schemas.values() if s.name == "worldenv_trl.Scalar")
    for each in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(each)
    scalar = message_factory.GetMessageClass(pool.FindMessageTypeByName("worldenv_trl.Scalar"))
    found = {
        topic: [(m.value, m.step) for m in map(scalar.FromString, data)]
        for topic, data in messages(tmp_path / "run.mcap").items()
    }
    assert found == {"/train/reward": [(0.25, 3), (0.5, -1)], "/loss": [(1.5, 7)], "/clip": [(2.0, 7)]}


def test_videos_are_raw_images(tmp_path):
    logger = MCAPLogger("run", tmp_path)
    video = torch.randint(0, 256, (2, 4, 3, 8, 10), dtype=torch.uint8)
    logger.log_video("rollout", video, step=1)
    with pytest.raises(ValueError, match=r"uint8 \[\(N,\) T, 3, H, W\]"):
        logger.log_video("rollout", video.float())
    logger.shutdown()
    data = messages(tmp_path / "run.mcap")["/rollout"]
    assert len(data) == 8
    width, height, start = image_data(data[5])
    assert (width, height) == (10, 8)
    pixels = torch.frombuffer(bytearray(data[5]), dtype=torch.uint8, offset=start, count=240).view(8, 10, 3)
    assert torch.equal(pixels.permute(2, 0, 1), video[1, 1])


def test_settings_histograms_and_text_are_kept(tmp_path):
    @dataclass
    class Settings:
        lr: float = 0.1
        tasks: tuple[str, ...] = ("a", "b")

    logger = MCAPLogger("run", tmp_path)
    logger.log_hparams(Settings())
    logger.log_histogram("ratio", torch.tensor([0.0, 0.0, 1.0]), step=2, bins=2)
    logger.log_str("note", "hello", step=2)
    with pytest.raises(ValueError, match="dictionary or a dataclass, got list"):
        logger.log_hparams([1])
    logger.shutdown()
    with open(tmp_path / "run.mcap", "rb") as file:
        values = {r.name: r.metadata for r in make_reader(file).iter_metadata()}["hparams"]
    assert {key: json.loads(value) for key, value in values.items()} == {"lr": 0.1, "tasks": ["a", "b"]}
    found = messages(tmp_path / "run.mcap")
    assert json.loads(found["/ratio"][0]) == {"counts": [2, 1], "edges": [0.0, 0.5, 1.0], "step": 2}
    assert b"step 2: hello" in found["/log"][0]


def test_an_existing_log_is_kept_unless_asked(tmp_path):
    MCAPLogger("run", tmp_path).shutdown()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        MCAPLogger("run", tmp_path)
    MCAPLogger("run", tmp_path, overwrite=True).shutdown()


def test_a_second_logger_on_one_path_is_refused_while_the_first_writes(tmp_path):
    logger = MCAPLogger("a", tmp_path)
    logger.log_scalar("x", 1.0)
    with pytest.raises(FileExistsError, match="is being written by another logger"):
        MCAPLogger("a", tmp_path, overwrite=True)
    logger.shutdown()
    MCAPLogger("a", tmp_path, overwrite=True).shutdown()


def test_what_cannot_be_logged_is_refused(tmp_path):
    logger = MCAPLogger("a", tmp_path)
    logger.log_scalar("x", 1.0)
    with pytest.raises(ValueError, match="'x' was logged as a scalar, it cannot be a histogram, too"):
        logger.log_histogram("x", [1.0, 2.0])
    with pytest.raises(ValueError, match="fps must be positive, got 0"):
        logger.log_video("v", torch.zeros(2, 3, 8, 8, dtype=torch.uint8), fps=0)
    with pytest.raises(TypeError, match="must be text, got None"):
        logger.log_scalar(None, 1.0)
    logger.shutdown()
    with pytest.raises(ValueError, match=r"a\.mcap is closed: 'y' was not logged"):
        logger.log_scalar("y", 1.0)
