"""Price of merging two Gaussians: how far the field of colour that one makes is from that of the two."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from splatwizard_core.api import SH_C0
from sw_gaussians.merging import Splats, covariances, surface

COLOR_PRICE = 4 * math.pi * 1e-6
"""Of a squared difference of colour: keeps fine texture from being merged where its volume is next to nothing."""
SMALLEST = 1e-36
"""Divisors are held to at least this: float32 has no smaller normal numbers to speak of."""


class Columns(NamedTuple):
    """Gaussians as the price looks at them, column by column; lengths in units of the scene.

    places      [3,N]
    six         [6,N] xx, xy, xz, yy, yz, zz of the covariances
    volumes     [N] product of the three standard deviations
    masses      [N] opacity times surface
    opacities   [N]
    colors      [3,N] base colours
    rest        [3 (K - 1),N] coefficients of the higher SH bands
    """

    places: Tensor
    six: Tensor
    volumes: Tensor
    masses: Tensor
    opacities: Tensor
    colors: Tensor
    rest: Tensor

    def part(self, start: int, end: int) -> Columns:
        """The rows from `start` up to `end`, as views."""
        return Columns(*(values[..., start:end] for values in self))


def columns_of(splats: Splats, unit: float, center: Tensor | None = None) -> Columns:
    """Columns of Gaussians [N]; `unit` is the scene's size, so that prices do not depend on what its lengths mean.

    center  [3] the origin of the places; None: their mean
    """
    center = splats.means.mean(dim=0) if center is None else center
    scales = splats.scales / unit
    full = covariances(scales, splats.quats)
    return Columns(
        places=((splats.means - center) / unit).T.contiguous(),
        six=torch.stack([full[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]),
        volumes=scales.prod(dim=1),
        masses=splats.opacities * surface(scales),
        opacities=splats.opacities,
        colors=(0.5 + SH_C0 * splats.sh[:, 0]).T.contiguous(),
        rest=splats.sh[:, 1:].flatten(1).T.contiguous(),
    )


def closeness(a: Columns, b: Columns) -> Tensor:
    """Return the squared Mahalanobis distances [N] of pairs, by the sum of both covariances."""
    six = a.six + b.six
    return _quadratic(six, b.places - a.places, _det(six))


def prices(a: Columns, b: Columns, apart: Tensor | None = None) -> Tensor:
    """Return the price [N] >= 0 of merging each of `a` with its partner in `b`, by moments and the ink rule.

    apart   [N] squared distance of their higher bands; None: of those of the columns

    The integral of the squared difference of opacity times colour times the Gaussian, before and after, over all
    space, in cubes of the unit, and the difference of their colours at COLOR_PRICE.
    """
    total = a.masses + b.masses
    share = torch.where(total > 0, a.masses / total.clamp_min(SMALLEST), 0.5)
    other = 1 - share
    d = b.places - a.places
    six = share * a.six + other * b.six + share * other * _outer(d)
    opacities = _ink_opacity(a, b, d, six)
    colors = share * a.colors + other * b.colors
    volumes = _det(six).clamp_min(0).sqrt()
    at, bt, mt = a.opacities, b.opacities, opacities
    field = (
        at * at * _dot(a.colors, a.colors) * a.volumes
        + bt * bt * _dot(b.colors, b.colors) * b.volumes
        + mt * mt * _dot(colors, colors) * volumes
    ) / math.sqrt(8)  # the product of a Gaussian with itself: both covariances add up to twice the one
    field = field + 2 * at * bt * _dot(a.colors, b.colors) * _product(a.volumes, b.volumes, a.six + b.six, d)
    field = field - 2 * at * mt * _dot(a.colors, colors) * _product(a.volumes, volumes, a.six + six, other * d)
    field = field - 2 * bt * mt * _dot(b.colors, colors) * _product(b.volumes, volumes, b.six + six, share * d)
    apart = ((a.rest - b.rest) ** 2).sum(dim=0) if apart is None else apart
    apart = ((a.colors - b.colors) ** 2).sum(dim=0) + apart / (4 * math.pi)
    found: Tensor = (2 * math.pi) ** 1.5 * field.clamp_min(0) + COLOR_PRICE * apart
    return found


def _ink_opacity(a: Columns, b: Columns, d: Tensor, six: Tensor) -> Tensor:
    """Opacity [N] of the merged Gaussian, as `merging.merge_groups` has it for two."""
    least = _least_eigenvalue(six)
    normal = _null_vector(six, least)
    # Across a normal n the projection of S has determinant n' adj(S) n.
    pa, pb, pm = (_quadratic_of(_adjugate(s), normal).clamp_min(0) for s in (a.six, b.six, six))
    both = a.six + b.six
    pab = _quadratic_of(_adjugate(both), normal).clamp_min(SMALLEST)
    # Within the plane d' P^-1 d is the determinant of P stretched by d over that of P.
    inner = (_quadratic_of(_adjugate(both + _outer(d)), normal) / pab - 1).clamp_min(0)
    ink_a, ink_b = a.opacities * pa.sqrt(), b.opacities * pb.sqrt()
    shared = a.opacities * b.opacities * (pa * (pb / pab)).sqrt() * torch.exp(-inner / 2)
    wanted = torch.maximum(ink_a + ink_b - shared, torch.maximum(ink_a, ink_b))
    most = torch.maximum(a.opacities, b.opacities)
    return torch.where(pm > 0, wanted / pm.clamp_min(SMALLEST).sqrt(), most).clamp(0, 1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=0)


def _outer(d: Tensor) -> Tensor:
    x, y, z = d
    return torch.stack([x * x, x * y, x * z, y * y, y * z, z * z])


def _adjugate(six: Tensor) -> Tensor:
    xx, xy, xz, yy, yz, zz = six
    return torch.stack([
        yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
        xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy,
    ])  # fmt: skip


def _det(six: Tensor) -> Tensor:
    xx, xy, xz, yy, yz, zz = six
    found: Tensor = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return found


def _quadratic_of(six: Tensor, v: Tensor) -> Tensor:
    x, y, z = v
    xx, xy, xz, yy, yz, zz = six
    found: Tensor = x * (xx * x + 2 * (xy * y + xz * z)) + y * (yy * y + 2 * yz * z) + zz * z * z
    return found


def _quadratic(six: Tensor, d: Tensor, det: Tensor) -> Tensor:
    """d' S^-1 d of each."""
    return _quadratic_of(_adjugate(six), d).clamp_min(0) / det.clamp_min(SMALLEST)


def _product(volume_a: Tensor, volume_b: Tensor, both: Tensor, d: Tensor) -> Tensor:
    """Integral of the product of two Gaussians, over (2 pi)^(3/2)."""
    det = _det(both)
    root = det.clamp_min(SMALLEST).sqrt()
    return volume_a * (volume_b / root) * torch.exp(-_quadratic(both, d, det) / 2)


def _least_eigenvalue(six: Tensor) -> Tensor:
    """Smallest eigenvalue [N] of symmetric matrices, by the angle of their characteristic cubic."""
    xx, xy, xz, yy, yz, zz = six
    middle = (xx + yy + zz) / 3
    x, y, z = xx - middle, yy - middle, zz - middle
    off = xy * xy + xz * xz + yz * yz
    p = ((x * x + y * y + z * z + 2 * off) / 6).sqrt()
    det = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
    r = (det / (2 * p * p * p).clamp_min(SMALLEST)).clamp(-1, 1)
    found: Tensor = middle + 2 * p * torch.cos(torch.acos(r) / 3 + 2 * math.pi / 3)
    return found.clamp_min(0)


def _null_vector(six: Tensor, value: Tensor) -> Tensor:
    """Unit eigenvector [3,N] of an eigenvalue: the longest product of two rows of S - value I; any of a sphere."""
    xx, xy, xz, yy, yz, zz = six
    columns = _adjugate(torch.stack([xx - value, xy, xz, yy - value, yz, zz - value]))
    a, b, c, d, e, f = columns
    best = torch.stack([a.abs(), d.abs(), f.abs()]).argmax(dim=0)
    choice = torch.stack([torch.stack([a, b, c]), torch.stack([b, d, e]), torch.stack([c, e, f])])
    vector = choice.gather(0, best[None, None].expand(1, 3, -1))[0]
    length = (vector * vector).sum(dim=0).sqrt()
    plain = torch.zeros_like(vector)
    plain[0] = 1
    return torch.where(length > SMALLEST, vector / length.clamp_min(SMALLEST), plain)
