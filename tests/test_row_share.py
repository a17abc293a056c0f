"""Processes that share a batch draw together what one would draw for all of it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch.distributions import Laplace

from worldenv_trl.policies import IndependentLaplace, random_shift
from worldenv_trl.row_share import own_items, own_rows, row_share


def together(draw: Callable[[int], torch.Tensor], size: int = 3) -> torch.Tensor:
    """What ``size`` processes draw, the first of them first; they begin alike and end alike."""
    parts, following = [], set()
    for rank in range(size):
        torch.manual_seed(0)
        with row_share(rank, size):
            parts.append(draw(rank))
        following.add(float(torch.rand(())))
    assert len(following) == 1
    return torch.cat(parts)


def test_rows_of_all_are_those_of_one():
    torch.manual_seed(0)
    expected = torch.rand(6)
    assert torch.equal(together(lambda _: own_rows(torch.rand, 2)), expected)


def test_items_are_shared_in_their_order():
    with row_share(1, 2):
        assert own_items(lambda count: list(range(count)), 3) == [3, 4, 5]
    assert own_items(lambda count: list(range(count)), 3) == [0, 1, 2]


def test_a_share_ends_even_if_something_fails():
    with pytest.raises(KeyError), row_share(1, 2):
        raise KeyError
    assert len(own_rows(torch.rand, 2)) == 2 and own_items(range, 2)[0] == 0


@pytest.mark.parametrize(("rank", "size"), [(2, 2), (-1, 2), (0, 0)])
def test_a_rank_that_does_not_exist_is_refused(rank, size):
    with pytest.raises(ValueError, match=rf"rank must be in \[0, {size}\), got {rank}"), row_share(rank, size):
        pass


@pytest.mark.parametrize("scale", [torch.rand(7) + 0.1, torch.rand(6, 2, 4, 7) + 0.1])
def test_actions_of_all_are_those_of_one(scale):
    loc = torch.randn(6, 2, 4, 7)
    torch.manual_seed(0)
    expected = Laplace(loc, scale).sample()

    def act(rank: int) -> torch.Tensor:
        rows = slice(2 * rank, 2 * rank + 2)
        return IndependentLaplace(loc[rows], scale[rows] if scale.ndim > 1 else scale).sample()

    assert torch.equal(together(act), expected)


def test_samples_are_differentiable_and_those_of_torch():
    loc, scale = torch.zeros(3, 7, requires_grad=True), torch.ones(3, 7, requires_grad=True)
    torch.manual_seed(0)
    expected = Laplace(loc, scale).rsample()
    torch.manual_seed(0)
    found = IndependentLaplace(loc, scale).rsample()
    gradients = [torch.autograd.grad(values.sum(), (loc, scale)) for values in (found, expected)]
    assert torch.equal(found, expected) and all(map(torch.equal, *gradients))
    assert IndependentLaplace(loc, scale).rsample(torch.Size([2])).shape == (2, 3, 7)


def test_images_of_all_are_shifted_like_those_of_one():
    images = torch.randint(256, (6, 3, 16, 16), dtype=torch.uint8)
    torch.manual_seed(0)
    expected = random_shift(images, 3)
    assert torch.equal(together(lambda rank: random_shift(images[2 * rank : 2 * rank + 2], 3)), expected)
