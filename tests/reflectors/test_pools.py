"""Rows that are drawn as often of each pool."""

from __future__ import annotations

import pytest
import torch

from worldenv_trl.reflectors.pools import drawn, share


@pytest.mark.parametrize(("pools", "count", "each"), [(1, 64, 64), (6, 64, 10), (20, 64, 3), (80, 64, 1)])
def test_a_batch_has_as_many_rows_of_each_pool_and_of_each_one_at_least(pools, count, each):
    rows = [torch.arange(5) + 10 * number for number in range(pools)]
    assert share(rows, count) == each
    found = drawn(rows, count)
    assert (found // 10).bincount(minlength=pools).tolist() == [each] * pools
    assert (found % 10).max() < 5
