"""Parser of .ply elements into tables; checks the header against the file size before allocating.

Rows of fixed width are viewed where they lie; text, and what stands behind elements with lists, is read by plyfile.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from plyfile import PlyData

from splatwizard_core.api import BitstreamError

BOM = b"\xef\xbb\xbf"
"""Mark of UTF-8 that some editors put before a text."""
MAX_HEADER = 1 << 17
MAX_LIST_ROWS = 1 << 20
"""Largest number of rows with lists, which are parsed one by one."""
_TYPES = {
    "char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
    "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

Table = npt.NDArray[np.void]
"""[N] rows of named numbers."""


@dataclass
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)  # property, type code
    lists: int = 0
    names: set[str] = field(default_factory=set)  # of the fields, to look one up

    def least_bytes(self, binary: bool) -> int:
        """Return the least number of bytes of the rows: per list its length, per text value 2, per empty row 1."""
        width = sum(int(code[1]) for _, code in self.fields) if binary else 2 * len(self.fields)
        return self.count * max(width + self.lists * (1 if binary else 2), 1)


@dataclass(frozen=True)
class PlyHeader:
    """Elements of a file in their order, its comments, where its rows begin, and its byte order ("" for text)."""

    elements: tuple[_Element, ...]
    comments: tuple[str, ...]
    rows_at: int
    order: str

    def names(self, element: str) -> list[str]:
        """The properties of an element; empty if there is no such element."""
        return [name for each in self.elements if each.name == element for name, _ in each.fields]

    def spare_bytes(self, size: int) -> int:
        """Bytes of a file of `size` after its last row; 0 for text and where lists decide how long the rows are."""
        if not self.order or any(each.lists for each in self.elements):
            return 0
        return (
            size
            - self.rows_at
            - sum(each.count * sum(int(code[1]) for _, code in each.fields) for each in self.elements)
        )

    def count(self, element: str) -> int:
        """The rows of an element; 0 if there is no such element."""
        return sum(each.count for each in self.elements if each.name == element)


def read_header(head: bytes, size: int, name: str) -> PlyHeader:
    """Parse the header, and check that the file is long enough for its rows.

    head    the first MAX_HEADER bytes of the file (fewer if it is shorter)
    size    bytes of the file
    name    for messages

    Raises BitstreamError.
    """
    match = re.search(rb"[\r\n]end_header(\r\n|\n|\r)", head)
    if not head.removeprefix(BOM).startswith(b"ply"):
        raise BitstreamError(f"{name}: not a .ply file: it does not start with `ply`", section="header")
    if match is None:
        end = "truncated" if size <= MAX_HEADER else f"no header within {MAX_HEADER:,} bytes"
        raise BitstreamError(f"{name}: not a whole .ply file: its header has no end ({end})", section="header")
    elements: list[_Element] = []
    named: set[str] = set()
    comments: list[str] = []
    order: str | None = None
    for line in re.split(r"\r\n|\r|\n", head[: match.start()].decode("ascii", "replace"))[1:]:
        words = line.split()
        if words[:1] == ["format"] and order is None:
            order = _ORDERS.get(words[1] if len(words) > 1 else "")
            if order is None:
                raise BitstreamError(f"{name}: not a readable .ply: '{line[:60]}'", section="header")
        elif words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"\d{1,12}", words[2]) or words[1] in named:
                raise BitstreamError(f"{name}: bad header line '{line[:60]}'", section="header")
            elements.append(_Element(words[1], int(words[2])))
            named.add(words[1])
        elif words[:1] == ["property"] and elements:
            _add_property(elements[-1], words, f"{name}: property '{line[:60]}'")
        elif words[:1] in (["comment"], ["obj_info"]):
            comments.append(" ".join(line.split(None, 1)[1:]).strip())
        elif words:
            raise BitstreamError(f"{name}: bad header line '{line[:60]}'", section="header")
    if order is None:
        raise BitstreamError(f"{name}: not a readable .ply: its header names no format", section="header")
    claimed, have = sum(each.least_bytes(bool(order)) for each in elements), size - match.end()
    if claimed > have + (0 if order else 1):  # the last line of text need not end
        raise BitstreamError(
            f"{name}: the header claims {claimed:,} bytes of data, the file holds {have:,}: it is truncated",
            section="vertex",
        )
    return PlyHeader(tuple(elements), tuple(comments), match.end(), order)


def _add_property(element: _Element, words: list[str], told: str) -> None:
    is_list = len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES
    if is_list and element.name != "vertex":
        element.lists += 1
    elif len(words) != 3 or words[1] not in _TYPES:
        raise BitstreamError(f"{told} has no place in a 3DGS model", section="header")
    elif words[2] in element.names:
        raise BitstreamError(f"{told} stands twice in the header", section="header")
    else:
        element.fields.append((words[2], _TYPES[words[1]]))
        element.names.add(words[2])


def read_tables(data: bytes | memoryview, header: PlyHeader, wanted: tuple[str, ...], name: str) -> Mapping[str, Table]:
    """Return the wanted elements that the file has: views of `data` where rows have a fixed width.

    data    the whole file

    Raises BitstreamError if the rows are damaged.
    """
    last = max((i for i, each in enumerate(header.elements) if each.name in wanted), default=-1)
    ahead = header.elements[: last + 1]
    walked = sum(each.count for each in ahead if each.lists)
    if not header.order or walked:
        if walked > MAX_LIST_ROWS:
            raise BitstreamError(f"{name}: {walked:,} rows of lists stand before the Gaussians", section="vertex")
        return _by_plyfile(data, header, wanted, name)
    found: dict[str, Table] = {}
    at = header.rows_at
    for each in ahead:
        row = np.dtype([(n, header.order + code) for n, code in each.fields])
        if each.name in wanted:
            found[each.name] = np.ndarray(each.count, row, buffer=data, offset=at)
        at += each.count * row.itemsize
    return found


def _by_plyfile(data: bytes | memoryview, header: PlyHeader, wanted: tuple[str, ...], name: str) -> Mapping[str, Table]:
    try:
        parsed = PlyData.read(io.BytesIO(bytes(data).removeprefix(BOM)))
        found = {each.name: each.data for each in parsed.elements if each.name in wanted}
    except Exception as error:  # plyfile raises many kinds for damaged files, MemoryError and IndexError among them
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BitstreamError(f"{name}: not a readable .ply: {reason}", section="vertex") from error
    for element, table in found.items():
        if len(table) != header.count(element):
            raise BitstreamError(
                f"{name}: {len(table)} rows of '{element}', header says {header.count(element)}", section=element
            )
    return found
