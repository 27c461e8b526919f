"""Merging Gaussians: one in place of several, by exact moments, with the opacity that keeps what is seen of them.

Weights of the moments are opacity times surface. Two rules for the opacity: *ink* keeps the integral of
1 - (1 - alpha_1)(1 - alpha_2) over the plane across the thinnest axis, so that coincident Gaussians become as opaque as
they look together; *mass* keeps the sum of opacity times surface, as NanoGS (arXiv 2603.16103) does.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from splatwizard_core.api import GaussianModel, ShapeError
from sw_gaussians.principal_axes import principal_axes, quaternions

THOMSEN = 1.6075
"""Exponent of Thomsen's formula for the surface of an ellipsoid, at most 1.06 % off."""

ROWS_AT_ONCE = 1 << 16
"""Rows of spherical harmonics that are copied together."""

COEFFICIENTS_AT_ONCE = 4
"""Spherical harmonics that are put into another order together: they are most of a Gaussian."""

Rule = Literal["ink", "mass"]


class Splats(NamedTuple):
    """Gaussians with activated values; leading dimensions [...] are alike in all.

    means       [...,3] world units
    scales      [...,3] standard deviations, world units
    quats       [...,4] w,x,y,z of any norm
    opacities   [...] in 0..1
    sh          [...,K,3] coefficients, band 0 first
    """

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    sh: Tensor

    def rows(self, index: Tensor) -> Splats:
        """The Gaussians of an index over the first dimension; that of a matrix [G,M] gives groups."""
        flat = index.flatten()  # whole rows are copied faster than elements are picked
        return Splats(*(each.index_select(0, flat).view(*index.shape, *each.shape[1:]) for each in self))

    def to(self, dtype: torch.dtype) -> Splats:
        """The same numbers in another precision."""
        return Splats(*(values.to(dtype) for values in self))


def splats_of(model: GaussianModel, rows: Tensor | None = None) -> Splats:
    """The Gaussians of a model, or some rows [M], its active SH bands; a copy of these.

    Raises ShapeError for surfels, which have two scales.
    """
    if model.NUM_SCALES != GaussianModel.NUM_SCALES:
        raise ShapeError("surfels cannot be merged: an average of flat ones has a thickness")
    rows = torch.arange(model.num_rows, device=model.device) if rows is None else rows
    bands = (model.active_sh_degree + 1) ** 2 - 1
    sh = model.sh_dc.new_empty(len(rows), 1 + bands, 3)
    for place, some in zip(sh.split(ROWS_AT_ONCE), rows.split(ROWS_AT_ONCE), strict=True):
        place[:, :1] = model.sh_dc.detach().index_select(0, some)
        place[:, 1:] = model.sh_rest.detach()[:, :bands].index_select(0, some)
    means, log_scales, quats, logits = (
        values.detach().index_select(0, rows)  # whole rows are copied faster than elements are picked
        for values in (model.means, model.log_scales, model.quats, model.opacity_logits)
    )
    return Splats(means, log_scales.exp(), normalize(quats, dim=1), logits.sigmoid(), sh)


def model_of(splats: Splats, rows: Tensor, like: GaussianModel) -> GaussianModel:
    """A model in float32 of some Gaussians, fixed, with what the file of `like` told; overwrites their SH."""
    dc, rest = sh_of(splats.sh, rows)
    log_scales = splats.scales[rows].double().clamp(1e-38, 3e38).log().float()
    raw = (splats.means[rows], dc, rest, logits_of(splats.opacities[rows]), log_scales, splats.quats[rows])
    model = GaussianModel(*(values.float() for values in raw))
    model.origin = like.origin
    return model.eval().requires_grad_(False)


def logits_of(opacities: Tensor) -> Tensor:
    """Logits [N] float32 of opacities [N], within +-13.8."""
    return torch.logit(opacities.double().clamp(1e-6, 1 - 1e-6)).float()


def sh_of(sh: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The first band [n,1,3] and the others [n,K-1,3] of some rows of coefficients [N,K,3], which it overwrites.

    Where most rows stay, the others lie in the memory of all: they are most of a Gaussian, so a copy would be the
    largest thing beside them.
    """
    n, bands = len(rows), sh.shape[1] - 1
    dc = sh[:, :1].index_select(0, rows)
    if 2 * n <= len(sh) or not sh.is_contiguous():
        return dc, sh[:, 1:].index_select(0, rows)
    for some in sh.split(COEFFICIENTS_AT_ONCE, dim=1):
        some[:n] = some[rows]
    rest = sh.view(-1)[: 3 * bands * n].view(n, bands, 3)
    for start in range(0, n, ROWS_AT_ONCE):  # what is written lies before what is still to be read
        part = slice(start, min(start + ROWS_AT_ONCE, n))
        rest[part] = sh[part, 1:].clone()
    return dc, rest


def surface(scales: Tensor) -> Tensor:
    """Return the surfaces [...] of ellipsoids with semi-axes [...,3], by Thomsen's formula."""
    a, b, c = scales.unbind(-1)
    mean = ((a * b) ** THOMSEN + (a * c) ** THOMSEN + (b * c) ** THOMSEN) / 3
    return 4 * math.pi * mean ** (1 / THOMSEN)


def covariances(scales: Tensor, quats: Tensor) -> Tensor:
    """Return covariances [...,3,3] of standard deviations [...,3] along the axes of unit quaternions [...,4]."""
    w, x, y, z = quats.unbind(-1)
    rotation = torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], dim=-1).view(*w.shape, 3, 3)  # fmt: skip
    axes = rotation * scales[..., None, :]
    found: Tensor = axes @ axes.mT
    return found


@torch.no_grad()
def merge_groups(groups: Splats, *, rule: Rule = "ink", widen: bool = False) -> Splats:
    """Return one Gaussian for each group, in float64, SH in their own; the order of the members does not matter.

    groups  Splats [G,M]: M members each; one of opacity 0 counts for nothing, unless all of the group are
    rule    of the opacity: see the module
    widen   where opacity 1 is not enough, grow the covariance by what is missing: mass and ink are kept. Else they
            are cut at opacity 1

    The ink of more than two stops at pairs (inclusion and exclusion), and so is held to at least that of the member
    with most. Means, covariances and SH are the weighted moments, exact up to rounding.
    """
    groups = groups.to(torch.float64)._replace(sh=groups.sh)
    alphas = groups.opacities
    first = groups.means[:, :1]
    offsets = groups.means - first
    # In units of the group, so that neither squares nor cubes of a scale leave the range of float64.
    unit = torch.maximum(groups.scales.amax(dim=(1, 2)), offsets.abs().amax(dim=(1, 2))).clamp_min(1e-300)
    offsets, scales = offsets / unit[:, None, None], groups.scales / unit[:, None, None]
    masses = alphas * surface(scales)
    total = masses.sum(dim=1, keepdim=True)
    shares = torch.where(total > 0, masses / total.clamp_min(1e-300), 1 / alphas.shape[1])
    center = (shares[..., None] * offsets).sum(dim=1, keepdim=True)
    offsets = offsets - center
    members = covariances(scales, normalize(groups.quats, dim=-1))
    spread = offsets[..., :, None] * offsets[..., None, :]
    found = (shares[..., None, None] * (members + spread)).sum(dim=1)
    values, axes = principal_axes((found + found.mT) / 2)
    values = values.clamp_min(0)
    if rule == "ink":
        wanted, size = _ink(alphas, members, offsets, axes[..., 1:]), 2 * math.pi * (values[:, 1] * values[:, 2]).sqrt()
    else:
        wanted, size = total[:, 0], surface(values.sqrt())
    most = alphas.amax(dim=1)
    opacities = torch.where(size > 0, wanted / size.clamp_min(1e-300), most)
    if widen:
        values = values * opacities.clamp_min(1)[:, None]
    return Splats(
        means=(first + center * unit[:, None, None])[:, 0],
        scales=values.sqrt() * unit[:, None],
        quats=quaternions(axes),
        opacities=opacities.clamp(0, 1),
        sh=(shares.to(groups.sh)[..., None, None] * groups.sh).sum(dim=1),
    )


def _ink(alphas: Tensor, members: Tensor, offsets: Tensor, plane: Tensor) -> Tensor:
    """Return the ink [G] of groups: the integral of their joint opacity over a plane.

    alphas, members, offsets    [G,M], [G,M,3,3], [G,M,3]
    plane                       [G,3,2] two axes of unit length
    """
    flat = plane.mT[:, None] @ members @ plane[:, None]
    places = (offsets[..., None, :] @ plane[:, None])[..., 0, :]
    inks = alphas * 2 * math.pi * _det2(flat).sqrt()
    shared = torch.zeros_like(inks[:, 0])
    for i in range(alphas.shape[1] - 1):
        both = flat[:, i, None] + flat[:, i + 1 :]
        det = _det2(both)
        d = places[:, i, None] - places[:, i + 1 :]
        dx, dy = d.unbind(-1)
        apart = dx * dx * both[..., 1, 1] - 2 * dx * dy * both[..., 0, 1] + dy * dy * both[..., 0, 0]
        det = det.clamp_min(1e-300)
        overlap = (_det2(flat[:, i, None]) * _det2(flat[:, i + 1 :]) / det).sqrt() * torch.exp(-apart / (2 * det))
        shared += (2 * math.pi * alphas[:, i, None] * alphas[:, i + 1 :] * overlap).sum(dim=1)
    return torch.maximum(inks.sum(dim=1) - shared, inks.amax(dim=1))


def _det2(matrices: Tensor) -> Tensor:
    m = matrices
    return (m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0]).clamp_min(0)
