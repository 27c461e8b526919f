"""PLY files of meshes and of points: written little-endian, read little-endian or as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatwizard_core.api import UserInputError, replacing
from sw_geometry.mesh import Floats, Mesh

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
LONGEST_HEADER = 65_536


def write_mesh(mesh: Mesh, path: Path, origin: tuple[float, float, float] | None = None) -> None:
    """Write a mesh, atomically: float32 x y z, nx ny nz and uchar red green blue where it has them, int32 indices.

    origin  added to the vertices, which then are doubles; None: they stay as they are
    """
    fields: list[tuple[str, str]] = [(name, "<f4" if origin is None else "<f8") for name in "xyz"]
    columns = [mesh.vertices if origin is None else mesh.vertices + origin]
    if mesh.normals is not None:
        fields += [(name, "<f4") for name in ("nx", "ny", "nz")]
        columns.append(mesh.normals)
    if mesh.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        columns.append(np.rint(np.clip(mesh.colors, 0, 1) * 255))
    vertices = np.empty(len(mesh.vertices), dtype=fields)
    for (name, _), column in zip(fields, np.concatenate(columns, axis=1).T, strict=True):
        vertices[name] = column
    faces = np.empty(len(mesh), dtype=[("count", "u1"), ("rows", "<i4", 3)])
    faces["count"], faces["rows"] = 3, mesh.triangles
    kinds = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0"]
    header += [] if origin is None else ["comment world_coordinates " + " ".join(map(repr, origin))]
    header += [f"element vertex {len(vertices)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in fields]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    content = "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()
    with replacing(path, wanted=len(content)) as temporary:
        temporary.write_bytes(content)


def read_mesh(path: Path) -> Mesh:
    """Read a mesh of triangles, with normals and 8-bit colours where it has them.

    Raises UserInputError for a file that is none, or is damaged.
    """
    elements, body, is_text = _parse(path)
    if [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
        raise UserInputError(f"{path}: not a mesh: its elements are {', '.join(e[0] for e in elements) or 'none'}")
    vertices, rest = _table(path, elements[0], body, is_text)
    count = elements[1][1]
    lists = [kind for _, kind in elements[1][2] if isinstance(kind, tuple)]
    if len(elements[1][2]) != 1 or len(lists) != 1:
        raise UserInputError(f"{path}: its faces must have one property, the list of vertex indices")
    length, index = lists[0]
    if is_text:
        faces = _whole_numbers(rest, 4 * count)
        sides = None if faces is None else faces.reshape(-1, 4)[:, 0]
        rows = None if faces is None else faces.reshape(-1, 4)[:, 1:]
    else:
        dtype = np.dtype([("count", length), ("rows", index, 3)])
        whole = len(rest) >= count * dtype.itemsize
        table = np.frombuffer(rest, dtype, count) if whole else None
        sides = None if table is None else table["count"]
        rows = None if table is None else table["rows"].astype(np.int64)
    if sides is None or rows is None or (sides != 3).any():
        raise UserInputError(f"{path}: it is truncated, or has faces that are no triangles")
    if rows.size and not (rows.min() >= 0 and rows.max() < len(vertices)):
        raise UserInputError(f"{path}: a triangle names a vertex that is not there")
    names = vertices.dtype.names or ()
    return Mesh(
        _columns(path, vertices, "x", "y", "z"),
        rows.reshape(-1, 3),
        _columns(path, vertices, "nx", "ny", "nz") if "nx" in names else None,
        _columns(path, vertices, "red", "green", "blue") / 255 if "red" in names else None,
    )


def read_points(path: Path) -> Floats:
    """The points [n,3] float64 of a PLY file. Raises UserInputError for a file that is none, or is damaged."""
    elements, body, is_text = _parse(path)
    if not elements or elements[0][0] != "vertex":
        raise UserInputError(f"{path}: its first element is not 'vertex'")
    return _columns(path, _table(path, elements[0], body, is_text)[0], "x", "y", "z")


Property = tuple[str, str | tuple[str, str]]
Element = tuple[str, int, list[Property]]


def _parse(path: Path) -> tuple[list[Element], bytes, bool]:
    """(elements, what follows the header, whether that is text)."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserInputError(f"{path}: cannot be read: {error.strerror}") from error
    end = content.find(b"end_header\n", 0, LONGEST_HEADER)
    if not content.startswith(b"ply") or end < 0:
        raise UserInputError(f"{path}: not a PLY file")
    elements: list[Element] = []
    form = ""
    for line in content[:end].decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", form, *_]:
                pass
            case ["element", name, count] if count.isdigit():
                elements.append((name, int(count), []))
            case ["property", "list", length, index, name] if elements and length in TYPES and index in TYPES:
                elements[-1][2].append((name, (TYPES[length], TYPES[index])))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append((name, TYPES[kind]))
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise UserInputError(f"{path}: the header has a line that makes no sense: {line!r:.80}")
    if form not in ("binary_little_endian", "ascii"):
        raise UserInputError(f"{path}: its format is {form!r:.40}; binary_little_endian and ascii can be read")
    return elements, content[end + len(b"end_header\n") :], form == "ascii"


def _table(path: Path, element: Element, body: bytes, is_text: bool) -> tuple[np.ndarray, bytes]:
    """The rows of an element without lists, and what follows them."""
    _, count, properties = element
    names = [name for name, _ in properties]
    if not names or len(set(names)) < len(names) or any(isinstance(kind, tuple) for _, kind in properties):
        raise UserInputError(f"{path}: element '{element[0]}' must have plain properties with different names")
    dtype = np.dtype([(name, str(kind)) for name, kind in properties])
    if is_text:
        lines = body.split(b"\n", count)
        try:
            values = np.array(b" ".join(lines[:count]).split(), dtype=np.float64).reshape(count, len(names))
        except ValueError:
            raise UserInputError(f"{path}: it is truncated, or a line has not {len(names)} numbers") from None
        table = np.empty(count, dtype=dtype)
        for name, column in zip(names, values.T, strict=True):
            table[name] = column
        return table, lines[count] if len(lines) > count else b""
    if len(body) < count * dtype.itemsize:
        raise UserInputError(f"{path}: it is truncated: {count:,} rows of '{element[0]}' are announced")
    return np.frombuffer(body, dtype, count), body[count * dtype.itemsize :]


def _whole_numbers(text: bytes, count: int) -> np.ndarray | None:
    """The first `count` whole numbers of a text; None if there are fewer."""
    words = text.split()[:count]
    try:
        return np.array(words, dtype=np.int64) if len(words) == count else None
    except ValueError:
        return None


def _columns(path: Path, table: np.ndarray, *names: str) -> Floats:
    if not set(names) <= set(table.dtype.names or ()):
        raise UserInputError(f"{path}: its vertices have no {', '.join(names)}")
    found = np.stack([table[name].astype(np.float64) for name in names], axis=1)
    if not np.isfinite(found).all():
        raise UserInputError(f"{path}: {', '.join(names)} of a vertex are not finite")
    return found
