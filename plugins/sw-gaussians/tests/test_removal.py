"""Costs of removal against renders without each Gaussian; sensitivities against every derivative."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_gaussians.removal import Removal, removal_costs, sensitivities
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import permute_inputs

from splatwizard_core.api import SH, Camera, GaussianInputs, GaussianModel, RasterOptions, stream
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

BACKGROUND = torch.tensor([0.2, 0.5, 0.1])
REFERENCE = ReferenceRasterizer()
compiled = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
RASTERIZERS = [REFERENCE, pytest.param(StandardRasterizer(), marks=compiled)]


class Picture:
    """A view whose photograph is a tensor [3,H,W]."""

    def __init__(self, camera: Camera, image: torch.Tensor) -> None:
        self.camera, self._image = camera, image

    def image(self, background=None, device="cpu") -> torch.Tensor:
        return self._image.to(device)


def camera_at(*eye: float, size: int = 32) -> Camera:
    place = torch.tensor(eye)
    return Camera.look_at(place, torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]), width=size, height=size, fov_x=0.9)


def splats(n: int, *, opacity: float = 0.9) -> GaussianInputs:
    """float64 Gaussians around the origin; alphas stay below the clamp, and no pixel becomes opaque."""
    random = stream(n, "splats")
    rand = torch.rand(n, 14, generator=random, dtype=torch.float64)
    return GaussianInputs(
        means=rand[:, :3] * 1.6 - 0.8, opacities=rand[:, 3] * opacity * 0.7 + 0.3 * opacity,
        scales=rand[:, 4:7] * 0.25 + 0.05, quats=rand[:, 7:11] - 0.5,
        sh=SH(dense=torch.randn(n, 4, 3, generator=random, dtype=torch.float64) * 0.5, active_degree=1),
    )  # fmt: skip


@pytest.fixture(scope="module")
def views() -> list[Picture]:
    random = stream(2, "pictures")
    eyes = [(0.0, 0.0, -3.0), (2.5, 0.3, -1.5), (0.2, 1.0, 3.0)]
    return [Picture(camera_at(*eye), torch.rand(3, 32, 32, generator=random)) for eye in eyes]


def squared_error(g: GaussianInputs, views: list[Picture]) -> float:
    total = 0.0
    for view in views:
        image = REFERENCE.render(g, view.camera, RasterOptions(background=BACKGROUND)).image
        total += float((image - view.image().double()).square().sum())
    return total


def without(g: GaussianInputs, row: int) -> GaussianInputs:
    return permute_inputs(g, torch.arange(len(g)) != row)


@pytest.mark.parametrize("rasterizer", RASTERIZERS, ids=["reference", "standard"])
def test_cost_is_the_error_after_removal_less_the_one_before(rasterizer, views):
    g = splats(20, opacity=0.5)
    found = removal_costs(lambda camera: g, views, rasterizer, BACKGROUND)
    before = squared_error(g, views)
    after = torch.tensor([squared_error(without(g, row), views) for row in range(20)], dtype=torch.float64)
    assert found.squared_error == pytest.approx(before, rel=1e-6)
    assert found.values == 3 * 3 * 32 * 32
    # float32 scores per view; relative to what the views gain and lose, which nearly cancels for some.
    torch.testing.assert_close(found.cost, after - before, rtol=1e-4, atol=1e-4 * float(found.change.min()))
    assert bool((found.cost < 0).any())
    assert bool((found.cost > 0).any())


def test_cost_is_the_squared_change_less_the_gradient_by_the_opacity(views):
    """S(m) - o dSE/do, o the opacity; also for Gaussians that have a covariance and no scales."""
    g = splats(12, opacity=0.5)
    root = torch.randn(12, 3, 3, generator=stream(0, "shapes"), dtype=torch.float64) * 0.15
    full = root @ root.mT + 0.003 * torch.eye(3, dtype=torch.float64)
    cov3d = torch.stack([full[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], dim=1)
    opacities = g.opacities.clone().requires_grad_()
    g = replace(g, scales=None, quats=None, cov3d=cov3d, opacities=opacities)
    for view in views:
        image = REFERENCE.render(g, view.camera, RasterOptions(background=BACKGROUND)).image
        (image - view.image().double()).square().sum().backward()
    found = removal_costs(lambda camera: g, views, REFERENCE, BACKGROUND)
    expected = found.change - opacities.detach() * opacities.grad
    torch.testing.assert_close(found.cost, expected, rtol=1e-4, atol=1e-6 * float(found.change.max()))


def test_a_camera_without_a_picture_counts_the_change_of_its_render(views):
    g = splats(9, opacity=0.5)
    cameras = [view.camera for view in views]
    kinds = ("hits", "blend_sq", "blend_max", "shown")
    found = removal_costs(lambda camera: g, cameras, REFERENCE, BACKGROUND, also=kinds)
    rendered = [
        Picture(camera, REFERENCE.render(g, camera, RasterOptions(background=BACKGROUND)).image) for camera in cameras
    ]
    expected = torch.tensor([squared_error(without(g, row), rendered) for row in range(9)], dtype=torch.float64)
    torch.testing.assert_close(found.cost, found.change, rtol=0, atol=0)
    torch.testing.assert_close(found.change, expected, rtol=1e-4, atol=0)
    assert set(found.scores) == set(kinds)
    assert bool((found.scores["shown"] <= found.scores["hits"]).all())
    assert bool((found.scores["blend_sq"] <= found.scores["hits"] * found.scores["blend_max"] ** 2).all())
    with pytest.raises(ValueError, match="at least one view"):
        removal_costs(lambda camera: g, [], REFERENCE, BACKGROUND)


def test_a_hidden_gaussian_costs_nothing_and_one_that_a_single_view_shows_costs_something():
    wall = torch.linspace(-0.4, 0.4, 3)
    xy = torch.cartesian_prod(wall, wall)
    means = torch.cat([torch.cat([xy, torch.full((9, 1), z)], dim=1) for z in (-0.5, -0.45, -0.4)])
    means = torch.cat([means, torch.tensor([[0.0, 0.0, 0.5]])])  # behind three opaque sheets
    n = len(means)
    scales = torch.full((n, 3), 0.25)
    scales[:, 2], scales[-1] = 0.01, 0.02
    model = GaussianModel(
        means, torch.rand(n, 1, 3, generator=stream(0, "colors")), torch.zeros(n, 0, 3), torch.full((n,), 12.0),
        scales.log(), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
    )  # fmt: skip
    front, behind = camera_at(0.0, 0.0, -3.0), camera_at(0.0, 0.0, 3.0)

    def of_last(cameras: list[Camera]) -> float:
        return float(Removal().score(model, cameras, REFERENCE)[-1])

    assert of_last([front]) == -torch.inf
    change = removal_costs(lambda camera: model.gaussians(camera, REFERENCE), [front], REFERENCE).change
    assert float(change[-1]) == 0
    assert of_last([front] * 20 + [behind]) == pytest.approx(of_last([behind]))
    assert of_last([behind]) > 1e-3


@compiled
def test_sensitivities_are_the_sums_of_squared_derivatives():
    g, camera, rasterizer = splats(20), camera_at(0.0, 0.0, -3.0, size=12), StandardRasterizer()
    leaves = {name: getattr(g, name).clone().requires_grad_() for name in ("means", "opacities", "scales")}
    drawn = replace(g, **leaves)
    exact = {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
    image = rasterizer.render(drawn, camera, RasterOptions(background=BACKGROUND)).image
    for value in image.flatten():
        for name, gradient in zip(
            exact, torch.autograd.grad(value, [*leaves.values()], retain_graph=True), strict=True
        ):
            exact[name] += gradient.square()
    found = sensitivities(lambda _: drawn, leaves, [camera], rasterizer, stream(0, "signs"), BACKGROUND, draws=200)
    assert all(leaf.grad is None for leaf in leaves.values())
    for name, expected in exact.items():
        ratio = found[name].double()[expected > 0] / expected[expected > 0]
        assert float(ratio.mean()) == pytest.approx(1, abs=0.04), name  # the rms of one entry is 10 %
        assert bool(((ratio - 1).abs() < 0.4).all()), name


def test_other_models_are_refused(views):
    with pytest.raises(TypeError, match="GaussianModel"):
        Removal().score_views(torch.nn.Linear(1, 1), views, REFERENCE)
