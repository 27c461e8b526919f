"""Reading binary glTF with KHR_gaussian_splatting: all its primitives, each moved by the nodes above it.

Source: the text of the extension in KhronosGroup/glTF.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError, UserInputError
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.frames import placed
from sw_interchange.gltf_writer import EXTENSION, SPZ
from sw_interchange.scene import FLAT, GaussianScene, Limits, ReadReport, decoded_bytes, joined, logits_of
from sw_interchange.source import Source, json_reason
from sw_interchange.spz import read_spz

MAX_JSON = 1 << 24
MAX_NODES = 1 << 16
MAX_PRIMITIVES = 1 << 10
MOST_READ = 16
"""Times that the bytes of a file may be read: primitives and nodes may share accessors."""
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

Matrix = npt.NDArray[np.float64]


class _Document:
    """The two chunks of a file, every index into them checked."""

    def __init__(self, source: Source, limits: Limits) -> None:
        self.name, self.limits, self.rows, self.read = source.name, limits, 0, 0
        data = source.data
        self.size = len(data)
        if bytes(data[:4]) != b"glTF":
            raise self.error("a .gltf of text, which is not read: make a .glb of it")
        if len(data) < 20:
            raise self.error("truncated")
        version, length, size, kind = struct.unpack_from("<III4s", data, 4)
        if version != 2 or kind != b"JSON" or length > len(data) or 20 + size > length or size > MAX_JSON:
            raise self.error("no .glb of version 2, or truncated")
        try:
            self.root = json.loads(bytes(data[20 : 20 + size]), parse_constant=_refuse)
        except (ValueError, RecursionError) as error:
            raise self.error(f"damaged JSON: {json_reason(error)}") from error
        at = 20 + size
        self.blob = memoryview(b"")
        if at + 8 <= length:
            size, kind = struct.unpack_from("<I4s", data, at)
            if kind != b"BIN\0" or at + 8 + size > length:
                raise self.error("its second chunk is cut off")
            self.blob = memoryview(data)[at + 8 : at + 8 + size]

    def error(self, reason: str) -> BitstreamError:
        return BitstreamError(f"{self.name}: {reason}")

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """One object of a list of the root."""
        found = self.root.get(kind) if isinstance(self.root, dict) else None
        if not isinstance(found, list) or type(index) is not int or not 0 <= index < len(found):
            raise self.error(f"names {kind} number {index!r:.20}, which there is not")
        if not isinstance(found[index], dict):
            raise self.error(f"{kind} number {index} is no object")
        return found[index]

    def whole(self, part: dict[str, Any], key: str, default: int | None = None) -> int:
        found = part.get(key, default)
        if type(found) is not int or not 0 <= found < 1 << 40:
            raise self.error(f"'{key}' is {found!r:.20}, which is no size")
        return found

    def view(self, index: Any) -> dict[str, Any]:
        """A part of the second chunk."""
        view = self.item("bufferViews", index)
        buffer = self.item("buffers", view.get("buffer"))
        if view["buffer"] != 0 or "uri" in buffer:
            raise self.error("its numbers lie in another file, which is not opened")
        return view

    def bytes_of(self, index: Any) -> memoryview:
        """All bytes of a view."""
        view = self.view(index)
        start, length = self.whole(view, "byteOffset", 0), self.whole(view, "byteLength")
        self.read += length
        if start + length > len(self.blob) or self.read > MOST_READ * len(self.blob):
            raise self.error("a view reaches beyond its buffer, or is read too often")
        return self.blob[start : start + length]

    def column(self, index: Any) -> Array:
        """[N,width] float32 of an accessor; normalised integers become what they stand for."""
        accessor = self.item("accessors", index)
        component, width = (
            _COMPONENTS.get(self.whole(accessor, "componentType")),
            _WIDTHS.get(str(accessor.get("type"))),
        )
        if component is None or width is None or "sparse" in accessor:
            raise self.error(f"accessor {index} has a type, or a sparse form, that splats do not have")
        view = self.view(accessor.get("bufferView"))
        row = np.dtype((component, (width,)))
        count, stride = self.whole(accessor, "count"), self.whole(view, "byteStride", 0) or row.itemsize
        self.rows += count
        self.limits.check(count, 4 * width * self.rows, self.size, self.name)
        start = self.whole(view, "byteOffset", 0) + self.whole(accessor, "byteOffset", 0)
        end = start + (stride * (count - 1) + row.itemsize if count else 0)
        inside = self.whole(view, "byteOffset", 0) + self.whole(view, "byteLength")
        if stride < row.itemsize or end > inside or inside > len(self.blob):
            raise self.error(f"accessor {index} reaches beyond its buffer: it is truncated")
        self.read += count * row.itemsize
        if self.read > MOST_READ * len(self.blob):
            raise self.error(f"its splats name the same bytes more than {MOST_READ} times over")
        strides = (stride, row.base.itemsize)
        raw = np.ndarray((count, width), row.base, buffer=self.blob, offset=start, strides=strides)
        values = raw.astype(np.float32)
        if accessor.get("normalized") is True and component != "<f4":
            values = np.maximum(values / np.float32(np.iinfo(row.base).max), -1)
        return values


def _refuse(word: str) -> float:
    raise ValueError(f"{word} is no number")


def read_gltf(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a .glb. Raises BitstreamError."""
    document = _Document(source, limits)
    report.version = "2.0"
    parts = [_primitive(document, each, place, report) for each, place in _placed(document)]
    if not parts:
        raise document.error(f"there are no splats in it: nothing uses {EXTENSION}")
    return joined(parts)


def _placed(document: _Document) -> list[tuple[dict[str, Any], Matrix]]:
    """Primitives with splats, and the map [4,4] of each from its mesh to the world."""
    root = document.root if isinstance(document.root, dict) else {}
    scene = document.item("scenes", root.get("scene", 0))
    waiting = [(index, np.eye(4)) for index in _list(scene.get("nodes"))]
    seen: set[int] = set()
    of_meshes: dict[int, list[dict[str, Any]]] = {}
    found = []
    while waiting:
        index, above = waiting.pop()
        node = document.item("nodes", index)
        if index in seen or len(seen) >= MAX_NODES:
            raise document.error("its nodes are no tree")
        seen.add(index)
        place = above @ _local(document, node)
        waiting += [(child, place) for child in _list(node.get("children"))]
        if "mesh" not in node:
            continue
        mesh = document.item("meshes", node["mesh"])
        # Once a mesh: many nodes may name one of many primitives.
        if node["mesh"] not in of_meshes:
            of_meshes[node["mesh"]] = [each for each in _list(mesh.get("primitives")) if _has_splats(each)]
        found += [(primitive, place) for primitive in of_meshes[node["mesh"]]]
        if len(found) > MAX_PRIMITIVES:
            raise document.error(f"more than {MAX_PRIMITIVES:,} primitives with splats")
    return found


def _has_splats(primitive: Any) -> bool:
    told = primitive.get("extensions") if isinstance(primitive, dict) else None
    return isinstance(told, dict) and EXTENSION in told


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _local(document: _Document, node: dict[str, Any]) -> Matrix:
    """The map [4,4] of a node, from a matrix or from its three parts."""

    def numbers(key: str, default: list[float]) -> Matrix:
        found = node.get(key, default)
        good = isinstance(found, list) and len(found) == len(default)
        if not good or not all(type(x) in (int, float) and abs(x) < 1e12 for x in found):
            raise document.error(f"'{key}' of a node is no list of {len(default)} numbers")
        return np.array(found, np.float64)

    if "matrix" in node:
        return numbers("matrix", np.eye(4).ravel().tolist()).reshape(4, 4).T
    x, y, z, w = numbers("rotation", [0, 0, 0, 1])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= numbers("scale", [1, 1, 1])
    matrix[:3, 3] = numbers("translation", [0, 0, 0])
    return matrix


def _primitive(document: _Document, primitive: dict[str, Any], place: Matrix, report: ReadReport) -> GaussianScene:
    extension = primitive["extensions"][EXTENSION]
    if isinstance(extension, dict) and extension.get("colorSpace") == "lin_rec709_display":
        report.warnings.append("its colours are linear, and are taken as they are: they will look too dark")
    if isinstance(extension, dict) and isinstance(packed := extension.get("extensions"), dict) and packed:
        return _moved(document, _unpacked(document, packed, report), place)
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise document.error("a primitive without attributes")

    def column(name: str, width: int, count: int | None) -> Array:
        values = document.column(attributes.get(name))
        if values.shape[1] != width or (count is not None and len(values) != count):
            raise document.error(
                f"'{name}' has {len(values):,} rows of {values.shape[1]}, not {count or 'N'} of {width}"
            )
        return values

    means = column("POSITION", 3, None)
    n = len(means)
    scales = column(f"{EXTENSION}:SCALE", 3, n)
    alphas = column(f"{EXTENSION}:OPACITY", 1, n)[:, 0]
    degree = next((d for d in range(4) if f"{EXTENSION}:SH_DEGREE_{d + 1}_COEF_0" not in attributes), 3)
    document.limits.check(n, decoded_bytes(n, COEFFICIENTS[degree]), document.size, document.name)
    rest = np.zeros((n, COEFFICIENTS[degree], 3), np.float32)
    places = [(d, i) for d in range(1, degree + 1) for i in range(2 * d + 1)]
    for k, (d, i) in enumerate(places):
        rest[:, k] = column(f"{EXTENSION}:SH_DEGREE_{d}_COEF_{i}", 3, n)
    with np.errstate(all="ignore"):
        log_scales = np.where(scales == 0, np.float32(FLAT), np.log(scales)).astype(np.float32)
    scene = GaussianScene(
        means, log_scales, column(f"{EXTENSION}:ROTATION", 4, n)[:, [3, 0, 1, 2]], logits_of(alphas),
        column(f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3, n), rest, frame="LUF",
    )  # fmt: skip
    return _moved(document, scene, place)


def _unpacked(document: _Document, packed: dict[str, Any], report: ReadReport) -> GaussianScene:
    """The splats of a primitive that are compressed in a way of an extension of the extension."""
    found = packed.get(SPZ)
    if not isinstance(found, dict):
        names = ", ".join(f"{name:.60}" for name in sorted(packed)[:3])
        raise document.error(f"its splats are compressed by {names}, which is not read; {SPZ} is")
    source = Source(document.bytes_of(found.get("bufferView")), f"{document.name}/spz")
    scene = read_spz(source, document.limits, report)
    document.rows += scene.num_gaussians
    document.limits.check(document.rows, decoded_bytes(document.rows, 15), document.size, document.name)
    report.version = "2.0"
    return scene.in_frame("LUF")


def _moved(document: _Document, scene: GaussianScene, place: Matrix) -> GaussianScene:
    try:
        with np.errstate(all="ignore"):
            return placed(scene, place)
    except UserInputError as error:
        raise document.error(f"a node moves its splats in a way that is not read: {error}") from error
