"""Fusion of depth maps into a truncated signed distance on a sparse grid, and its mesh: Open3D's VoxelBlockGrid.

Source: "KinectFusion" (Newcombe et al., ISMAR 2011) by way of Open3D's tensor API, measured with 0.19 and 0.20.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import UserInputError
from sw_geometry.mesh import Floats, Mesh
from sw_geometry.open3d_import import import_open3d

BLOCK = 16
"""Voxels along a block."""
VOXEL_BYTES = 4 + 4 + 3 * 4
"""Distance, weight and colour of a voxel, float32."""
BLOCK_BYTES = BLOCK**3 * VOXEL_BYTES
EXTRACTION_BYTES = BLOCK**3 * 4 * 4
"""Of each block in use while the mesh is extracted: four int32 a voxel."""
FIRST_BLOCKS = 2000

Floats32 = NDArray[np.float32]


class Fusion:
    """The grid that depth maps are fused into.

    voxel_size      units of the scene
    truncation      reach of the signed distance, in voxels: 4 or 5; a longer one pulls edges outwards
    depth_trunc     larger depths are left out, units of the scene
    max_bytes       what grid and extraction may take at most, by estimate before it is taken
    device          "CPU:0", or "CUDA:0" where Open3D has CUDA
    """

    def __init__(
        self, *, voxel_size: float, truncation: float, depth_trunc: float, max_bytes: float, device: str = "CPU:0"
    ) -> None:
        self._open3d = open3d = import_open3d()
        self._voxel_size, self._truncation, self._depth_trunc = float(voxel_size), float(truncation), float(depth_trunc)
        self._max_bytes = max_bytes
        self._device = open3d.core.Device(device)
        self._grid = open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), (open3d.core.float32,) * 3, ((1), (1), (3)),
            self._voxel_size, BLOCK, FIRST_BLOCKS, self._device,
        )  # fmt: skip
        self._blocks: set[bytes] = set()
        self.used = self.skipped = 0
        """Views that were fused, and views left out since they show no surface."""

    @property
    def estimated_bytes(self) -> int:
        """Memory that the grid and the extraction of its mesh take now."""
        return needed_bytes(len(self._blocks), 0, self._grid.hashmap().capacity())

    def add(self, depth: Floats32, color: Floats32, K: Floats, E: Floats) -> None:
        """Fuse one view; one without any surface is counted and left out.

        depth   [H,W] camera z, units of the scene; 0 or not finite: no surface
        color   [H,W,3] in 0..1
        K, E    [3,3] intrinsics, whose principal point counts pixel centres at .5, and [4,4] world to camera

        Raises UserInputError before more memory is taken than the limit.
        """
        core, images = self._open3d.core, self._open3d.t.geometry
        depth = np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0)
        depth = np.where((depth > 0) & (depth < self._depth_trunc), depth, 0).astype(np.float32)
        if not depth.any():
            self.skipped += 1
            return
        seen = images.Image(core.Tensor(np.ascontiguousarray(depth[:, :, None]))).to(self._device)
        drawn = images.Image(core.Tensor(np.ascontiguousarray(color, dtype=np.float32))).to(self._device)
        intrinsic, extrinsic = (core.Tensor(np.ascontiguousarray(m, dtype=np.float64)) for m in (K, E))
        # The principal point stays as it is: this grid takes the pixel that a point falls into.
        where = self._grid.compute_unique_block_coordinates(
            seen, intrinsic, extrinsic, 1.0, self._depth_trunc, self._truncation
        )
        told = where.cpu().numpy()
        blocks = self._blocks | {row.tobytes() for row in told}
        self._check(len(self._blocks), len(blocks), len(told))
        self._blocks = blocks
        self._grid.integrate(where, seen, drawn, intrinsic, extrinsic, 1.0, self._depth_trunc, self._truncation)
        self.used += 1

    def _check(self, before: int, after: int, incoming: int) -> None:
        needed = needed_bytes(after, incoming, self._grid.hashmap().capacity(), before)
        if needed > self._max_bytes:
            # Blocks on a surface: their number goes with the inverse square of the voxel.
            wider = self._voxel_size * 1.2 * (needed / self._max_bytes) ** 0.5
            raise UserInputError(
                f"voxel_size {self._voxel_size:.3g} needs more than {needed / 1e9:.2g} GB "
                f"(limit {self._max_bytes / 1e9:.2g} GB, after {self.used} views); try {wider:.2g}, or raise max_memory"
            )

    def mesh(self, *, min_views: int) -> Mesh:
        """The surface where at least `min_views` views saw it, in the order that threads left it in; maybe empty."""
        # The threshold is strict, and views count 1 each.
        if not self.used:
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
        found = self._grid.extract_triangle_mesh(weight_threshold=min_views - 0.5, estimated_vertex_number=-1).cpu()
        if "indices" not in found.triangle or not len(found.triangle.indices):
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
        return Mesh(
            found.vertex.positions.numpy().astype(np.float64),
            found.triangle.indices.numpy().astype(np.int64),
            found.vertex.normals.numpy().astype(np.float64) if "normals" in found.vertex else None,
            found.vertex.colors.numpy().astype(np.float64) if "colors" in found.vertex else None,
        )


def needed_bytes(blocks: int, incoming: int, capacity: int, before: int | None = None) -> int:
    """Memory that a grid needs at most, bytes.

    blocks      in use afterwards
    incoming    handed to the grid at once: it makes room for all of them, old ones too
    capacity    that it has room for now; it grows by doubling, and holds old and new room for a moment
    before      in use before; None: as afterwards
    """
    room, wanted = capacity, (blocks if before is None else before) + incoming
    while room < wanted:
        room *= 2
    grown = room + (capacity if room > capacity else 0)
    return max(grown * BLOCK_BYTES, room * BLOCK_BYTES + blocks * EXTRACTION_BYTES)
