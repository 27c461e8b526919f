import numpy as np
import pytest
import torch

from sw_wisp import rate
from sw_wisp.nested import index_bits, table_levels


@pytest.mark.parametrize("level", [0.0, 10.0, 30.3, 50.0, 63.0])
def test_estimate_matches_the_tables(level):
    """Noisy residuals in training cost what their rounded ones cost in the file."""
    sigma = float(rate.sigma_of(torch.tensor(level), 1.0))
    r = torch.from_numpy(np.random.default_rng(0).normal(0, sigma, 200_000))
    exact = index_bits(table_levels(np.full(len(r), round(4096 * level))), r.round().numpy().astype(int)).mean()
    assert float(rate.bits(r.round(), sigma, 1.0).mean()) == pytest.approx(exact, rel=0.02, abs=1e-3)


def test_levels_and_scales_are_inverse():
    levels = torch.linspace(0, 63, 20)
    assert torch.allclose(rate.level_of(rate.sigma_of(levels, 0.4), 0.4), levels, atol=1e-3)


def test_the_clamp_lets_only_gradients_that_lead_back_pass():
    outside = [(-1.0, -1.0, True), (-1.0, 1.0, False), (70.0, 1.0, True), (70.0, -1.0, False)]
    for x, grad, passes in [*outside, (5.0, 1.0, True)]:
        at = torch.tensor(x, requires_grad=True)
        rate.inward_clamp(at, 0.0, 63.0).backward(torch.tensor(grad))
        assert float(at.grad) == (grad if passes else 0)


def test_an_outlier_is_still_pulled_inwards():
    r = torch.tensor([40.0], requires_grad=True, dtype=torch.float64)
    sigma = torch.tensor([2.0], requires_grad=True, dtype=torch.float64)
    found = rate.bits(r, sigma, 1.0)
    assert found.item() == 16
    found.sum().backward()
    assert float(r.grad) > 0 or float(sigma.grad) < 0
