"""Root cube, cells and levels."""

import torch

from sw_wisp.positions import levels_by_cost, middle_scales
from sw_wisp.shape import log_covariance


def test_middle_scale_is_the_second_of_three() -> None:
    scales = torch.tensor([[0.01, 0.1, 5.0], [1.0, 1.0, 1.0], [70.0, 50.0, 60.0]])
    shape, size = log_covariance(scales.log(), torch.tensor([[0.3, -0.2, 0.8, 0.5]]).repeat(3, 1))
    assert torch.allclose(middle_scales(shape, size), torch.tensor([0.1, 1.0, 60.0]), rtol=1e-5)


def test_level_by_cost_is_the_cheapest() -> None:
    costs = torch.logspace(-6, 6, 40, dtype=torch.float64)
    edge, price = 10.0, 1e-3
    found = levels_by_cost(costs, price, edge, 0.5)
    total = torch.stack([costs * (edge * 2.0**-k) ** 2 / 12 + 3 * k * price for k in range(3, 19)])
    # The rounded optimum of the continuous sum: at most one level beside the discrete one, and hardly dearer.
    assert (found - 3 - total.argmin(dim=0)).abs().max() <= 1
    at = total.gather(0, found[None] - 3)[0]
    assert ((at - total.amin(dim=0)) / price).max() < 0.4
