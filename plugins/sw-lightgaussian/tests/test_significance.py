"""The significance score against sums by hand, and what it must not depend on."""

import math

import pytest
import torch
from sw_gaussians.finetune.pruning import lowest, removal_count
from sw_gaussians.finetune.volume import volume_factor

from splatwizard_core.gaussians.model import GaussianModel
from sw_lightgaussian.significance import Significance, tiles_under


def alphas(camera, depth, opacity, scale):
    """alpha of an isotropic Gaussian on the optical axis at every pixel centre, [H,W]."""
    variance = (camera.fx * scale / depth) ** 2 + 0.3
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    squared = (x - camera.cx) ** 2 + (y - camera.cy) ** 2
    return opacity * torch.exp(-squared.double() / (2 * variance))


def score(rasterizer, model, cameras, **settings):
    return Significance(**settings).score(model, cameras, rasterizer)


def test_one_gaussian_catches_its_opacity_in_every_pixel_that_it_touches(rasterizer, make):
    camera = make.camera([0.0, 0.0, -4.0])
    model = make.gaussians([[0.0, 0.0, 0.0]], [0.8], [0.15])
    hits = int((alphas(camera, 4.0, 0.8, 0.15) >= 1 / 255).sum())
    assert 20 < hits < camera.width * camera.height
    assert score(rasterizer, model, [camera], kind="count").tolist() == [hits]
    found = score(rasterizer, model, [camera], kind="important_score")
    assert found.dtype == torch.float64
    assert float(found) == pytest.approx(0.8 * hits, rel=1e-5)  # of the opacity, not of alpha
    assert float(score(rasterizer, model, [camera])) == pytest.approx(0.8 * hits, rel=1e-5)
    assert float(score(rasterizer, model, [camera], kind="opacity")) == pytest.approx(0.8, rel=1e-6)
    largest = score(rasterizer, model, [camera], kind="max_v_important_score")
    assert float(largest) == pytest.approx(0.8 * hits * 0.15, rel=1e-5)


def test_a_disc_of_pixels_touches_the_tiles_that_it_covers_wherever_it_lies():
    # A disc of one pixel is 1.13 wide.
    assert tiles_under(torch.tensor([0.0, 1.0])).tolist() == pytest.approx([0, 1], abs=0.02)
    for width in (3, 20):
        places = [len({(x + i) // 16 for i in range(width)}) for x in range(16)]
        expected = (sum(places) / 16) ** 2
        assert float(tiles_under(torch.tensor([math.pi / 4 * width**2]).double())) == pytest.approx(expected)


def test_counted_by_tiles_a_wide_gaussian_is_worth_less_than_its_pixels(rasterizer, make):
    camera = make.camera([0.0, 0.0, -4.0])
    small, wide = (make.gaussians([[0.0, 0.0, 0.0]], [0.8], [scale]) for scale in (0.01, 0.3))
    for model in (small, wide):
        hits = score(rasterizer, model, [camera], kind="count")
        tiles = score(rasterizer, model, [camera, camera], kind="v_tile_score", v_pow=0.0)
        torch.testing.assert_close(tiles, 2 * 0.8 * tiles_under(hits), rtol=1e-5, atol=0)
        assert float(tiles_under(hits)) < float(hits)
    ratios = [
        float(score(rasterizer, wide, [camera], kind=kind) / score(rasterizer, small, [camera], kind=kind))
        for kind in ("v_important_score", "v_tile_score")
    ]
    assert ratios[1] < ratios[0] / 5


def test_what_stands_behind_catches_what_is_let_through(rasterizer, make):
    camera = make.camera([0.0, 0.0, -4.0])
    model = make.gaussians([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [0.6, 0.6], [0.15, 0.15])
    alpha = alphas(camera, 4.0, 0.6, 0.15)
    touched = alpha >= 1 / 255
    found = score(rasterizer, model, [camera], kind="important_score")
    behind = (0.6 * (1 - alpha) * touched).sum()
    assert sorted(found.tolist()) == pytest.approx([float(behind), 0.6 * int(touched.sum())], rel=1e-5)
    early = score(rasterizer, model, [camera], kind="important_score", use_transmittance=False)
    assert early.tolist() == pytest.approx([0.6 * int(touched.sum())] * 2, rel=1e-5)


def test_what_is_hidden_or_beside_the_picture_goes_first(rasterizer, make):
    wall = [[0.0, 0.0, -0.1 * i] for i in range(12)]
    model = make.gaussians([*wall, [0.0, 0.0, 2.0], [50.0, 0.0, 0.0]], [0.99] * 14, [2.0] * 12 + [0.01, 0.5])
    found = score(rasterizer, model, [make.camera([0.0, 0.0, -4.0])])
    assert found[-2:].tolist() == [-math.inf] * 2
    unseen = torch.isinf(found)  # and what the wall's front hides of it
    assert torch.equal(lowest(found, int(unseen.sum())), unseen)
    assert bool((found[~unseen] > 0).all())


def test_views_add_up_and_neither_their_order_nor_that_of_the_rows_matters(rasterizer, make):
    model = make.cloud(200)
    cameras = [make.camera(eye) for eye in ([0.0, 0.0, -4.0], [3.0, 0.5, -3.0], [-2.0, 2.0, 3.0])]
    settings = {"kind": "important_score"}
    together = score(rasterizer, model, cameras, **settings)
    each = [score(rasterizer, model, [camera], **settings).clamp_min(0) for camera in cameras]
    assert together.clamp_min(0).tolist() == pytest.approx(sum(each).tolist(), rel=1e-12)
    assert torch.equal(score(rasterizer, model, cameras, **settings), together)
    assert torch.equal(score(rasterizer, model, cameras[::-1], **settings), together)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    shuffled = GaussianModel(*(getattr(model, n).detach()[order] for n in GaussianModel.ROWS[:6]))
    assert score(rasterizer, shuffled, cameras, **settings).tolist() == pytest.approx(
        together[order].tolist(), rel=1e-5
    )


def test_scoring_leaves_model_and_gradients_alone(rasterizer, make):
    model = make.cloud(50)
    model.means.sum().backward()
    before, gradient = model.digest(), model.means.grad.clone()
    score(rasterizer, model, [make.camera([0.0, 0.0, -4.0])])
    assert model.digest() == before
    assert torch.equal(model.means.grad, gradient)


def test_the_scale_of_the_scene_ranks_no_volume_anew():
    log_scales = torch.randn(500, 3, dtype=torch.float64)
    for norm in ("unclamped", "paper_clamp"):
        a, b = volume_factor(log_scales, 0.1, norm), volume_factor(log_scales + 1.7, 0.1, norm)
        assert a.tolist() == pytest.approx(b.tolist(), rel=1e-9)


def test_the_references_are_the_tenth_and_the_ninetieth_percentile():
    log_scales = torch.zeros(1000, 3, dtype=torch.float64)
    log_scales[:, 0] = torch.linspace(-4, 2, 1000, dtype=torch.float64)[torch.randperm(1000)]
    unclamped = volume_factor(log_scales, 0.1)
    assert int((unclamped >= 1).sum()) == 901
    assert float(unclamped.max() / unclamped.min()) == pytest.approx(math.exp(0.1 * 6))
    clamped = volume_factor(log_scales, 0.1, "paper_clamp")
    assert float(clamped.max()) == 1
    assert int((clamped == 1).sum()) == 101  # the element itself, and the 10 % above it
    assert bool((clamped[log_scales[:, 0].argsort()].diff() >= 0).all())


def test_no_power_no_volume(rasterizer, make):
    model, camera = make.cloud(80), make.camera([0.0, 0.0, -4.0])
    plain = score(rasterizer, model, [camera], kind="important_score")
    assert torch.equal(score(rasterizer, model, [camera], v_pow=0.0), plain)
    assert not torch.equal(score(rasterizer, model, [camera]), plain)


@pytest.mark.parametrize("n", [0, 1])
def test_hardly_any_volume(n):
    for norm in ("unclamped", "paper_clamp"):
        assert volume_factor(torch.full((n, 3), -200.0, dtype=torch.float64), 0.1, norm).tolist() == [1.0] * n


def test_the_published_share_of_a_thousand():
    assert 1000 - removal_count(1000, 0.66) == 340


def test_any_method_finds_it_by_name(plugins):
    pruner = plugins.pruners.load("lightgaussian")()
    assert pruner.uses_statistics is False
    assert pruner.v_pow == 0.1


@pytest.mark.cuda
@pytest.mark.parametrize("kind", ["v_important_score", "v_tile_score"])
def test_a_gpu_gives_the_scores_of_the_cpu(plugins, rasterizer, make, kind):
    from splatwizard_core.rendering.negotiation import NegotiatedRasterizer

    model = make.cloud(2000)
    cameras = [make.camera(eye, 320, 240) for eye in ([0.0, 0.0, -4.0], [3.0, 0.5, -3.0])]
    on_cpu = score(rasterizer, model, cameras, kind=kind)
    on_gpu = score(NegotiatedRasterizer(plugins, device="cuda"), model.cuda(), cameras, kind=kind)
    assert on_gpu.is_cuda
    assert on_gpu.cpu().tolist() == pytest.approx(on_cpu.tolist(), rel=1e-5)
