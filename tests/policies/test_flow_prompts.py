"""What flow-matching policies read of an instruction."""

from __future__ import annotations

import numpy as np
import torch
from lerobot_folders import tokenizer

from worldenv_trl.policies.flow_prompts import Prompts, state_digits


def read(ids, valid) -> list[str]:
    made = tokenizer(True)
    return ["".join(made.id_to_token(int(each)) for each in row[seen]) for row, seen in zip(ids, valid, strict=True)]


def test_smolvla_and_pi0_read_one_line():
    for kind in ("smolvla", "pi0"):
        ids, valid = Prompts(kind, tokenizer(True), 48)(["open it", "put it down\n"], torch.zeros(2, 8))
        assert read(ids, valid) == ["<bos>open it\n", "<bos>put it down\n"]
        assert ids.shape == (2, 13) and not ids[0, 9:].any()  # padded behind


def test_pi05_reads_proprioception_as_digits_and_no_underscores():
    state = torch.tensor([[-1.0, 0.0, 0.999], [-9.0, 9.0, 0.5]])
    ids, valid = Prompts("pi05", tokenizer(False), 200)([" open_the\ndrawer ", "stop"], state)
    assert read(ids, valid) == [
        "Task: open the drawer, State: 0 128 255;\nAction: ",
        "Task: stop, State: -1 255 192;\nAction: ",
    ]


def test_what_is_too_long_is_cut_behind():
    ids, valid = Prompts("pi0", tokenizer(True), 5)(["open the drawer"], torch.zeros(1, 8))
    assert read(ids, valid) == ["<bos>open"]


def test_digits_are_numpys():
    state = torch.cat([torch.linspace(-1.3, 1.3, 999), torch.arange(-128, 129) / 128])[:, None]
    wanted = np.digitize(state.numpy(), np.linspace(-1, 1, 257)[:-1]) - 1
    assert state_digits(state) == wanted.tolist()


def test_a_tokenizer_that_was_saved_with_padding_pads_and_cuts_nothing():
    made = tokenizer(True)
    made.enable_padding(length=40)
    made.enable_truncation(4)
    ids, valid = Prompts("pi0", made, 48)(["open the drawer"], torch.zeros(1, 8))
    assert read(ids, valid) == ["<bos>open the drawer\n"]
