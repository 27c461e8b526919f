"""Errors of depth and normals of a model, pixel by pixel, on scenes that bring exact maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from sw_gaussians.surface import depth_normals
from torch import Tensor

from splatwizard_core.api import Rasterizer, RasterOptions, SplatModel, View, track
from sw_geometry.depth import depth_of

ANGLES = (11.25, 22.5, 30.0)
"""Degrees of which tables of normals tell the share of pixels below."""


def depth_and_normal_error(
    model: SplatModel,
    views: Sequence[View],
    rasterizer: Rasterizer,
    options: RasterOptions,
    truth: Mapping[str, Mapping[str, Tensor]],
    *,
    depth_ratio: float,
    alpha_min: float,
) -> dict[str, dict[str, float]]:
    """Compare depth, and the normals of the surface that the depth describes, with exact maps.

    truth   "depth": view name -> [1,H,W], 0 = nothing; "normal_maps": view name -> [3,H,W], world frame

    Returns, over all pixels of all views where both have a surface, "depth": abs_rel (mean |z - t| / t), rmse (units of
    the scene), covered (share of the true surface that has a depth); and "normals": mean, median (degrees), and
    within_11, within_22, within_30, the shares below 11.25, 22.5 and 30 degrees. Empty where no view has both.
    """
    relative, squared, degrees = [], [], []
    covered = total = 0
    with track("compare depth", total=len(views), unit="views") as bar:
        for view in views:
            depth, alpha, _ = depth_of(model, view, rasterizer, options, depth_ratio=depth_ratio)
            depth = torch.where(alpha >= alpha_min, depth, 0.0).cpu()
            exact = truth["depth"][view.name]
            both = (depth > 0) & (exact > 0)
            total += int((exact > 0).sum())
            covered += int(both.sum())
            gap = (depth - exact)[both].double()
            relative.append(gap.abs() / exact[both].double())
            squared.append(gap * gap)
            if "normal_maps" in truth:
                degrees.append(_angles(depth_normals(depth, view.camera), truth["normal_maps"][view.name], both[0]))
            bar.advance()
    if not covered:
        return {}
    found = {
        "depth": {
            "abs_rel": float(torch.cat(relative).mean()),
            "rmse": float(torch.cat(squared).mean().sqrt()),
            "covered": covered / total,
        }
    }
    angles = torch.cat(degrees) if degrees else torch.zeros(0)
    if len(angles):
        found["normals"] = {
            "mean": float(angles.mean()),
            "median": float(angles.median()),
            **{f"within_{int(limit)}": float((angles < limit).double().mean()) for limit in ANGLES},
        }
    return found


def _angles(normals: Tensor, exact: Tensor, there: Tensor) -> Tensor:
    """Degrees between unit normals [3,H,W], where both are there and `there` [H,W]; [n] float64."""
    there = there & (normals.norm(dim=0) > 0.5)
    a, b = normals[:, there].double(), exact[:, there].double()
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b, dim=0).norm(dim=0), (a * b).sum(dim=0)))
