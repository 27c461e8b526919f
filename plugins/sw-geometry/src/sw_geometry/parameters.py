"""Parameters of a mesh, decided from the scene where the user gives none.

Source: 2DGS (arXiv 2403.17888) and its mesh extraction, for bounded scenes and for DTU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from splatwizard_core.api import BitstreamError, Camera, Scene, SceneError
from sw_geometry.mesh import Floats
from sw_geometry.settings import MeshSettings

DTU = {"voxel_size": 0.004, "sdf_trunc": 0.016, "depth_trunc": 3.0, "clusters": 1}
"""Of scenes whose object lies in the unit sphere, as 2DGS and TrimGS mesh DTU."""
MESH_RES, UNBOUNDED_RES = 1024, 256
"""Voxels along depth_trunc, and along the grid of the unbounded mode: published code takes 1024 there, 80 GB here."""
AUTO_CLUSTERS = 50
AUTO_TRUNCATION = 5.0  # voxels; with 8, the library's default, the surface moves outwards at edges


@dataclass(frozen=True)
class Parameters:
    """The values that one mesh is made with; lengths in units of the scene.

    depth_ratio     0: expected depth, 1: median
    focus, radius   the point that the cameras look at, and their smallest distance from it
    backend         which class of Open3D fuses: tensor or legacy
    """

    voxel_size: float
    sdf_trunc: float
    depth_trunc: float
    mesh_res: int
    clusters: int
    min_views: int
    depth_ratio: float
    alpha_min: float
    mask: bool
    views: str
    unbounded: bool
    cull: Literal["all", "any", "none"]
    focus: tuple[float, float, float]
    radius: float
    backend: str = "tensor"


def stated(model: object, static: Mapping[str, Any]) -> Mapping[str, Any]:
    """Values of a model's file, with the depth_ratio that the model itself was trained with if the file says none."""
    surface = getattr(model, "surface", None)
    return static if surface is None else {"depth_ratio": surface.depth_ratio, **static}


def resolve(settings: MeshSettings, scene: Scene, static: Mapping[str, Any]) -> Parameters:
    """Parameters of a mesh of a scene.

    static  as `stated` tells it; its depth_ratio holds where the user names no depth

    Raises SceneError for cameras that do not look at anything in common, BitstreamError for a bad depth_ratio.
    """
    is_dtu = scene.protocol.dataset == "dtu"
    focus, radius = focus_and_radius([view.camera for view in scene.train])
    bounded: Mapping[str, Any] = DTU if is_dtu else {"depth_trunc": 2 * radius, "clusters": AUTO_CLUSTERS}
    depth_trunc = settings.depth_trunc or bounded["depth_trunc"]
    mesh_res = settings.mesh_res or (UNBOUNDED_RES if settings.unbounded else MESH_RES)
    # Published code knows no such limit; below a pixel, depth that is looked up at the nearest one has no detail.
    footprint = 0.0 if settings.mesh_res else radius / max(view.camera.fx for view in scene.train)
    voxel = settings.voxel_size or bounded.get("voxel_size") or max(depth_trunc / mesh_res, footprint)
    truncation = DTU["sdf_trunc"] / DTU["voxel_size"] if is_dtu else AUTO_TRUNCATION
    return Parameters(
        voxel_size=voxel,
        sdf_trunc=settings.sdf_trunc or truncation * voxel,
        depth_trunc=depth_trunc,
        mesh_res=mesh_res,
        clusters=settings.clusters or bounded["clusters"],
        min_views=settings.min_views,
        depth_ratio=_depth_ratio(settings.depth, static, 1.0 if is_dtu else 0.0),
        alpha_min=settings.alpha_min,
        mask=settings.mask,
        views=settings.views,
        unbounded=settings.unbounded,
        cull=settings.cull or ("all" if is_dtu else "none"),
        focus=(float(focus[0]), float(focus[1]), float(focus[2])),
        radius=radius,
        backend=settings.backend,
    )


def _depth_ratio(asked: str | None, static: Mapping[str, Any], default: float) -> float:
    if asked is not None:
        return {"expected": 0.0, "median": 1.0}[asked] if "=" not in asked else float(asked.partition("=")[2])
    ratio = static.get("depth_ratio", default)
    if isinstance(ratio, bool) or not isinstance(ratio, (int, float)) or not 0 <= ratio <= 1:
        raise BitstreamError(f"the file says depth_ratio = {ratio!r:.40}; it must be between 0 and 1")
    return float(ratio)


def focus_and_radius(cameras: Sequence[Camera]) -> tuple[Floats, float]:
    """The point [3] nearest to all optical axes (least squares), and the smallest distance of a camera from it.

    Raises SceneError where the axes are parallel, or a camera stands in that point.
    """
    centers = np.stack([camera.center.double().cpu().numpy() for camera in cameras])
    axes = np.stack([camera.R[2].double().cpu().numpy() for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None]  # [n,3,3]: away from the axis; its own square
    left, right = across.mean(axis=0), (across @ centers[:, :, None]).mean(axis=0)
    if np.linalg.eigvalsh(left)[0] < 1e-6:
        raise SceneError("the cameras look in one direction: name depth_trunc and voxel_size, or other views")
    focus = np.linalg.solve(left, right)[:, 0]
    radius = float(np.linalg.norm(centers - focus, axis=1).min())
    if not radius > 0:
        raise SceneError("a camera stands in the point that the others look at: name depth_trunc and voxel_size")
    return focus, radius
