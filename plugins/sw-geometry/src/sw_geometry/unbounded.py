"""Fusion in contracted space, for scenes whose background is far away. Experimental.

The unit ball about the point that the cameras look at is kept, all of space outside is contracted into the shell up to
radius 2; samples of a signed distance lie on a regular grid of that space. Space that no view saw holds no surface.

Source: 2DGS (arXiv 2403.17888), unbounded mesh extraction, which counts unseen space as seen once, inside; the
contraction is that of Mip-NeRF 360 (arXiv 2111.12077).
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict

import numpy as np
import psutil
from numpy.typing import NDArray

from splatwizard_core.api import CapabilityError, SplatwizardError, UserInputError, track
from sw_geometry.build import Built
from sw_geometry.clusters import largest_clusters
from sw_geometry.depth import DepthView
from sw_geometry.mesh import Floats, Mesh, canonical
from sw_geometry.parameters import Parameters

FARTHEST = 1.9
"""Half edge of the grid in contracted space: what lies at 1.9 there is ten radii away."""
TRUNCATION = 5.0  # voxels
SAMPLE_BYTES = 5 * 4 + 60
"""Of each sample: distance, weight and three of colour, float32; and what one slab's projection takes."""
SLAB = 1 << 20
"""Samples that are projected at a time."""

Floats32 = NDArray[np.float32]


def contracted(points: Floats) -> Floats:
    """Points [n,3] of the normalised scene in contracted space: y inside the unit ball, (2 - 1/|y|) y/|y| outside."""
    length = np.linalg.norm(points, axis=1, keepdims=True)
    far = np.maximum(length, 1.0)
    return np.where(length <= 1, points, (2 - 1 / far) * points / far)


def expanded(points: Floats) -> Floats:
    """Inverse of `contracted`, for points of length below 2."""
    length = np.linalg.norm(points, axis=1, keepdims=True)
    far = np.maximum(length, 1.0)
    return np.where(length <= 1, points, points / far / (2 - far))


def build_unbounded(
    views: Iterable[DepthView], total: int, parameters: Parameters, *, max_memory: float | None = None, label: str
) -> Built:
    """Fuse views into a mesh of all of space, `mesh_res` samples along the grid; see `build.build`.

    Raises CapabilityError without scikit-image, UserInputError if memory would not suffice, SplatwizardError if there
    is no surface.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise CapabilityError("unbounded meshes need scikit-image: pip install 'sw-geometry[unbounded]'") from error
    began = time.perf_counter()
    limit = psutil.virtual_memory().total / 2 if max_memory is None else max_memory * 1e9
    count = parameters.mesh_res
    needed = count**3 * SAMPLE_BYTES
    if needed > limit:
        fits = int((limit / SAMPLE_BYTES) ** (1 / 3))
        raise UserInputError(
            f"mesh_res {count} needs about {needed / 1e9:.2g} GB (limit {limit / 1e9:.2g} GB): try {fits}, or raise "
            "max_memory"
        )
    grid = _Grid(parameters)
    with track(label, total=total, unit="views") as bar:
        for view in views:
            grid.add(view)
            bar.advance()
    field = np.where(grid.weight >= parameters.min_views, grid.distance, np.nan).reshape(count, count, count)
    raw = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    if (field < 0).any() and (field > 0).any():
        vertices, triangles, _, _ = marching_cubes(field, 0.0, mask=~np.isnan(field))  # type: ignore[no-untyped-call]
        raw = grid.to_mesh(vertices.astype(np.float64), triangles.astype(np.int64))
    raw = canonical(raw)
    post = canonical(largest_clusters(raw, parameters.clusters))
    if not len(post):
        raise SplatwizardError(f"no surface: raise mesh_res (now {count}), or look at the depth maps")
    facts = {
        **asdict(parameters),
        "backend": "contracted grid, marching cubes",
        "views_used": grid.used,
        "views_skipped": total - grid.used,
        "vertices": len(raw.vertices),
        "triangles": len(raw),
        "vertices_post": len(post.vertices),
        "triangles_post": len(post),
        "grid_bytes": needed,
        "seconds": round(time.perf_counter() - began, 3),
    }
    return Built(raw, post, facts)


class _Grid:
    """Running means of distance, in units of the truncation, and of colour, at samples of contracted space."""

    def __init__(self, parameters: Parameters) -> None:
        self.count = parameters.mesh_res
        self.focus, self.radius = np.array(parameters.focus), parameters.radius
        self.axis = np.linspace(-FARTHEST, FARTHEST, self.count)
        self.truncation = TRUNCATION * 2 * FARTHEST / self.count * self.radius
        samples = self.count**3
        self.distance = np.zeros(samples, dtype=np.float32)
        self.weight = np.zeros(samples, dtype=np.float32)
        self.color = np.zeros((samples, 3), dtype=np.float32)
        self.used = 0

    def points(self, rows: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """World points [n,3] of samples, and the truncation [n] there: wider where space is contracted."""
        at = np.stack([self.axis[each] for each in np.unravel_index(rows, (self.count,) * 3)], axis=1)
        length = np.linalg.norm(at, axis=1)
        inside = length < 2  # the corners of the grid lie beyond infinity
        world = np.full_like(at, np.nan)
        world[inside] = expanded(at[inside]) * self.radius + self.focus
        wider = np.where(length > 1, 1 / (2 - np.minimum(length, FARTHEST)), 1.0)
        return world, self.truncation * wider

    def add(self, view: DepthView) -> None:
        """Average one view in where it sees a sample that does not lie far behind its surface."""
        depth = np.nan_to_num(view.depth, nan=0.0, posinf=0.0, neginf=0.0)
        self.used += bool((depth > 0).any())
        height, width = depth.shape
        for begin in range(0, self.count**3, SLAB):
            rows = np.arange(begin, min(begin + SLAB, self.count**3))
            world, reach = self.points(rows)
            x, y, z = (world @ view.E[:3, :3].T + view.E[:3, 3]).T
            with np.errstate(invalid="ignore", divide="ignore"):
                u = np.floor(view.K[0, 0] * x / z + view.K[0, 2])
                v = np.floor(view.K[1, 1] * y / z + view.K[1, 2])
                shown = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
            at = np.flatnonzero(shown)
            row, column = v[at].astype(np.int64), u[at].astype(np.int64)
            signed = (depth[row, column] - z[at]) / reach[at]
            kept = (depth[row, column] > 0) & (signed > -1)
            at, row, column, signed = at[kept], row[kept], column[kept], np.minimum(signed[kept], 1.0)
            into = rows[at]
            self.weight[into] += 1
            share = 1 / self.weight[into]
            self.distance[into] += (signed - self.distance[into]) * share
            self.color[into] += (view.color[row, column] - self.color[into]) * share[:, None]

    def to_mesh(self, vertices: Floats, triangles: NDArray[np.int64]) -> Mesh:
        """A mesh of vertices [V,3] that count samples, in the world, with the colour of the nearest sample.

        A vertex beside a sample that no view saw is not a number, and goes.
        """
        mesh = Mesh(vertices, triangles).with_vertices(np.asarray(np.isfinite(vertices).all(axis=1)))
        vertices, triangles = mesh.vertices, mesh.triangles
        at = -FARTHEST + vertices * (2 * FARTHEST / (self.count - 1))
        world = expanded(at) * self.radius + self.focus
        nearest = np.rint(vertices).astype(np.int64).clip(0, self.count - 1)
        colors = self.color[np.ravel_multi_index(tuple(nearest.T), (self.count,) * 3)].astype(np.float64)
        return Mesh(world, triangles, None, colors)
