"""Check of what meshes need: Open3D, imported and made to fuse one picture."""

from __future__ import annotations

import numpy as np

from splatwizard_core.api import CapabilityError
from splatwizard_core.tooling import Check
from sw_geometry.open3d_import import EXTRA, SYSTEM_PACKAGES, import_open3d

GROUP, NAME = "geometry", "Open3D"


def check_open3d() -> list[Check]:
    """Import Open3D and make a mesh of a flat wall."""
    try:
        open3d = import_open3d()
    except CapabilityError as error:
        told = str(error)
        if "library of the system" in told:
            return [Check(GROUP, NAME, "broken", told, f"apt install {SYSTEM_PACKAGES}")]
        if told.startswith("meshes need"):
            return [Check(GROUP, NAME, "missing", "Open3D is not installed", f"pip install '{EXTRA}'")]
        return [Check(GROUP, NAME, "broken", told, f"pip install --force-reinstall '{EXTRA}'")]
    from sw_geometry.fusion import Fusion

    fusion = Fusion(voxel_size=0.05, truncation=4.0, depth_trunc=10.0, max_bytes=1 << 30)
    K = np.array([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    fusion.add(np.full((32, 32), 1.0, dtype=np.float32), np.full((32, 32, 3), 0.5, dtype=np.float32), K, np.eye(4))
    triangles = len(fusion.mesh(min_views=1))
    version = f"open3d {open3d.__version__}"
    if not triangles:
        return [Check(GROUP, NAME, "broken", f"{version} makes no mesh", f"pip install --force-reinstall '{EXTRA}'")]
    device = "CUDA" if open3d.core.cuda.is_available() else "CPU"
    return [Check(GROUP, NAME, "ok", f"{version}, {device}", facts={"triangles": triangles})]
