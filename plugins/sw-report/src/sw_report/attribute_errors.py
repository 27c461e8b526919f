"""Errors of the attributes of one set of Gaussians against another, row by row, whatever order they are in."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from sw_gaussians.covariances import covariances_of

from splatwizard_core.api import SH_C0, GaussianModel

Array = NDArray[np.float64]

TIED = 8
"""Gaussians of B at one place that are told apart by likeness, where the orders differ."""
SAMPLED, AGREE = 10_000, 0.99
"""Rows that are looked at to see whether the orders agree, and the share that must be nearest to their own row."""
FLAT = -20.0
"""Log scale of a surfel along its normal, as files with three scales have it."""


@dataclass(frozen=True)
class Error:
    """Root mean square, median, 99 % quantile and largest of the absolute differences."""

    rms: float
    median: float
    q99: float
    max: float


@dataclass(frozen=True)
class AttributeErrors:
    """Errors of A against its partners in B.

    matched     "in order", or "nearest": by the means
    rows        Gaussians compared
    left_out    of A and B, with values that are not finite
    taken_twice, never_taken    how many of B are the partner of several Gaussians of A, and of none
    extent      diagonal of the box that holds the middle 90 % of A, world units
    errors      "position" (world units), "log_scale" (the three of each, sorted), "log_covariance" (Frobenius norm of
                the difference of R diag(ln s) R^T, which no order of axes and no sign changes), "covariance" (the same
                of R diag(s^2) R^T, relative to A), "opacity" and "color" (SH band 0; 1 is the range of a picture), "sh"
                (higher coefficients; missing ones are 0)
    """

    matched: str
    rows: int
    left_out: tuple[int, int]
    taken_twice: int
    never_taken: int
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
    taken = np.bincount(partner, minlength=len(theirs.means))
    low, high = np.percentile(ours.means, [5, 95], axis=0)
    covariance = ours.covariances() - theirs_matched.covariances()
    size = np.linalg.norm(ours.covariances(), axis=(1, 2))
    found = {
        "position": _error(np.linalg.norm(ours.means - theirs_matched.means, axis=1)),
        "log_scale": _error(np.sort(ours.log_scales, axis=1) - np.sort(theirs_matched.log_scales, axis=1)),
        "log_covariance": _error(
            np.linalg.norm(ours.log_covariances() - theirs_matched.log_covariances(), axis=(1, 2))
        ),
        "covariance": _error(np.linalg.norm(covariance, axis=(1, 2)) / np.maximum(size, 1e-300)),
        "opacity": _error(ours.opacities - theirs_matched.opacities),
        "color": _error(ours.colors - theirs_matched.colors),
        "sh": _error(ours.rest - theirs_matched.rest),
    }
    return AttributeErrors(
        matched=matched,
        rows=len(ours.means),
        left_out=(a.num_rows - len(ours.means), b.num_rows - len(theirs.means)),
        taken_twice=int((taken > 1).sum()),
        never_taken=int((taken == 0).sum()),
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
        steps = 1 / SH_C0  # of the coefficient for one of the colour
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

    def log_covariances(self) -> Array:
        """[n,3,3] R diag(ln s) R^T."""
        axes = _rotations(self.quats)
        return np.einsum("nij,nj,nkj->nik", axes, self.log_scales, axes)


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
    """Pair the rows: "in order" or "nearest", and the row of `b` for each of `a`.

    The orders agree if the counts do and 99 % of 10,000 evenly spaced rows have no nearer row than their own. Else the
    nearest mean is taken; where several are equally near (coincident Gaussians), the one that is most alike.
    """
    tree = cKDTree(b.means)
    if len(a.means) == len(b.means):
        rows = np.unique(np.linspace(0, len(a.means) - 1, min(SAMPLED, len(a.means))).astype(np.intp))
        nearest, _ = tree.query(a.means[rows])
        own = np.linalg.norm(a.means[rows] - b.means[rows], axis=1)
        if (own <= nearest).mean() >= AGREE:
            return "in order", np.arange(len(a.means))
    near, candidates = tree.query(a.means, k=min(TIED, len(b.means)))
    near, candidates = near.reshape(len(a.means), -1), candidates.reshape(len(a.means), -1)
    order = np.argsort(candidates, axis=1)  # so that of those alike the lowest row is taken
    near, candidates = (np.take_along_axis(each, order, axis=1) for each in (near, candidates))
    unlike = np.where(near <= near.min(axis=1, keepdims=True), 0.0, np.inf)
    for column in ("log_scales", "opacities", "colors"):
        ours, theirs = getattr(a, column), getattr(b, column)[candidates]
        unlike = unlike + abs(theirs - ours[:, None]).reshape(*candidates.shape, -1).sum(axis=2)
    return "nearest", candidates[np.arange(len(candidates)), unlike.argmin(axis=1)]


def _error(differences: Array) -> Error:
    """Summarise differences, one per row or several."""
    sizes = abs(differences)
    middle, high = np.quantile(sizes, [0.5, 0.99])
    return Error(float(np.sqrt((sizes**2).mean())), float(middle), float(high), float(sizes.max()))
