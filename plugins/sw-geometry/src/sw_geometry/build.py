"""From depth views to a finished mesh, with the facts of its making."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import psutil

from splatwizard_core.api import SplatwizardError, track
from sw_geometry.clusters import largest_clusters
from sw_geometry.depth import DepthView
from sw_geometry.fusion import Fusion
from sw_geometry.legacy import LegacyFusion
from sw_geometry.mesh import Mesh, canonical
from sw_geometry.open3d_import import import_open3d
from sw_geometry.parameters import Parameters


@dataclass(frozen=True, eq=False)
class Built:
    """A mesh.

    raw     as it was extracted
    post    its largest pieces
    facts   parameters, backend, views, counts, seconds, memory: plain values
    """

    raw: Mesh
    post: Mesh
    facts: dict[str, Any]


def build(
    views: Iterable[DepthView], total: int, parameters: Parameters, *, max_memory: float | None = None, label: str
) -> Built:
    """Fuse views into a mesh, in canonical order: equal views give equal meshes.

    total       number of views, for the progress
    max_memory  GB that the grid may take; None: half of the machine's. The legacy backend watches no limit

    Raises SplatwizardError if there is no surface, UserInputError if memory would not suffice, CapabilityError without
    Open3D.
    """
    open3d = import_open3d()
    began = time.perf_counter()
    limit = psutil.virtual_memory().total / 2 if max_memory is None else max_memory * 1e9
    device = "CUDA:0" if open3d.core.cuda.is_available() else "CPU:0"
    fusion: Fusion | LegacyFusion
    lengths = {"voxel_size": parameters.voxel_size, "depth_trunc": parameters.depth_trunc}
    if parameters.backend == "legacy":
        fusion, device = LegacyFusion(**lengths, sdf_trunc=parameters.sdf_trunc), "CPU:0"
    else:
        truncation = parameters.sdf_trunc / parameters.voxel_size
        fusion = Fusion(**lengths, truncation=truncation, max_bytes=limit, device=device)
    maker = "ScalableTSDFVolume" if parameters.backend == "legacy" else "VoxelBlockGrid"
    with track(label, total=total, unit="views") as bar:
        for view in views:
            fusion.add(view.depth, view.color, view.K, view.E)
            bar.advance()
    raw = canonical(fusion.mesh(min_views=parameters.min_views))
    post = canonical(largest_clusters(raw, parameters.clusters))
    if not len(post):
        raise SplatwizardError(
            f"no surface: raise depth_trunc (now {parameters.depth_trunc:.4g}), lower alpha_min (now "
            f"{parameters.alpha_min:g}), or look at the depth maps ({fusion.used} of {total} views show something)"
        )
    facts = {
        **asdict(parameters),
        "backend": f"open3d {open3d.__version__} {maker} {device}",
        "views_used": fusion.used,
        "views_skipped": fusion.skipped,
        "vertices": len(raw.vertices),
        "triangles": len(raw),
        "vertices_post": len(post.vertices),
        "triangles_post": len(post),
        "grid_bytes": fusion.estimated_bytes,
        "seconds": round(time.perf_counter() - began, 3),
    }
    return Built(raw, post, facts)
