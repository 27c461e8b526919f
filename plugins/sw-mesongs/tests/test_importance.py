"""The score against sums by hand."""

import math

import pytest
import torch
from sw_gaussians.finetune.pruning import up_to

from sw_mesongs.importance import Importance


def score(rasterizer, model, cameras, **settings):
    return Importance(**settings).score(model, cameras, rasterizer)


def alphas(camera, depth, opacity, scale):
    """alpha of an isotropic Gaussian on the optical axis at every pixel centre, [H,W]; 0 where it is not blended."""
    variance = (camera.fx * scale / depth) ** 2 + 0.3
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    squared = (x - camera.cx) ** 2 + (y - camera.cy) ** 2
    alpha = (opacity * torch.exp(-squared.double() / (2 * variance))).clamp_max(0.99)
    return torch.where(alpha >= 1 / 255, alpha, 0.0)


def test_the_sum_is_over_alpha_of_every_pixel(rasterizer, make):
    camera = make.camera([0.0, 0.0, -4.0])
    model = make.gaussians([[0.0, 0.0, 0.0]], [0.8], [0.15])
    found = score(rasterizer, model, [camera])
    assert found.dtype == torch.float64
    assert float(found) == pytest.approx(float(alphas(camera, 4.0, 0.8, 0.15).sum()), rel=1e-4)
    assert float(score(rasterizer, model, [camera] * 3)) == pytest.approx(3 * float(found), rel=1e-6)


def test_an_opaque_one_of_a_pixel_has_099_and_the_one_behind_what_is_left(rasterizer, make):
    camera = make.camera([0.0, 0.0, -4.0], width=1, height=1)
    one = make.gaussians([[0.0, 0.0, 0.0]], [0.9999], [5.0])
    assert float(score(rasterizer, one, [camera])) == pytest.approx(0.99, rel=1e-5)
    # 0.98, since behind two of 0.99 the transmittance is 1e-4, where the pixel is finished.
    two = make.gaussians([[0.0, 0.0, 0.5], [0.0, 0.0, -0.5]], [0.98, 0.98], [5.0, 5.0])
    assert score(rasterizer, two, [camera]).tolist() == pytest.approx([0.98 * 0.02, 0.98], rel=1e-3)


def test_the_volume_counts_by_its_power(rasterizer, make):
    camera = make.camera([0.0, 0.0, -4.0])
    model = make.gaussians([[-0.8, 0.0, 0.0], [0.8, 0.0, 0.0]], [0.5, 0.5], [0.1, 0.2])
    plain = score(rasterizer, model, [camera], beta=0.0)
    for beta in (0.1, 0.5):
        ratio = score(rasterizer, model, [camera], beta=beta) / plain
        assert float(ratio[1] / ratio[0]) == pytest.approx(8**beta, rel=1e-6)
    assert torch.equal(score(rasterizer, model, [camera]), score(rasterizer, model, [camera], beta=0.1))


def test_what_no_view_shows_has_none_and_goes_at_any_share(rasterizer, make):
    model = make.gaussians([[0.0, 0.0, 0.0], [50.0, 0, 0], [0, 50.0, 0], [0.3, 0, 0]], [0.5] * 4, [0.1] * 4)
    found = score(rasterizer, model, [make.camera([0.0, 0.0, -4.0])])
    assert found[1:3].tolist() == [0, 0]
    assert up_to(found, 0.0).tolist() == [False, True, True, False]


def test_the_published_rule_counts_one_more():
    assert int(up_to(torch.arange(5.0), 0.5).sum()) == 3


def test_only_gaussians_are_scored(rasterizer):
    with pytest.raises(TypeError, match="mesongs"):
        Importance().score(torch.nn.Linear(1, 1), [], rasterizer)


def test_any_method_finds_it_by_name(plugins):
    pruner = plugins.pruners.load("mesongs")(beta=0.03)
    assert pruner.uses_statistics is False
    assert pruner.beta == 0.03


@pytest.mark.cuda
def test_a_gpu_gives_the_scores_of_the_cpu(plugins, rasterizer, make):
    from splatwizard_core.rendering.negotiation import NegotiatedRasterizer

    model = make.cloud(2000)
    cameras = [make.camera(eye, 320, 240) for eye in ([0.0, 0.0, -4.0], [3.0, 0.5, -3.0])]
    here = score(rasterizer, model, cameras)
    there = score(NegotiatedRasterizer(plugins, device="cuda"), model.cuda(), cameras)
    assert torch.allclose(there.cpu(), here, rtol=1e-4, atol=math.sqrt(1e-6))
