"""The losses of surfaces on a few surfels that the rasterizers draw, and on maps worked out by hand."""

import math

import pytest
import torch
from sw_gaussians.native import GAUSSIANS
from sw_gaussians.surface_losses import (
    add_surface_losses,
    distortion_loss,
    maps_for,
    normal_disagreement,
)
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.errors import ConfigError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions, RenderResult
from splatwizard_core.scene.camera import Camera
from splatwizard_core.training.losses import LossPack

BOTH = maps_for(distortion=True, normals=True, depth_ratio=0.5)


@pytest.fixture(scope="module")
def rasterizer() -> NegotiatedRasterizer:
    return NegotiatedRasterizer(load_plugins(), device="cpu")


def camera() -> Camera:
    """At the origin, looking along z; pixel (8, 6) has the optical axis at its corner."""
    return Camera(16, 12, 20.0, 20.0, 8.0, 6.0, torch.eye(3), torch.zeros(3))


def planes(depths: list[float], opacities: list[float], tilt: float = 0.0) -> SurfelModel:
    """Surfels larger than the picture, one behind the other, turned by `tilt` degrees about y."""
    n = len(depths)
    size = 1000.0 if tilt == 0 else 1.2  # a tilted one must not reach behind the camera
    half = math.radians(tilt) / 2
    return SurfelModel(
        torch.tensor([[0.0, 0.0, z] for z in depths]), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3),
        torch.logit(torch.tensor(opacities)), torch.full((n, 2), math.log(size)),
        torch.tensor([[math.cos(half), 0.0, math.sin(half), 0.0]]).repeat(n, 1),
    )  # fmt: skip


@torch.no_grad()
def drawn(model: SurfelModel, rasterizer: NegotiatedRasterizer, **options: object) -> RenderResult:
    return rasterizer.render(model.gaussians(camera(), rasterizer), camera(), RasterOptions(**{**BOTH, **options}))


@pytest.mark.parametrize("tilt", [0.0, 30.0])
def test_an_opaque_plane_has_no_distortion_and_agrees_with_its_depth(rasterizer, tilt):
    result = drawn(planes([2.0] * 3, [0.98] * 3, tilt), rasterizer)
    assert float(result.alpha.min()) > (0.9995 if tilt == 0 else 0.9)
    if tilt == 0:
        assert torch.allclose(result.depth["median"], torch.tensor(2.0), rtol=1e-5)
        assert torch.allclose(result.depth["expected"], torch.tensor(2.0), rtol=1e-5)
    assert float(distortion_loss(result)) < 1e-8
    found = normal_disagreement(result, camera(), 0.5)
    assert found.shape == (1, 12, 16)
    # n is A times the normal of the plane, n_surf its normal.
    assert torch.allclose(found[:, 1:-1, 1:-1], (1 - result.alpha**2)[:, 1:-1, 1:-1], atol=1e-5)
    border = found.clone()
    border[:, 1:-1, 1:-1] = 1
    assert torch.equal(border, torch.ones_like(border))


def test_two_planes_have_the_depths_and_the_distortion_of_the_formula(rasterizer):
    result = drawn(planes([2.0, 3.0], [0.6, 0.99]), rasterizer)
    assert torch.allclose(result.depth["expected"], torch.tensor((0.6 * 2 + 0.396 * 3) / 0.996), rtol=1e-5)
    assert torch.allclose(result.depth["median"], torch.tensor(2.0), rtol=1e-5)
    m = [100 / 99.8 * (1 - 0.2 / z) for z in (2.0, 3.0)]
    assert float(distortion_loss(result)) == pytest.approx(0.6 * 0.396 * (m[0] - m[1]) ** 2, rel=1e-3)
    faint = drawn(planes([2.0, 3.0], [0.4, 0.99]), rasterizer)
    assert torch.allclose(faint.depth["median"], torch.tensor(3.0), rtol=1e-5)


def by_hand(alpha: torch.Tensor, depth: torch.Tensor, normals: torch.Tensor) -> RenderResult:
    nothing = GaussianInputs(means=torch.zeros(0, 3), opacities=torch.zeros(0))
    return RenderResult(torch.zeros(3), torch.zeros(0), nothing, alpha=alpha, depth={"median": depth}, normals=normals)


def test_the_factor_of_opacity_has_no_gradient_and_pixels_of_nothing_cost_one():
    alpha = torch.full((1, 12, 16), 0.5).requires_grad_()
    depth = torch.full((1, 12, 16), 2.0).requires_grad_()
    normals = torch.tensor([0.0, 0.0, -0.5])[:, None, None].repeat(1, 12, 16).requires_grad_()
    found = normal_disagreement(by_hand(alpha, depth, normals), camera(), 1.0)
    assert torch.allclose(found[:, 1:-1, 1:-1], torch.tensor(0.75))  # 1 - 0.5 * 0.5
    found.mean().backward()
    assert alpha.grad is None
    assert depth.grad is not None
    assert normals.grad is not None
    empty = by_hand(torch.zeros(1, 12, 16), torch.zeros(1, 12, 16), torch.zeros(3, 12, 16))
    assert torch.equal(normal_disagreement(empty, camera(), 1.0), torch.ones(1, 12, 16))


@pytest.mark.parametrize("opacity", [0.1, 0.9])
def test_covering_an_empty_background_pays_by_the_code_and_not_by_the_paper(rasterizer, opacity):
    model = planes([2.0], [opacity], tilt=20.0)
    slopes = {}
    for term in ("code", "paper"):
        model.zero_grad()
        result = rasterizer.render(model.gaussians(camera(), rasterizer), camera(), RasterOptions(**BOTH))
        found = normal_disagreement(result, camera(), 0.5, term)
        found.mean().backward()
        slopes[term] = float(model.opacity_logits.grad)
    assert slopes["code"] < -0.003
    assert abs(slopes["paper"]) < 1e-6
    assert float(found.detach().abs().max()) < 1e-5
    empty = by_hand(torch.zeros(1, 12, 16), torch.zeros(1, 12, 16), torch.zeros(3, 12, 16))
    assert torch.equal(normal_disagreement(empty, camera(), 1.0, "paper"), torch.zeros(1, 12, 16))


def test_the_papers_term_is_the_sum_over_surfels_of_what_each_lacks():
    alpha, depth = torch.full((1, 12, 16), 0.8), torch.full((1, 12, 16), 2.0)
    # 0.5 of a surfel that faces the camera, 0.3 of one turned by 60 degrees: 0.5 (1 - 1) + 0.3 (1 - 0.5)
    normals = 0.5 * torch.tensor([0.0, 0.0, -1.0]) + 0.3 * torch.tensor([math.sin(math.pi / 3), 0.0, -0.5])
    found = normal_disagreement(by_hand(alpha, depth, normals[:, None, None].repeat(1, 12, 16)), camera(), 1.0, "paper")
    assert torch.allclose(found[:, 1:-1, 1:-1], torch.tensor(0.15))
    assert not found[:, 0].any()  # the border has no normal


@pytest.mark.parametrize("term", ["code", "paper"])
def test_the_gradient_of_the_normal_loss_is_that_of_finite_differences(term):
    generator = torch.Generator().manual_seed(1)
    small = Camera(6, 5, 7.0, 7.0, 3.0, 2.5, torch.eye(3).double(), torch.zeros(3).double())
    alpha = torch.rand(1, 5, 6, generator=generator, dtype=torch.float64).requires_grad_(term == "paper")
    depth = (2 + torch.rand(1, 5, 6, generator=generator, dtype=torch.float64)).requires_grad_()
    normals = torch.randn(3, 5, 6, generator=generator, dtype=torch.float64).requires_grad_()

    def loss(alpha: torch.Tensor, depth: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
        return normal_disagreement(by_hand(alpha, depth, normals), small, 1.0, term).mean()

    assert torch.autograd.gradcheck(loss, (alpha, depth, normals), atol=1e-6)


def test_weighted_terms_are_added_and_named_without_their_weight(rasterizer):
    result = drawn(planes([2.0, 3.0], [0.6, 0.99]), rasterizer)
    before = LossPack(torch.tensor(1.0), {"l1": torch.tensor(1.0)})
    distortion, disagreement = distortion_loss(result), normal_disagreement(result, camera(), 0.5)
    mask = torch.zeros(1, 12, 16)
    mask[:, 3, 5] = 1
    found = add_surface_losses(before, result, camera(), 0.5, distortion=100.0, normals=0.5, mask=mask)
    assert set(found.parts) == {"l1", "distortion", "normals"}
    assert float(found.parts["normals"]) == pytest.approx(float(disagreement[0, 3, 5]) / (12 * 16))
    assert float(found.total) == pytest.approx(1 + 100 * float(distortion) + 0.5 * float(found.parts["normals"]))
    assert add_surface_losses(before, result, camera(), 0.5).parts.keys() == {"l1"}


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("term", ["code", "paper"])
@pytest.mark.parametrize("size", [(1, 1), (2, 7), (3, 3), (37, 65)])
def test_the_kernel_gives_the_disagreement_and_the_gradients_of_torch(size, term):
    assert GAUSSIANS.has_cuda(), "built without CUDA"
    height, width = size
    generator = torch.Generator().manual_seed(2)
    lens = Camera(width, height, 40.0, 35.0, width / 2 + 0.3, height / 2, torch.eye(3), torch.zeros(3))
    depth = 2 + torch.rand(1, height, width, generator=generator)
    depth[torch.rand(1, height, width, generator=generator) < 0.2] = 0  # no surface
    alpha = torch.rand(1, height, width, generator=generator)
    normals = torch.randn(3, height, width, generator=generator)
    weights = torch.randn(1, height, width, generator=generator)
    found = []
    for device, dtype in (("cpu", torch.float64), ("cuda", torch.float32)):
        z, n = (t.to(device, dtype).requires_grad_() for t in (depth, normals))
        value = normal_disagreement(by_hand(alpha.to(device, dtype), z, n), lens, 1.0, term)
        (value * weights.to(device, dtype)).sum().backward()
        slopes = [torch.zeros_like(t) if t.grad is None else t.grad for t in (z, n)]  # a border alone has none
        found.append([t.detach().cpu().double() for t in (value, *slopes)])
    for exact, measured in zip(*found, strict=True):
        assert torch.allclose(measured, exact, rtol=1e-3, atol=1e-4 * float(exact.abs().max()))


def test_only_what_a_loss_reads_is_drawn():
    assert maps_for(distortion=False, normals=False, depth_ratio=1.0) == {}
    assert maps_for(distortion=True, normals=False, depth_ratio=1.0) == {"distortion": True}
    assert maps_for(distortion=False, normals=True, depth_ratio=1.0)["depth"] == {"median"}
    assert maps_for(distortion=False, normals=True, depth_ratio=0.0)["depth"] == {"expected"}
    assert BOTH["depth"] == {"expected", "median"}


def test_maps_that_were_not_drawn_are_named(rasterizer):
    model = planes([2.0], [0.9])
    plain = rasterizer.render(model.gaussians(camera(), rasterizer), camera(), RasterOptions())
    with pytest.raises(ValueError, match="distortion=True"):
        distortion_loss(plain)
    with pytest.raises(ValueError, match="normals=True"):
        normal_disagreement(plain, camera(), 0.0)
    with pytest.raises(ConfigError, match="median"):
        normal_disagreement(drawn(model, rasterizer, depth=frozenset({"expected"})), camera(), 1.0)
