"""Fewer Gaussians: their number, what they weigh, and that merging after pruning is better than pruning alone."""

import pytest
import torch
from sw_compress import reducing
from sw_compress.pruning import Pruning
from sw_compress.quality import Pictures
from sw_compress.reducing import Reduction
from sw_compress.rows import IMPORTANCE
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.api import Camera, GaussianModel, RasterOptions
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

RASTERIZER = StandardRasterizer() if MODULE.available() is None else ReferenceRasterizer()
ALPHA = RasterOptions(alpha=True)
UP = torch.tensor([0.0, -1.0, 0.0])
CAMERAS = [
    Camera.look_at(torch.tensor(eye), torch.zeros(3), UP, width=48, height=48, fov_x=0.8)
    for eye in ((0.1, 0.2, -3.0), (2.9, -0.4, 0.3), (-1.5, 0.5, 2.4))
]


@pytest.fixture
def reduction(ball) -> Reduction:
    model = ball(300, degree=0)
    model.sh_dc[:] = model.means[:, None].abs()  # neighbours look alike, as those of a trained scene do
    return Reduction(model, Pruning(model, CAMERAS, RASTERIZER, keeps_unseen=False))


def error(model: GaussianModel, source: GaussianModel) -> float:
    drawn = [[RASTERIZER.render(each.gaussians(c, RASTERIZER), c, RasterOptions()).image for c in CAMERAS]
             for each in (model, source)]  # fmt: skip
    return sum(float((a - b).square().sum()) for a, b in zip(*drawn, strict=True))


@pytest.mark.parametrize("count", [299, 150, 20, 1])
def test_as_many_stay_as_are_asked_for(reduction: Reduction, count: int):
    part = reduction.part(count)
    assert part.num_rows == count
    assert len(getattr(part, IMPORTANCE)) == count
    assert 0 <= reduction.pruned(count) <= 300 - count


def test_the_weight_of_what_merged_is_the_sum(reduction: Reduction, monkeypatch):
    monkeypatch.setattr(reducing, "POWERS", (0.0,))  # nothing is removed
    assert reduction.pruned(100) == 0
    weights = reduction.pruning.importance
    floor = reducing.FAINTEST_WEIGHT * float(weights[weights > 0].median())
    assert float(getattr(reduction.part(100), IMPORTANCE).sum()) == pytest.approx(
        float(weights.clamp_min(floor).sum()), rel=1e-4
    )


def test_what_is_better_is_chosen_by_pictures(reduction: Reduction):
    alone = error(reduction.part(100), reduction.model)
    reduction = Reduction(reduction.model, reduction.pruning, Pictures(reduction.model, CAMERAS, RASTERIZER, ALPHA))
    assert error(reduction.part(100), reduction.model) < 0.8 * alone
    assert reduction.pruned(100) < 200
    assert reduction.pruned(299) == 1  # one removal in place of a merge


def test_what_no_camera_shows_merges_as_if_it_were_of_middling_weight(ball):
    model = ball(100, degree=0)
    model.means[:50] += 500.0
    reduction = Reduction(model, Pruning(model, CAMERAS, RASTERIZER, keeps_unseen=True))
    far = (reduction.part(60).means[:, 0] > 250).sum()
    assert 20 <= int(far) <= 50
