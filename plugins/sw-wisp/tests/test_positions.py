"""Root cube, cells and levels."""

import math

import torch
from sw_wisp.positions import Root, levels_by_cost, levels_by_size
from sw_wisp.shape import log_covariance


def test_every_splat_lies_in_its_cell() -> None:
    means = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * 7
    root = Root.around(means)
    for level in (3, 10, 18):
        levels = torch.full((500,), level)
        cells = root.cells(means, levels)
        assert cells.min() >= 0
        assert cells.max() < 2**level
        off = (root.centres(cells, levels) - means.double()).abs()
        assert off.max() <= root.edge * 2.0**-level / 2 * (1 + 1e-9)


def test_cell_of_a_centre_is_the_cell() -> None:
    root = Root(torch.tensor([-3.0, 2.0, 100.0], dtype=torch.float64), 37.0)
    levels = torch.randint(3, 19, (1_000,), generator=torch.Generator().manual_seed(0))
    cells = (torch.rand(1_000, 3, dtype=torch.float64) * 2.0 ** levels[:, None].double()).floor().long()
    assert torch.equal(root.cells(root.centres(cells, levels), levels), cells)


def test_cells_are_at_most_eta_middle_scales_wide() -> None:
    scales = torch.tensor([[0.01, 0.1, 5.0], [1.0, 1.0, 1.0], [1e-9, 1e-9, 1.0], [50.0, 60.0, 70.0]])
    shape, size = log_covariance(scales.log(), torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1))
    levels = levels_by_size(shape, size, 100.0, 0.5, (3, 18))
    assert levels.tolist() == [math.ceil(math.log2(2000)), math.ceil(math.log2(200)), 18, 3]


def test_level_by_cost_is_the_cheapest() -> None:
    costs = torch.logspace(-6, 6, 40, dtype=torch.float64)
    edge, price = 10.0, 1e-3
    found = levels_by_cost(costs, price, edge, 0.5, (0, 18))
    total = torch.stack([costs * (edge * 2.0**-k) ** 2 / 12 + 3 * k * price for k in range(19)])
    # The rounded optimum of the continuous sum: at most one level beside the discrete one, and hardly dearer.
    assert (found - total.argmin(dim=0)).abs().max() <= 1
    at = total.gather(0, found[None])[0]
    assert ((at - total.amin(dim=0)) / price).max() < 0.4
