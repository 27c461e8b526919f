"""Connected pieces of a mesh, and the removal of the small ones."""

from __future__ import annotations

import numpy as np

from sw_geometry.mesh import Indices, Mesh, without_degenerate

FEWEST_TRIANGLES = 50
"""A smaller piece is noise, however few pieces there are. Source: 2DGS (arXiv 2403.17888), mesh extraction."""


def cluster_of_triangles(mesh: Mesh) -> Indices:
    """Number of the piece that each triangle belongs to, [F]; triangles with a common edge are of one piece."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(mesh)
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)  # [3F,2]
    code = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    order = np.argsort(code, kind="stable")
    same = code[order][1:] == code[order][:-1]
    left, right = order[:-1][same] // 3, order[1:][same] // 3
    graph = coo_matrix((np.ones(len(left), dtype=np.int8), (left, right)), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    return np.asarray(labels, dtype=np.int64)


def largest_clusters(mesh: Mesh, keep: int) -> Mesh:
    """The `keep` largest pieces of a mesh, without those of fewer than 50 triangles and without degenerate triangles.

    A piece as large as the last one that is kept stays too. An empty mesh, and fewer pieces than `keep`, are fine.
    Source: 2DGS (arXiv 2403.17888), mesh extraction, whose code cannot deal with fewer pieces.
    """
    sizes = np.bincount(labels := cluster_of_triangles(mesh))
    if not len(sizes):
        return mesh
    smallest = max(int(np.sort(sizes)[::-1][min(keep, len(sizes)) - 1]), FEWEST_TRIANGLES)
    return without_degenerate(mesh.with_triangles(sizes[labels] >= smallest))
