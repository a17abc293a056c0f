from __future__ import annotations

import math

import pytest
import torch

from worldenv_trl.metrics import classification


def test_figures_of_a_case_counted_by_hand():
    probability = torch.tensor([0.9, 0.8, 0.6, 0.4, 0.3, 0.1])
    label = torch.tensor([True, False, True, True, False, False])
    figures = classification(probability, label)  # 2 of 3 predictions right, 2 of 3 truths found
    assert (figures.precision, figures.recall, figures.f1) == pytest.approx((2 / 3, 2 / 3, 2 / 3))
    strict = classification(probability, label, threshold=0.85)
    assert (strict.precision, strict.recall, strict.f1) == pytest.approx((1.0, 1 / 3, 0.5))


def test_auc_is_the_share_of_pairs_ranked_right_with_ties_counted_half():
    generator = torch.Generator().manual_seed(0)
    probability = torch.randint(5, (60,), generator=generator) / 5
    label = torch.rand(60, generator=generator) < 0.3 + 0.4 * probability
    pairs = [(p > q) + 0.5 * (p == q) for p in probability[label].tolist() for q in probability[~label].tolist()]
    assert classification(probability, label).auc == pytest.approx(sum(pairs) / len(pairs))


def test_nothing_predicted_or_nothing_true_gives_zero_and_one_class_has_no_auc():
    none = classification(torch.zeros(4), torch.tensor([True, False, True, False]))
    assert (none.precision, none.recall, none.f1) == (0, 0, 0)
    only = classification(torch.ones(4), torch.zeros(4, dtype=torch.bool))
    assert (only.precision, only.recall, only.f1) == (0, 0, 0) and math.isnan(only.auc)


@pytest.mark.parametrize(("probability", "label"), [(torch.rand(3), torch.ones(4)), (torch.rand(0), torch.ones(0))])
def test_shapes_that_do_not_match_are_refused(probability, label):
    with pytest.raises(ValueError, match="must be"):
        classification(probability, label.bool())
