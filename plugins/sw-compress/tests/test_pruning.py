"""Order in which Gaussians go, those that stay, and that fewer are always a part of more."""

import pytest
import torch
from sw_compress.pruning import AT_ONCE, NEIGHBOURS, ROUND_SHARE, Pruning
from sw_compress.rows import select
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.api import Camera, GaussianModel, RasterOptions
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

RASTERIZER = StandardRasterizer() if MODULE.available() is None else ReferenceRasterizer()


def looking(*eye: float) -> Camera:
    up = torch.tensor([0.0, -1.0, 0.0])
    return Camera.look_at(torch.tensor(eye), torch.zeros(3), up, width=48, height=48, fov_x=0.8)


CAMERAS = [looking(0.1, 0.2, -3.0), looking(0.5, -0.4, -2.8)]
"""One side alone."""


@pytest.fixture(scope="module")
def model(ball) -> GaussianModel:

    found = ball(200, degree=0)
    found.opacity_logits.clamp_(min=1.0)
    return found


def pictures(model: GaussianModel) -> list[torch.Tensor]:
    return [RASTERIZER.render(model.gaussians(c, RASTERIZER), c, RasterOptions()).image for c in CAMERAS]


def change(model: GaussianModel, rows: torch.Tensor) -> float:
    pairs = zip(pictures(model), pictures(select(model, rows)), strict=True)
    return sum(float((a - b).square().sum()) for a, b in pairs)


def test_fewer_are_a_part_of_more(model: GaussianModel):
    pruning = Pruning(model, CAMERAS, RASTERIZER, keeps_unseen=False)
    small, large = pruning.rows(60), pruning.rows(150)
    assert (len(small), len(large)) == (60, 150)
    assert set(small.tolist()) < set(large.tolist())
    assert (small.diff() > 0).all()


def test_what_goes_changes_less_than_what_goes_by_chance(model: GaussianModel):
    kept = Pruning(model, CAMERAS, RASTERIZER, keeps_unseen=False).rows(100)
    chance = torch.randperm(200, generator=torch.Generator().manual_seed(0))[:100].sort().values
    assert change(model, kept) < 0.1 * change(model, chance)


def test_what_no_camera_shows_stays(model: GaussianModel):
    far = select(model, torch.arange(200))
    far.means[:50, 2] += 100.0  # behind the rest
    far.means[:50, 0] += 500.0  # and beside the pictures
    hidden = far.means[:, 0] > 400
    pruning = Pruning(far, CAMERAS, RASTERIZER)
    kept = pruning.rows(10)
    assert hidden[kept].sum() == 50
    assert int(pruning.unseen.sum()) >= 50
    assert len(kept) > 50 - 1
    assert len(Pruning(far, CAMERAS, RASTERIZER, keeps_unseen=False).rows(10)) == 10


def test_what_no_camera_shows_goes_first_where_it_may(model: GaussianModel):
    far = select(model, torch.arange(200))
    far.means[:80, 0] += 500.0
    pruning = Pruning(far, CAMERAS, RASTERIZER, keeps_unseen=False)
    assert pruning.rows(120).tolist() == list(range(80, 200))


def test_a_round_takes_few_and_few_neighbours(model: GaussianModel):
    pruning = Pruning(model, CAMERAS, RASTERIZER, keeps_unseen=False)
    pruning.rows(199)
    before = len(pruning._left)
    assert pruning._round(10**6)
    gone = before - len(pruning._left)
    assert 0 < gone <= ROUND_SHARE * before
    assert gone <= AT_ONCE * -(-before // NEIGHBOURS)


def test_as_many_as_there_are_is_all(model: GaussianModel):
    pruning = Pruning(model, [], RASTERIZER)
    assert pruning.rows(200).tolist() == list(range(200))
