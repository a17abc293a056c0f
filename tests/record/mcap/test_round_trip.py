from __future__ import annotations

import itertools
import json
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from tensordict import NonTensorData, NonTensorStack, TensorDict

from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter, list_rollouts, read_attachments, read_metadata, read_rollouts

SIZE = 16


def step_rollouts(lengths: list[int], steps: int = 6, seed: int = 0, task: int = 0) -> TensorDict:
    """Rollouts [R, T] as an env writes them: a finished row stays as it was."""
    generator = torch.Generator().manual_seed(seed)
    rows = len(lengths)
    done = torch.arange(1, steps + 1) >= torch.tensor(lengths).unsqueeze(-1)

    def chain(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        values = torch.randn(rows, steps + 1, *shape, generator=generator) * 100
        values = values.abs().clamp(max=255).to(dtype) if dtype == torch.uint8 else values
        values = values > 0 if dtype == torch.bool else values.to(dtype)
        for row, length in enumerate(lengths):
            values[row, length:] = values[row, length].clone()
        return values

    image, state = chain(3, SIZE, SIZE, dtype=torch.uint8), chain(7)
    sim, count = chain(5, dtype=torch.float64), chain(1, dtype=torch.int64)
    success = chain(1, dtype=torch.bool)
    words = NonTensorStack(*(NonTensorData(f"do thing {row}", batch_size=[steps]) for row in range(rows)))

    def observed(part: slice) -> dict:
        return {
            "observation": {"image": image[:, part], "state": state[:, part]},
            keys.SIM_STATE: sim[:, part],
            keys.NUM_STEPS: count[:, part],
            keys.SUCCESS: success[:, part],
            keys.TASK_ID: torch.full((rows, steps, 1), task),
            keys.INSTRUCTION: words,
        }

    return TensorDict(
        {
            **observed(slice(0, -1)),
            keys.ACTION: torch.randn(rows, steps, 7, generator=generator),
            keys.CHUNK: torch.randn(rows, steps, 2, 7, generator=generator),
            keys.LOG_PROBS: torch.randn(rows, steps, 2, generator=generator),
            "returns": torch.randn(rows, steps, generator=generator),
            keys.MASK: torch.arange(steps) < torch.tensor(lengths).unsqueeze(-1),
            "next": {
                **observed(slice(1, None)),
                "reward": torch.randn(rows, steps, 1, generator=generator),
                "done": done.unsqueeze(-1),
            },
        },
        batch_size=[rows, steps],
    )


def decision_rollouts(
    executed: list[list[int]], chunk: int = 3, seed: int = 1, cameras: Sequence[str] = ("image",)
) -> TensorDict:
    """Rollouts [R, D] of chunks with each camera's frames; its next image is the last executed frame."""
    counts = torch.tensor(executed)
    rows, decisions = counts.shape
    mask = torch.arange(chunk) < counts.unsqueeze(-1)
    row, decision = torch.meshgrid(torch.arange(rows), torch.arange(decisions), indexing="ij")

    def before(values: torch.Tensor, first: torch.Tensor) -> torch.Tensor:
        return torch.cat([first, values[:, :-1]], 1)

    out = TensorDict({keys.STEP_MASK: before(mask, torch.zeros_like(mask[:, :1])), keys.MASK: counts > 0})
    out["next", keys.STEP_MASK] = mask
    for place, camera in enumerate(cameras):
        generator = torch.Generator().manual_seed(seed + 100 * place)
        frames = torch.randint(0, 256, (rows, decisions, chunk, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8)
        start = torch.randint(0, 256, (rows, 1, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8)
        after = frames[row, decision, (counts - 1).clamp(min=0)]
        out["observation", camera], out["next", "observation", camera] = before(after, start), after
        out[keys.FRAMES, camera] = before(frames, torch.zeros_like(frames[:, :1]))
        out["next", keys.FRAMES, camera] = frames
        if not place:
            out[keys.CHUNK] = torch.randn(rows, decisions, chunk, 7, generator=generator)
            out["next", "reward"] = torch.randn(rows, decisions, 1, generator=generator)
    out.batch_size = [rows, decisions]
    return out


def assert_same(read: TensorDict, written: TensorDict) -> None:
    """Equal keys, shapes, dtypes and bits where the mask is True; zero elsewhere."""
    assert read.batch_size == written.batch_size
    assert set(read.keys(True, True)) == set(written.keys(True, True))
    mask = written[keys.MASK]
    for key in written.keys(True, True):
        value, expected = read[key], written[key]
        assert value.dtype == expected.dtype and value.shape == expected.shape, key
        bits = [np.ascontiguousarray(each[mask].numpy()).tobytes() for each in (value, expected)]
        assert bits[0] == bits[1], key
        assert not value[~mask].any(), key


def write(path, *rollouts: TensorDict, **options) -> None:
    with RolloutWriter(path, **options) as writer:
        for part in rollouts:
            writer.write(part)


def topics(path) -> dict[str, int]:
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    return {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}


def test_single_steps_come_back_bit_for_bit(tmp_path):
    rollouts = step_rollouts([6, 3, 1])
    rollouts["next", "reward"][0, 0] = torch.nan
    rollouts["observation", "state"][0, 0, 0] = -0.0
    write(tmp_path / "a.mcap", rollouts)
    read = read_rollouts(tmp_path / "a.mcap")
    assert_same(read, rollouts)
    assert read[0, 0].get(keys.INSTRUCTION).tolist() == "do thing 0"
    assert read[:, 0].get(keys.INSTRUCTION).tolist() == ["do thing 0", "do thing 1", "do thing 2"]


def test_decisions_come_back_bit_for_bit_with_a_stop_inside_a_chunk(tmp_path):
    rollouts = decision_rollouts([[3, 2, 0], [3, 3, 3], [1, 0, 0]])
    write(tmp_path / "a.mcap", rollouts)
    assert_same(read_rollouts(tmp_path / "a.mcap"), rollouts)


def test_the_frames_of_two_cameras_come_back_bit_for_bit(tmp_path):
    rollouts = decision_rollouts([[3, 2, 0], [3, 3, 3], [1, 0, 0]], cameras=("image", "wrist_image"))
    write(tmp_path / "a.mcap", rollouts)
    assert_same(read_rollouts(tmp_path / "a.mcap"), rollouts)
    wrist = [("next", keys.FRAMES, "wrist_image"), keys.WRIST_IMAGE]
    assert_same(read_rollouts(tmp_path / "a.mcap", keys=wrist), rollouts.select(*wrist, keys.MASK))
    both = read_rollouts(tmp_path / "a.mcap", keys=[keys.FRAMES])
    assert_same(both, rollouts.select(keys.FRAMES, keys.MASK))


def test_a_camera_whose_image_is_no_frame_leaves_the_other_as_it_is(tmp_path):
    rollouts = decision_rollouts([[3, 2], [3, 3]], cameras=("image", "left"))
    rollouts["next", "observation", "left"] = 255 - rollouts["next", "observation", "left"]
    write(tmp_path / "a.mcap", rollouts)
    assert_same(read_rollouts(tmp_path / "a.mcap"), rollouts)
    found = topics(tmp_path / "a.mcap")
    assert found["/observation/image"] == 2 + 11 and found["/frames/left"] == 12


def test_decisions_without_frames_come_back_and_play_as_long(tmp_path):
    rollouts = decision_rollouts([[3, 2], [3, 3]])
    write(tmp_path / "with.mcap", rollouts)
    bare = rollouts.exclude(keys.FRAMES, ("next", keys.FRAMES))
    write(tmp_path / "without.mcap", bare)
    assert_same(read_rollouts(tmp_path / "without.mcap"), bare)
    starts = [[each.start for each in list_rollouts(tmp_path / f"{name}.mcap")] for name in ("with", "without")]
    assert starts[0] == starts[1]


def test_an_image_is_stored_once(tmp_path):
    write(tmp_path / "steps.mcap", step_rollouts([6, 3]))
    assert topics(tmp_path / "steps.mcap")["/observation/image"] == 7 + 4
    write(tmp_path / "decisions.mcap", decision_rollouts([[3, 2]], cameras=("image", "wrist_image")))
    found = topics(tmp_path / "decisions.mcap")
    for name in ("image", "wrist_image"):
        assert found[f"/observation/{name}"] == 1 + 5 and found[f"/observation/{name}/after_stop"] == 1


def test_root_and_next_values_that_differ_are_both_stored(tmp_path):
    rollouts = step_rollouts([6, 6])
    rollouts["next", "observation", "image"] = rollouts["next", "observation", "image"].flip(-1)
    rollouts["next", keys.NUM_STEPS] = rollouts["next", keys.NUM_STEPS] + 1
    rollouts["next", keys.SIM_STATE] = rollouts["next", keys.SIM_STATE].float()
    write(tmp_path / "a.mcap", rollouts)
    assert_same(read_rollouts(tmp_path / "a.mcap"), rollouts)


def test_decisions_whose_image_is_no_frame_come_back_too(tmp_path):
    rollouts = decision_rollouts([[3, 2], [3, 3]])
    rollouts["next", "observation", "image"] = 255 - rollouts["next", "observation", "image"]
    rollouts[keys.FRAMES, "image"] = rollouts[keys.FRAMES, "image"] + 1
    write(tmp_path / "a.mcap", rollouts)
    assert_same(read_rollouts(tmp_path / "a.mcap"), rollouts)


@pytest.mark.parametrize("batch", [(), (6,), (2, 3), (3, 2, 1)])
def test_batch_dimensions_are_kept(tmp_path, batch):
    count = int(np.prod(batch)) if batch else 1
    rollouts = step_rollouts([3, 6, 1, 2, 5, 4][:count])
    if batch == ():
        rollouts = rollouts[0]
        rollouts[keys.INSTRUCTION] = NonTensorData("do it", batch_size=[6])
        rollouts["next", keys.INSTRUCTION] = NonTensorData("do it", batch_size=[6])
    else:
        rollouts = rollouts.reshape(*batch, 6)
    write(tmp_path / "a.mcap", rollouts)
    assert_same(read_rollouts(tmp_path / "a.mcap"), rollouts)


def test_other_dtypes_come_back(tmp_path):
    rollouts = step_rollouts([6, 3])
    for index, dtype in enumerate((torch.float16, torch.bfloat16, torch.int32, torch.int8, torch.uint8)):
        rollouts[f"extra_{index}"] = (torch.randn(2, 6, 3) * 50).to(dtype)
    rollouts["scalar"] = torch.randn(2, 6)
    rollouts["empty"] = torch.zeros(2, 6, 0)
    write(tmp_path / "a.mcap", rollouts)
    read = read_rollouts(tmp_path / "a.mcap")
    for key in [f"extra_{index}" for index in range(5)] + ["scalar", "empty"]:
        assert read[key].dtype == rollouts[key].dtype and read[key].shape == rollouts[key].shape
        assert torch.equal(read[key][rollouts[keys.MASK]], rollouts[key][rollouts[keys.MASK]])


def test_without_a_mask_a_rollout_ends_at_its_first_done(tmp_path):
    rollouts = step_rollouts([2, 6])
    write(tmp_path / "a.mcap", rollouts.exclude(keys.MASK))
    assert_same(read_rollouts(tmp_path / "a.mcap"), rollouts)


def test_several_writes_are_concatenated_and_padded(tmp_path):
    first, second = step_rollouts([6, 3]), step_rollouts([4, 2, 1], steps=4, seed=5)
    write(tmp_path / "a.mcap", first, second)
    read = read_rollouts(tmp_path / "a.mcap")
    assert read.batch_size == (5, 6)
    assert_same(read[:2], first)
    assert_same(read[2:, :4], second)
    assert not read[keys.MASK][2:, 4:].any() and not read[keys.IMAGE][2:, 4:].any()


def test_folders_and_patterns_read_all_their_files(tmp_path):
    write(tmp_path / "a.mcap", step_rollouts([6, 3]))
    write(tmp_path / "b.mcap", step_rollouts([5], seed=2))
    partial = RolloutWriter(tmp_path / "c.mcap")
    partial.write(step_rollouts([6], seed=3))
    assert read_rollouts(tmp_path).batch_size == (3, 6)
    assert read_rollouts(str(tmp_path / "[ab].mcap")).batch_size == (3, 6)
    partial.close()
    assert read_rollouts(tmp_path).batch_size == (4, 6)


def test_files_with_other_entries_are_not_mixed(tmp_path):
    write(tmp_path / "a.mcap", step_rollouts([6]))
    write(tmp_path / "b.mcap", step_rollouts([6]).exclude(keys.SIM_STATE, ("next", keys.SIM_STATE)))
    with pytest.raises(ValueError, match=r"b\.mcap and .*a\.mcap hold different entries .*sim_state"):
        read_rollouts(tmp_path)


def test_metadata_and_attachments_come_before_the_rollouts(tmp_path):
    metadata = {"tasks": ["goal/a"], "seed": 3, "note": "grün", "config": {"lr": 1e-3}}
    model = tmp_path / "model.xml"
    model.write_text("<mujoco/>")
    attachments = {"model.xml": model, "raw": b"\x00\x01", "text": "hello"}
    write(tmp_path / "a.mcap", step_rollouts([6]), metadata=metadata, attachments=attachments)
    assert read_metadata(tmp_path / "a.mcap") == metadata
    read = read_attachments(tmp_path / "a.mcap")
    assert read == {"model.xml": b"<mujoco/>", "raw": b"\x00\x01", "text": b"hello"}


def test_a_task_selects_its_rollouts(tmp_path):
    tasks = ["goal/a", "goal/b"]
    parts = [step_rollouts([6, 3], seed=task, task=task) for task in range(2)]
    write(tmp_path / "a.mcap", *parts, metadata={"tasks": tasks})
    assert_same(read_rollouts(tmp_path / "a.mcap", task=tasks[1]), parts[1])
    with pytest.raises(ValueError, match=r"a\.mcap is of goal/a, goal/b, not of goal/c"):
        read_rollouts(tmp_path / "a.mcap", task="goal/c")
    write(tmp_path / "b.mcap", parts[0])
    with pytest.raises(ValueError, match="does not say of which tasks"):
        read_rollouts(tmp_path / "b.mcap", task=tasks[0])


def test_a_task_is_found_by_what_each_file_calls_it(tmp_path):
    first, second = step_rollouts([6, 3], task=7), step_rollouts([4, 2], seed=1, task=3)
    write(tmp_path / "a.mcap", first, second, metadata={"tasks": ["goal/a", "goal/b"], "task_ids": [7, 3]})
    write(tmp_path / "b.mcap", second, first, metadata={"tasks": ["goal/b", "goal/a"], "task_ids": [7, 3]})
    assert_same(read_rollouts(tmp_path, task="goal/a"), torch.cat([first, second]))
    bare = [keys.ACTION]
    assert_same(read_rollouts(tmp_path, task="goal/b", keys=bare), torch.cat([second, first]).select(*bare, keys.MASK))
    assert_same(read_rollouts(tmp_path / "a.mcap", task="goal/b", rollouts=[0, 3]), second[1:])


def test_messages_are_typed_and_images_viewable(tmp_path):
    """Read by the official MCAP reader and protobuf runtime, which know nothing of this package."""
    pool = pytest.importorskip("google.protobuf.descriptor_pool")
    from google.protobuf import descriptor_pb2, message_factory

    rollouts = step_rollouts([6, 3])
    write(tmp_path / "a.mcap", rollouts)
    decoded: dict[str, list] = {}
    pools: dict[int, object] = {}
    with open(tmp_path / "a.mcap", "rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema.id not in pools:
                files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
                known = pool.DescriptorPool()
                for each in files.file:
                    known.Add(each)
                pools[schema.id] = message_factory.GetMessageClass(known.FindMessageTypeByName(schema.name))
            decoded.setdefault(channel.topic, []).append(pools[schema.id].FromString(message.data))
    assert [(m.rollout, m.step) for m in decoded["/step"]] == [(0, i) for i in range(6)] + [(1, i) for i in range(3)]
    step = decoded["/step"][7]
    assert np.allclose(step.action, rollouts[keys.ACTION][1, 1], atol=0)
    assert step.reward == rollouts["next", "reward"][1, 1].item()
    assert list(step.observation_state) == rollouts["next", "observation", "state"][1, 1].tolist()
    assert list(decoded["/reset"][1].sim_state) == rollouts[keys.SIM_STATE][1, 0].tolist()
    image = decoded["/observation/image"][1]
    assert (image.encoding, image.width, image.height, image.step) == ("rgb8", SIZE, SIZE, 3 * SIZE)
    pixels = torch.frombuffer(bytearray(image.data), dtype=torch.uint8).view(SIZE, SIZE, 3).permute(2, 0, 1)
    assert torch.equal(pixels, rollouts["next", "observation", "image"][0, 0])
    assert "do thing 1" in decoded["/instruction"][1].message
    position = decoded["/hand"][0].pose.position
    assert [position.x, position.y, position.z] == rollouts["next", "observation", "state"][0, 0, :3].tolist()


def test_log_times_never_go_back_on_a_topic(tmp_path):
    write(tmp_path / "a.mcap", step_rollouts([6, 3]), step_rollouts([2], seed=4))
    times: dict[str, list[int]] = {}
    with open(tmp_path / "a.mcap", "rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            times.setdefault(channel.topic, []).append(message.log_time)
    for topic, stamps in times.items():
        assert all(a < b for a, b in itertools.pairwise(stamps)), topic


def test_metadata_must_be_plain(tmp_path):
    with pytest.raises(ValueError, match="plain values"):
        RolloutWriter(tmp_path / "a.mcap", metadata={"policy": object()})
    assert json.dumps([p.name for p in tmp_path.iterdir()]) == "[]"


def test_physical_states_of_several_tasks_are_padded_to_the_longest(tmp_path):
    with RolloutWriter(tmp_path / "a.mcap") as writer:
        for width in (3, 5):
            writer.write(TensorDict({"sim_state": torch.ones(2, 4, width, dtype=torch.float64)}, [2, 4]))
    read = read_rollouts(tmp_path / "a.mcap")["sim_state"]
    assert read.shape == (4, 4, 5)
    assert read.sum((1, 2)).tolist() == [12, 12, 20, 20] and not read[:2, :, 3:].any()


def test_an_image_that_was_a_number_before_the_step_comes_back_as_both(tmp_path):
    rollouts = TensorDict(
        {
            "observation": {"view": torch.rand(2, 3, 3, 16, 16)},
            "next": {"observation": {"view": torch.randint(0, 256, (2, 3, 3, 16, 16), dtype=torch.uint8)}},
        },
        [2, 3],
    )
    write(tmp_path / "a.mcap", rollouts)
    read = read_rollouts(tmp_path / "a.mcap")
    assert torch.equal(read["observation", "view"], rollouts["observation", "view"])
    assert torch.equal(read["next", "observation", "view"], rollouts["next", "observation", "view"])


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"depth": torch.zeros(2, 3, 8, dtype=torch.uint16)}, r"entry \('depth',\) is torch.uint16.*int32"),
        ({"text": torch.zeros(2, 3, 1)}, r"entry \('text',\) has a name that recordings use themselves"),
        ({"step": torch.zeros(2, 3, 3, 16, 16, dtype=torch.uint8)}, r"would be on the topic /step of a recording"),
        (
            {name: torch.zeros(2, 3, 3, 16, 16, dtype=torch.uint8) for name in ("a/b", ("a", "b"))},
            "would both be the image topic /a/b: rename one",
        ),
    ],
)
def test_entries_that_could_not_be_read_back_are_refused(tmp_path, entries, message):
    rollouts = TensorDict({}, [2, 3])
    for key, value in entries.items():
        rollouts.set(key, value)
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "a.mcap", rollouts)
