"""Initialisation: one Gaussian (or surfel) per start point."""

from __future__ import annotations

import logging
import math
from typing import Literal

import torch
from torch import Tensor

from splatwizard_core.api import SH_C0, GaussianModel, PointCloud, Scene, SceneError
from sw_gaussians.knn import mean_squared_neighbor_distance
from sw_gaussians.surfels import SurfelModel

log = logging.getLogger(__name__)

MIN_SQUARED_DISTANCE = 1e-7
"""Floor of the squared neighbour distance, world units squared (smallest sigma 3.162e-4)."""

Rotation = Literal["uniform4", "haar", "identity"]


def logit(p: float) -> float:
    """ln(p / (1 - p)), the inverse of the logistic function."""
    return math.log(p / (1 - p))


def start_points(scene: Scene, who: str, *, instead: str = "") -> PointCloud:
    """Return the start points of a scene. Raises SceneError if it has none.

    who         the method that needs them
    instead     what else would do, for the message
    """
    if scene.points is None or len(scene.points) == 0:
        other = f", or {instead}" if instead else ""
        raise SceneError(
            f"scene '{scene.name}' has no start points: {who} needs SfM points or random ones{other}", path=scene.path
        )
    return scene.points


def gaussians_from_points(
    points: PointCloud, *, max_sh_degree: int = 3, opacity: float = 0.1, scale_factor: float = 1.0
) -> GaussianModel:
    """Make one isotropic Gaussian per point, sigma = RMS distance to its three nearest neighbours.

    points          xyz [P,3]; points that are not finite are dropped with a warning; missing colours are grey
    opacity         initial opacity, 0..1
    scale_factor    multiplies the initial standard deviations (MCMC starts at 0.1)

    The active SH degree starts at 0. Raises SceneError if no point is left.
    Source: 3DGS (arXiv 2308.04079), code of the authors.
    """
    xyz, sh_dc, distances = _usable(points)
    quats = xyz.new_zeros(len(xyz), 4)
    quats[:, 0] = 1
    return GaussianModel(
        xyz.clone(),
        sh_dc,
        xyz.new_zeros(len(xyz), (max_sh_degree + 1) ** 2 - 1, 3),
        xyz.new_full((len(xyz),), logit(opacity)),
        (distances * scale_factor).log()[:, None].repeat(1, 3),
        quats,
        active_sh_degree=0,
    )


def surfels_from_points(
    points: PointCloud,
    *,
    generator: torch.Generator,
    max_sh_degree: int = 3,
    opacity: float = 0.1,
    scale_factor: float = 1.0,
    rotation: Rotation = "uniform4",
) -> SurfelModel:
    """Make one round surfel per point, sigma = RMS distance to its three nearest neighbours.

    points      xyz [P,3]; points that are not finite are dropped with a warning; missing colours are grey
    generator   of the rotations, on the CPU
    opacity     initial opacity, 0..1
    scale_factor    multiplies the initial standard deviations
    rotation    "uniform4": four numbers in [0,1), as the authors' code, which is no uniform rotation; "haar": a
                uniform rotation; "identity": all normals along z

    The active SH degree starts at 0. Raises SceneError if no point is left.
    Source: 2DGS (arXiv 2403.17888), code of the authors.
    """
    xyz, sh_dc, distances = _usable(points)
    n = len(xyz)
    if rotation == "uniform4":
        quats = torch.rand(n, 4, generator=generator)
    elif rotation == "haar":
        quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1)
    else:
        quats = torch.eye(4)[0].repeat(n, 1)
    return SurfelModel(
        xyz.clone(),
        sh_dc,
        xyz.new_zeros(n, (max_sh_degree + 1) ** 2 - 1, 3),
        xyz.new_full((n,), logit(opacity)),
        (distances * scale_factor).log()[:, None].repeat(1, 2),
        quats.to(xyz),
        active_sh_degree=0,
    )


def _usable(points: PointCloud) -> tuple[Tensor, Tensor, Tensor]:
    """Positions [N,3] of the finite points, SH band 0 [N,1,3], root mean square distance to three neighbours [N]."""
    finite = PointCloud(points.xyz.float(), points.rgb).finite()
    n = len(finite)
    if n < len(points):
        log.warning("dropped %d of %d start points that are not finite", len(points) - n, len(points))
    xyz, rgb = finite.xyz, finite.rgb
    if n == 0:
        raise SceneError("the scene has no usable start point: training needs SfM points or random ones")
    if rgb is None:
        log.warning("the %d start points have no colours; they start grey", n)
        sh_dc = xyz.new_zeros(n, 1, 3)
    else:
        sh_dc = ((rgb.to(xyz) - 0.5) / SH_C0)[:, None, :]
    squared = mean_squared_neighbor_distance(xyz).clamp_min(MIN_SQUARED_DISTANCE)
    return xyz, sh_dc, squared.sqrt()
