"""Reader and writer of Gaussian .ply files in the dialects of public trainers.

Sources: 3D Gaussian Splatting (arXiv 2308.04079) for the layout, Mip-Splatting (arXiv 2311.16493) for `filter_3D`, and
the comments that public trainers write.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import SH_C0, SceneError
from sw_gaussians.ply_tables import MAX_HEADER, PlyHeader, Table, read_header, read_tables

Array = npt.NDArray[np.float32]

MIP_COMMENT = "SplatRenderMode: mip"
"""Comment of files trained with the Mip-Splatting filter."""
ORIGIN_COMMENT, WORLD_COMMENT = "world_origin", "world_coordinates"
"""Keywords of comments with three numbers. First: world position of the coordinate origin. Second: coordinates are
world coordinates, and the numbers are a suggested local origin for float32."""
MAX_OFFSET_RATIO = 1e4
"""Distance from 0, in model sizes, beyond which float64 coordinates get a local origin."""
_ROWS_AT_ONCE = 1 << 13  # 2 MB of rows: they stay in the processor's cache


@dataclass
class PlyGaussians:
    """Raw values of a file, rows in file order.

    means           [N,3] float32
    sh_dc           [N,3]
    sh_rest         [N,K,3], K = 0, 3, 8, 15 or 24
    opacity_logits  [N]
    log_scales      [N,3], of surfels [N,2]
    quats           [N,4] w,x,y,z of any norm
    antialiased     the file says that it was trained with the filter of Mip-Splatting
    ignored         properties that mean nothing to a Gaussian
    notes           what else a reader should tell
    world_origin    where the origin of `means` lies in the world; None: the file does not say
    """

    means: Array
    sh_dc: Array
    sh_rest: Array
    opacity_logits: Array
    log_scales: Array
    quats: Array
    antialiased: bool
    comments: tuple[str, ...]
    ignored: tuple[str, ...]
    notes: tuple[str, ...]
    world_origin: tuple[float, float, float] | None = None


def property_names(sh_rest: int, scales: int = 3) -> list[str]:
    """The vertex properties in the order of the file.

    sh_rest     K - 1, higher SH coefficients per channel
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


def parse_gaussians(
    data: bytes | memoryview, path: str, *, max_gaussians: int | None = None, interleaved: bool = False
) -> PlyGaussians:
    """Read the Gaussians of a .ply of any dialect. Raises BitstreamError if it is damaged, SceneError if it has none.

    data            the whole file
    path            what errors call it
    interleaved     f_rest begins with red, green and blue of the first coefficient, as some converters write it
    """
    name = Path(path).name
    header = read_header(bytes(data[:MAX_HEADER]), len(data), name)
    rest, flat = _check_dialect(header, name, path)
    if max_gaussians is not None and header.count("vertex") > max_gaussians:
        raise SceneError(f"{name}: {header.count('vertex'):,} Gaussians, more than {max_gaussians:,}", path=path)
    vertex = read_tables(data, header, ("vertex",), name)["vertex"]
    names = set(vertex.dtype.names or ())
    # f_rest is channel-major: all K-1 coefficients of red, then green, then blue.
    order = np.arange(rest).reshape((-1, 3) if interleaved else (3, -1))
    columns = order.T.ravel() if interleaved else order.ravel()
    channels = _columns(vertex, [f"f_rest_{i}" for i in columns]).reshape(len(vertex), 3, rest // 3)
    log_scales = _contiguous(_columns(vertex, [f"scale_{i}" for i in range(2 if flat else 3)]))
    opacity_logits, notes = _opacities(vertex), []
    if "filter_3D" in names:
        log_scales, opacity_logits = _bake(log_scales, opacity_logits, _columns(vertex, ["filter_3D"]))
        notes.append("the 3D filter of Mip-Splatting is part of scales and opacities now")
    known = {*property_names(rest // 3), "filter_3D", *([] if "f_dc_0" in names else ["red", "green", "blue"]),
             *([] if "opacity" in names else ["alpha"])}  # fmt: skip
    mode = _render_mode(header.comments)
    if any(comment.lower().startswith("vertical axis: z") for comment in header.comments):
        notes.append("its world is that of nerfstudio (z up, re-scaled), not that of the photographs")
    if mode == "2dgs" and not flat:
        notes.append(
            "its comments say that it was trained as surfels (2dgs), but it has three scales: read as Gaussians"
        )
    if spare := header.spare_bytes(len(data)):
        notes.append(f"{spare:,} bytes after its last row mean nothing")
    means, world_origin = _means(vertex, header.comments, notes)
    return PlyGaussians(
        means,
        _colours(vertex),
        _contiguous(channels.transpose(0, 2, 1)),
        opacity_logits,
        log_scales,
        _contiguous(_columns(vertex, [f"rot_{i}" for i in range(4)])),
        mode == "mip",
        header.comments,
        tuple(n for n in vertex.dtype.names or () if n not in known),
        tuple(notes),
        world_origin,
    )


def _means(vertex: Table, comments: Sequence[str], notes: list[str]) -> tuple[Array, tuple[float, float, float] | None]:
    """(means [N,3], world origin): coordinates of the world are moved to a local origin in double precision."""
    told = {word: _three_numbers(comments, word) for word in (ORIGIN_COMMENT, WORLD_COMMENT)}
    origin = told[WORLD_COMMENT]
    doubles = [vertex.dtype[axis] for axis in "xyz"] == [np.dtype("f8")] * 3
    if origin is None and told[ORIGIN_COMMENT] is None and doubles and len(vertex):
        middle = [float(np.median(vertex[axis])) for axis in "xyz"]
        size = max(float(np.median(np.abs(vertex[axis] - at))) for axis, at in zip("xyz", middle, strict=True))
        if math.isfinite(sum(middle)) and math.hypot(*middle) > MAX_OFFSET_RATIO * max(size, 1e-9):
            origin = (round(middle[0]), round(middle[1]), round(middle[2]))
            notes.append(f"its coordinates lie far from 0 and are moved to a local origin at {origin}")
    if origin is None:
        return _contiguous(_columns(vertex, ["x", "y", "z"])), told[ORIGIN_COMMENT]
    columns = [vertex[axis].astype(np.float64) - at for axis, at in zip("xyz", origin, strict=True)]
    with np.errstate(all="ignore"):
        return np.stack(columns, axis=1).astype(np.float32), origin


def _three_numbers(comments: Sequence[str], word: str) -> tuple[float, float, float] | None:
    for comment in comments:
        name, *rest = comment.split()[:5] or [""]
        if name == word and len(rest) == 3:
            try:
                x, y, z = map(float, rest)
            except ValueError:
                return None
            return (x, y, z) if math.isfinite(x + y + z) else None
    return None


def _check_dialect(header: PlyHeader, name: str, path: str) -> tuple[int, bool]:
    """The number of f_rest properties, and whether these are surfels. Raises SceneError if they are no Gaussians."""

    def refuse(reason: str) -> SceneError:
        return SceneError(f"{name}: {reason}", path=path)

    names = set(header.names("vertex"))
    if header.names("codebook_centers"):
        raise refuse(
            "a .ply with codebooks (Reducing the Memory Footprint), which is not read: export it as plain .ply"
        )
    if "packed_position" in names:
        raise refuse("a compressed .ply: call it NAME.compressed.ply, which sw-interchange reads")
    if any(n.startswith(("f_offset", "f_anchor_feat")) for n in names):
        raise refuse("anchors (Scaffold-GS and its kin) and not Gaussians: their networks are not in the file")
    if "vertex" not in {each.name for each in header.elements}:
        raise refuse("not a 3DGS model: the header names no element 'vertex'")
    if "x" in names and not names & {"opacity", "scale_0", "rot_0"}:
        found = "a mesh" if header.count("face") else "a point cloud"
        raise refuse(
            f"{found}, not a 3DGS model: there is no opacity, scale or rotation (trainers keep an input.ply of points "
            "beside their models)"
        )
    moving = sorted(n for n in names if n in ("t", "trbf_center") or n.startswith("motion_"))
    if moving:
        raise refuse(f"Gaussians that move with time ('{moving[0]}'), which are not read: export one moment")
    rest = sum(1 for each in names if re.fullmatch(r"f_rest_\d+", each))
    degree = math.isqrt(rest // 3 + 1) - 1
    if rest % 3 or (degree + 1) ** 2 != rest // 3 + 1 or degree > 4:
        raise refuse(f"{rest} f_rest properties; 0, 9, 24 or 45 (SH degree 0 to 3) are possible")
    flat = "scale_1" in names and "scale_2" not in names
    needed = [n for n in property_names(rest // 3, 2 if flat else 3) if n not in ("nx", "ny", "nz")]
    if "f_dc_0" not in names and {"red", "green", "blue"} <= names:
        needed = [n for n in needed if not n.startswith("f_dc")]
    if "alpha" in names:
        needed.remove("opacity")
    missing = [each for each in needed if each not in names]
    if missing:
        raise refuse(f"not a 3DGS model, property '{missing[0]}' is missing ({len(missing)} in all)")
    return rest, flat


def _opacities(vertex: Table) -> Array:
    """Logits [N], from `alpha` where there are none: 0..1, or a share of the largest whole number."""
    if "opacity" in (vertex.dtype.names or ()):
        return _contiguous(_columns(vertex, ["opacity"]))[:, 0]
    alphas = _columns(vertex, ["alpha"])[:, 0].astype(np.float64)
    if vertex.dtype["alpha"].kind != "f":
        alphas /= np.iinfo(vertex.dtype["alpha"]).max
    alphas = np.clip(alphas, 1e-6, 1 - 1e-6)
    return (np.log(alphas) - np.log1p(-alphas)).astype(np.float32)


def _colours(vertex: Table) -> Array:
    if "f_dc_0" in (vertex.dtype.names or ()):
        return _contiguous(_columns(vertex, ["f_dc_0", "f_dc_1", "f_dc_2"]))
    colours = _contiguous(_columns(vertex, ["red", "green", "blue"]))
    if vertex.dtype["red"].kind != "f":
        colours /= np.iinfo(vertex.dtype["red"]).max
    return ((colours - 0.5) / SH_C0).astype(np.float32)


def _bake(log_scales: Array, logits: Array, filters: Array) -> tuple[Array, Array]:
    """Make the 3D filter part of the Gaussian: s^2 + f^2 along each axis, and alpha times the loss of volume."""
    with np.errstate(all="ignore"):
        widened = 0.5 * np.logaddexp(2 * log_scales.astype(np.float64), 2 * np.log(np.abs(filters, dtype=np.float64)))
        loss = (log_scales - widened).sum(1)  # of log alpha, <= 0
        alpha = np.exp(loss - np.logaddexp(0, -logits.astype(np.float64)))
        return widened.astype(np.float32), (np.log(alpha) - np.log1p(-alpha)).astype(np.float32)


def _render_mode(comments: Sequence[str]) -> str:
    """Return the training mode from the file's comments: default, mip or 2dgs; "" if not stated."""
    mode = ""
    for comment in comments:
        words = comment.lower().replace(":", " ").split()
        if words[:1] == ["antialiased"] and len(words) > 1:
            mode = "mip" if words[1] == "1" else "default"
        elif words[:1] == ["splatrendermode"] and len(words) > 1:
            mode = words[1]
    return mode


def _columns(vertex: Table, names: Sequence[str]) -> Array:
    """[N, len(names)]: a view where the columns stand side by side as float32 of this machine, else a copy."""
    if not names or not len(vertex):
        return np.zeros((len(vertex), len(names)), np.float32)
    fields = vertex.dtype.fields or {}
    first = int(fields[names[0]][1])
    if all(fields[n] == (np.dtype("<f4"), first + 4 * i) for i, n in enumerate(names)):
        steps = (vertex.dtype.itemsize, 4)
        return np.ndarray((len(vertex), len(names)), np.float32, buffer=vertex, offset=first, strides=steps)
    copy = np.empty((len(vertex), len(names)), np.float32)
    with np.errstate(all="ignore"):  # a double beyond float32 becomes infinity
        for i, each in enumerate(names):
            copy[:, i] = vertex[each]
    return copy


def _contiguous(view: Array) -> Array:
    """Return a contiguous copy, made by two threads."""
    out = np.empty(view.shape, np.float32)
    _by_threads(lambda rows: np.copyto(out[rows], view[rows]), len(view))
    return out


def _by_threads(work: Callable[[slice], None], rows: int) -> None:
    parts = [slice(at, at + _ROWS_AT_ONCE) for at in range(0, rows, _ROWS_AT_ONCE)]
    if len(parts) < 4:
        for part in parts:
            work(part)
        return
    with ThreadPoolExecutor(2) as pool:
        for _ in pool.map(work, parts):
            pass


def file_parts(
    means: Array,
    sh_dc: Array,
    sh_rest: Array,
    opacity_logits: Array,
    log_scales: Array,
    quats: Array,
    comments: Sequence[str] = (),
    add: Sequence[float] | None = None,
) -> Iterator[bytes | memoryview]:
    """Yield the header, then rows little-endian, normals zero, columns as `property_names` (shapes: PlyGaussians).

    add     to the coordinates, which become doubles then
    """
    names = property_names(sh_rest.shape[1], log_scales.shape[1])
    told = "".join(f"comment {comment}\n" for comment in comments)
    wide = "xyz" if add is not None else ""
    properties = "".join(f"property {'double' if name in wide else 'float'} {name}\n" for name in names)
    start = f"ply\nformat binary_little_endian 1.0\n{told}element vertex {len(means)}\n{properties}end_header\n"
    yield start.encode("ascii", "replace")
    rest = 9 + 3 * sh_rest.shape[1]
    for at in range(0, len(means), _ROWS_AT_ONCE):
        part = slice(at, at + _ROWS_AT_ONCE)
        rows = np.zeros((len(means[part]), len(names)), "<f4")
        rows[:, :3], rows[:, 6:9], rows[:, rest] = means[part], sh_dc[part], opacity_logits[part]
        rows[:, 9:rest] = sh_rest[part].transpose(0, 2, 1).reshape(len(rows), -1)
        rows[:, rest + 1 : -4], rows[:, -4:] = log_scales[part], quats[part]
        if add is None:
            yield rows.data
            continue
        doubles = np.empty(len(rows), [("means", "<f8", 3), ("others", "<f4", len(names) - 3)])
        doubles["means"], doubles["others"] = means[part].astype(np.float64) + np.array(add), rows[:, 3:]
        yield doubles.tobytes()
