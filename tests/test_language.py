from __future__ import annotations

import warnings

import pytest
import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict

from worldenv_trl.keys import INSTRUCTION
from worldenv_trl.language import SeenInstructions, Vocabulary, instructions_of


def holding(text, *batch: int) -> TensorDict:
    return TensorDict(batch_size=batch).set(INSTRUCTION, text)


@pytest.mark.parametrize(
    ("tensordict", "expected"),
    [
        (holding("go on"), ["go on"]),
        (holding("go on", 3), ["go on"] * 3),
        (holding(NonTensorStack("a b", "c d"), 2), ["a b", "c d"]),
        (holding(NonTensorStack(*"abcdef").reshape(2, 3), 2, 3), list("abcdef")),
        (holding(NonTensorStack("a b", "c d"), 2)[1], ["c d"]),
        (holding(NonTensorStack("a b", "c d"), 2)[torch.zeros(2, dtype=torch.bool)], []),
        (holding(NonTensorData("go on", batch_size=[2, 2]), 2, 2)[:, :1], ["go on"] * 2),
        (torch.stack([holding("a b", 2), holding("c d", 2)], 1), ["a b", "c d"] * 2),
    ],
)
def test_there_is_one_text_for_each_row_however_they_are_stored(tensordict, expected):
    assert instructions_of(tensordict) == expected


def test_without_a_text_it_says_so():
    with pytest.raises(ValueError, match="reads the goal as text"):
        instructions_of(TensorDict(batch_size=[2]))


def test_unknown_words_are_one_word_and_padding_is_another():
    vocabulary = Vocabulary(Vocabulary.of(["turn on the stove"]), max_words=5)
    ids = vocabulary.ids(["turn on the stove", "Turn off!"], min_length=5)
    assert ids.shape == (2, 5) and ids.dtype == torch.int64
    assert (ids[0, :4] > 1).all() and ids[0, 0] == ids[1, 0]
    assert ids[1].tolist()[1:] == [1, 0, 0, 0] and ids[0, 4] == 0
    assert vocabulary.ids([]).shape == (0, 1)


@pytest.mark.parametrize("text", ["", " ... "])
def test_an_instruction_needs_words(text):
    with pytest.raises(ValueError, match=f"must have a word, got {text!r}"):
        Vocabulary(Vocabulary.of(["go"]), max_words=5).ids(["go", text])


def test_of_a_long_instruction_the_first_words_are_read():
    vocabulary = Vocabulary(Vocabulary.of(["go up and down"]), max_words=3)
    assert torch.equal(vocabulary.ids(["go up and down"]), vocabulary.ids(["go up and"]))


def test_each_unknown_instruction_is_warned_of_once_and_an_untrained_part_never_warns():
    seen = SeenInstructions("the part", ["a", "b", "c", "d"])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            seen.check(["a", "x", "y", "x"])
            SeenInstructions("the part", []).check(["x"])
    assert [str(warning.message).split(";")[0] for warning in caught] == [
        "the part was never trained on the instruction 'x'",
        "the part was never trained on the instruction 'y'",
    ]
    assert "'a', 'b', 'c' ..." in str(caught[0].message)
