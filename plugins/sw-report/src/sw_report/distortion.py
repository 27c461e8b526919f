"""BD-rates of a report: every method against the anchor, scene by scene, then the mean over scenes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from splatwizard_core.api import UserInputError
from sw_report.aggregate import comparable, mean
from sw_report.declared import bd_anchor_rank, metric_style
from sw_report.numbers import is_lpips, main_lpips, ordered_metrics
from sw_report.rate_distortion import BdResult, bd_quality, bd_rate
from sw_report.runs import Run, natural

DIRECTIONS = ("higher", "lower")
FLAG_TEXTS = {
    "low_overlap": "the curves share less than a quarter of their range",
    "few_points": "fewer than 4 points, joined by straight lines",
    "no_overlap": "the curves share no range",
}


@dataclass(frozen=True)
class BdCell:
    """A BD value, or None with a reason; `flags` as of BdResult."""

    value: float | None
    flags: tuple[str, ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class BdRow:
    """One method on one scene (scene None: the mean over scenes)."""

    variant: str
    scene: str | None
    rate: BdCell
    quality: BdCell


@dataclass(frozen=True)
class BdTable:
    """BD values of all methods against one anchor, by one metric, in one protocol group.

    chosen  why that anchor
    lower   lower values of the metric are better; gains are turned all the same, so that positive ones are better
    """

    metric: str
    anchor: str
    protocol: str
    rows: list[BdRow]
    chosen: str = ""
    lower: bool = False


def choose_anchor(runs: Sequence[Run], wanted: str | None) -> str | None:
    """Choose the variant that others are compared against; None if there is only one.

    wanted  a variant or a method; None: of those whose curve shares a range with at least half of the other curves,
            the one whose method declares the smallest `bd_anchor`, else the alphabetically first; if there is none,
            the one that shares a range with most

    Raises UserInputError for a name that no run is of, or that several variants share.
    """
    variants = list(dict.fromkeys(run.variant for run in runs))
    if wanted is not None:
        matches = [v for v in variants if v == wanted] or [r.variant for r in runs if r.facts.method == wanted]
        if not matches:
            raise UserInputError(f"--anchor {wanted}: no run is of it; there are {', '.join(variants)}")
        if len(set(matches)) > 1:
            raise UserInputError(f"--anchor {wanted} is not unique: choose one of {', '.join(dict.fromkeys(matches))}")
        return matches[0]
    if len(variants) < 2:
        return None
    ranked = _ranked(runs)
    shared = {variant: len(overlapping(runs, variant)) for variant in ranked}
    curves = sum(count > 0 for count in shared.values())
    enough = [variant for variant in ranked if shared[variant] and 2 * shared[variant] >= curves - 1]
    return enough[0] if enough else max(ranked, key=lambda variant: shared[variant])


def why_anchor(runs: Sequence[Run], anchor: str) -> str:
    """Say in a sentence what the anchor is, and why it is not the usual one, if that is so."""
    usual = _ranked(runs)[0]
    if usual == anchor:
        return f"The anchor is {anchor}."
    return f"The anchor is {anchor}; {usual} shares a range of PSNR with {len(overlapping(runs, usual))} other curves."


def _ranked(runs: Sequence[Run]) -> list[str]:
    """Variants, the most usual anchors first."""
    methods = {run.variant: run.facts.method for run in runs}
    return sorted(methods, key=lambda variant: (bd_anchor_rank(methods[variant]), natural(variant)))


def overlapping(runs: Sequence[Run], variant: str) -> list[str]:
    """Other variants whose curve of PSNR (else of the first metric) shares a range with this one's, on any scene."""
    known = bd_metrics(runs)[:1]
    places = dict.fromkeys(run.place for run in runs if run.variant == variant)
    others = [other for other in dict.fromkeys(run.variant for run in runs) if other != variant]
    return [
        other for other in others
        if any(_shares_a_range(runs, place, variant, other, metric) for metric in known for place in places)
    ]  # fmt: skip


def _shares_a_range(runs: Sequence[Run], place: tuple[str, str], first: str, second: str, metric: str) -> bool:
    """Whether two curves of one scene, of two points or more, reach a common range of quality."""
    reached = []
    for variant in (first, second):
        _, quality = curve([run for run in runs if run.place == place and run.variant == variant], metric)
        if len(quality) < 2:
            return False
        reached.append((min(quality), max(quality)))
    return max(low for low, _ in reached) < min(high for _, high in reached)


def bd_metrics(runs: Sequence[Run]) -> list[str]:
    """Metrics that curves are compared by: all that have a direction and a value, but diagnostic ones.

    Of those over the model, which measure its geometry, the first one alone: the distance of its mesh from the truth.
    """
    known = ordered_metrics(
        name
        for run in runs
        for name, metric in run.facts.metrics.items()
        if metric.mean is not None and metric.direction in DIRECTIONS and not run.facts.is_diagnostic(name)
    )
    of_model = {name for run in runs for name in run.facts.geometry or {}}
    further = [name for name in known if name in of_model][1:]
    return [name for name in known if name not in further]


def drawn_metrics(runs: Sequence[Run]) -> list[str]:
    """Metrics whose curves are drawn: those of BD-rates, but of several forms of LPIPS one, and no mean difference."""
    known = bd_metrics(runs)
    lpips = main_lpips(known)
    return [name for name in known if name != "l1" and (name == lpips or not is_lpips(name))]


def bd_tables(runs: Sequence[Run], anchor: str | None, *, pareto: bool = False, partial: bool = False) -> list[BdTable]:
    """One table for each protocol and metric that has something to compare.

    partial     the mean over the scenes that have a value; else it needs all of them
    """
    if anchor is None:
        return []
    tables, chosen = [], why_anchor(runs, anchor)
    for group in comparable(runs):
        places = dict.fromkeys(run.place for run in group if run.variant == anchor)
        others = [v for v in dict.fromkeys(run.variant for run in group) if v != anchor]
        if not places or not others:
            continue
        ids = ", ".join(dict.fromkeys(run.facts.protocol.id for run in group))
        for metric in bd_metrics(group):
            rows = []
            for variant in others:
                cells = [_compare(group, place, anchor, variant, metric, pareto) for place in places]
                rows += cells
                if len(cells) > 1:
                    rows.append(_mean_row(variant, cells, partial))
            lower = any(run.facts.metrics[metric].direction == "lower" for run in group if metric in run.facts.metrics)
            tables.append(BdTable(metric, anchor, ids, rows, chosen, lower))
    return tables


def with_values(tables: Iterable[BdTable]) -> tuple[list[BdTable], list[str]]:
    """Tables that hold a value, and for those that hold none one line for each reason."""
    kept, reasons = [], dict[str, dict[str, None]]()
    for table in tables:
        cells = [cell for row in table.rows for cell in (row.rate, row.quality)]
        if any(cell.value is not None for cell in cells):
            kept.append(table)
            continue
        for cell in cells:
            reasons.setdefault(cell.reason, {})[metric_style(table.metric).label] = None
    return kept, [f"No BD values by {', '.join(labels)}: {why}." for why, labels in reasons.items() if why]


def why_no_values(runs: Sequence[Run], anchor: str, tables: Sequence[BdTable]) -> list[str]:
    """Say why an anchor that somebody asked for compares with nothing; empty where it does."""
    kept, reasons = with_values(tables)
    if kept:
        return []
    if not tables:
        return [f"--anchor {anchor}: there is no other method on its scenes, under its protocol, to compare with"]
    metric, lines = tables[0].metric, [f"--anchor {anchor}: {reason}" for reason in reasons]
    for place in dict.fromkeys(run.place for run in runs if run.variant == anchor):
        reached = []
        for variant in dict.fromkeys(run.variant for run in runs):
            found = [v for run in runs if run.place == place and run.variant == variant
                     and (v := run.mean(metric)) is not None]  # fmt: skip
            if found:
                reached.append(f"{variant} {min(found):.2f} to {max(found):.2f}")
        lines.append(f"{place[0]}: {metric_style(metric).heading} of {', '.join(reached)}")
    return lines


def curve(runs: Sequence[Run], metric: str) -> tuple[list[float], list[float]]:
    """(bytes, quality), quality turned so that higher is better."""
    known = [(run, value) for run in runs if (value := run.mean(metric)) is not None]
    return (
        [run.size for run, _ in known],
        [value * (-1 if run.facts.metrics[metric].direction == "lower" else 1) for run, value in known],
    )


def _compare(
    runs: Sequence[Run], place: tuple[str, str], anchor: str, variant: str, metric: str, pareto: bool
) -> BdRow:
    here = [run for run in runs if run.place == place and run.variant in (anchor, variant)]
    voxels = _voxels(here, metric)
    if len(voxels) > 1:
        told = f"meshes with voxels of {', '.join(f'{size:.4g}' for size in voxels)} are not compared"
        return BdRow(variant, place[0], BdCell(None, (), told), BdCell(None, (), told))
    curves = [curve([run for run in here if run.variant == name], metric) for name in (anchor, variant)]
    names, label = (anchor, variant), metric_style(metric).label
    calls = (
        lambda: bd_rate(*curves, pareto=pareto, names=names, metric=label),
        lambda: bd_quality(*curves, pareto=pareto, names=names),
    )
    cells = []
    for call in calls:
        try:
            cells.append(_cell(call()))
        except UserInputError as error:
            cells.append(BdCell(None, (), str(error).partition(": ")[2] or str(error)))
    return BdRow(variant, place[0], *cells)


def _voxels(runs: Sequence[Run], metric: str) -> list[float]:
    """Voxel sizes of the meshes that a metric of geometry was measured on, which decide how near one can be."""
    meshes = [((run.facts.geometry or {}).get(metric) or {}).get("mesh") or {} for run in runs]
    return sorted({float(mesh["voxel_size"]) for mesh in meshes if isinstance(mesh.get("voxel_size"), (int, float))})


def _cell(result: BdResult) -> BdCell:
    reasons = [FLAG_TEXTS[flag] for flag in result.flags if flag in FLAG_TEXTS]
    return BdCell(result.value, result.flags, "; ".join(reasons))


def _mean_row(variant: str, cells: Sequence[BdRow], partial: bool) -> BdRow:
    def over(values: Sequence[BdCell]) -> BdCell:
        flags = tuple(dict.fromkeys(flag for cell in values for flag in cell.flags if cell.value is not None))
        without = sum(cell.value is None for cell in values)
        reason = f"{without} of {len(values)} scenes have no value" if without else ""
        return BdCell(mean([cell.value for cell in values], partial=partial), flags, reason)

    return BdRow(variant, None, over([row.rate for row in cells]), over([row.quality for row in cells]))
