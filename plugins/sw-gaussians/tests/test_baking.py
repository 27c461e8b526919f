"""Baking: what can be explicit is found again, what cannot is the mean of what is seen."""

from __future__ import annotations

import math

import pytest
import torch
from sw_gaussians.bake_refining import refine
from sw_gaussians.baking import bake
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.spherical_harmonics import sh_basis
from torch import Tensor, nn

from splatwizard_core.api import (
    SH,
    Camera,
    GaussianInputs,
    GaussianModel,
    Rasterizer,
    RasterOptions,
    SceneError,
    SplatModel,
    UserInputError,
)

RASTERIZER, OPTIONS = ReferenceRasterizer(), RasterOptions(background=torch.zeros(3))


class ByView(SplatModel):
    """Gaussians in a row; opacity, colour and which of them are drawn are functions of the camera.

    ids     of those that can be drawn, in the order of the tensors
    """

    ROWS = ("means",)

    def __init__(
        self, n: int, degree: int = 2, *, opacity=lambda camera: 0.7, drawn=lambda camera, n: range(n)
    ) -> None:
        super().__init__()
        g = torch.Generator().manual_seed(1)
        self.means = nn.Parameter(torch.stack([torch.linspace(-0.6, 0.6, n), 0.1 * torch.randn(n, generator=g),
                                               0.1 * torch.randn(n, generator=g)], dim=1))  # fmt: skip
        self.register_buffer("coefficients", 0.15 * torch.randn(n, (degree + 1) ** 2, 3, generator=g))
        self.register_buffer("scales", 0.05 + 0.05 * torch.rand(n, 3, generator=g))
        self.register_buffer("quats", torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=1))
        self.opacity, self.drawn, self.degree = opacity, drawn, degree

    @property
    def num_gaussian_ids(self) -> int:
        return 2 * self.num_rows  # only even ids are there

    def gaussian_ids(self, inputs: GaussianInputs) -> Tensor:
        ids: Tensor = inputs.extras["ids"]
        return ids

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        rows = torch.tensor(list(self.drawn(camera, self.num_rows)), dtype=torch.int64)
        means = self.means[rows]
        basis = sh_basis(torch.nn.functional.normalize(means - camera.center, dim=1), self.degree)
        colors = 0.5 + (basis[:, :, None] * self.coefficients[rows]).sum(dim=1)
        signs = 1 if camera.center[0] > 0 else -1  # q and -q are one rotation
        return GaussianInputs(
            means, torch.full((len(rows),), float(self.opacity(camera))), self.scales[rows], signs * self.quats[rows],
            colors=colors, extras={"ids": 2 * rows},
        )  # fmt: skip


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    """Twenty cameras on a sphere."""
    found = []
    for i in range(20):
        z, angle = 0.9 - 1.8 * i / 19, 2.4 * i
        eye = 3 * torch.tensor([math.sqrt(1 - z * z) * math.cos(angle), math.sqrt(1 - z * z) * math.sin(angle), z])
        up = torch.tensor([0.0, 0.0, 1.0])
        found.append(Camera.look_at(eye, torch.zeros(3), up, width=24, height=18, fov_x=0.7))
    return found


def test_harmonics_shapes_and_positions_are_found_again(cameras: list[Camera]):
    model = ByView(4)
    baked = bake(model, cameras, RASTERIZER, OPTIONS, sh_degree=2)
    assert type(baked) is GaussianModel
    assert baked.num_rows == 4
    torch.testing.assert_close(baked.means, model.means)
    torch.testing.assert_close(baked.scales, model.scales, rtol=1e-4, atol=0)
    torch.testing.assert_close((baked.quats * model.quats).sum(dim=1).abs(), torch.ones(4), atol=1e-4, rtol=0)
    torch.testing.assert_close(baked.opacities, torch.full((4,), 0.7), atol=1e-4, rtol=0)
    found = torch.cat([baked.sh_dc, baked.sh_rest], dim=1)
    # The ridge of 0.005 beside eigenvalues of about 1 / 4 pi = 0.08 takes 6 % of the higher bands (0.5 at most here).
    torch.testing.assert_close(found, model.coefficients, atol=0.04, rtol=0)
    ours = torch.stack([RASTERIZER.render(baked.gaussians(c, RASTERIZER), c, OPTIONS).image for c in cameras])
    wanted = torch.stack([RASTERIZER.render(model.gaussians(c, RASTERIZER), c, OPTIONS).image for c in cameras])
    assert ((ours - wanted) ** 2).mean() < 3e-5


def test_an_opacity_that_depends_on_the_camera_becomes_its_mean(cameras: list[Camera]):
    model = ByView(3, 0, opacity=lambda camera: 0.9 if camera.center[2] > 0 else 0.3)
    baked = bake(model, cameras, RASTERIZER, OPTIONS, sh_degree=0)
    assert ((baked.opacities > 0.4) & (baked.opacities < 0.8)).all()
    # Views in which it is not drawn count as transparent.
    model = ByView(3, 0, drawn=lambda camera, n: range(n) if camera.center[2] > 0 else range(1, n))
    baked = bake(model, cameras, RASTERIZER, OPTIONS, sh_degree=0)
    assert 0.2 < baked.opacities[0] < 0.5
    torch.testing.assert_close(baked.opacities[1:], torch.full((2,), 0.7), atol=1e-4, rtol=0)


def test_what_no_camera_sees_or_hardly_anyone_is_left_out(cameras: list[Camera]):
    model = ByView(3, 0, drawn=lambda camera, n: (1,))
    assert bake(model, cameras, RASTERIZER, OPTIONS, sh_degree=1).num_rows == 1
    with pytest.raises(SceneError, match="no Gaussian is seen"):
        bake(ByView(3, 0, drawn=lambda camera, n: ()), cameras, RASTERIZER, OPTIONS)
    with pytest.raises(SceneError, match="opaque enough"):
        bake(ByView(3, 0, opacity=lambda camera: 0.002), cameras, RASTERIZER, OPTIONS)


def test_explicit_gaussians_need_no_baking(cameras: list[Camera]):
    baked = bake(ByView(2, 0), cameras[:3], RASTERIZER, OPTIONS, sh_degree=0)
    with pytest.raises(UserInputError, match="explicit already"):
        bake(baked, cameras, RASTERIZER, OPTIONS)


def test_a_model_of_the_same_gaussians_in_each_view_needs_no_numbers(cameras: list[Camera]):
    class Colored(SplatModel):
        """Explicit Gaussians whose colours come as harmonics, as those of Compact3DGS."""

        ROWS = ("means",)

        def __init__(self, of: ByView) -> None:
            super().__init__()
            self.of, self.means = of, of.means

        def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
            g = self.of.gaussians(camera, rasterizer)
            sh = SH(dense=self.of.coefficients[:, :1], active_degree=0)
            return GaussianInputs(g.means, g.opacities, g.scales, g.quats, sh=sh)

    inner = ByView(3, 0)
    baked = bake(Colored(inner), cameras, RASTERIZER, OPTIONS, sh_degree=0)
    torch.testing.assert_close(baked.sh_dc, inner.coefficients, atol=1e-4, rtol=0)
    inner.drawn = lambda camera, n: range(2)
    inner.coefficients = inner.coefficients[:2]
    with pytest.raises(UserInputError, match="does not say which"):
        bake(Colored(inner), cameras, RASTERIZER, OPTIONS)


def test_refining_brings_the_pictures_nearer(cameras: list[Camera]):
    model = ByView(4, 2, opacity=lambda camera: 0.9 if camera.center[2] > 0 else 0.3)
    baked = bake(model, cameras[::3], RASTERIZER, OPTIONS, sh_degree=1)

    def error() -> float:
        total = 0.0
        for camera in cameras[::3]:
            ours = RASTERIZER.render(baked.gaussians(camera, RASTERIZER), camera, OPTIONS).image
            wanted = RASTERIZER.render(model.gaussians(camera, RASTERIZER), camera, OPTIONS).image
            total += ((ours - wanted) ** 2).mean().item()
        return total

    before, means = error(), baked.means.detach().clone()
    refine(baked, model, cameras[::3], RASTERIZER, OPTIONS, steps=30, generator=torch.Generator().manual_seed(0))
    assert error() < 0.99 * before
    assert torch.equal(baked.means, means)
    assert not any(parameter.requires_grad for parameter in baked.parameters())
