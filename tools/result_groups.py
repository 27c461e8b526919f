"""Small records of one scene in groups of seeds: in the order of the tables, named, and beside their 3DGS."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Sequence

from result_records import SmallRecord

PLY_BYTES = 248  # of a Gaussian in a float32 .ply of SH degree 3
BASE = "3dgs"
TITLES = {
    "3dgs": "3DGS", "pruned-3dgs": "3DGS, pruned", "trimming-the-fat": "Trimming the Fat", "pup-3dgs": "PUP-3DGS",
    "speedy-splat": "Speedy-Splat", "lightgaussian": "LightGaussian", "chimerags": "ChimeraGS", "hac": "HAC",
    "hac-plus": "HAC++", "cat-3dgs": "CAT-3DGS", "mesongs": "MesonGS", "c3dgs": "C3DGS",
    "compact3dgs": "Compact3DGS", "2dgs": "2DGS", "flat-3dgs": "flat 3DGS", "trim-3dgs": "Trim3DGS",
    "trim-2dgs": "Trim2DGS", "trim-2dgs-scratch": "Trim2DGS, scratch",
}  # fmt: skip
NONE = "-"

Rows = Sequence[SmallRecord]


def spread(values: Sequence[float | None], digits: int) -> str:
    """Write mean ± deviation of the values; "-" if one of them is missing or there is none."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return NONE
    mean = f"{statistics.fmean(known):,.{digits}f}"
    return mean if len(known) == 1 else f"{mean} ± {statistics.stdev(known):,.{digits}f}"


def points(records: Rows) -> list[list[SmallRecord]]:
    """Group the records of one scene by method, variant and rate point, largest file of a method first."""
    groups = defaultdict(list)
    for record in records:
        groups[record.method, record.variant, record.rate].append(record)
    order = list(TITLES)

    def place(group: list[SmallRecord]) -> tuple[int, str, str, float]:
        first = group[0]
        known = order.index(first.method) if first.method in order else len(order)
        return known, first.method, first.variant, -statistics.fmean(r.bytes for r in group)

    return sorted((sorted(group, key=lambda r: r.seed) for group in groups.values()), key=place)


def exact(records: Rows) -> list[SmallRecord]:
    """Select the runs of 3DGS that keep every float: those of its highest rate point."""
    plain = [r for r in records if r.method == BASE and not r.variant]
    highest = max((r.rate for r in plain), default="")
    return [r for r in plain if r.rate == highest]


def bases(group: Rows, records: Rows, *, same_matrix: bool = False) -> list[SmallRecord | None]:
    """Return the exact 3DGS of each run's seed, that of the same repetition if there is one.

    same_matrix     that of the same repetition or none
    """
    found: dict[tuple[int, int | None], SmallRecord] = {}
    for r in exact(records):
        if r.gaussians:
            found[r.seed, r.repetition] = r
            if not same_matrix:
                found.setdefault((r.seed, None), r)
    return [found.get((r.seed, r.repetition), found.get((r.seed, None))) for r in group]


def smaller(group: Rows, records: Rows, *, same_matrix: bool = False) -> list[float | None]:
    """Divide the float32 .ply of the same seed's 3DGS, as `bases` finds it, by each file."""
    found = zip(group, bases(group, records, same_matrix=same_matrix), strict=True)
    return [None if base is None else PLY_BYTES * (base.gaussians or 0) / r.bytes for r, base in found]


def title(group: Rows) -> str:
    """Name a method and its variant."""
    first = group[0]
    return f"{TITLES.get(first.method, first.method)}{f' ({first.variant})' if first.variant else ''}"


def rate(group: Rows) -> str:
    """Name a rate point; the default one is marked."""
    return f"{group[0].rate} *" if group[0].default_rate else group[0].rate
