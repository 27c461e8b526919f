"""Chamfer distance, precision and recall of a mesh against the truth that a scene brings (protocol `analytic`).

No part is cut away and no distance is clipped; units are those of the scene. It is not DTU's protocol, and its numbers
do not compare with DTU's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from torch import Tensor

from splatwizard_core.api import Camera, Scene
from sw_geometry.mesh import Floats, Indices, Mask, Mesh
from sw_geometry.nearest import nearest_points, to_triangles
from sw_geometry.sampling import uniform_samples

PROTOCOL = "analytic"
SAMPLES = 100_000
"""Points on the mesh: their mean distance is then known to a few thousandths of itself."""
TAU = 0.005
"""Share of the scene's extent within which a point counts as right."""
SEEN_BY = 2
"""Cameras that must see a point of the truth: what none sees, no reconstruction can have."""
LOOKED_AT = 24
"""Training cameras that are asked, about, evenly spread: exact depth maps take their time."""
BEHIND = 0.01
"""Share of its depth by which a point may lie behind the surface that a camera sees, and still be that surface."""

Distance = Callable[[Floats], Floats]


@dataclass(frozen=True, eq=False)
class Truth:
    """The true surface of a scene.

    points      [P,3] samples that the cameras see
    normals     [P,3] unit vectors | None
    distance    points [n,3] -> exact distance [n] to the surface | None
    """

    points: Floats
    normals: Floats | None = None
    distance: Distance | None = None

    @classmethod
    def of(cls, scene: Scene) -> Truth | None:
        """The truth of a scene, without points that fewer than two training cameras see; None if it brings none."""
        known = scene.ground_truth
        if "points" not in known:
            return None
        points = _floats(known["points"])
        seen = np.ones(len(points), dtype=bool)
        if "depth" in known:
            some = scene.train[:: max(len(scene.train) // LOOKED_AT, 1)]
            views = [(view.camera, known["depth"][view.name]) for view in some if view.name in known["depth"]]
            seen = seen_by(points, views) >= min(SEEN_BY, len(views))
        normals = _floats(known["normals"])[seen] if "normals" in known else None
        return cls(points[seen], normals, cast(Distance, known["distance"]) if "distance" in known else None)

    def distances(self, points: Floats) -> tuple[Floats, Indices]:
        """Distance [n] of points [n,3] to the surface, and the nearest sample [n] of it.

        Exact where the truth is; else along the normal of the nearest sample, since the distance to the sample itself
        is as large as the samples are sparse; else that distance.
        """
        to_sample, row = nearest_points(points, self.points)
        if self.distance is not None:
            return np.abs(self.distance(points)), row
        if self.normals is not None:
            return np.abs(((points - self.points[row]) * self.normals[row]).sum(axis=1)), row
        return to_sample, row


def seen_by(points: Floats, views: Sequence[tuple[Camera, Tensor]]) -> Indices:
    """Number of cameras that see each point [n]: inside the picture, and not behind its exact depth [1,H,W].

    The depth that counts is the largest of the pixel and its eight neighbours: across one pixel of a surface that is
    seen at a grazing angle it changes by more than any tolerance.
    """
    from scipy.ndimage import maximum_filter

    count = np.zeros(len(points), dtype=np.int64)
    for camera, depth in views:
        column, row, z, inside = pixels_of(points, camera)
        surface = maximum_filter(depth[0].cpu().numpy(), 3)[row[inside], column[inside]]
        count[np.flatnonzero(inside)[(surface > 0) & (z[inside] <= (1 + BEHIND) * surface)]] += 1
    return count


def pixels_of(points: Floats, camera: Camera) -> tuple[Indices, Indices, Floats, Mask]:
    """Column, row and z [n] of points [n,3] in a camera, and which of them [n] lie in its picture."""
    R, tau = camera.R.double().cpu().numpy(), camera.tau.double().cpu().numpy()
    x, y, z = (points @ R.T + tau).T
    ahead = z > 0
    depth = np.where(ahead, z, 1.0)
    column = np.floor(np.clip(camera.fx * x / depth + camera.cx, -1, camera.width)).astype(np.int64)
    row = np.floor(np.clip(camera.fy * y / depth + camera.cy, -1, camera.height)).astype(np.int64)
    inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return column, row, z, inside


def compare(mesh: Mesh, truth: Truth, tau: float, *, samples: int = SAMPLES) -> dict[str, float]:
    """Compare a mesh with the truth.

    tau     distance within which a point counts as right, units of the scene
    samples points on the mesh

    Returns acc, mean distance of points on the mesh to the truth; comp, mean distance of points of the truth to the
    triangles; overall, their mean; precision and recall, shares of the two within tau; f1, their harmonic mean; and
    normal_consistency, mean |cosine| between the normals of mesh and truth at nearest points, where the truth has some.
    Raises ValueError for a mesh without area.
    """
    points, rows = uniform_samples(mesh, samples)
    to_truth, nearest = truth.distances(points)
    return _scores(to_truth, to_triangles(truth.points, mesh)[0], tau) | (
        {} if truth.normals is None else {"normal_consistency": _consistency(mesh, rows, truth.normals[nearest])}
    )


def compare_points(points: Floats, truth: Truth, tau: float) -> dict[str, float]:
    """Compare the centres of Gaussians [n,3] with the truth: as `compare`, but point to point in both directions.

    How dense the points are is then part of the number. Raises ValueError without a point.
    """
    if not len(points):
        raise ValueError("there is no point")
    return _scores(truth.distances(points)[0], nearest_points(truth.points, points)[0], tau)


def _scores(to_truth: Floats, from_truth: Floats, tau: float) -> dict[str, float]:
    acc, comp = float(to_truth.mean()), float(from_truth.mean())
    precision, recall = float((to_truth < tau).mean()), float((from_truth < tau).mean())
    f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    overall = (acc + comp) / 2
    return {"acc": acc, "comp": comp, "overall": overall, "precision": precision, "recall": recall, "f1": f1}


def _consistency(mesh: Mesh, rows: Indices, normals: Floats) -> float:
    crossed = mesh.crossed()[rows]
    unit = crossed / np.linalg.norm(crossed, axis=1, keepdims=True)
    return float(np.abs((unit * normals).sum(axis=1)).mean())


def _floats(value: Any) -> Floats:
    return np.asarray(value.detach().cpu().double().numpy() if isinstance(value, Tensor) else value, dtype=np.float64)


def default_tau(scene: Scene) -> float:
    """0.5 % of the scene's extent."""
    return TAU * scene.extent
