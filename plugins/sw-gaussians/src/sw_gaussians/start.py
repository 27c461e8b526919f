"""The first Gaussians of a scene: one for each of its start points."""

from __future__ import annotations

import logging
import math

from splatwizard_core.api import GaussianModel, PointCloud, SceneError, rgb_to_dc
from sw_gaussians.knn import mean_squared_neighbor_distance

log = logging.getLogger(__name__)

MIN_SQUARED_DISTANCE = 1e-7
"""Floor of the squared neighbour distance, world units squared (smallest sigma 3.162e-4)."""


def logit(p: float) -> float:
    """ln(p / (1 - p)), the inverse of the logistic function."""
    return math.log(p / (1 - p))


def gaussians_from_points(
    points: PointCloud, *, max_sh_degree: int = 3, opacity: float = 0.1, scale_factor: float = 1.0
) -> GaussianModel:
    """Make one isotropic Gaussian for each point, as large as the distance to its three nearest neighbours.

    points          xyz [P,3]; points that are not finite are dropped with a warning; missing colours are grey
    opacity         initial opacity, 0..1
    scale_factor    multiplies the initial standard deviations (MCMC starts at 0.1)

    The active SH degree starts at 0. Raises SceneError if no point is left.
    Source: 3DGS (arXiv 2308.04079), code of the authors.
    """
    finite = PointCloud(points.xyz.float(), points.rgb).finite()
    n = len(finite)
    if n < len(points):
        log.warning("dropped %d of %d start points that are not finite", len(points) - n, len(points))
    xyz, rgb = finite.xyz, finite.rgb
    if n == 0:
        raise SceneError("the scene has no usable start point: 3DGS needs SfM points or random ones")
    if rgb is None:
        log.warning("the %d start points have no colours; they start grey", n)
        sh_dc = xyz.new_zeros(n, 1, 3)
    else:
        sh_dc = rgb_to_dc(rgb.to(xyz))[:, None, :]
    squared = mean_squared_neighbor_distance(xyz).clamp_min(MIN_SQUARED_DISTANCE)
    log_scales = (squared.sqrt() * scale_factor).log()[:, None].repeat(1, 3)
    quats = xyz.new_zeros(n, 4)
    quats[:, 0] = 1
    return GaussianModel(
        xyz.clone(),
        sh_dc,
        xyz.new_zeros(n, (max_sh_degree + 1) ** 2 - 1, 3),
        xyz.new_full((n,), logit(opacity)),
        log_scales,
        quats,
        active_sh_degree=0,
    )
