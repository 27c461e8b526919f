"""The .ply of 3DGS: 62 float32 a Gaussian at SH degree 3, raw values, as the authors' code and all viewers read it.

That of 2DGS differs in one thing: a surfel has no `scale_2`. Which of the two a file is, that property says.
"""

from __future__ import annotations

import io
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData
from torch import Tensor

from splatwizard_core.api import BitstreamError, GaussianModel, SceneError, SplatModel, replacing
from sw_gaussians.surfels import SurfelModel, as_ellipsoids, gaussians_of

MAX_HEADER = 1 << 16
END_OF_HEADER = re.compile(rb"(?:^|\n)end_header\r?\n")
_SIZES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8,
}  # fmt: skip


def property_names(sh_rest: int, scales: int = 3) -> list[str]:
    """The vertex properties in the order of the file.

    sh_rest     K - 1, higher SH coefficients a channel
    scales      of a Gaussian: 3, of a surfel 2
    """
    return [
        "x", "y", "z", "nx", "ny", "nz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * sh_rest)),
        "opacity",
        *(f"scale_{i}" for i in range(scales)),
        *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip


def load_ply(path: str | os.PathLike[str]) -> GaussianModel:
    """Read a model with exactly the values of the file, active SH degree = the degree that is stored (0 .. 3).

    A file with scale_0 and scale_1 and no scale_2 holds surfels: a SurfelModel.

    Any order of properties, float or double, binary or ASCII, is read; normals and unknown properties are ignored.
    Raises BitstreamError if the file is damaged, SceneError if it is not a 3DGS model.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            # Before the rest is read: it may be anything.
            _check_header(file.read(MAX_HEADER), os.fstat(file.fileno()).st_size, str(path))
            file.seek(0)
            return from_ply(file.read(), str(path))
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}", path=str(path)) from error


def from_ply(data: bytes, path: str) -> GaussianModel:
    """Read a model from the bytes of a file, as `load_ply` does.

    path    what errors call it: where it lies, if it lies anywhere
    """
    name = Path(path).name
    count = _check_header(data[:MAX_HEADER], len(data), path)
    try:
        vertex = _vertices(data)
    except Exception as error:  # plyfile raises many kinds for damaged files, MemoryError and IndexError among them
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BitstreamError(f"{name}: not a readable .ply: {reason}", section="vertex") from error
    if len(vertex) != count:
        raise BitstreamError(f"{name}: {len(vertex)} vertices, header says {count}", section="vertex")
    names = set(vertex.dtype.names or ())
    rest = sum(1 for each in names if re.fullmatch(r"f_rest_\d+", each))
    degree = math.isqrt(rest // 3 + 1) - 1
    if rest % 3 or (degree + 1) ** 2 != rest // 3 + 1 or degree > 3:
        raise SceneError(f"{name}: {rest} f_rest properties; 0, 9, 24 or 45 (SH degree 0 to 3) are possible", path=path)
    flat = "scale_1" in names and "scale_2" not in names
    scales = SurfelModel.NUM_SCALES if flat else GaussianModel.NUM_SCALES
    needed = [each for each in property_names(rest // 3, scales) if each not in ("nx", "ny", "nz")]
    missing = [each for each in needed if each not in names]
    if missing:
        raise SceneError(
            f"{name}: not a 3DGS model, property '{missing[0]}' is missing ({len(missing)} in all)", path=path
        )

    def columns(*wanted: str) -> Tensor:
        table = np.empty((count, len(wanted)), dtype=np.float32)
        for i, each in enumerate(wanted):
            table[:, i] = vertex[each]
        return torch.from_numpy(table)

    # f_rest is channel-major: all K-1 coefficients of red, then green, then blue.
    sh_rest = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(count, 3, rest // 3)
    return gaussians_of(
        columns("x", "y", "z"),
        columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :],
        sh_rest.transpose(1, 2).contiguous(),
        columns("opacity")[:, 0],
        columns(*(f"scale_{i}" for i in range(scales))),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
    )


def export_ply(model: SplatModel, path: str | os.PathLike[str]) -> None:
    """Write the raw parameters, binary little-endian, normals zero; `load_ply` gives every bit back.

    The file is complete or absent: it is written beside `path` and then renamed. Raises SceneError for models that
    are not explicit Gaussians.
    """
    if not isinstance(model, GaussianModel):
        raise SceneError(
            f"a {type(model).__name__} cannot be written as .ply: its Gaussians depend on the camera", path=str(path)
        )
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.writelines(_file_parts(model))


def export_ply_as_3dgs(model: SplatModel, path: str | os.PathLike[str]) -> None:
    """Do what `export_ply` does, with a third scale of 1e-8 for surfels, so that viewers of 3DGS show them.

    What these show is not what a rasterizer of surfels draws: they widen every Gaussian by their low-pass filter.
    """
    export_ply(as_ellipsoids(model) if isinstance(model, GaussianModel) else model, path)


def to_ply(model: GaussianModel) -> bytes:
    """The bytes that `export_ply` writes of a model."""
    return b"".join(_file_parts(model))


def _file_parts(model: GaussianModel) -> tuple[bytes, memoryview]:
    """The header, and the rows [N, 17 + 3 (K - 1)] (surfels: one less) little-endian, columns as `property_names`."""
    names = property_names(model.sh_rest.shape[1], model.NUM_SCALES)
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {model.num_rows}\n{properties}end_header\n"
    columns = (
        model.means,
        model.means.new_zeros(model.num_rows, 3),
        model.sh_dc[:, 0, :],
        model.sh_rest.transpose(1, 2).flatten(1),
        model.opacity_logits[:, None],
        model.log_scales,
        model.quats,
    )
    rows = np.concatenate([each.detach().cpu().float().numpy() for each in columns], axis=1, dtype="<f4")
    return header.encode("ascii"), rows.data


def _vertices(data: bytes) -> NDArray[Any]:
    """Return the rows of the element `vertex` of a file whose header has been checked, a structured array."""
    end = END_OF_HEADER.search(data, 0, MAX_HEADER)
    assert end is not None
    # Of bytes that are no file plyfile reads number by number, 5 minutes for a million Gaussians: it reads a header
    # that claims no rows, and gives their type.
    empty = re.sub(rb"(?m)^([ \t]*element[ \t]+\S+[ \t]+)\d+", rb"\g<1>0", data[: end.end()])
    header = PlyData.read(io.BytesIO(empty))
    if header.text:
        return PlyData.read(io.BytesIO(data))["vertex"].data
    start = end.end()
    counts = re.findall(rb"(?m)^[ \t]*element[ \t]+\S+[ \t]+(\d+)", data[:start])
    for element, count in zip(header.elements, map(int, counts), strict=True):
        rows = element.dtype(header.byte_order)
        if element.name == "vertex":
            return np.frombuffer(data, rows, count, start)
        start += count * rows.itemsize
    raise ValueError("no element 'vertex'")


def _check_header(head: bytes, size: int, path: str) -> int:
    """The vertex count that a header claims, checked against the size of the file before anything is allocated."""
    name = Path(path).name
    match = END_OF_HEADER.search(head)
    if not head.startswith(b"ply") or match is None:
        raise BitstreamError(f"{name}: not a .ply file: no header within {MAX_HEADER} bytes", section="header")
    binary, element = False, None
    counts: dict[str, int] = {}
    widths: dict[str, int] = {}
    for line in head[: match.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            binary = len(words) > 1 and words[1].startswith("binary")
        elif words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"\d{1,12}", words[2]):
                raise BitstreamError(f"{name}: bad header line '{line[:60]}'", section="header")
            element = words[1]
            counts[element], widths[element] = int(words[2]), 0
        elif words[:1] == ["property"] and element is not None:
            if len(words) != 3 or words[1] not in _SIZES:
                raise BitstreamError(f"{name}: property '{line[:60]}' has no place in a 3DGS model", section="header")
            widths[element] += _SIZES[words[1]] if binary else 2
    if "vertex" not in counts:
        raise SceneError(f"{name}: not a 3DGS model: the header names no element 'vertex'", path=path)
    # An ASCII value takes two bytes at least; an element without properties would loop for nothing.
    claimed = sum(counts[each] * max(widths[each], 1) for each in counts)
    have = size - match.end()
    if claimed > have + (0 if binary else 1):
        raise BitstreamError(
            f"{name}: the header claims {claimed:,} bytes of data, the file holds {have:,}: it is truncated",
            section="vertex",
        )
    return counts["vertex"]
