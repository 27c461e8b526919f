"""The .ply of 3DGS: 62 float32 per Gaussian at SH degree 3, raw values, as the authors' code and viewers read it.

A .ply of 2DGS has no `scale_2`; that property tells the two apart.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from splatwizard_core.api import (
    GaussianModel,
    SceneError,
    SplatModel,
    leave_out_senseless,
    replacing,
)
from sw_gaussians.memory_map import memory_map
from sw_gaussians.ply_gaussians import MIP_COMMENT, ORIGIN_COMMENT, WORLD_COMMENT, file_parts, parse_gaussians
from sw_gaussians.render_options import antialias_of, lost_options
from sw_gaussians.surfels import as_ellipsoids, gaussians_of

log = logging.getLogger(__name__)


def load_ply(path: str | os.PathLike[str]) -> GaussianModel:
    """Read a model with the values of the file, active SH degree = the degree that is stored (0 .. 3).

    Rows that mean nothing (a value that is no number, a rotation of zero) are left out, and counted in the log.

    A file with scale_0 and scale_1 and no scale_2 holds surfels: a SurfelModel. One whose comments say that it was
    trained with antialiasing asks for that in the model's `origin`.

    Any order of properties, any type of number, binary or ASCII, is read; normals and unknown properties are ignored.
    Raises BitstreamError if the file is damaged, SceneError if it cannot be read or is not a 3DGS model.
    """
    return from_ply(memory_map(path), os.fspath(path))


def from_ply(data: bytes | memoryview, path: str, *, tell: bool = True) -> GaussianModel:
    """Read a model from the bytes of a file, as `load_ply` does.

    path    what errors call it: where it lies, if it lies anywhere
    tell    log what a reader should know
    """
    found = parse_gaussians(data, path)
    if found.sh_rest.shape[1] > 15:
        raise SceneError(
            f"{Path(path).name}: {3 * found.sh_rest.shape[1]} f_rest properties; 0, 9, 24 or 45 (SH degree 0 to 3) "
            "are possible",
            path=path,
        )
    for note in found.notes if tell else ():
        log.warning("%s: %s", Path(path).name, note)
    columns = (found.means, found.sh_dc[:, None], found.sh_rest, found.opacity_logits, found.log_scales, found.quats)
    model = gaussians_of(*(torch.from_numpy(column) for column in columns))
    if found.antialiased:
        model.origin = {"antialiased": True, "raster": {"antialias": True}}
    if found.world_origin is not None:
        model.origin = {**model.origin, "world_origin": list(found.world_origin)}
    return leave_out_senseless(model, Path(path).name, tell=tell)


def export_ply(model: SplatModel, path: str | os.PathLike[str]) -> None:
    """Write the raw parameters, binary little-endian, normals zero; `load_ply` gives every bit back.

    Comments say that the model asks for antialiasing, and where its origin lies in the world; the log tells what no
    .ply can say. The file is complete or absent: it is written beside `path` and then renamed. Raises SceneError for
    models that are not explicit Gaussians.
    """
    if not isinstance(model, GaussianModel):
        raise SceneError(
            "this model cannot be written as .ply: its Gaussians depend on the camera; "
            "`sw bake FILE OUT --scene SCENE` fits explicit ones",
            path=str(path),
        )
    for what in lost_options(model):
        log.warning("%s: not kept: %s", Path(path).name, what)
    comments = [MIP_COMMENT] if antialias_of(model) else []
    shift = model.world_shift
    if (origin := model.world_origin) is not None and any(origin):
        word = ORIGIN_COMMENT if shift is None else WORLD_COMMENT
        comments.append(f"{word} {' '.join(map(repr, origin))}")
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.writelines(_parts_of(model, comments, shift))


def export_ply_as_3dgs(model: SplatModel, path: str | os.PathLike[str]) -> None:
    """Write as `export_ply`, but give surfels a third scale of 1e-8, so that 3DGS viewers show them.

    What these show is not what a rasterizer of surfels draws: they widen every Gaussian by their low-pass filter.
    """
    export_ply(as_ellipsoids(model) if isinstance(model, GaussianModel) else model, path)


def to_ply(model: GaussianModel) -> bytes:
    """Return the bytes that `export_ply` writes, without comments."""
    return b"".join(_parts_of(model))


def _parts_of(
    model: GaussianModel, comments: Sequence[str] = (), add: Sequence[float] | None = None
) -> Iterator[bytes | memoryview]:
    columns = (model.means, model.sh_dc[:, 0], model.sh_rest, model.opacity_logits, model.log_scales, model.quats)
    return file_parts(*(column.detach().cpu().float().numpy() for column in columns), comments=comments, add=add)
