"""The oracle's oracle: one Gaussian after the other, all pixels at once, no tiles; for a few dozen Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, RasterOptions
from sw_reference.spherical_harmonics import sh_colors

Note = Callable[["Tensor | float", float], None]
MaskedNote = Callable[..., None]


@dataclass
class Pair:
    """The effect of one Gaussian on every pixel, each [H,W]; `raw` is alpha before the clamp and the cuts."""

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

    Of surfels also normals [3,H,W] and distortion [H,W].

    margin  smallest relative distance of any quantity to a threshold that would change the picture discontinuously
    """

    image: Tensor
    alpha: Tensor
    depth: dict[str, Tensor]
    features: Tensor | None
    pairs: list[Pair]
    margin: float
    normals: Tensor | None = None
    distortion: Tensor | None = None


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
    flat = g.scales is not None and g.scales.shape[1] == 2
    T = torch.ones(H, W).to(g.means)
    running = torch.ones(H, W, dtype=torch.bool)
    image: Tensor | None = None
    sums = {"accumulated": torch.zeros_like(T), "inverse": torch.zeros_like(T), "median": torch.zeros_like(T)}
    features = None if g.features is None else torch.zeros(g.features.shape[1], H, W).to(g.means)
    pairs = []
    light: list[tuple[Tensor, Tensor]] = []  # (weight, depth mapped to 0..1) of each surfel
    normals = torch.zeros(3, H, W).to(g.means)
    for _, i in order:
        t = R @ g.means[i] + tau
        if flat:
            raw, depth, normal, d, met = _surfel(g, i, t, R, cam, opt, pixels, note)
        else:
            raw, d = _ellipsoid(g, i, t, R, cam, opt, pixels, note)
            depth, met = t[2].expand(H, W), torch.ones_like(running)
        alpha = torch.clamp(raw, max=0.99)
        if opt.clamp_grad == "pass":
            alpha = raw + (alpha - raw).detach()
        tried = running & met & (alpha >= 1 / 255)
        note(raw, 1 / 255, running & met)
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
        sums["accumulated"] = sums["accumulated"] + weight * depth
        sums["inverse"] = sums["inverse"] + weight / depth
        sums["median"] = torch.where(blended & (T > 0.5), depth, sums["median"])
        if flat:
            normals = normals + normal[:, None, None] * weight
            light.append((weight, 100 / 99.8 * (1 - 0.2 / depth)))
        running = running & ~(tried & ~blended)
        T = torch.where(blended, after, T)
    channels = 3 if g.colors is None else g.colors.shape[1]
    if image is None:
        image = torch.zeros(channels, H, W).to(g.means)
    if opt.background is not None:
        background = opt.background.to(image)
        image = image + T * (background[:, None, None] if background.dim() == 1 else background)
    sums["expected"] = sums["accumulated"] / torch.clamp(1 - T, min=1e-10)
    distortion = torch.zeros_like(T)
    for i, (weight, m) in enumerate(light):
        for other, n in light[:i]:
            distortion = distortion + weight * other * (m - n) ** 2
    return NaiveResult(
        image, 1 - T, {m: sums[m] for m in opt.depth}, features, pairs, margin,
        normals if opt.normals else None, distortion if opt.distortion else None,
    )  # fmt: skip


def _ellipsoid(
    g: GaussianInputs, i: int, t: Tensor, R: Tensor, cam: Camera, opt: RasterOptions, pixels: Tensor, note: Note
) -> tuple[Tensor, Tensor]:
    """(alpha before clamp and cuts [H,W], centre minus pixel [H,W,2])."""
    sigma2d, low_pass = _screen_covariance(g, i, t, R, cam, opt, note)
    K = torch.linalg.inv(low_pass)
    opacity = g.opacities[i]
    if opt.antialias:
        ratio = torch.linalg.det(sigma2d) / torch.linalg.det(low_pass)
        note(ratio, 2.5e-5)
        opacity = opacity * torch.sqrt(torch.clamp(ratio, min=2.5e-5))
    u = torch.stack([cam.fx * t[0] / t[2] + cam.cx, cam.fy * t[1] / t[2] + cam.cy])
    d = u - pixels
    return opacity * torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", d, K, d)), d


def _surfel(
    g: GaussianInputs, i: int, t: Tensor, R: Tensor, cam: Camera, opt: RasterOptions, pixels: Tensor, note: MaskedNote
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(alpha before clamp and cuts, z, normal [3], centre minus pixel, whether the ray meets the plane in front).

    By geometry: the ray through the pixel is cut with the plane and measured along the surfel's axes. The centre of
    the low-pass is the middle of the picture of the 3-sigma circle, from that ellipse's dual conic.
    """
    assert g.scales is not None
    assert g.quats is not None
    s1, s2 = opt.scale_modifier * g.scales[i]
    e1, e2, normal = (R @ _rotation(g.quats[i])).unbind(dim=1)
    note((normal @ t) / t.norm() + 1, 1.0)
    if bool(normal @ t > 0):
        normal = -normal
    rays = torch.stack([
        (pixels[..., 0] - cam.cx) / cam.fx, (pixels[..., 1] - cam.cy) / cam.fy, torch.ones_like(pixels[..., 0])
    ], dim=-1)  # fmt: skip
    slope = rays @ normal
    z = (normal @ t) / torch.where(slope == 0, 1, slope)
    met = (slope != 0) & (z >= cam.near) & (z <= cam.far)
    z = torch.where(met, z, 1)
    at = rays * z[..., None] - t
    on_plane = (at @ e1 / s1) ** 2 + (at @ e2 / s2) ** 2

    K = t.new_tensor([[cam.fx, 0, cam.cx], [0, cam.fy, cam.cy], [0, 0, 1]])
    circle = torch.diag(t.new_tensor([9.0, 9.0, -1.0]))
    H = K @ torch.stack([s1 * e1, s2 * e2, t], dim=1)
    dual = H @ circle @ H.T
    d = dual[:2, 2] / dual[2, 2] - pixels
    on_screen = 2 * (d * d).sum(dim=-1)
    rho = torch.where(on_plane <= on_screen, on_plane, on_screen)
    raw = g.opacities[i] * torch.exp(-0.5 * rho)
    seen = met & (raw > 1 / 300)
    # The value is continuous there: only differences across the kink must be avoided, so a smaller margin will do.
    note(1 + 10 * (on_plane / on_screen - 1), 1.0, seen)
    note(z, cam.near, raw > 1 / 300)
    return raw, z, normal, d, met


def _rotation(quat: Tensor) -> Tensor:
    w, x, y, z = quat / quat.norm()
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]).reshape(3, 3)  # fmt: skip


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
        factor = opt.scale_modifier * (1 if g.scale_factors is None else g.scale_factors[i])
        M = _rotation(g.quats[at]) @ torch.diag(factor * g.scales[at])
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
    raw = sh_colors(g.sh, -R.T @ tau, g.means, rows=torch.tensor([i]), clamp=False)[0]
    if not opt.clamp_color:
        return raw
    note(raw + 1, 1.0)  # absolute distance to zero
    return torch.clamp(raw, min=0)
