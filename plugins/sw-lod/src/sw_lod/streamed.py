"""Writing streamed SOG: an index of places and levels, and units that a viewer asks for one by one."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sw_interchange.known_formats import META
from sw_interchange.scene import GaussianScene, WriteReport
from sw_interchange.sog_writer import SogOptions, sog_files

from splatwizard_core.tooling import write_atomic
from sw_lod.tree import Node, Rows, build_tree, leaves_of

Shares = NDArray[np.float64]
UNSEEN = 1e-3
"""Of the mean squared picture of a leaf: added to that of each."""
GENERATOR = "Splatwizard"
UNIT = re.compile(rf"\d+_\d+/{re.escape(META)}")
"""Names that the index has for a unit: level and number."""
DIGITS = 7
"""Of numbers in the index; float32 has no more."""


def write_streamed(
    levels: Sequence[GaussianScene], index: Path, *, chunk: int, shares: Sequence[Shares] = (), iterations: int = 10,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:  # fmt: skip
    """Write the index and its units beside it, the index last: it names files that are there.

    levels      the same scene ever coarser, in RDF; the finest first
    chunk       Gaussians of a leaf at most, all levels together; a unit is closed when it holds more
    shares      of each level [N]: squared pictures of the finest by its Gaussians, then squared errors of the coarser
                ones; none: a viewer that weighs errors counts Gaussians instead
    iterations  of the k-means that finds each unit's palette of SH

    Returns facts: `counts` by level, `units`, `leaves`, `bytes`, `warnings`. Raises UserInputError for a scene that
    SOG cannot hold.
    """
    tree = build_tree(levels, chunk)
    leaves = leaves_of(tree)
    lods: list[dict[str, dict[str, int]]] = [{} for _ in leaves]
    names: list[str] = []
    warnings: set[str] = set()
    total = 0
    # An index of an earlier scene would name units that are being replaced.
    earlier = _units_of(index)
    index.unlink(missing_ok=True)
    for level, scene in enumerate(levels):
        for number, members in enumerate(_units(leaves, level, chunk)):
            folder = f"{level}_{number}"
            offset, file = 0, len(names)
            for leaf in members:
                count = len(leaves[leaf].rows[level])
                lods[leaf][str(level)] = {"file": file, "offset": offset, "count": count}
                offset += count
            rows: Rows = np.concatenate([leaves[leaf].rows[level] for leaf in members])
            report = WriteReport("sog")
            files = sog_files(scene.select(rows), SogOptions(iterations=iterations), report)
            total += _write_unit(index.parent / folder, files)
            warnings.update(report.notices())
            names.append(f"{folder}/{META}")
            say(f"{folder}: {len(rows):,} Gaussians")
    errors = _errors(leaves, shares)
    text = json.dumps(_description(tree, levels, names, lods, errors), separators=(",", ":"), allow_nan=False)
    write_atomic(index, text.encode())
    for unit in sorted(earlier - {name.partition("/")[0] for name in names}):
        _remove_unit(index.parent / unit)
        say(f"{unit}: of the scene that was here before, removed")
    return {
        "counts": [scene.num_gaussians for scene in levels], "units": len(names), "leaves": len(leaves),
        "bytes": total + len(text), "warnings": sorted(warnings),
    }  # fmt: skip


def _units_of(index: Path) -> set[str]:
    """Folders of the units that an index of ours names; none if there is no such index."""
    try:
        told = json.loads(index.read_bytes())
        ours = told["asset"]["generator"] == GENERATOR
        return {name.partition("/")[0] for name in told["filenames"] if ours and UNIT.fullmatch(name)}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _remove_unit(folder: Path) -> None:
    """Remove the files of a unit, and its folder if nothing else is in it."""
    if folder.is_symlink():
        return
    for file in (folder / META, *folder.glob("*.webp")):
        file.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def _units(leaves: list[Node], level: int, chunk: int) -> Iterator[list[int]]:
    """Numbers of the leaves of each unit of a level: neighbours, until there are more Gaussians than `chunk`."""
    members: list[int] = []
    held = 0
    for number, leaf in enumerate(leaves):
        count = len(leaf.rows[level])
        if not count:
            continue
        members.append(number)
        held += count
        if held > chunk:
            yield members
            members, held = [], 0
    if members:
        yield members


def _write_unit(folder: Path, files: dict[str, bytes]) -> int:
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        write_atomic(folder / name, content)
    return sum(map(len, files.values()))


def _errors(leaves: list[Node], shares: Sequence[Shares]) -> list[list[float]]:
    """Squared error of each level by the squared picture of each leaf, never less than that of a finer level.

    Of a leaf that hardly a picture shows it is nearly that of all. None of any leaf if no picture shows anything.
    """
    if not shares or not shares[0].any():
        return []
    sums = np.array([[share[leaf.rows[level]].sum() for leaf in leaves] for level, share in enumerate(shares)])
    sums[0] += (least := UNSEEN * sums[0].mean())
    of_all = sums[1:].mean(axis=1, keepdims=True) / sums[0].mean()
    found = (sums[1:] + least * of_all) / sums[0]
    return np.maximum.accumulate(np.concatenate([np.zeros((1, len(leaves))), found])).T.tolist()  # type: ignore[no-any-return]


def _description(
    tree: Node, levels: Sequence[GaussianScene], names: list[str], lods: list[dict[str, dict[str, int]]],
    errors: list[list[float]],
) -> dict[str, Any]:  # fmt: skip
    counts = [scene.num_gaussians for scene in levels]
    remaining, wrong = iter(lods), iter(errors)

    def told(node: Node) -> dict[str, Any]:
        bound = {"min": _rounded(node.low), "max": _rounded(node.high)}
        if node.children is None:
            known = {"errors": _rounded(next(wrong))} if errors else {}
            return {"bound": bound, "lods": next(remaining), **known}
        return {"bound": bound, "children": [told(child) for child in node.children]}

    return {
        "version": 1, "asset": {"generator": GENERATOR}, "count": sum(counts), "counts": counts,
        "lodLevels": len(levels), "lodErrors": bool(errors), "filenames": names, "tree": told(tree),
    }  # fmt: skip


def _rounded(point: Any) -> list[float]:
    return [float(f"{x:.{DIGITS}g}") for x in point]
