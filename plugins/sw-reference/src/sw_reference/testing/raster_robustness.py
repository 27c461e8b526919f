"""Invariances, culling, and inputs at the edge of sense: nothing crashes, hangs, or spoils another Gaussian."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, Rasterizer, RasterOptions
from sw_reference.projection import rotation_matrices
from sw_reference.testing.facts import check, close, draw
from sw_reference.testing.raster_scenes import (
    RasterCase,
    concatenate_inputs,
    draw_scene,
    front_camera,
    margin_scene,
    permute_inputs,
    splats,
    with_tensors,
)

CASE = RasterCase("robust", n=20, width=37, height=29, color="colors")
LEAVES = ("means", "opacities", "scales", "quats", "colors")


def _gradients(r: Rasterizer, device: str, g: GaussianInputs, cam: Camera) -> tuple[Tensor, list[Tensor]]:
    """(image, gradients of LEAVES) under a fixed random weighting of the image."""
    present = g.tensors()
    leaves = {name: present[name].detach().clone().requires_grad_() for name in LEAVES}
    image = draw(r, device, with_tensors(g, leaves), cam, RasterOptions()).image
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(8)).to(image)
    return image.detach(), list(torch.autograd.grad((image * weights).sum(), list(leaves.values())))


@check("BACKWARD")
def permuting_gaussians_changes_nothing(r: Rasterizer, device: str) -> None:
    g, cam = margin_scene(CASE, 1, torch.float32, 1e-4)
    order = torch.randperm(len(g), generator=torch.Generator().manual_seed(0))
    image, gradients = _gradients(r, device, g, cam)
    permuted, permuted_gradients = _gradients(r, device, permute_inputs(g, order), cam)
    if device == "cpu":
        assert torch.equal(image, permuted)
    close(permuted, image)
    for a, b in zip(gradients, permuted_gradients, strict=True):
        close(b, a[order], atol=1e-4, rtol=1e-4)


@check()
def moving_world_and_camera_together_changes_nothing(r: Rasterizer, device: str) -> None:
    g, cam = margin_scene(CASE, 2, margin=1e-4)
    assert g.quats is not None
    turn = torch.tensor([0.6, 0.4, -0.5, 0.3], dtype=torch.float64)
    Q = rotation_matrices(turn[None])[0]
    shift = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    moved = with_tensors(g, {"means": g.means @ Q.T + shift, "quats": _multiply(turn, g.quats)})
    moved_cam = replace(cam, R=cam.R @ Q.T, tau=cam.tau - cam.R @ Q.T @ shift)
    images = [
        draw(r, device, with_tensors(x, {k: v.float() for k, v in x.tensors().items()}), c.to(dtype=torch.float32),
             RasterOptions()).image
        for x, c in ((g, cam), (moved, moved_cam))
    ]  # fmt: skip
    close(images[1], images[0], atol=1e-5)


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a b of [4] with [N,4]: rotate by b, then by a."""
    w, v = a[0], a[1:].expand(len(b), 3)
    real = w * b[:, :1] - (v * b[:, 1:]).sum(dim=1, keepdim=True)
    return torch.cat([real, w * b[:, 1:] + b[:, :1] * v + torch.linalg.cross(v, b[:, 1:])], dim=1)


@check()
def doubling_the_resolution_keeps_the_picture(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4], [0.5, 0.3, 5]], opacities=[0.6, 0.8], scales=[0.8, 1.0])
    cam = front_camera()
    small = draw(r, device, g, cam, RasterOptions()).image
    large = draw(r, device, g, cam.resized(128, 128), RasterOptions()).image
    # The low-pass of 0.3 px^2 is 0.2 % of these splats' variance, and averaging four pixels is not point sampling.
    close(torch.nn.functional.avg_pool2d(large[None], 2)[0], small, atol=5e-3)


@check("BACKWARD")
def gaussians_that_cannot_be_seen_change_nothing(r: Rasterizer, device: str) -> None:
    g, cam = margin_scene(CASE, 3, torch.float32, 1e-4)
    unseen = splats([[0, 0, -5], [0, 0, 0], [0.1, 0, 4], [0, 0, -4], [500, 0, 1]], opacities=[0.9, 0.9, 0.003, 0.9, 1])
    unseen.means = (unseen.means - cam.tau) @ cam.R  # written in the camera's frame
    image, gradients = _gradients(r, device, g, cam)
    both, both_gradients = _gradients(r, device, concatenate_inputs(g, unseen), cam)
    close(both, image, atol=1e-6)
    for a, b in zip(gradients, both_gradients, strict=True):
        close(b[: len(g)], a, atol=1e-5, rtol=1e-4)
        assert float(b[len(g) :].abs().max()) == 0


@check()
def crops_equal_the_cropped_picture(r: Rasterizer, device: str) -> None:
    """Splats in the middle of the field of view, faint enough that no profile clips them."""
    g = splats([[0, 0, 4], [0.2, 0.1, 5], [-0.2, -0.1, 6]], opacities=[0.34, 0.2, 0.3], scales=[0.3, 0.3, 0.4])
    whole = draw(r, device, g, front_camera(), RasterOptions()).image
    for x, y in ((0, 0), (32, 0), (0, 32), (32, 32)):
        cam = replace(front_camera(32, 32), cx=32.0 - x, cy=32.0 - y)
        close(draw(r, device, g, cam, RasterOptions()).image, whole[:, y : y + 32, x : x + 32], atol=2e-6)


@check("VISIBLE_FILTER")
def visible_filter_gives_the_radii_of_a_render(r: Rasterizer, device: str) -> None:
    g, cam = draw_scene(replace(CASE, n=300, spread=4.0), 4, torch.float32)
    radii = draw(r, device, g, cam, RasterOptions()).radii
    moved = with_tensors(g, {name: x.to(device) for name, x in g.tensors().items()})
    filtered = r.visible_filter(moved, cam.to(device))
    assert 0 < int((radii > 0).sum()) < 300
    assert filtered.dtype == torch.int32
    assert torch.equal(filtered, radii)


@check()
def visible_mask_leaves_gaussians_out(r: Rasterizer, device: str) -> None:
    g, cam = draw_scene(CASE, 5, torch.float32)
    mask = torch.arange(len(g)) % 3 != 0
    subset = draw(r, device, permute_inputs(g, torch.nonzero(mask)[:, 0]), cam, RasterOptions()).image
    g.visible = mask
    result = draw(r, device, g, cam, RasterOptions())
    close(result.image, subset, atol=1e-6)
    assert not bool(result.visible.cpu()[~mask].any())


@check()
def near_plane_is_exclusive(r: Rasterizer, device: str) -> None:
    for z, radius in ((0.2, 0), (0.2001, 1), (0.1, 0), (-1.0, 0)):
        g = splats([[0, 0, z]], opacities=[0.8], scales=[0.001])
        radii = draw(r, device, g, front_camera(), RasterOptions()).radii
        assert bool(radii[0] > 0) == bool(radius), f"tz = {z}"


@check()
def splats_at_the_border_and_outside_the_field_of_view(r: Rasterizer, device: str) -> None:
    inside = [[2.2, 0, 4], [0, -2.2, 4]]  # centre 3 px outside, radius 10
    outside = [[40.0, 0, 4], [0, 40.0, 4]]  # beyond the clamp of the Jacobian
    result = draw(r, device, splats(inside + outside, opacities=[0.9] * 4), front_camera(), RasterOptions())
    assert result.visible.tolist() == [True, True, False, False]
    assert float(result.image[:, 31:33, 63].min()) > 0
    assert float(result.image[:, 0, 31:33].min()) > 0
    # One that touches only the last, partial column of tiles of a 70 px wide picture.
    cam = front_camera(70, 64)
    result = draw(r, device, splats([[2.3, 0, 4]], opacities=[0.9], scales=[0.1]), cam, RasterOptions())
    assert result.radii.tolist() == [6]
    assert float(result.image[:, :, 69].amax()) > 0
    assert float(result.image[:, :, :60].amax()) == 0


@check("BACKWARD")
def sizes_that_are_no_multiple_of_a_tile(r: Rasterizer, device: str) -> None:
    for width, height in ((1, 1), (17, 33), (15, 1), (1, 40)):
        g = splats([[0, 0, 4], [0.02, 0.01, 5]], opacities=[0.6, 0.8])
        image, gradients = _gradients(r, device, g, front_camera(width, height))
        assert image.shape == (3, height, width)
        assert float(image.amin()) >= 0
        assert float(image[:, height // 2, width // 2].min()) > 0.1
        assert all(bool(torch.isfinite(x).all()) for x in gradients)


@check("BACKWARD")
def nothing_to_draw_gives_the_background(r: Rasterizer, device: str) -> None:
    background = torch.tensor([0.2, 0.4, 0.6], device=device)
    behind = splats([[0, 0, -4], [0, 0, 0]], opacities=[0.8, 0.8])
    for g in (splats([], opacities=[], scales=[]), behind):
        g.means.requires_grad_()
        result = draw(r, device, g, front_camera(20, 10), RasterOptions(background=background, grad2d=True))
        close(result.image, background[:, None, None].cpu().expand(3, 10, 20))
        assert result.radii.shape == (len(g),)
        assert not bool(result.visible.any())
        torch.autograd.backward(result.image.sum())
        assert g.means.grad is not None
        assert float(g.means.grad.abs().sum()) == 0
        assert result.grad2d is not None
        assert result.grad2d.value.shape == (len(g), 2)


BROKEN: dict[str, tuple[str, list[float]]] = {
    "nan mean": ("means", [math.nan, 0, 4]),
    "infinite mean": ("means", [0, math.inf, 4]),
    "infinitely far": ("means", [0, 0, math.inf]),
    "nan opacity": ("opacities", [math.nan]),
    "negative opacity": ("opacities", [-0.5]),
    "nan scale": ("scales", [0.1, math.nan, 0.1]),
    "infinite scale": ("scales", [math.inf, 0.1, 0.1]),
    "zero quaternion": ("quats", [0, 0, 0, 0]),
    "nan quaternion": ("quats", [math.nan, 0, 0, 1]),
    "nan colour": ("colors", [math.nan, 0, 0]),
}


@check("BACKWARD")
def broken_gaussians_are_culled_and_harm_no_other(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4], [0.3, 0.1, 5]], opacities=[0.6, 0.8])
    image, gradients = _gradients(r, device, g, front_camera())
    for what, (field, value) in BROKEN.items():
        bad = splats([[0.1, 0.1, 4.5]], opacities=[0.7])
        row = torch.tensor(value, dtype=torch.float32)
        bad = with_tensors(bad, {field: row if field == "opacities" else row[None]})
        both = concatenate_inputs(g, bad)
        result = draw(r, device, both, front_camera(), RasterOptions())
        assert int(result.radii[2]) == 0, what
        if not all(math.isfinite(v) for v in value):
            assert result.stats.n_invalid in (1, None), what
        both_image, both_gradients = _gradients(r, device, both, front_camera())
        assert torch.equal(both_image, image), what
        for a, b in zip(gradients, both_gradients, strict=True):
            close(b[:2], a, atol=1e-5)
            assert float(b[2:].abs().max()) == 0, what


@check()
def all_colors_that_are_not_finite_are_counted(r: Rasterizer, device: str) -> None:
    n = 300
    g = splats([[0.01 * (i % 20) - 0.1, 0.01 * (i // 20), 4] for i in range(n)], opacities=[0.5] * n)
    assert g.colors is not None
    g.colors[::3] = math.nan
    result = draw(r, device, g, front_camera(), RasterOptions())
    assert result.visible.tolist() == [i % 3 != 0 for i in range(n)]
    assert result.stats.n_invalid in (n // 3, None)


@check("BACKWARD", "COV3D")
def impossible_covariance_is_culled(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4], [0, 0, 5]], opacities=[0.6, 0.8])
    g.scales = g.quats = None
    g.cov3d = torch.tensor([[-1.0, 0, 0, 1.0, 0, 1.0], [0.04, 0, 0, 0.04, 0, 0.04]], requires_grad=True)
    result = draw(r, device, g, front_camera(), RasterOptions())
    assert result.visible.tolist() == [False, True]
    torch.autograd.backward(result.image.sum())
    assert g.cov3d.grad is not None
    assert float(g.cov3d.grad[0].abs().max()) == 0
    assert float(g.cov3d.grad[1].abs().max()) > 0


@check("BACKWARD")
def extreme_scales_and_opacities_stay_finite(r: Rasterizer, device: str) -> None:
    for scale, opacity in ((0.0, 0.8), (1e-20, 0.8), (1e6, 0.8), (0.2, 0.0), (0.2, 1.0), (0.2, 3.0)):
        g = splats([[0.1, 0, 4], [0.3, 0.1, 5]], opacities=[opacity, 0.8], scales=[scale, 0.2])
        image, gradients = _gradients(r, device, g, front_camera())
        assert bool(torch.isfinite(image).all()), (scale, opacity)
        assert all(bool(torch.isfinite(x).all()) for x in gradients), (scale, opacity)
    # A scale of zero is a point: the low-pass alone, variance 0.3.
    point = draw(r, device, splats([[0, 0, 4]], opacities=[0.8], scales=[0.0]), front_camera(), RasterOptions())
    colors = splats([[0, 0, 4]], opacities=[0.8]).colors
    assert colors is not None
    close(point.image[:, 32, 32], 0.8 * math.exp(-0.25 / 0.3) * colors[0])
    # A huge one covers every pixel of every tile.
    huge = draw(r, device, splats([[0, 0, 4]], opacities=[0.8], scales=[1e4]), front_camera(), RasterOptions())
    close(huge.image, 0.8 * colors[0][:, None, None].expand(3, 64, 64), atol=1e-4)


@check()
def equal_depths_are_drawn_in_index_order(r: Rasterizer, device: str) -> None:
    n = 40
    g = splats([[0, 0, 4]] * n, opacities=[0.3] * n, colors=torch.eye(n, 3) + 0.1)
    image = draw(r, device, g, front_camera(cx=32.5, cy=32.5), RasterOptions()).image
    assert g.colors is not None
    T, expected = 1.0, torch.zeros(3)
    for i in range(n):
        if T * 0.7 < 1e-4:
            break
        expected, T = expected + 0.3 * T * g.colors[i], T * 0.7
    close(image[:, 32, 32], expected)


@check("BACKWARD")
def long_lists_in_one_tile(r: Rasterizer, device: str) -> None:
    """20 000 faint splats on top of each other: more than any block or chunk holds."""
    n = 20_000
    g = splats([[0, 0, 4 + 1e-4 * i] for i in range(n)], opacities=[0.006] * n, scales=[0.5] * n)
    cam = front_camera(8, 8)
    image, gradients = _gradients(r, device, g, cam)
    assert g.colors is not None
    assert all(bool(torch.isfinite(x).all()) for x in gradients)
    assert float(gradients[1][0].abs()) > 0
    assert float(gradients[1][-1].abs()) == 0  # the pixels stop after about 1 500
    mean = g.colors[:1500].mean(dim=0)
    close(image[:, 4, 4], mean, atol=0.05)
