"""Quality against the distance from the training views: how far from them a model holds.

Test views are ranked by `path_combined` and cut into four groups of equal size; a row of the table is a run, a column
the mean over a group. Splits that ask for interpolation and for extrapolation are other protocols and stand apart.
Source: specification of the protocols, path distance.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from splatwizard_core.api import UserInputError
from sw_report import numbers
from sw_report.blocks import Charts, Column, Figure, Part, Section, Table, row
from sw_report.charts import Chart, Point, Series, swatch
from sw_report.declared import metric_style
from sw_report.distortion import drawn_metrics
from sw_report.pictures import pick_evenly
from sw_report.runs import Run

HEADING = "How far from the training views it holds"
DISTANCE = "path_combined"
DISTANCE_LABEL = "distance / extent + angle / 90°"
GROUPS = 4
FEWEST_RANKED = 8  # views, below which a rank correlation says nothing
EXPLAINED = (
    "Test views in four groups of equal size, by their distance from the nearest training view (distance / scene "
    "extent + angle / 90°). Fall: the nearest group's mean less the farthest's. Rank correlation (Spearman): of that "
    f"distance and PSNR, −1 where each farther view is worse; a dash with fewer than {FEWEST_RANKED} views."
)
MOST_LINES = 8
NEAR_TO_FAR = ("nearest", "2nd quarter", "3rd quarter", "farthest")


@dataclass(frozen=True)
class Reached:
    """A run at the distances of its test views.

    groups      (mean distance, mean value) of each group, nearest first
    fall        value of the nearest group less that of the farthest
    rank        Spearman's correlation of distance and value; None below 8 views, or where one of them is constant
    """

    groups: list[tuple[float, float]]
    fall: float
    rank: float | None


def with_distances(runs: Sequence[Run]) -> list[Run]:
    """Runs whose records say how far each of enough test views lies from the training views."""
    return [run for run in runs if len(_known(run, DISTANCE)) >= GROUPS]


def reached(run: Run, metric: str) -> Reached | None:
    """A metric near to and far from the training views; None where fewer than four views have both values.

    Groups are by rank of (distance, name); their sizes differ by at most one, larger ones first.
    """
    distance, values = _known(run, DISTANCE), _known(run, metric)
    views = sorted(distance.keys() & values.keys(), key=lambda name: (distance[name], name))
    if len(views) < GROUPS:
        return None
    size, larger = divmod(len(views), GROUPS)
    starts = [i * size + min(i, larger) for i in range(GROUPS + 1)]
    groups = [
        (statistics.fmean(distance[v] for v in part), statistics.fmean(values[v] for v in part))
        for part in (views[a:b] for a, b in itertools.pairwise(starts))
    ]
    rank = spearman([distance[v] for v in views], [values[v] for v in views]) if len(views) >= FEWEST_RANKED else None
    return Reached(groups, groups[0][1] - groups[-1][1], rank)


def spearman(a: Sequence[float], b: Sequence[float]) -> float | None:
    """Rank correlation in -1..1, with average ranks for ties; None where one is constant."""
    x, y = (_ranks(np.asarray(values, dtype=np.float64)) for values in (a, b))
    x, y = x - x.mean(), y - y.mean()
    norm = float(np.sqrt((x @ x) * (y @ y)))
    return None if norm == 0 else float(x @ y) / norm


def _ranks(values: np.ndarray) -> np.ndarray:
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - (count - 1) / 2)[place])


def _known(run: Run, metric: str) -> dict[str, float]:
    """View -> value of a metric, mean over the seeds, where all of them know it."""
    each = []
    for facts in run.seeds:
        scores = facts.metrics[metric].per_view if metric in facts.metrics else []
        each.append({name: v for name, v in zip(facts.views, scores, strict=False) if v is not None})
    common = set(each[0]).intersection(*each[1:])
    return {name: statistics.fmean(found[name] for found in each) for name in common}


def distance_table(runs: Sequence[Run]) -> Table:
    """PSNR near to and far from the training views, one row a run."""
    heads = [Column("run", text=True), *(Column(f"{name}, dB") for name in NEAR_TO_FAR),
             Column("fall, dB"), Column("rank correlation")]  # fmt: skip
    rows = []
    for run in runs:
        found = reached(run, "psnr")
        if found is not None:
            rank = numbers.MISSING if found.rank is None else numbers.signed(found.rank)
            rows.append(row([run.label, *(numbers.score("psnr", value) for _, value in found.groups),
                             numbers.signed(found.fall), rank]))  # fmt: skip
    groups = reached(runs[0], DISTANCE)
    notes = [f"Mean distance of the groups: {', '.join(f'{mean:.2f}' for mean, _ in groups.groups)}."] if groups else []
    return Table("PSNR by distance from the training views", heads, rows, notes=notes, sortable=True)


def distance_charts(
    runs: Sequence[Run], style_of: dict[str, int], metrics: Sequence[str] | None = None
) -> Charts | None:
    """Means of the four groups against their distance, one chart a metric, one line a run; single views of one run.

    metrics     None: those of the other curves
    """
    shown = pick_evenly(runs, MOST_LINES)
    dashes = [sum(run.variant == other.variant for other in shown[:i]) for i, run in enumerate(shown)]
    figures = []
    for metric in drawn_metrics(shown) if metrics is None else metrics:
        style, lines = metric_style(metric), []
        for run, dash in zip(shown, dashes, strict=True):
            found = reached(run, metric)
            if found is None:
                continue
            points = [
                Point(x, y, f"{run.label}, {name}: {numbers.score(metric, y)} {style.unit} at {x:.2f}")
                for (x, y), name in zip(found.groups, NEAR_TO_FAR, strict=True)
            ]
            lines.append(Series(run.label, points, style_of[run.variant], dash=dash))
        if len(lines) == 1:
            distance, values = _known(runs[0], DISTANCE), _known(runs[0], metric)
            views = [Point(distance[v], values[v], f"{v}: {numbers.score(metric, values[v])} at {distance[v]:.2f}")
                     for v in sorted(distance.keys() & values.keys())]  # fmt: skip
            lines.insert(0, Series("single views", views, style_of[runs[0].variant] + 1, joined=False))
        if lines:
            better = (
                " (lower is better)"
                if any(r.facts.metrics[metric].direction == "lower" for r in shown if metric in r.facts.metrics)
                else ""
            )
            caption = ", ".join(filter(None, (style.label, style.unit)))
            chart = Chart(f"{style.heading} against distance from the training views", lines, DISTANCE_LABEL)
            figures.append(Figure(f"{caption}{better}", chart.draw()))
    if not figures:
        return None
    legend = [(swatch(style_of[r.variant], dash=dash), r.label) for r, dash in zip(shown, dashes, strict=True)]
    if len(shown) == 1:
        legend = [(swatch(style_of[shown[0].variant] + 1), "single views"), (legend[0][0], "means of the quarters")]
    notes = [f"{len(shown)} of {len(runs)} runs, spread evenly."] if len(shown) < len(runs) else []
    return Charts(figures, legend, notes)


def distance_parts(runs: Sequence[Run], style_of: dict[str, int]) -> list[Part]:
    """Charts and table of the runs of one scene under one protocol; empty for records without distances."""
    known = with_distances(runs)
    charts = distance_charts(known, style_of) if known else None
    if charts is None:
        return []
    return [Part(HEADING, EXPLAINED, charts=charts), Part(table=distance_table(known))]


def sheet_section(runs: Sequence[Run], style_of: dict[str, int]) -> Section:
    """PSNR of all scenes and protocols against distance, side by side, and a table of each.

    Raises UserInputError, with the reason, if there is nothing to draw.
    """
    places: dict[tuple[str, str], list[Run]] = {}
    for run in with_distances(runs):
        places.setdefault(run.place, []).append(run)
    figures: list[Figure] = []
    legend: dict[str, Markup] = {}
    tables: list[Part] = []
    for place, group in places.items():
        drawn = distance_charts(group, style_of, ["psnr"])
        if drawn is not None:
            figures += [Figure(f"{place[0]}, {group[0].facts.protocol.split}: {each.caption}", each.svg)
                        for each in drawn.figures]  # fmt: skip
            legend.update({name: key for key, name in drawn.legend})
            tables.append(Part(f"{place[0]}, protocol {place[1]}", table=distance_table(group)))
    if not figures:
        views = max((len(_known(run, DISTANCE)) for run in runs), default=0)
        raise UserInputError(
            f"no run has {GROUPS} test views whose distance and PSNR are known, a group each; the most is {views}"
            if views
            else "no record says how far its test views lie from the training views: make one by `sw run` with "
            "sw-metrics, which measures path_combined"
        )
    charts = Charts(figures, [(key, name) for name, key in legend.items()])
    return Section("distance", "PSNR by distance from the training views", [Part(charts=charts), *tables], EXPLAINED)
