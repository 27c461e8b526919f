"""The oracle's Fisher blocks against central differences of what it draws."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import RasterCase, draw_scene, margin_scene

from splatwizard_core.api import CapabilityError, RasterOptions

REFERENCE = ReferenceRasterizer()
CASE = RasterCase("fisher", n=3, width=6, height=5, spread=0.5, scale=(0.3, 0.6))
STEP = 1e-5


def by_differences(g, cam, opt):
    """F [N,6,6] from central differences of the image by the mean and the log scale of one Gaussian after another."""
    blocks = []
    for n in range(len(g)):
        slopes = []
        for k in range(6):
            images = []
            for sign in (STEP, -STEP):
                means, scales = g.means.clone(), g.scales.clone()
                if k < 3:
                    means[n, k] += sign
                else:
                    scales[n, k - 3] *= torch.exp(torch.tensor(sign, dtype=torch.float64))
                images.append(REFERENCE.render(replace(g, means=means, scales=scales), cam, opt).image)
            slopes.append((images[0] - images[1]).flatten() / (2 * STEP))
        slope = torch.stack(slopes)
        blocks.append(slope @ slope.T)
    return torch.stack(blocks)


@pytest.mark.parametrize("changes", [{}, {"antialias": True}, {"background": torch.tensor([0.2, 0.9, 0.5])}], ids=str)
def test_fisher_blocks_equal_central_differences(changes):
    g, cam = margin_scene(CASE, 1)
    opt = RasterOptions(**changes)
    found = REFERENCE.render(g, cam, replace(opt, fisher=True)).fisher
    first, second = torch.triu_indices(6, 6)
    expected = by_differences(g, cam, opt)[:, first, second]
    scale = expected.abs().amax(dim=1, keepdim=True)
    assert bool((scale > 0).all())
    torch.testing.assert_close(found / scale, expected / scale, rtol=1e-5, atol=1e-6)


def test_gathered_scales_have_the_blocks_of_dense_ones():
    g, cam = draw_scene(replace(CASE, geometry="indexed"), 3)
    dense = replace(
        g,
        scales=g.scales[g.geom_indices] * g.scale_factors[:, None],
        quats=g.quats[g.geom_indices],
        geom_indices=None,
        scale_factors=None,
    )
    opt = RasterOptions(fisher=True)
    torch.testing.assert_close(REFERENCE.render(g, cam, opt).fisher, REFERENCE.render(dense, cam, opt).fisher)


def test_blocks_add_up_over_views_and_touch_no_gradient():
    g, cam = draw_scene(CASE, 2)
    g.means.requires_grad_()
    second = cam.resized(4, 3)
    opt = RasterOptions(fisher=True)
    total = REFERENCE.accumulate(g, [cam, second], opt)
    assert total.scores == {}
    with torch.no_grad():
        views = [REFERENCE.render(g, c, opt).fisher for c in (cam, second)]
    torch.testing.assert_close(total.fisher, views[0] + views[1])
    assert g.means.grad is None
    assert not total.fisher.requires_grad


def test_covariances_have_no_log_scale():
    g, cam = draw_scene(replace(CASE, geometry="cov3d"), 1)
    with pytest.raises(CapabilityError, match="COV3D and FISHER"):
        REFERENCE.render(g, cam, RasterOptions(fisher=True))
