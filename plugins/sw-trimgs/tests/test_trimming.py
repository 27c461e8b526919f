"""Scores below a quantile, and the effect of a trim on the rows."""

import pytest
import torch

from sw_trimgs.trimming import quantile, trimmed


def test_a_tenth_of_ten_distinct_scores_is_one():
    scores = torch.tensor([7.0, 3, 9, 1, 5, 8, 2, 6, 4, 10])
    assert trimmed(scores, 0.1, unseen=False).nonzero().flatten().tolist() == [3]


def test_of_equal_scores_none_goes():
    assert not trimmed(torch.ones(10), 0.1, unseen=True).any()


@pytest.mark.parametrize("level", [0.0, 0.1, 0.37, 0.5, 1.0])
@pytest.mark.parametrize("n", [1, 2, 11, 100])
def test_the_quantile_is_that_of_torch(n, level):
    values = torch.rand(n, generator=torch.Generator().manual_seed(n))
    assert float(quantile(values, level)) == pytest.approx(float(torch.quantile(values, level)), abs=1e-6)


def test_where_many_are_unseen_the_published_rule_removes_nothing():
    scores = torch.tensor([-torch.inf, -torch.inf, -torch.inf, 0.2, 0.3, 0.4])
    assert not trimmed(scores, 0.1, unseen=False).any()
    assert trimmed(scores, 0.1, unseen=True).tolist() == [True, True, True, False, False, False]


def test_where_few_are_unseen_both_rules_remove_them():
    scores = torch.tensor([-torch.inf, *torch.linspace(0.1, 1, 19).tolist()])
    for unseen in (False, True):
        assert trimmed(scores, 0.1, unseen=unseen)[0]
    assert int(trimmed(scores, 0.1, unseen=False).sum()) == 2
