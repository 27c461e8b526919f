"""Learning rates that fall at the end: the factor at each step, and which groups it reaches."""

import pytest
import torch
from sw_gaussians.learning_rate_decay import SettleLearningRates

from splatwizard_core.api import GaussianModel, ParamGroup, SplatOptimizer


def test_rates_fall_log_linearly_between_two_steps():
    settle = SettleLearningRates({}, first=100, last=300, factor=0.01)
    assert [settle.share(step) for step in (1, 100, 200, 300, 400)] == pytest.approx([1, 1, 0.1, 0.01, 0.01])


def test_given_rates_are_scaled_whatever_the_optimizer_has_and_others_left_alone():
    model = GaussianModel(
        torch.zeros(1, 3),
        torch.zeros(1, 1, 3),
        torch.zeros(1, 3, 3),
        torch.zeros(1),
        torch.zeros(1, 3),
        torch.ones(1, 4),
    )
    optimizer = SplatOptimizer(model, [ParamGroup("means", lr=3.0), ParamGroup("quats", lr=2.0)])
    settle = SettleLearningRates({"quats": 2.0, "color": 1.0}, first=0, last=10, factor=0.1)
    for step in (5, 10):  # twice: the second call does not begin with what the first left
        settle(optimizer, step)
    assert (optimizer.lr("means"), optimizer.lr("quats")) == (3.0, pytest.approx(0.2))


@pytest.mark.parametrize(
    ("first", "last", "factor", "said"), [(0, 9, 0.0, "factor"), (0, 9, 1.1, "factor"), (9, 9, 0.5, "9")]
)
def test_settings_outside_their_range_are_refused(first, last, factor, said):
    with pytest.raises(ValueError, match=said):
        SettleLearningRates({}, first=first, last=last, factor=factor)
