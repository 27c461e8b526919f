"""Errors of the attributes of one set of Gaussians against another, row by row, whatever order they are in."""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from sw_gaussians.covariances import covariances_of

from splatwizard_core.api import GaussianModel, rgb_to_dc

Array = NDArray[np.float64]

NEIGHBORS = 8
"""Of B, looked at for each Gaussian of A where the orders differ: the one that is most alike is its partner."""
DISTINCT = 0.01
"""Difference of log scales from which on an axis has a direction of its own: those of a sphere have none."""
FLAT = -20.0
"""Log scale of a surfel along its normal, as files with three scales have it."""


@dataclass(frozen=True)
class Error:
    """Root mean square and largest absolute value of the differences."""

    rms: float
    max: float


@dataclass(frozen=True)
class AttributeErrors:
    """Errors of A against its partners in B.

    matched     "in order", or "nearest": by position, then by likeness
    rows        Gaussians compared
    left_out    of A and B, with values that are not finite
    unpaired    share of B that is nobody's partner, 0 .. 1
    extent      diagonal of the box that holds the middle 90 % of A, world units
    errors      "position" (world units), "log_scale" and "rotation" (the largest angle of an axis, degrees), once axes
                and signs are matched, "covariance" (Frobenius norm, relative to that of A), "opacity" and "color" (SH
                band 0; 1 is the range of a picture), "sh" (higher coefficients; missing ones are 0)
    """

    matched: str
    rows: int
    left_out: tuple[int, int]
    unpaired: float
    extent: float
    errors: dict[str, Error]

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def attribute_errors(a: GaussianModel, b: GaussianModel) -> AttributeErrors | None:
    """Compare two models on the CPU; None if one of them has no Gaussian with finite values."""
    ours, theirs = _Columns.of(a), _Columns.of(b)
    if not len(ours.means) or not len(theirs.means):
        return None
    matched, partner = _partners(ours, theirs)
    theirs_matched = theirs.rows(partner)
    low, high = np.percentile(ours.means, [5, 95], axis=0)
    log_scales, angles = _same_axes(ours, theirs_matched)
    covariance = ours.covariances() - theirs_matched.covariances()
    size = np.linalg.norm(ours.covariances(), axis=(1, 2))
    found = {
        "position": _error(np.linalg.norm(ours.means - theirs_matched.means, axis=1)),
        "log_scale": _error(ours.log_scales - log_scales),
        "rotation": _error(angles),
        "covariance": _error(np.linalg.norm(covariance, axis=(1, 2)) / np.maximum(size, 1e-300)),
        "opacity": _error(ours.opacities - theirs_matched.opacities),
        "color": _error(ours.colors - theirs_matched.colors),
        "sh": _error(ours.rest - theirs_matched.rest),
    }
    return AttributeErrors(
        matched=matched,
        rows=len(ours.means),
        left_out=(a.num_rows - len(ours.means), b.num_rows - len(theirs.means)),
        unpaired=1 - len(np.unique(partner)) / len(theirs.means),
        extent=float(np.linalg.norm(high - low)),
        errors=found,
    )


@dataclass(frozen=True)
class _Columns:
    """Attributes of n Gaussians, float64: [n,3], [n,3], [n,4] unit, [n], [n,3], [n,15,3]."""

    means: Array
    log_scales: Array
    quats: Array
    opacities: Array
    colors: Array
    rest: Array

    @classmethod
    def of(cls, model: GaussianModel) -> _Columns:
        values = {name: getattr(model, name).detach().cpu().double().numpy() for name in model.RAW}
        n = model.num_rows
        active = (model.active_sh_degree + 1) ** 2 - 1
        rest = np.zeros((n, 15, 3))
        rest[:, :active] = values["sh_rest"][:, :active]
        scales = values["log_scales"]
        scales = np.concatenate([scales, np.full((n, 3 - scales.shape[1]), FLAT)], axis=1)
        with np.errstate(over="ignore"):
            opacities = 1 / (1 + np.exp(-values["opacity_logits"]))
        quats = values["quats"] / np.maximum(np.linalg.norm(values["quats"], axis=1, keepdims=True), 1e-12)
        steps = float(rgb_to_dc(torch.tensor(1.5)))  # of the coefficient for one of the colour
        colors = 0.5 + values["sh_dc"][:, 0] / steps
        found = cls(values["means"], np.maximum(scales, FLAT), quats, opacities, colors, rest)
        sound = np.ones(n, dtype=bool)
        for column in vars(found).values():
            sound &= np.isfinite(column).reshape(n, -1).all(axis=1)
        return found.rows(np.flatnonzero(sound))

    def rows(self, index: NDArray[np.intp]) -> _Columns:
        return _Columns(*(column[index] for column in vars(self).values()))

    def covariances(self) -> Array:
        """[n,3,3]."""
        return covariances_of(self.quats, np.exp(self.log_scales))


def _same_axes(a: _Columns, b: _Columns) -> tuple[Array, Array]:
    """Log scales [n,3] of `b` by the axes of `a`, and the largest angle between these, degrees [n].

    An ellipsoid has 24 pairs of scales and a quaternion: its axes in any order, each in either direction. Of the six
    orders the one is taken that is most alike in scales and directions. An axis with the scale of another has no
    direction, and no angle.
    """
    turned = np.einsum("nki,nkj->nij", _rotations(a.quats), _rotations(b.quats))  # cosines: axis i of a, j of b
    cosines = np.minimum(np.abs(turned), 1.0)
    best, order = np.full(len(a.means), np.inf), np.zeros((len(a.means), 3), dtype=np.intp)
    axes = np.arange(3)
    for each in itertools.permutations(range(3)):
        unlike = np.abs(a.log_scales - b.log_scales[:, each]).sum(axis=1) + (1 - cosines[:, axes, each]).sum(axis=1)
        order = np.where((unlike < best)[:, None], np.array(each), order)
        best = np.minimum(unlike, best)
    rows = np.arange(len(a.means))[:, None]
    apart = np.abs(a.log_scales[:, :, None] - a.log_scales[:, None, :]) + np.diag([np.inf] * 3)
    has_direction = apart.min(axis=2) > DISTINCT
    angles = np.degrees(np.arccos(cosines[rows, axes, order]))
    return b.log_scales[rows, order], np.where(has_direction, angles, 0.0).max(axis=1)


def _rotations(quats: Array) -> Array:
    """[n,3,3] of unit quaternions (w, x, y, z); columns are the axes."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(each, axis=-1) for each in rows], axis=-2)


def _partners(a: _Columns, b: _Columns) -> tuple[str, NDArray[np.intp]]:
    """Pair the rows: "in order" or "nearest", and the row of `b` for each of `a`."""
    tree = cKDTree(b.means)
    near, candidates = tree.query(a.means, k=min(NEIGHBORS, len(b.means)))
    near, candidates = near.reshape(len(a.means), -1), candidates.reshape(len(a.means), -1)
    if len(a.means) == len(b.means):
        apart = np.linalg.norm(a.means - b.means, axis=1)
        # Rows that a coder moved are nearly as near as the nearest; of another order they are as far as any two.
        if apart.mean() <= 4 * near[:, 0].mean() + 1e-12:
            return "in order", np.arange(len(a.means))
    # Where Gaussians lie closer than a coder moves them, the nearest is often another: likeness decides.
    unlike = near / max(float(np.median(near[:, 0])), 1e-12 + float(np.ptp(a.means, axis=0).max()) * 1e-6) / 4
    for column in ("log_scales", "opacities", "colors"):
        ours, theirs = getattr(a, column), getattr(b, column)
        if column == "log_scales":  # in whatever order the axes are
            ours, theirs = np.sort(ours, axis=1), np.sort(theirs, axis=1)
        theirs = theirs[candidates]
        unlike = unlike + abs(theirs - ours[:, None]).reshape(*candidates.shape, -1).sum(axis=2)
    return "nearest", candidates[np.arange(len(candidates)), unlike.argmin(axis=1)]


def _error(differences: Array) -> Error:
    return Error(float(np.sqrt((differences**2).mean())), float(abs(differences).max()))
