"""The .rad format of Spark: a tree of Gaussians in chunks, the coarsest first. Read only.

Rows are nodes; those without children are the scene. `level` k reads the cut of the tree with at most a 2^k-th of
them: starting at the root, the node that is largest is replaced by its children. Source: the format's description in
Spark's repository, June 2026.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import SH_C0, BitstreamError, UserInputError
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.rad_encodings import BYTES, WHOLE, decoded, inflated, whole_numbers
from sw_interchange.scene import FLAT, LARGEST_LOGIT, GaussianScene, Limits, ReadReport, decoded_bytes
from sw_interchange.sog import is_plain
from sw_interchange.source import Source, json_reason

MAGIC, CHUNK_MAGIC = b"RAD0", b"RADC"
MAX_HEADER, MAX_CHUNK_HEADER = 8 << 20, 1 << 18
MAX_ROWS = 1 << 26
"""Of a chunk; writers put 65,536 into one."""
MAX_PROPERTIES = 64
MAX_DEPTH = 4096
MAX_LEVEL = 32
WIDTHS = {"center": 3, "alpha": 1, "rgb": 3, "scales": 3, "orientation": 3, "sh1": 9, "sh2": 15, "sh3": 21,
          "child_count": 1, "child_start": 1}  # fmt: skip
NEEDED = ("center", "alpha", "rgb", "scales", "orientation")
Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class _Chunk:
    """Rows of the file: first row, number, and its bytes."""

    base: int
    count: int
    data: memoryview
    name: str


def read_rad(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode the leaves, or the cut of `source.level`. Raises BitstreamError, UserInputError."""
    if not 0 <= source.level <= MAX_LEVEL:
        raise UserInputError(f"{source.name}: there is no level {source.level}; 0 to {MAX_LEVEL} are cut")
    header, data = _header(source)
    report.version = "1"
    total = _whole(header, "count", limits.max_gaussians, source.name)
    degree = header.get("maxSh", 0)
    if type(degree) is not int or not 0 <= degree <= 3:
        raise BitstreamError(f"{source.name}: its SH degree is {degree!r:.20}; 0 to 3 are possible")
    chunks = _chunks(source, header, data, total, report)
    limits.check(total, decoded_bytes(total, COEFFICIENTS[degree]), report.bytes, source.name)
    columns: dict[str, list[Any]] = {}
    ignored: set[str] = set()
    for chunk in chunks:
        found, unknown = _properties(chunk, degree)
        ignored |= unknown
        for name, values in found.items():
            columns.setdefault(name, []).append(values)
    report.ignored.extend(sorted(ignored))
    if any(name.startswith("sh") for name in ignored):
        report.warnings.append("its spherical harmonics lie in a codebook, which is not read: they are left out")
    for name in (*NEEDED, *columns):
        if len(columns.get(name, ())) != len(chunks):
            raise BitstreamError(f"{source.name}: property '{name}' is not there in every chunk")
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    if "child_count" in whole:
        rows = _rows_of_cut(whole, source)
        whole = {name: values[rows] for name, values in whole.items()}
    return _scene(whole, report)


def _header(source: Source) -> tuple[dict[str, Any], memoryview]:
    """Description, and what follows it."""
    data = memoryview(source.data)
    found, after = _json_at(data, MAGIC, MAX_HEADER, source.name)
    if found.get("version") != 1 or found.get("type", "gsplat") != "gsplat":
        raise BitstreamError(f"{source.name}: version {found.get('version')!r:.20} of .rad; 1 is read")
    return found, data[after:]


def _json_at(data: memoryview, magic: bytes, most: int, name: str) -> tuple[dict[str, Any], int]:
    """JSON behind a magic word and its length, and where the padding to 8 bytes after it ends."""

    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no number")

    if len(data) < 8 or bytes(data[:4]) != magic:
        raise BitstreamError(f"{name}: does not begin with {magic.decode()}")
    length = int.from_bytes(data[4:8], "little")
    if length > most or 8 + length > len(data):
        raise BitstreamError(f"{name}: claims a description of {length:,} bytes; {min(most, len(data)):,} are possible")
    try:
        found = json.loads(bytes(data[8 : 8 + length]), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise BitstreamError(f"{name}: a damaged description: {json_reason(error)}") from error
    if not isinstance(found, dict):
        raise BitstreamError(f"{name}: its description is no object")
    return found, (8 + length + 7) // 8 * 8


def _whole(told: dict[str, Any], key: str, most: int, name: str, least: int = 1) -> int:
    value = told.get(key)
    if type(value) is not int or not least <= value <= most:
        raise BitstreamError(f"{name}: '{key}' is {value!r:.20}; {least:,} to {most:,} are possible")
    return value


def _chunks(source: Source, header: dict[str, Any], data: memoryview, total: int, report: ReadReport) -> list[_Chunk]:
    told = header.get("chunks")
    if not isinstance(told, list) or not all(isinstance(each, dict) for each in told):
        raise BitstreamError(f"{source.name}: lists no chunks")
    chunks: list[_Chunk] = []
    rows, end, names = 0, 0, set()
    for number, each in enumerate(told, 1):
        name = f"{source.name}: chunk {number}"
        size = _whole(each, "bytes", 1 << 62, name)
        if (file := each.get("filename")) is not None:
            if file in names:
                raise BitstreamError(f"{name}: its file stands twice in the list")
            names.add(file)
            content = _beside(source, file, name)
            report.bytes += len(content)
        else:
            offset = _whole(each, "offset", 1 << 62, name, least=0)
            if offset < end or offset + size > len(data):
                raise BitstreamError(f"{name}: lies before the end of the one before, or beyond the end of the file")
            end = offset + size
            content = data[offset:end]
        chunk = _opened(content, each, rows, total, name)
        rows += chunk.count
        chunks.append(chunk)
    if rows != total:
        raise BitstreamError(f"{source.name}: its chunks hold {rows:,} rows, the header says {total:,}")
    return chunks


def _opened(content: memoryview, told: dict[str, Any], base: int, total: int, name: str) -> _Chunk:
    own, _ = _json_at(content, CHUNK_MAGIC, MAX_CHUNK_HEADER, name)
    count = _whole(own, "count", min(MAX_ROWS, total - base) if total > base else 1, name)
    if own.get("base", base) != base or told.get("base", base) != base or told.get("count", count) != count:
        raise BitstreamError(f"{name}: its rows do not follow those of the one before")
    return _Chunk(base, count, content, name)


def _beside(source: Source, file: Any, name: str) -> memoryview:
    if not isinstance(file, str) or not is_plain(file) or not file.lower().endswith(".radc"):
        raise BitstreamError(f"{name}: its file {file!r:.40} is no plain name that ends in .radc")
    return memoryview(source.beside(file))


def _properties(chunk: _Chunk, degree: int) -> tuple[dict[str, Any], set[str]]:
    """Columns of a chunk by name, and the names of those that mean nothing here."""
    told, at = _json_at(chunk.data, CHUNK_MAGIC, MAX_CHUNK_HEADER, chunk.name)
    if at + 8 > len(chunk.data):
        raise BitstreamError(f"{chunk.name}: is truncated")
    size = int.from_bytes(chunk.data[at : at + 8], "little")
    payload = chunk.data[at + 8 :]
    if size != told.get("payloadBytes", size) or size > len(payload):
        raise BitstreamError(f"{chunk.name}: claims {size:,} bytes of properties, {len(payload):,} are there")
    listed = told.get("properties")
    if not isinstance(listed, list) or len(listed) > MAX_PROPERTIES or not all(isinstance(p, dict) for p in listed):
        raise BitstreamError(f"{chunk.name}: has no list of properties, or more than {MAX_PROPERTIES}")
    found: dict[str, Any] = {}
    ignored: set[str] = set()
    for each in listed:
        kind = each.get("property")
        if not isinstance(kind, str) or not 0 < len(kind) <= 32 or kind in found:
            raise BitstreamError(f"{chunk.name}: a property without a name, or twice the same")
        if kind not in WIDTHS or (kind in ("sh1", "sh2", "sh3") and int(kind[2]) > degree):
            ignored.add(kind)
            continue
        found[kind] = _property(chunk, each, kind, payload[:size])
    return found, ignored


def _property(chunk: _Chunk, told: dict[str, Any], kind: str, payload: memoryview) -> Any:
    name = f"{chunk.name}, '{kind}'"
    encoding, width = told.get("encoding"), WIDTHS[kind]
    if encoding not in BYTES or (encoding == "oct88r8") != (kind == "orientation" and encoding == "oct88r8"):
        raise BitstreamError(f"{name}: an unknown encoding {encoding!r:.20}")
    is_whole = kind in ("child_count", "child_start")
    if is_whole != (encoding in WHOLE):
        raise BitstreamError(f"{name}: an encoding {encoding!r:.20} that does not suit it")
    offset, length = (_whole(told, key, len(payload), name, least=0) for key in ("offset", "bytes"))
    if offset + length > len(payload):
        raise BitstreamError(f"{name}: lies beyond the end of its chunk")
    data = payload[offset : offset + length]
    size = chunk.count * BYTES[encoding] * (1 if encoding == "oct88r8" else width)
    compression = told.get("compression")
    if compression == "gz":
        content = inflated(data, size, name)
    elif compression in (None, "", "none") and len(data) == size:
        content = bytes(data)
    else:
        raise BitstreamError(f"{name}: of {len(data):,} bytes where {size:,} are needed, or packed in a way of its own")
    if is_whole:
        return whole_numbers(content, encoding)
    values = decoded(content, encoding, chunk.count, {**told, "rows": chunk.count}, name)
    if kind == "orientation" and values.shape[1] == 3:  # x,y,z of a rotation whose w is not negative
        w = np.sqrt(np.maximum(1 - (values * values).sum(axis=1, keepdims=True), 0))
        values = np.concatenate([values, w], axis=1)
    return values


def _rows_of_cut(columns: dict[str, Any], source: Source) -> Index:
    """Rows of the leaves, or of a coarser cut."""
    counts, starts = columns["child_count"], columns.get("child_start")
    if starts is None:
        raise BitstreamError(f"{source.name}: its tree says how many children, and not which")
    n, rows = len(counts), np.arange(len(counts))
    parents = rows[counts > 0]
    first, number = starts[parents], counts[parents]
    if (first <= parents).any() or (first + number > n).any():
        raise BitstreamError(f"{source.name}: children of its tree lie before their parent, or beyond the last row")
    children = np.repeat(first - np.cumsum(number) + number, number) + np.arange(int(number.sum()))
    if len(children) != n - 1 or (np.bincount(children, minlength=n) > 1).any():
        raise BitstreamError(f"{source.name}: a row of its tree has no parent, or two")
    if source.level == 0:
        leaves: Index = rows[counts == 0]
        return leaves
    parent_of = np.zeros(n, np.int64)
    parent_of[children] = np.repeat(parents, number)
    sizes = _sizes_below(columns, counts, starts, parent_of, source.name)
    order = np.lexsort((parents, -sizes[parents]))
    held = 1 + np.cumsum(number[order] - 1)
    opened = np.zeros(n, bool)
    opened[parents[order[held <= max(int((counts == 0).sum()) >> source.level, 1)]]] = True
    above = opened[parent_of]
    above[0] = True
    cut: Index = rows[above & ~opened]
    return cut


def _sizes_below(columns: dict[str, Any], counts: Index, starts: Index, parent_of: Index, name: str) -> Array:
    """Largest scale of each node, of none more than that of its parent: parents are replaced before their children."""
    sizes: Array = columns["scales"].max(axis=1) * (1 + 4 * np.maximum(columns["alpha"][:, 0] - 1, 0))
    nodes = np.zeros(1, np.int64)
    for _ in range(MAX_DEPTH):
        inner = nodes[counts[nodes] > 0]
        if not len(inner):
            return sizes
        number = counts[inner]
        nodes = np.repeat(starts[inner] - np.cumsum(number) + number, number) + np.arange(int(number.sum()))
        sizes[nodes] = np.minimum(sizes[nodes], sizes[parent_of[nodes]])
    raise BitstreamError(f"{name}: its tree is deeper than {MAX_DEPTH:,}")


def _scene(columns: dict[str, Any], report: ReadReport) -> GaussianScene:
    alphas = columns["alpha"][:, 0].astype(np.float64)
    report.repaired("opacities above 1, which only nodes of a tree have", int((alphas > 1.001).sum()))
    alphas = np.clip(alphas, 1e-6, 1 - 1e-6)
    rest: list[Array] = []
    for band in (1, 2, 3):
        if f"sh{band}" not in columns:
            break
        values = columns[f"sh{band}"]
        rest.append(values.reshape(len(values), -1, 3))
    count = len(alphas)
    return GaussianScene(
        means=columns["center"],
        log_scales=np.maximum(np.log(np.maximum(columns["scales"], 0)), FLAT).astype(np.float32),
        quats=np.ascontiguousarray(columns["orientation"][:, [3, 0, 1, 2]]),
        opacity_logits=np.clip(np.log(alphas / (1 - alphas)), -LARGEST_LOGIT, LARGEST_LOGIT).astype(np.float32),
        sh_dc=((columns["rgb"] - 0.5) / SH_C0).astype(np.float32),
        sh_rest=np.concatenate(rest, axis=1) if rest else np.zeros((count, 0, 3), np.float32),
    )
