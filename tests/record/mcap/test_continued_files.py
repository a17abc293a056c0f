"""A recording that is continued ends byte for byte as one that was written at a stretch."""

from __future__ import annotations

import pytest
import torch
from recordings import FilmEnv, make_rollouts
from tensordict import TensorDict

from worldenv_trl import keys
from worldenv_trl.record import RolloutWriter


def waves() -> list[TensorDict]:
    """Of three layouts, with texts, frames by decision and rollouts of different lengths."""
    first = make_rollouts(3, 9)
    first[keys.MASK] = torch.arange(9) < torch.tensor([[9], [2], [5]])
    torch.manual_seed(0)  # of its actions
    film = FilmEnv(2).rollout(3, break_when_any_done=False)
    return [first, film, make_rollouts(2, 12), make_rollouts(2, 4, 16), film]


def write(writer: RolloutWriter, number: int) -> None:
    """One of the waves and, behind every second one, an annotation."""
    numbers = writer.write(waves()[number])
    if number % 2:
        shape = waves()[number].shape
        writer.annotate(TensorDict({"advantage": torch.full((*shape, 1), float(number))}, shape), numbers)


def begun(path) -> RolloutWriter:
    return RolloutWriter(path, metadata={"task": "a", "seed": 3}, attachments={"notes.txt": "words"}, overwrite=True)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    with begun(path) as writer:
        for number in range(5):
            write(writer, number)
    return path


def continued(path, state, first: int) -> None:
    with RolloutWriter.resumed(path, state) as writer:
        for number in range(first, 5):
            write(writer, number)


@pytest.mark.parametrize("kept", range(6))
@pytest.mark.parametrize("end", ["left", "completed", "cut", "finished"])
def test_what_came_after_the_state_goes_and_the_rest_follows_byte_for_byte(tmp_path, whole, kept, end):
    path, states = tmp_path / "a.mcap", []
    writer = begun(path)
    states.append(writer.state_dict())
    for number in range(5):
        write(writer, number)
        states.append(writer.state_dict())
    if end == "completed":
        with pytest.raises(KeyError), writer:
            raise KeyError
    elif end == "finished":
        writer.close()
    else:
        writer._file.abort()
    if end == "cut":
        partial = path.with_name("a.partial.mcap")
        with partial.open("rb+") as file:
            file.truncate((states[kept]["size"] + partial.stat().st_size) // 2)
    continued(path, states[kept], kept)
    assert path.read_bytes() == whole.read_bytes()
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]


def test_it_can_be_continued_again_and_again(tmp_path, whole):
    path = tmp_path / "a.mcap"
    writer = begun(path)
    for number in range(5):
        write(writer, number)
        state = writer.state_dict()
        writer._file.abort()
        writer = RolloutWriter.resumed(path, state)
    writer.close()
    assert path.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize("damage", ["cut", "flip", "gone", "another"])
def test_a_file_that_no_longer_holds_what_the_state_says_is_refused_and_stays(tmp_path, damage):
    path, partial = tmp_path / "a.mcap", tmp_path / "a.partial.mcap"
    writer = begun(path)
    write(writer, 0)
    state = writer.state_dict()
    write(writer, 1)
    writer._file.abort()
    assert RolloutWriter.still_holds(path, state)
    data = bytearray(partial.read_bytes())
    data[state["size"] // 2] ^= 1
    if damage == "gone":
        partial.unlink()
    elif damage == "another":
        with begun(path) as other:
            write(other, 1)
    else:
        partial.write_bytes(data if damage == "flip" else data[: state["size"] - 1])
    left = {each.name: each.read_bytes() for each in tmp_path.iterdir()}
    assert not RolloutWriter.still_holds(path, state)
    with pytest.raises(ValueError, match="is cut short, damaged or gone: it can not be continued"):
        RolloutWriter.resumed(path, state)
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == left


def test_a_closed_writer_has_no_state_to_continue_from(tmp_path):
    with begun(tmp_path / "a.mcap") as writer:
        write(writer, 0)
    with pytest.raises(ValueError, match="is closed"):
        writer.state_dict()


def test_another_writer_at_work_keeps_its_file(tmp_path):
    writer = begun(tmp_path / "a.mcap")
    write(writer, 0)
    with pytest.raises(FileExistsError, match="is being written by another writer"):
        RolloutWriter.resumed(tmp_path / "a.mcap", writer.state_dict())
    write(writer, 1)
    writer.close()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.mcap"]
