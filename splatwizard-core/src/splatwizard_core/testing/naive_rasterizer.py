"""The oracle's oracle: one Gaussian after the other, all pixels at once, no tiles; for a few dozen Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.gaussians.spherical_harmonics import eval_sh
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.camera import Camera

Note = Callable[["Tensor | float", float], None]


@dataclass
class Pair:
    """What one Gaussian does to every pixel, each [H,W]; `raw` is alpha before the clamp and the cuts."""

    index: int
    offset: Tensor  # [H,W,2] centre minus pixel
    raw: Tensor
    before: Tensor
    alpha: Tensor
    tried: Tensor
    blended: Tensor


@dataclass
class NaiveResult:
    """image [C,H,W], alpha [H,W], depth modes [H,W], features [E,H,W], pairs front to back, and what cuts were close.

    margin  smallest relative distance of any quantity to a threshold that would change the picture discontinuously
    """

    image: Tensor
    alpha: Tensor
    depth: dict[str, Tensor]
    features: Tensor | None
    pairs: list[Pair]
    margin: float


def naive_render(g: GaussianInputs, cam: Camera, opt: RasterOptions) -> NaiveResult:
    """Draw by the definitions of the specification, one by one; differentiable by autograd. Valid inputs only.

    A Gaussian in front of the near plane is drawn wherever its exact support reaches.
    """
    R, tau = cam.R.to(g.means), cam.tau.to(g.means)
    H, W = cam.height, cam.width
    margin = math.inf

    def note(value: Tensor | float, threshold: float, mask: Tensor | None = None) -> None:
        nonlocal margin
        gap = (torch.as_tensor(value).detach().double() - threshold).abs() / max(abs(threshold), 1e-12)
        if mask is not None:
            gap = gap[mask]
        if gap.numel():
            margin = min(margin, float(gap.min()))

    depths = [float((R[2] * mean).sum() + tau[2]) for mean in g.means.detach()]
    order = sorted((z, i) for i, z in enumerate(depths) if z > cam.near)
    for (z, _), (next_z, _) in pairwise(order):
        note(next_z, z)
    ys, xs = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    pixels = torch.stack([xs, ys], dim=-1).to(g.means)
    T = torch.ones(H, W).to(g.means)
    running = torch.ones(H, W, dtype=torch.bool)
    image: Tensor | None = None
    sums = {"accumulated": torch.zeros_like(T), "inverse": torch.zeros_like(T), "median": torch.zeros_like(T)}
    features = None if g.features is None else torch.zeros(g.features.shape[1], H, W).to(g.means)
    pairs = []
    for _, i in order:
        t = R @ g.means[i] + tau
        sigma2d, low_pass = _screen_covariance(g, i, t, R, cam, opt, note)
        K = torch.linalg.inv(low_pass)
        opacity = g.opacities[i]
        if opt.antialias:
            ratio = torch.linalg.det(sigma2d) / torch.linalg.det(low_pass)
            note(ratio, 2.5e-5)
            opacity = opacity * torch.sqrt(torch.clamp(ratio, min=2.5e-5))
        u = torch.stack([cam.fx * t[0] / t[2] + cam.cx, cam.fy * t[1] / t[2] + cam.cy])
        d = u - pixels
        raw = opacity * torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", d, K, d))
        alpha = torch.clamp(raw, max=0.99)
        if opt.clamp_grad == "pass":
            alpha = raw + (alpha - raw).detach()
        tried = running & (alpha >= 1 / 255)
        note(raw, 1 / 255, running)
        note(raw, 0.99, tried)
        after = T * (1 - alpha)
        note(after, 1e-4, tried)
        note(T, 0.5, tried)
        blended = tried & (after >= 1e-4)
        pairs.append(Pair(i, d.detach(), raw.detach(), T.detach(), alpha.detach(), tried, blended))
        weight = torch.where(blended, alpha * T, 0)
        color = _color(g, i, R, tau, opt, note)
        image = (0 if image is None else image) + color[:, None, None] * weight
        if features is not None and g.features is not None:
            own = weight.detach() if opt.features_detach_geometry else weight
            features = features + g.features[i][:, None, None] * own
        sums["accumulated"] = sums["accumulated"] + weight * t[2]
        sums["inverse"] = sums["inverse"] + weight / t[2]
        sums["median"] = torch.where(blended & (T > 0.5), t[2], sums["median"])
        running = running & ~(tried & ~blended)
        T = torch.where(blended, after, T)
    channels = 3 if g.colors is None else g.colors.shape[1]
    if image is None:
        image = torch.zeros(channels, H, W).to(g.means)
    if opt.background is not None:
        background = opt.background.to(image)
        image = image + T * (background[:, None, None] if background.dim() == 1 else background)
    sums["expected"] = sums["accumulated"] / torch.clamp(1 - T, min=1e-10)
    return NaiveResult(image, 1 - T, {m: sums[m] for m in opt.depth}, features, pairs, margin)


def _screen_covariance(
    g: GaussianInputs, i: int, t: Tensor, R: Tensor, cam: Camera, opt: RasterOptions, note: Note
) -> tuple[Tensor, Tensor]:
    """[2,2] on the screen, without and with the low-pass."""
    if g.cov3d is not None:
        xx, xy, xz, yy, yz, zz = g.cov3d[i]
        S = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3)
    else:
        assert g.scales is not None
        assert g.quats is not None
        at = i if g.geom_indices is None else int(g.geom_indices[i])
        w, x, y, z = g.quats[at] / g.quats[at].norm()
        rotation = torch.stack([
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]).reshape(3, 3)  # fmt: skip
        factor = opt.scale_modifier * (1 if g.scale_factors is None else g.scale_factors[i])
        M = rotation @ torch.diag(factor * g.scales[at])
        S = M @ M.T
    tan_x, tan_y = cam.width / (2 * cam.fx), cam.height / (2 * cam.fy)
    limits_x = (-(cam.cx / cam.fx) - 0.3 * tan_x, (cam.width - cam.cx) / cam.fx + 0.3 * tan_x)
    limits_y = (-(cam.cy / cam.fy) - 0.3 * tan_y, (cam.height - cam.cy) / cam.fy + 0.3 * tan_y)
    for slope, limits in ((t[0] / t[2], limits_x), (t[1] / t[2], limits_y)):
        for limit in limits:
            note(slope, limit)
    a = torch.clamp(t[0] / t[2], *limits_x)
    b = torch.clamp(t[1] / t[2], *limits_y)
    zero = torch.zeros_like(a)
    J = torch.stack([cam.fx / t[2], zero, -cam.fx * a / t[2], zero, cam.fy / t[2], -cam.fy * b / t[2]]).reshape(2, 3)
    plain = J @ R @ S @ R.T @ J.T
    return plain, plain + opt.eps2d * torch.eye(2).to(plain)


def _color(g: GaussianInputs, i: int, R: Tensor, tau: Tensor, opt: RasterOptions, note: Note) -> Tensor:
    if g.colors is not None:
        return g.colors[i]
    assert g.sh is not None
    toward = g.means[i] + R.T @ tau
    raw = eval_sh(g.sh.to_dense()[i : i + 1], (toward / toward.norm())[None], g.sh.active_degree)[0] + 0.5
    if not opt.clamp_color:
        return raw
    note(raw + 1, 1.0)  # absolute distance to zero
    return torch.clamp(raw, min=0)
