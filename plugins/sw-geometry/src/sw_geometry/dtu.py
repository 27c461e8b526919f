"""The DTU protocol (`dtu-chamfer`): distances in millimetres between a mesh and the scanner's points.

Needs the official files: Points.zip and SampleSet.zip of the DTU MVS data set.
Source: "Large Scale Multi-view Stereopsis Evaluation" (Jensen et al., CVPR 2014); the published Python form of it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatwizard_core.api import CapabilityError, UserInputError
from sw_geometry.mesh import Floats, Mask, Mesh
from sw_geometry.nearest import nearest_points
from sw_geometry.ply import read_points
from sw_geometry.sampling import grid_samples, grid_thinned, thinned

PROTOCOL = "dtu-chamfer"
POINTS_PROTOCOL = "dtu-chamfer-points"
MISSING = "dtu-gt-missing"
"""Beginning of the reason where the official files are not there."""
SCANS = (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)
"""The scans of published tables of surface reconstruction."""
SPACING, GRID = 0.2, 1.0
"""Distance between the points of a mesh, and cell of a point cloud, mm."""
PATCH = 60.0
"""Distance that a point may lie below the box of the observed space, mm; twice that above it."""
FARTHEST = 20.0
"""Distance from which a point counts as an outlier, mm."""


@dataclass(frozen=True, eq=False)
class Official:
    """The official files of a scan.

    points      [n,3] of the scanner, mm
    observed    [X,Y,Z] bool, the space that the scanner saw
    box         [2,3] corners of it, mm, rounded to float32
    resolution  edge of its voxels, mm
    plane       [4]: points with plane . (x, 1) > 0 are above the table
    """

    points: Floats
    observed: Mask
    box: Floats
    resolution: float
    plane: Floats


def scan_number(scene: str) -> int | None:
    """Number of the scan that a scene is named by: "scan24", "dtu_scan24", "24"; None for any other name."""
    match = re.fullmatch(r"(?:.*scan)?0*(\d{1,3})", Path(scene).name)
    return None if match is None else int(match[1])


def official_files(folder: Path, scan: int) -> dict[str, Path]:
    """Official files of a scan below `folder`: "points", "mask", "plane".

    Raises CapabilityError that begins with `dtu-gt-missing` and names the first file that is not there, and where it
    comes from; or says that the scan has none.
    """
    if scan not in SCANS:
        raise CapabilityError(f"scan {scan} has no official evaluation files; the {len(SCANS)} scans are {SCANS}")
    found = {
        "points": folder / "Points" / "stl" / f"stl{scan:03d}_total.ply",
        "mask": folder / "ObsMask" / f"ObsMask{scan}_10.mat",
        "plane": folder / "ObsMask" / f"Plane{scan}.mat",
    }
    names = {"points": "reference points", "mask": "ObsMask file", "plane": "Plane file"}
    for kind, path in found.items():
        if not path.is_file():
            raise CapabilityError(
                f"{MISSING}: DTU {names[kind]} of scan {scan}: expected {path}. Get Points.zip and SampleSet.zip from "
                "roboimagedata.compute.dtu.dk (page_id=36), and name the folder: --set metrics.mesh.dtu_gt=FOLDER"
            )
    return found


def read_official(folder: Path, scan: int) -> Official:
    """Read the official files of a scan. Raises CapabilityError if one is missing, UserInputError if one is damaged."""
    files = official_files(folder, scan)
    mask, plane = _mat(files["mask"], "ObsMask", "BB", "Res"), _mat(files["plane"], "P")
    observed, box = np.asarray(mask["ObsMask"]), np.asarray(mask["BB"], dtype=np.float32).astype(np.float64)
    resolution, row = np.ravel(mask["Res"]), np.asarray(plane["P"], dtype=np.float64).ravel()
    if observed.ndim != 3 or box.shape != (2, 3) or len(resolution) != 1 or not float(resolution[0]) > 0:
        raise UserInputError(f"{files['mask']}: ObsMask must be [X,Y,Z], BB [2,3], Res one positive number")
    if len(row) != 4:
        raise UserInputError(f"{files['plane']}: P has {len(row)} numbers, not 4")
    return Official(read_points(files["points"]), observed.astype(bool), box, float(resolution[0]), row)


def _mat(path: Path, *names: str) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        found: dict[str, Any] = loadmat(path, variable_names=names)
    except Exception as error:  # whatever a damaged file makes scipy raise
        raise UserInputError(f"{path}: not a MATLAB file of version 5 ({type(error).__name__}: {error})") from error
    for name in names:
        if name not in found:
            raise UserInputError(f"{path}: '{name}' is missing")
    return found


def mesh_distance(mesh: Mesh, official: Official) -> dict[str, float]:
    """d2s (accuracy), s2d (completeness) and overall of a mesh in millimetres, with the vertices that culling left.

    Distances of 20 mm and more are left out of the means. Raises UserInputError if nothing is left to measure.
    """
    cloud = thinned(grid_samples(mesh, SPACING), SPACING)
    return _distances(cloud, official, lambda far: far[far < FARTHEST])


def point_distance(points: Floats, official: Official) -> dict[str, float]:
    """The same for the centres of Gaussians [n,3], mm: one for each cell of a 1 mm grid, distances clipped at 20 mm.

    Another measure than that of meshes: never in one table. Source: TrimGS (arXiv 2406.07499).
    """
    return _distances(grid_thinned(points, GRID, official.box[0]), official, lambda far: np.minimum(far, FARTHEST))


def _distances(cloud: Floats, official: Official, bounded: Callable[[Floats], Floats]) -> dict[str, float]:
    near = ((cloud >= official.box[0] - PATCH) & (cloud < official.box[1] + 2 * PATCH)).all(axis=1)
    cloud = cloud[near]
    voxel = np.rint((cloud - official.box[0]) / official.resolution).astype(np.int64)
    there = ((voxel >= 0) & (voxel < official.observed.shape)).all(axis=1)
    seen = np.zeros(len(cloud), dtype=bool)
    seen[there] = official.observed[tuple(voxel[there].T)]
    if not seen.any():
        raise UserInputError(
            f"no point of the surface lies in the space that the scanner observed ({len(cloud):,} are near it): "
            "is the mesh in millimetres, and of this scan?"
        )
    above = official.points[official.points @ official.plane[:3] + official.plane[3] > 0]
    found = {}
    for name, far in (
        ("d2s", nearest_points(cloud[seen], official.points)[0]),
        ("s2d", nearest_points(above, cloud)[0]),  # to all points near the box, as published
    ):
        counted = bounded(far)
        if not len(counted):
            raise UserInputError(f"no distance ({name}) is below {FARTHEST:g} mm: is the mesh of this scan?")
        found[name] = float(counted.mean())
    return {**found, "overall": (found["d2s"] + found["s2d"]) / 2}
