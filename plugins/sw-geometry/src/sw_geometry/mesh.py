"""A triangle mesh as plain arrays, in an order that does not depend on who made it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles.

    vertices    [V,3] float64, units of the scene
    triangles   [F,3] int64, rows of `vertices`; counter-clockwise from outside
    normals     [V,3] float64 unit vectors | None
    colors      [V,3] float64 in 0..1 | None
    """

    vertices: Floats
    triangles: Indices
    normals: Floats | None = None
    colors: Floats | None = None

    def __len__(self) -> int:
        return len(self.triangles)

    @property
    def corners(self) -> Floats:
        """[F,3,3]: the corners of each triangle."""
        return self.vertices[self.triangles]

    def crossed(self) -> Floats:
        """[F,3]: cross products of two edges, twice the area long, outwards."""
        corners = self.corners
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    def areas(self) -> Floats:
        """[F], square units."""
        return 0.5 * np.asarray(np.linalg.norm(self.crossed(), axis=1))

    def with_vertices(self, kept: Mask) -> Mesh:
        """The mesh without some vertices, kept [V] bool, and without the triangles that have one of them."""
        number = np.cumsum(kept) - 1
        inside = kept[self.triangles].all(axis=1)
        return replace(
            self,
            vertices=self.vertices[kept],
            triangles=number[self.triangles[inside]],
            normals=None if self.normals is None else self.normals[kept],
            colors=None if self.colors is None else self.colors[kept],
        )

    def with_triangles(self, kept: Mask) -> Mesh:
        """The mesh of some triangles, kept [F] bool, and of the vertices that they use."""
        triangles = self.triangles[kept]
        used = np.zeros(len(self.vertices), dtype=bool)
        used[triangles] = True
        return replace(self, triangles=triangles).with_vertices(used)

    def moved(self, scale: float, offset: Floats) -> Mesh:
        """The mesh at x * scale + offset, offset [3]."""
        return replace(self, vertices=self.vertices * scale + offset)


def canonical(mesh: Mesh) -> Mesh:
    """The same mesh in the one order that equal meshes have, however many threads made them.

    Vertices by z, then y, then x; each triangle begins with its smallest index, its sense kept; triangles in order.
    """
    order = np.lexsort((mesh.vertices[:, 0], mesh.vertices[:, 1], mesh.vertices[:, 2]))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    triangles = place[mesh.triangles]
    first = triangles.argmin(axis=1)[:, None]
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    triangles = triangles[np.lexsort((triangles[:, 2], triangles[:, 1], triangles[:, 0]))]
    return Mesh(
        mesh.vertices[order],
        triangles,
        None if mesh.normals is None else mesh.normals[order],
        None if mesh.colors is None else mesh.colors[order],
    )


def without_degenerate(mesh: Mesh) -> Mesh:
    """The mesh without triangles that have two equal corners or no area."""
    t = mesh.triangles
    distinct = (t[:, 0] != t[:, 1]) & (t[:, 1] != t[:, 2]) & (t[:, 2] != t[:, 0])
    return mesh.with_triangles(distinct & (mesh.areas() > 0))
