"""DTU scans as prepared for surface reconstruction: a COLMAP folder with mask/ and the alignments in cameras.npz."""

from __future__ import annotations

import io
import lzma
import os
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatwizard_core.api import Scene, SceneError, SceneOptions
from sw_datasets.loaders.colmap import load_colmap, mask_files, model_folder
from sw_datasets.picture_names import list_pictures
from sw_datasets.rules import Rules
from sw_datasets.zip_methods import check_method

CAMERAS = "cameras.npz"
LARGEST_MEMBER = 4096  # bytes; a 4x4 float64 matrix with its header takes 256
CENTRE_TOLERANCE = 0.01  # of the extent: the poses of both files agree to rounding, another unit is off by far more


def has_dtu_layout(path: Path) -> bool:
    """Whether a folder is a prepared DTU scan."""
    return model_folder(path) is not None and os.path.isfile(path / CAMERAS)


def load_dtu(path: Path, rules: Rules, options: SceneOptions) -> Scene:
    """The scene of a prepared scan, with `world_mats` and `scale_mats` in its ground truth.

    Raises SceneError in one line.
    """
    scene = load_colmap(path, rules, options, masks=numbered_masks)
    views = {view.name: view for view in scene.train + scene.test}
    world, scale = read_alignments(path / CAMERAS, len(views))
    if any(scene.origin):
        back = torch.eye(4, dtype=torch.float64)
        back[:3, 3] = torch.tensor(scene.origin, dtype=torch.float64)
        scale = scale @ back  # from the scene's units about its local origin
    scene.ground_truth |= {"world_mats": world, "scale_mats": scale}
    centres = projection_centres(world @ scale)
    said = torch.stack([views[name].camera.center.double() for name in sorted(views)])
    off = (centres - said).norm(dim=1).max().item()
    if not off <= CENTRE_TOLERANCE * scene.extent:
        scene.warnings.append(
            f"the cameras of {CAMERAS} and of sparse/ stand up to {off:.3g} apart (extent {scene.extent:.3g}): "
            "distances in millimetres cannot be taken from this scene"
        )
    if not any(view.load_mask for view in views.values()):
        scene.warnings.append("the pictures have no alpha and there is no mask/: meshes cannot be culled by it")
    return scene


def numbered_masks(path: Path, names: Sequence[str]) -> list[Path | None]:
    """The mask of each image: one of the same name, else the one in mask/ that carries the same number.

    The archives count pictures `0000.png` and masks `000.png`.
    """
    found = mask_files(path, names)
    folder = path / "mask"
    if not folder.is_dir() or all(found):
        return found
    numbered: dict[int, list[str]] = {}
    for mask in list_pictures(folder):
        if (number := _number(mask)) is not None:
            numbered.setdefault(number, []).append(mask)
    for i, name in enumerate(names):
        same = numbered.get(number, []) if (number := _number(name)) is not None else []
        if found[i] is None and len(same) == 1:
            found[i] = folder / same[0]
    return found


def _number(name: str) -> int | None:
    """The number that a file is named by, if it is named by nothing else."""
    match = re.fullmatch(r"(\d{1,9})\.\w+", name)
    return None if match is None else int(match[1])


def read_alignments(path: Path, count: int) -> tuple[Tensor, Tensor]:
    """(world_mats, scale_mats), each [count,4,4] float64, of a cameras.npz.

    world_mat_i takes world units to pixels of view i, scale_mat_i the scene's units to world units (millimetres).
    Nothing but small numeric arrays is read, never a pickle. Raises SceneError naming file and array.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            there = set(archive.namelist())
            mats = []
            for kind in ("world_mat", "scale_mat"):
                rows = []
                for i in range(count):
                    member = f"{kind}_{i}.npy"
                    if member not in there:
                        raise SceneError(
                            f"{path}: '{kind}_{i}' is missing; the scene has {count} views", path=str(path)
                        )
                    check_method(archive.getinfo(member))
                    with archive.open(member) as file:
                        rows.append(_matrix(file.read(LARGEST_MEMBER + 1), path, f"{kind}_{i}"))
                mats.append(torch.from_numpy(np.stack(rows)))
    except (OSError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError, ValueError) as error:
        # RuntimeError: an encrypted member; NotImplementedError, a kind of it: an unknown compression.
        raise SceneError(f"{path}: not a readable .npz archive ({error})", path=str(path)) from error
    return mats[0], mats[1]


def _matrix(raw: bytes, path: Path, name: str) -> NDArray[np.float64]:
    """A finite 4x4 matrix from the bytes of a .npy."""
    where = f"{path}: '{name}'"
    if len(raw) > LARGEST_MEMBER:
        raise SceneError(f"{where} is larger than a 4x4 matrix", path=str(path))
    stream = io.BytesIO(raw)
    try:
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(stream)
        if shape != (4, 4) or dtype.kind not in "fiu":  # before anything is allocated by them
            raise SceneError(f"{where} is {dtype} of shape {shape}, not a 4x4 matrix of numbers", path=str(path))
        stream.seek(0)
        matrix: NDArray[np.float64] = np.lib.format.read_array(stream, allow_pickle=False).astype(np.float64)
    except (ValueError, EOFError) as error:
        raise SceneError(f"{where} is no array ({error})", path=str(path)) from error
    if not np.isfinite(matrix).all():
        raise SceneError(f"{where} is not finite (NaN or infinite)", path=str(path))
    return matrix


def projection_centres(projections: Tensor) -> Tensor:
    """Camera centres [n,3] of projections [n,4,4] whose first three rows are [M | p]: -M^-1 p, NaN where singular."""
    M, p = projections[:, :3, :3], projections[:, :3, 3:]
    inverse, failed = torch.linalg.inv_ex(M)
    centres = -(inverse @ p)[..., 0]
    return torch.where(failed[:, None] != 0, torch.nan, centres)
