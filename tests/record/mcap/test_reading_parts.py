from __future__ import annotations

from pathlib import Path

import pytest
import torch
from recordings import FilmEnv
from tensordict import TensorDict
from test_round_trip import assert_same, decision_rollouts, step_rollouts, write

from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter, list_rollouts, read_attachments, read_metadata, read_rollouts, recorded
from worldenv_trl.record.mcap import part, writer

OLD = Path(__file__).parents[1] / "format_1"
ONE_CAMERA = Path(__file__).parents[1] / "format_2"  # frames were one tensor


def test_files_of_the_first_format_still_come_back_bit_for_bit():
    read = read_rollouts(OLD / "steps.mcap")
    assert_same(read[:3], step_rollouts([6, 3, 1]))
    assert_same(read[3:, :4], step_rollouts([4, 2, 1], steps=4, seed=5))
    assert read_metadata(OLD / "steps.mcap") == {"task": "goal/open_the_top_drawer", "seed": 3}
    assert read_attachments(OLD / "steps.mcap") == {"a": b"xyz"}
    assert_same(read_rollouts(OLD / "decisions.mcap"), decision_rollouts([[3, 2, 0], [3, 3, 3], [1, 0, 0]]))
    assert torch.equal(read_rollouts(OLD / "steps.mcap", rollouts=[4])[keys.ACTION][0, :4], read[4][keys.ACTION][:4])


def test_frames_of_the_second_format_come_back_as_those_of_its_one_camera():
    written = decision_rollouts([[3, 2, 0], [3, 3, 3], [1, 0, 0]])
    written["next", "recorded", keys.FRAMES, "image"] = written["next", keys.FRAMES, "image"]
    assert_same(read_rollouts(ONE_CAMERA / "decisions.mcap"), written)
    frames = read_rollouts(ONE_CAMERA / "decisions.mcap", keys=[("next", keys.FRAMES, "image")], rollouts=1)
    assert torch.equal(frames["next", keys.FRAMES, "image"][0], written["next", keys.FRAMES, "image"][1])
    with pytest.raises(ValueError, match="names several tasks and not their task_ids"):
        read_rollouts(ONE_CAMERA / "decisions.mcap", task="goal/a")


def test_a_recorder_s_frames_of_the_second_format_come_back_too(tmp_path):
    torch.manual_seed(0)
    env = recorded(FilmEnv(2), tmp_path / "a.mcap")
    env.rollout(3)
    env.close()
    assert_same(read_rollouts(ONE_CAMERA / "recorder.mcap"), read_rollouts(tmp_path / "a.mcap"))


@pytest.mark.parametrize("frames", [keys.FRAMES, None])
def test_a_recorder_keeps_the_frames_of_every_camera_or_none(tmp_path, frames):
    env = recorded(FilmEnv(4, ("image", "wrist_image", "left"), frames), tmp_path / "a.mcap")
    rollouts = env.rollout(3)
    env.close()
    read = read_rollouts(tmp_path / "a.mcap")
    assert set(rollouts.keys(True, True)) <= set(read.keys(True, True))
    for key in rollouts.keys(True, True):
        assert torch.equal(read[key], rollouts[key]), key
    assert [each.start for each in list_rollouts(tmp_path / "a.mcap")][1] == 1001 / 20


def test_an_image_that_stops_being_the_last_frame_of_its_camera_is_an_error(tmp_path):
    class Torn(FilmEnv):
        def _step(self, tensordict):
            out = super()._step(tensordict)
            out["observation", "left"] += tensordict[keys.STEP_MASK].any().to(torch.uint8)
            return out

    env = recorded(Torn(2, ("image", "left")), tmp_path / "a.mcap")
    with pytest.raises(
        ValueError, match=r"'observation', 'left'\) is not the last executed one of \('frames', 'left'\)"
    ):
        env.rollout(4)
        env.close()


def test_a_recording_of_a_later_release_is_refused_by_its_version(tmp_path, monkeypatch):
    monkeypatch.setattr(writer, "VERSION", writer.VERSION + 1)
    write(tmp_path / "a.mcap", decision_rollouts([[3]]))
    with pytest.raises(
        ValueError, match=f"format version {writer.VERSION}, .* reads up to {writer.VERSION - 1}: update"
    ):
        read_rollouts(tmp_path / "a.mcap")


def test_rollouts_are_chosen_by_number_through_all_files(tmp_path):
    first, second = step_rollouts([6, 3, 1]), step_rollouts([5, 2], seed=2)
    write(tmp_path / "a.mcap", first[:2], first[2:])
    write(tmp_path / "b.mcap", second)
    assert_same(read_rollouts(tmp_path, rollouts=[1, 3]), torch.cat([first[1:2], second[:1]]))
    assert_same(read_rollouts(tmp_path, rollouts=slice(-2, None)), second)
    assert_same(read_rollouts(tmp_path / "a.mcap", rollouts=2), first[2:])
    with pytest.raises(ValueError, match="holds the rollouts 0 to 4, not 5"):
        read_rollouts(tmp_path, rollouts=5)


def test_a_time_range_gives_the_rollouts_that_play_in_it(tmp_path):
    rollouts = step_rollouts([6, 3, 1])  # playing from 0, 0.35 and 0.55 s on
    write(tmp_path / "a.mcap", rollouts)
    assert [each.start for each in list_rollouts(tmp_path / "a.mcap")] == [0.0, 0.35, 0.55]
    assert_same(read_rollouts(tmp_path / "a.mcap", time=(0.4, 0.5)), rollouts[1:2])
    assert_same(read_rollouts(tmp_path / "a.mcap", time=(0.5, 9.0)), rollouts[1:])
    with pytest.raises(ValueError, match="no rollouts that were asked for"):
        read_rollouts(tmp_path / "a.mcap", time=(5.0, 6.0))


def test_steps_and_keys_are_chosen(tmp_path, monkeypatch):
    rollouts = step_rollouts([6, 3])
    write(tmp_path / "a.mcap", rollouts)
    read = read_rollouts(tmp_path / "a.mcap", steps=slice(2, 5))
    assert_same(read, rollouts[:, 2:5])
    with pytest.raises(ValueError, match=r"steps=slice\(6, 9, None\) chooses none: .* has 6 steps"):
        read_rollouts(tmp_path / "a.mcap", steps=slice(6, 9))
    monkeypatch.setattr(part, "_fill", lambda *_: pytest.fail("a frame was decoded"))
    read = read_rollouts(tmp_path / "a.mcap", keys=[keys.ACTION, ("next", "reward")])
    assert set(read.keys(True, True)) == {keys.ACTION, ("next", "reward"), keys.MASK}
    assert torch.equal(read[keys.ACTION][0], rollouts[keys.ACTION][0])
    with pytest.raises(ValueError, match=r"holds no entry 'rewards': did you mean .*'reward'"):
        read_rollouts(tmp_path / "a.mcap", keys=["rewards"])


def test_chunks_without_a_chosen_rollout_stay_compressed(tmp_path, monkeypatch):
    parts = [step_rollouts([6, 6], seed=seed) for seed in range(4)]
    write(tmp_path / "a.mcap", *parts)  # a chunk for each write
    from worldenv_trl.record.mcap.scan import McapScan

    opened = []
    real = McapScan._opened
    monkeypatch.setattr(McapScan, "_opened", lambda self, chunk: opened.append(chunk) or real(self, chunk))
    assert_same(read_rollouts(tmp_path / "a.mcap", rollouts=[5]), parts[2][1:])
    assert len(opened) == 1


def test_annotations_come_back_with_their_rollouts(tmp_path):
    rollouts = step_rollouts([6, 3, 1])
    advantage = torch.randn(2, 6, 1)
    clipped = torch.rand(2, 6, 2) > 0.5
    with RolloutWriter(tmp_path / "a.mcap") as writer:
        first = writer.write(rollouts[:1])
        numbers = writer.write(rollouts[1:])
        assert (first, numbers) == ([0], [1, 2])
        writer.annotate(TensorDict({keys.ADVANTAGE: advantage, keys.CLIPPED: clipped}, [2, 6]))
        writer.annotate(TensorDict({keys.ADVANTAGE: advantage[:1] + 1}, [1, 6]), [1])
        with pytest.raises(ValueError, match="rollout 7 is not in the file"):
            writer.annotate(TensorDict({keys.ADVANTAGE: advantage}, [2, 6]), [0, 7])
        with pytest.raises(ValueError, match=r"up to 6 entries, the annotation has 2"):
            writer.annotate(TensorDict({keys.ADVANTAGE: advantage[:1, :2]}, [1, 2]), [0])
        with pytest.raises(ValueError, match="neither images"):
            writer.annotate(rollouts.select(keys.IMAGE, ("next", *keys.IMAGE)), [0, 1, 2])
    read = read_rollouts(tmp_path / "a.mcap")
    assert_same(read.exclude(keys.ADVANTAGE, keys.CLIPPED), rollouts)
    assert torch.isnan(read[keys.ADVANTAGE][0]).all() and not read[keys.CLIPPED][0].any()
    assert torch.equal(read[keys.ADVANTAGE][1, :3], advantage[0, :3] + 1)
    assert torch.equal(read[keys.ADVANTAGE][2, :1], advantage[1, :1])
    assert torch.equal(read[keys.CLIPPED][1, :3], clipped[0, :3])
    assert not read[keys.ADVANTAGE][~read[keys.MASK]].any()


def test_a_folder_gives_neither_replays_nor_what_was_repaired_twice(tmp_path):
    first, again = step_rollouts([6, 3, 1]), step_rollouts([6], seed=3)
    write(tmp_path / "a.mcap", first)
    with RolloutWriter(tmp_path / "b.mcap", metadata={"replay": {"source": "a.mcap"}}) as writer:
        writer.write(again)
    assert_same(read_rollouts(tmp_path), first)
    assert len(list_rollouts(tmp_path)) == 3 and len(list_rollouts(tmp_path, replays=True)) == 4
    assert_same(read_rollouts(tmp_path, replays=True)[3:], again)
    assert_same(read_rollouts(tmp_path / "b.mcap"), again)
    assert len(read_rollouts(str(tmp_path / "*.mcap"))) == 4
    (tmp_path / "a.mcap").rename(tmp_path / "a.repaired.mcap")
    (tmp_path / "a.mcap").write_bytes((tmp_path / "a.repaired.mcap").read_bytes()[:-30])
    assert_same(read_rollouts(tmp_path), first)
    (tmp_path / "a.mcap").unlink()
    (tmp_path / "a.repaired.mcap").unlink()
    with pytest.raises(FileNotFoundError, match="nothing but replays: pass replays=True"):
        read_rollouts(tmp_path)


def test_an_unknown_entry_is_named_with_those_that_are_close(tmp_path):
    write(tmp_path / "a.mcap", step_rollouts([2]))
    with pytest.raises(ValueError, match=r"holds no entry 'acton': did you mean 'action'\? It has "):
        read_rollouts(tmp_path / "a.mcap", keys=["acton"])
    with pytest.raises(ValueError, match=r"did you mean \('observation', 'image'\)"):
        read_rollouts(tmp_path / "a.mcap", keys=[("observation", "images")])


@pytest.mark.parametrize(
    ("asked", "error", "message"),
    [
        ({"keys": "action"}, TypeError, "keys must be a list of entries, such as .*, got 'action'"),
        ({"keys": [("next", 3)]}, TypeError, "keys must be a list of entries"),
        ({"rollouts": "0"}, TypeError, "rollouts must be a number, a slice or a list of numbers, got '0'"),
        ({"rollouts": [True]}, TypeError, r"a list of numbers, got \[True\]"),
        ({"time": {4, 8}}, TypeError, "time must be two numbers"),
        ({"time": 5}, TypeError, "time must be two numbers, the first and the last second, got 5"),
        ({"time": (5, 1)}, ValueError, r"in this order, got \(5, 1\)"),
        ({"steps": 3}, TypeError, r"steps must be a slice, such as slice\(0, 10\), got 3"),
        ({"task": 3}, TypeError, "task must be a name such as .*, got 3"),
        ({"path": ""}, ValueError, "path is empty: name a file, a folder or a pattern"),
        ({"path": None}, TypeError, "path must be a file, a folder or a pattern, got None"),
    ],
)
def test_what_cannot_be_asked_is_refused_before_a_file_is_opened(asked, error, message):
    with pytest.raises(error, match=message):
        read_rollouts(**({"path": "gone.mcap"} | asked))
