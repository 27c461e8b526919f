"""Fusion with Open3D's class of before its tensor API, ScalableTSDFVolume: what published meshes were made with.

Source: Open3D 0.19, measured; 0.20.0 extracts nothing from any input, so that its use is refused there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from splatwizard_core.api import CapabilityError, UserInputError
from sw_geometry.fusion import Floats32
from sw_geometry.mesh import Floats, Mesh
from sw_geometry.open3d_import import import_open3d


class LegacyFusion:
    """The volume that depth maps are fused into, on the CPU; used as `sw_geometry.fusion.Fusion` is.

    voxel_size, sdf_trunc, depth_trunc  units of the scene

    It keeps what any view saw, and its memory is not known beforehand: no limit is watched. Colours have 8 bits.
    Raises CapabilityError where Open3D's class does not work.
    """

    estimated_bytes = 0

    def __init__(self, *, voxel_size: float, sdf_trunc: float, depth_trunc: float) -> None:
        self._open3d = open3d = import_open3d()
        if not works(open3d):
            raise CapabilityError(
                f"the legacy backend extracts no mesh with Open3D {open3d.__version__}: leave out --backend legacy, or "
                "pip install 'open3d-cpu<0.20'"
            )
        self._depth_trunc = float(depth_trunc)
        self._volume = _volume(open3d, voxel_size, sdf_trunc)
        self.used = self.skipped = 0

    def add(self, depth: Floats32, color: Floats32, K: Floats, E: Floats) -> None:
        """Fuse one view (arguments: `Fusion.add`); one without any surface is counted and left out."""
        depth = np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)
        depth = np.where((depth > 0) & (depth < self._depth_trunc), depth, 0).astype(np.float32)
        if not depth.any():
            self.skipped += 1
            return
        _integrate(self._open3d, self._volume, depth, color, K, E, self._depth_trunc)
        self.used += 1

    def mesh(self, *, min_views: int) -> Mesh:
        """The surface that any view saw; maybe empty. Raises UserInputError for more than one view."""
        if min_views > 1:
            raise UserInputError(f"min_views is {min_views}: the legacy backend keeps what any view saw; leave it at 1")
        found = self._volume.extract_triangle_mesh()
        found.compute_vertex_normals()
        vertices, triangles = np.asarray(found.vertices), np.asarray(found.triangles).astype(np.int64).reshape(-1, 3)
        return Mesh(vertices, triangles, np.asarray(found.vertex_normals), np.asarray(found.vertex_colors))


def works(open3d: Any) -> bool:
    """Whether the class makes a mesh of a flat wall."""
    volume = _volume(open3d, 0.05, 0.2)
    K = np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]])
    _integrate(
        open3d, volume, np.ones((16, 16), np.float32), np.ones((16, 16, 3), np.float32), K, np.eye(4), depth_trunc=2.0
    )
    return len(volume.extract_triangle_mesh().triangles) > 0


def _volume(open3d: Any, voxel_size: float, sdf_trunc: float) -> Any:
    integration = open3d.pipelines.integration
    return integration.ScalableTSDFVolume(
        voxel_length=float(voxel_size), sdf_trunc=float(sdf_trunc), color_type=integration.TSDFVolumeColorType.RGB8
    )


def _integrate(
    open3d: Any, volume: Any, depth: Floats32, color: Floats32, K: Floats, E: Floats, depth_trunc: float
) -> None:
    image, height, width = open3d.geometry.Image, *depth.shape
    bytes_ = np.ascontiguousarray((np.clip(color, 0, 1) * 255).round().astype(np.uint8))
    rgbd = open3d.geometry.RGBDImage.create_from_color_and_depth(
        image(bytes_), image(np.ascontiguousarray(depth)), depth_scale=1.0, depth_trunc=depth_trunc,
        convert_rgb_to_intensity=False,
    )  # fmt: skip
    # It rounds to the nearest pixel, whose centre therefore counts as a whole number.
    lens = open3d.camera.PinholeCameraIntrinsic(width, height, K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5)
    volume.integrate(rgbd, lens, np.ascontiguousarray(E, dtype=np.float64))
