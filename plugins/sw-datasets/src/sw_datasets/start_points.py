"""Start points of scenes that bring no reconstruction: from a .ply beside the poses, or random ones."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from sw_gaussians.memory_map import memory_map
from sw_gaussians.ply_tables import MAX_HEADER, read_header, read_tables
from torch import Tensor

from splatwizard_core.api import (
    SH_C0,
    BitstreamError,
    Camera,
    PointCloud,
    SceneError,
    SceneOptions,
    View,
    stream,
)

HALF_CUBE = 1.3  # start points of Blender scenes fill [-1.3, 1.3]^3 (3DGS)
DEPTHS = (0.8, 1.2)  # others lie about the distance at which the cameras' axes meet
PARALLEL_DEPTHS = (1.0, 10.0)  # where the axes are parallel: in distances between the cameras
CLOUDS = ("points3d.ply", "points3D.ply", "sparse_pc.ply", "point_cloud.ply")
"""Names that clouds of start points have beside transforms files: of the 3DGS code, COLMAP, nerfstudio."""
MOST_POINTS = 100_000_000


def random_points(count: int, seed: int) -> PointCloud:
    """`count` points, uniform in the cube [-1.3, 1.3]^3, practically mid grey.

    The colour is 0.5 + C0 u with u uniform in [0, 1/255), as the 3DGS code draws spherical-harmonics values.
    """
    generator = stream(seed, "random-points")
    xyz = (2 * torch.rand(count, 3, generator=generator) - 1) * HALF_CUBE
    return PointCloud(xyz, 0.5 + SH_C0 * torch.rand(count, 3, generator=generator) / 255)


def points_in_sight(cameras: Sequence[Camera], count: int, seed: int) -> PointCloud:
    """`count` mid-grey points (xyz float64) in the cameras' fields of view, about as far as where their axes meet.

    Where the axes are parallel, no depth follows from them: the points are spread over 1 to 10 times the size of the
    set of cameras, evenly in the logarithm.
    """
    if not cameras:
        return PointCloud(torch.zeros(0, 3), torch.zeros(0, 3))
    R = torch.stack([camera.R.double() for camera in cameras])  # [n,3,3] world -> camera
    centres = -(R.transpose(1, 2) @ torch.stack([camera.tau.double() for camera in cameras])[:, :, None])[..., 0]
    middle = centres.mean(0)
    near = centres - middle  # positions far from the origin lose nothing so
    forward = R[:, 2]
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]  # [n,3,3]
    normal = across.mean(0)
    generator = stream(seed, "random-points")
    which = torch.randint(len(cameras), (count,), generator=generator)
    u, v, share = torch.rand(3, count, generator=generator, dtype=torch.float64)
    # The smallest eigenvalue is the mean squared sine of the axes' angle to their common direction.
    if torch.linalg.eigvalsh(normal)[0] < 1e-6:
        size = near.norm(dim=1).max().item() or 1.0
        first, last = (size * depth for depth in PARALLEL_DEPTHS)
        depth = first * (last / first) ** share
    else:
        focus = torch.linalg.solve(normal, (across @ near[:, :, None]).mean(0))[:, 0]
        depth = (focus - near).norm(dim=1)[which] * (DEPTHS[0] + (DEPTHS[1] - DEPTHS[0]) * share)
    ends = torch.tensor(
        [[-c.cx / c.fx, (c.width - c.cx) / c.fx, -c.cy / c.fy, (c.height - c.cy) / c.fy] for c in cameras],
        dtype=torch.float64,
    )[which]  # [count,4] of each picture, at depth 1
    x, y = ends[:, 0] + u * (ends[:, 1] - ends[:, 0]), ends[:, 2] + v * (ends[:, 3] - ends[:, 2])
    ray = torch.stack([x, y, torch.ones_like(u)], dim=1)
    xyz = near[which] + depth[:, None] * (ray[:, None, :] @ R[which])[:, 0] + middle
    return PointCloud(xyz, torch.full((count, 3), 0.5))


def points_in_sight_of(options: SceneOptions) -> Callable[[Sequence[View]], PointCloud]:
    """Views -> `points_in_sight` of their cameras, as many and as drawn as the options ask."""
    return lambda views: points_in_sight([view.camera for view in views], options.init_points, options.seed)


def share_in_sight(points: Tensor, cameras: Sequence[Camera]) -> float:
    """Share of points [P,3] that one camera at least has in its picture."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for c in cameras:
        t = points.double() @ c.R.double().T + c.tau.double()
        u, v = c.fx * t[:, 0] / t[:, 2] + c.cx, c.fy * t[:, 1] / t[:, 2] + c.cy
        seen |= (t[:, 2] > c.near) & (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height)
    return float(seen.float().mean()) if len(points) else 1.0


def cloud_beside(folder: Path) -> Path | None:
    """The cloud of start points in a folder, known by its name; None without one."""
    return next((folder / name for name in CLOUDS if os.path.isfile(folder / name)), None)


def read_cloud(path: Path) -> PointCloud:
    """The points of a .ply: x, y, z (kept as float64), and red, green, blue where it has them.

    Raises SceneError for what is no such file.
    """
    data = memory_map(path)
    try:
        header = read_header(bytes(data[:MAX_HEADER]), len(data), path.name)
        count, names = header.count("vertex"), header.names("vertex")
        if not {"x", "y", "z"} <= set(names):
            raise SceneError(f"{path}: no cloud of points: it has no x, y, z", path=str(path))
        if count > MOST_POINTS:
            raise SceneError(f"{path}: {count:,} points, more than {MOST_POINTS:,}", path=str(path))
        rows = read_tables(data, header, ("vertex",), path.name)["vertex"]
    except BitstreamError as error:
        raise SceneError(f"{path}: the start points cannot be read ({error})", path=str(path)) from error
    xyz = torch.from_numpy(np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1))
    for colours in (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")):
        if set(colours) <= set(names):
            rgb = np.stack([rows[each].astype(np.float32) for each in colours], axis=1)
            kind = rows.dtype[colours[0]]
            if kind.kind in "iu":
                rgb /= np.iinfo(kind).max
            return PointCloud(xyz, torch.from_numpy(rgb).clamp(0, 1))
    return PointCloud(xyz)
