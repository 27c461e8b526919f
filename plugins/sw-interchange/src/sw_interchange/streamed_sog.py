"""Streamed SOG of PlayCanvas: a tree of places, each with several levels of detail, in units that are SOG folders.

`lod-meta.json` holds the tree; a leaf says for each level which rows of which unit are its. Level 0 is the finest. A
level is read as a scene: its rows of all leaves, and the environment if there is one. Source: the documentation of the
PlayCanvas engine, and files of splat-transform 3.7.0.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError, UserInputError
from sw_interchange.scene import GaussianScene, Limits, ReadReport, decoded_bytes, joined
from sw_interchange.sog import is_plain, read_sog
from sw_interchange.source import Source, json_reason

MAX_INDEX = 8 << 20
"""Bytes of an index: some 20,000 leaves of six levels."""
MAX_DEPTH = 64
MAX_NODES = 1_000_000
MAX_LEVELS = 64
MAX_UNITS = 65_536


@dataclass(frozen=True)
class Rows:
    """Rows of a unit that belong to one leaf."""

    file: int
    offset: int
    count: int


@dataclass(frozen=True)
class Leaf:
    """A place, its box [3], [3], and its rows by level."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    levels: dict[int, Rows]


@dataclass(frozen=True)
class Index:
    """Content of a lod-meta.json.

    levels      how many there are, the finest is 0
    counts      Gaussians of each level, without the environment
    units       paths of the units' meta.json, from the folder of the index
    environment path of the environment's meta.json; None: there is none
    """

    levels: int
    counts: list[int]
    units: list[str]
    environment: str | None
    leaves: list[Leaf]


def parse_index(text: bytes | memoryview, name: str) -> Index:
    """Read an index; whatever it claims is held against what else it says. Raises BitstreamError."""
    if len(text) > MAX_INDEX:
        raise BitstreamError(f"{name}: an index of more than {MAX_INDEX:,} bytes")

    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no number")

    try:
        found = json.loads(bytes(text), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise BitstreamError(f"{name}: a damaged index: {json_reason(error)}") from error
    try:
        return _index(found, name)
    except _RefusedError as error:
        raise BitstreamError(f"{name}: {error}") from None


def read_streamed_sog(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode level `source.level`. Raises BitstreamError, UserInputError for a level that is not there."""
    index = parse_index(source.data, source.name)
    if source.path is None:
        raise BitstreamError(f"{source.name}: its units lie in other files: read the folder")
    if not 0 <= source.level < index.levels:
        raise UserInputError(f"{source.name}: has levels 0 to {index.levels - 1}, there is no level {source.level}")
    total = index.counts[source.level]
    if total > limits.max_gaussians or decoded_bytes(total, 0) > limits.max_output_bytes:
        raise BitstreamError(f"{source.name}: claims {total:,} Gaussians, more than the limit")
    report.version = "1"
    wanted: dict[int, list[Rows]] = {}
    for leaf in index.leaves:
        if (rows := leaf.levels.get(source.level)) is not None and rows.count:
            wanted.setdefault(rows.file, []).append(rows)
    parts = []
    for file, ranges in sorted(wanted.items()):
        unit = _unit(source, index.units[file], limits, report)
        parts.append(unit.select(_selected(ranges, unit.num_gaussians, f"{source.name}: {index.units[file]}")))
    if index.environment is not None:
        parts.append(_unit(source, index.environment, limits, report))
        report.warnings.append(f"its environment of {parts[-1].num_gaussians:,} Gaussians is part of the scene")
    if not parts:
        raise BitstreamError(f"{source.name}: level {source.level} holds no Gaussians")
    return joined(parts)


def _unit(source: Source, name: str, limits: Limits, report: ReadReport) -> GaussianScene:
    assert source.path is not None  # of an index that was opened
    folder = source.path.parent
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise BitstreamError(f"{source.name}: '{name}', which it names, lies elsewhere: a link leads out of its folder")
    if not path.is_file():
        raise BitstreamError(f"{source.name}: '{name}', which it names, is not there")
    opened = Source.open(path)
    report.bytes += unit_bytes(path)
    inner = ReadReport("sog")
    unit = read_sog(Source(opened.data, f"{source.name}: {name}", path), limits, inner)
    report.warnings.extend(inner.warnings)
    for kind, count in inner.repairs.items():
        report.repaired(kind, count)
    return unit


def unit_bytes(meta: Path) -> int:
    """Bytes of the files in the folder of a unit."""
    return sum(entry.stat().st_size for entry in os.scandir(meta.parent) if entry.is_file(follow_symlinks=False))


def _selected(ranges: list[Rows], count: int, name: str) -> npt.NDArray[np.intp]:
    if max(rows.offset + rows.count for rows in ranges) > count:
        raise BitstreamError(f"{name} has {count:,} Gaussians, fewer than the tree names")
    return np.concatenate([np.arange(rows.offset, rows.offset + rows.count) for rows in ranges])


class _RefusedError(Exception):
    """Fault of an index; the reader adds its name."""


def _index(found: Any, name: str) -> Index:
    if not isinstance(found, dict) or not isinstance(found.get("tree"), dict):
        raise _RefusedError("no tree of levels of detail")
    if found.get("version", 1) != 1:
        raise _RefusedError(f"version {found['version']!r:.20} of streamed SOG; 1 is read")
    levels = found.get("lodLevels")
    if type(levels) is not int or not 1 <= levels <= MAX_LEVELS:
        raise _RefusedError(f"'lodLevels' is {levels!r:.20}; 1 to {MAX_LEVELS} are possible")
    units = found.get("filenames")
    if not isinstance(units, list) or len(units) > MAX_UNITS or not all(_is_inside(unit) for unit in units):
        raise _RefusedError("'filenames' is no list of paths within its folder")
    if len(set(units)) < len(units):
        raise _RefusedError("'filenames' names a unit twice")
    environment = found.get("environment")
    if environment is not None and (not _is_inside(environment) or "/" not in environment or environment == name):
        raise _RefusedError("'environment' is no path of a unit within its folder")
    leaves = list(_leaves(found["tree"], levels, len(units)))
    _check_ranges(leaves, len(units))
    sums = [sum(leaf.levels[k].count for leaf in leaves if k in leaf.levels) for k in range(levels)]
    if found.get("counts", sums) != sums or found.get("count", sum(sums)) != sum(sums):
        raise _RefusedError("its counts are not those of its leaves")
    return Index(levels, sums, units, environment, leaves)


def _is_inside(path: Any) -> bool:
    """Whether a path leads from the index into a folder below, on any system."""
    if not isinstance(path, str) or not 0 < len(path) <= 512:
        return False
    parts = path.split("/")
    return 1 <= len(parts) <= 8 and all(is_plain(part) for part in parts) and parts[-1].lower() == "meta.json"


def _leaves(tree: dict[str, Any], levels: int, units: int) -> Iterator[Leaf]:
    pending: list[tuple[Any, int]] = [(tree, 0)]
    nodes = 1
    while pending:
        node, depth = pending.pop()
        if not isinstance(node, dict):
            raise _RefusedError("a node of its tree is no object")
        if depth > MAX_DEPTH:
            raise _RefusedError(f"its tree is deeper than {MAX_DEPTH}")
        low, high = _bound(node.get("bound"))
        children = node.get("children")
        if children is not None:
            if not isinstance(children, list) or "lods" in node:
                raise _RefusedError("a node of its tree has no list of children, or rows of its own besides")
            nodes += len(children)
            if nodes > MAX_NODES:
                raise _RefusedError(f"its tree has more than {MAX_NODES:,} nodes")
            pending.extend((child, depth + 1) for child in reversed(children))
            continue
        lods = node.get("lods")
        if not isinstance(lods, dict):
            raise _RefusedError("a leaf of its tree has no levels")
        yield Leaf(low, high, {_level(key, levels): _rows(value, units) for key, value in lods.items()})


def _bound(value: Any) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    corners: list[Any] = [value.get("min"), value.get("max")] if isinstance(value, dict) else []
    good = len(corners) == 2 and all(isinstance(c, list) and len(c) == 3 for c in corners)
    if not good or not all(type(x) in (int, float) and abs(x) < 1e38 for corner in corners for x in corner):
        raise _RefusedError("the box of a node is no two points of three numbers")
    low, high = ((float(x), float(y), float(z)) for x, y, z in corners)
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise _RefusedError("the box of a node ends before it begins")
    return low, high


def _level(key: str, levels: int) -> int:
    if not (key.isascii() and key.isdigit() and len(key) < 4 and int(key) < levels):
        raise _RefusedError(f"a leaf has a level {key!r:.20}; there are 0 to {levels - 1}")
    return int(key)


def _rows(value: Any, units: int) -> Rows:
    numbers: list[Any] = [value.get(key) for key in ("file", "offset", "count")] if isinstance(value, dict) else []
    if len(numbers) != 3 or not all(type(n) is int and 0 <= n < 1 << 32 for n in numbers):
        raise _RefusedError("a level of a leaf has no file, offset and count")
    rows = Rows(*numbers)
    if rows.file >= units:
        raise _RefusedError(f"a leaf names unit {rows.file}, there are {units}")
    return rows


def _check_ranges(leaves: list[Leaf], units: int) -> None:
    """Refuse rows that two leaves or levels share: a scene would be larger than its units are."""
    ranges = sorted((r.file, r.offset, r.count) for leaf in leaves for r in leaf.levels.values() if r.count)
    for (file, offset, count), following in itertools.pairwise(ranges):
        if following[0] == file and following[1] < offset + count:
            raise _RefusedError(f"two leaves share rows of unit {file}")
