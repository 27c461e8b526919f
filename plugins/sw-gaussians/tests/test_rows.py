"""Parts of a model."""

import pytest
import torch
from sw_gaussians.rows import select
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.api import GaussianModel, PointCloud


@pytest.fixture
def model() -> GaussianModel:
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    found = gaussians_from_points(PointCloud(points, points), max_sh_degree=1)
    found.origin = {"antialiased": True}
    found.active_sh_degree = 0
    return found


@pytest.mark.parametrize("rows", [torch.tensor([4, 0]), torch.tensor([True, False, False, False, True, False])])
def test_a_part_has_the_rows_in_their_order_and_shares_nothing(model, rows):
    part = select(model, rows)
    order = rows if rows.dtype == torch.int64 else rows.nonzero().squeeze(1)
    for name in model.RAW:
        assert torch.equal(getattr(part, name), getattr(model, name)[order])
        assert not getattr(part, name).requires_grad
    assert (part.origin, part.active_sh_degree, part.max_sh_degree) == (model.origin, 0, 1)
    part.means.zero_()
    assert model.means.all()
