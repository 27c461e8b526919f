"""Tables of what was measured and, below it, what was published: a scene each, and the means over data sets."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from splatwizard_core.api import UserInputError
from sw_report import numbers
from sw_report.aggregate import dataset_tables
from sw_report.blocks import Row, Table, columns, row
from sw_report.declared import dataset_facts
from sw_report.equal_psnr import AtEqual, CurvePoint, at_equal
from sw_report.facts import RunFacts
from sw_report.published import METRICS, Beside, beside
from sw_report.published_files import Figure, read_published
from sw_report.runs import Run

VALUES = (*METRICS, "bytes", "gaussians")
NOT_READ = "*"
DELTAS = ("Δ PSNR", "Δ size", "at equal PSNR")
HOW = (
    "Δ: measured less published; at equal PSNR: size of the measured rate points, interpolated in log bytes at the "
    "published PSNR. Measured rows first, then published ones by number:"
)


@dataclass(frozen=True)
class Measured:
    """A run, or a mean over the scenes of a data set.

    values  by figure
    facts   a record that tells how it was made
    curve   the rate points measured of the same method there, this one included
    """

    label: str
    values: dict[str, float | None]
    facts: RunFacts
    curve: tuple[CurvePoint, ...] = ()


@dataclass(frozen=True)
class PublishedTable:
    """A scene, or the mean over a data set.

    groups      what was measured, each with the published figures of its method
    others      published figures of methods that were not measured
    left_out    published figures that may stand beside no other
    """

    title: str
    groups: list[tuple[Measured, list[Beside]]]
    others: list[Figure]
    left_out: list[Figure]

    def drawn(self) -> Table:
        """The table as text; each figure has a number, under which the notes tell its source and what differs."""
        heads = [*(numbers.heading(METRICS[name]) for name in METRICS), "MB", "primitives", *DELTAS]
        rows: list[Row] = []
        notes: list[str] = []
        for measured, found in self.groups:
            rows.append(row([measured.label, *_cells(measured.values), "", "", ""], emphasis=not found))
            for i, each in enumerate(found):
                equal = at_equal(measured.curve, each.figure.psnr, each.figure.bytes)
                why = f"no bytes at equal PSNR: {equal.why}" if equal.why and each.figure.bytes else ""
                notes.append(_note(len(notes) + 1, each.figure, each.differences, why))
                psnr, size = deltas(measured.values, each.figure)
                told = [numbers.signed(psnr), _percent(size), _percent(size_at_equal(equal))]
                rows.append(row([_name(each.figure, len(notes)), *_cells(_values(each.figure)), *told],
                                emphasis=i == len(found) - 1))  # fmt: skip
        for figure in self.others:
            notes.append(_note(len(notes) + 1, figure, ()))
            rows.append(row([_name(figure, len(notes)), *_cells(_values(figure)), "", "", ""]))
        notes.insert(0, HOW)
        if self.left_out:
            labels = ", ".join(dict.fromkeys(figure.label for figure in self.left_out))
            notes.append(f"left out, since its protocol is not that of the others: {labels}")
        if any(not figure.verified for figure in self.figures):
            notes.append(f"{NOT_READ} second-hand or recalled, not re-read at its source")
        return Table(self.title, columns(["", *heads]), rows, notes=notes)

    @property
    def figures(self) -> list[Figure]:
        """All published figures of the table."""
        return [*(each.figure for _, found in self.groups for each in found), *self.others]


def published_tables(runs: Sequence[Run], *, others: bool = True) -> list[PublishedTable]:
    """Put runs beside the published figures of their scenes, and means over whole data sets beside published means.

    others  with the figures of methods that were not measured
    Raises UserInputError if nothing is published for any of the scenes.
    """
    figures = read_published()
    curves = _curves(((run.place, run.variant), run.facts.rate, run.size, run.mean(METRICS["psnr"])) for run in runs)
    places: dict[tuple[str, str, str], list[Measured]] = {}
    for run in runs:
        facts = run.facts
        scene = dataset_facts(facts.dataset).scene_of(facts.scene)
        values = {name: run.mean(metric) for name, metric in METRICS.items()}
        sizes = {"bytes": run.size, "gaussians": run.counts.get("num_gaussians")}
        places.setdefault((facts.dataset, scene, facts.protocol.id), []).append(
            Measured(run.label, values | sizes, facts, curves.get((run.place, run.variant), ()))
        )
    found = [_table(f"{scene}, {id_}", dataset, scene, rows, figures, others)
             for (dataset, scene, id_), rows in places.items()]  # fmt: skip
    for table in dataset_tables(runs):
        means = _curves(
            (m.variant, m.rate, m.size, m.metrics.get(METRICS["psnr"])) for m in table.rows if not m.missing
        )
        rows = []
        for mean in table.rows if table.published else ():
            facts = next(r.facts for r in runs if (r.variant, r.facts.rate) == (mean.variant, mean.rate)
                         and r.facts.protocol.id in table.protocols)  # fmt: skip
            values = {name: mean.metrics.get(metric) for name, metric in METRICS.items()}
            sizes = {"bytes": mean.size, "gaussians": (mean.counts or {}).get("num_gaussians")}
            if not mean.missing:
                rows.append(Measured(f"{mean.variant} {mean.rate or ''}".rstrip(), values | sizes, facts,
                                     means.get(mean.variant, ())))  # fmt: skip
        if rows:
            title = f"mean over {table.title}, {len(table.scenes)} scenes"
            found.append(_table(title, table.dataset, None, rows, figures, others))
    found = [table for table in found if table.figures]
    if not found:
        asked = ", ".join(dict.fromkeys(f"{dataset}/{scene}" for dataset, scene, _ in places))
        known = ", ".join(dict.fromkeys(figure.dataset for figure in figures))
        raise UserInputError(f"nothing is published for {asked}: there are figures for scenes of {known}")
    return found


def _table(
    title: str, dataset: str, scene: str | None, rows: list[Measured], figures: Sequence[Figure], others: bool
) -> PublishedTable:
    groups = [(each, beside(each.facts, scene, figures)) for each in rows]
    methods = {each.facts.method for each in rows}
    left = [f for f in figures if (f.dataset, f.scene) == (dataset, scene) and f.method not in methods]
    fit, unfit = ([f for f in left if f.protocol.comparable is wanted] for wanted in (True, False))
    return PublishedTable(title, groups, fit if others else [], unfit if others else [])


def _curves(
    points: Iterable[tuple[Hashable, str | None, float | None, float | None]],
) -> dict[Hashable, tuple[CurvePoint, ...]]:
    """Gather (curve, rate, bytes, PSNR) by curve; points that lack one of them are left out."""
    found: dict[Hashable, tuple[CurvePoint, ...]] = {}
    for curve, rate, size, psnr in points:
        if rate is not None and size is not None and psnr is not None:
            found[curve] = (*found.get(curve, ()), CurvePoint(rate, size, psnr))
    return found


def deltas(measured: dict[str, float | None], figure: Figure) -> tuple[float | None, float | None]:
    """Measured less published: PSNR in dB, and the size in percent of the published one; None where one is unknown."""
    psnr, size = measured["psnr"], measured["bytes"]
    return (
        None if psnr is None or figure.psnr is None else psnr - figure.psnr,
        None if size is None or figure.bytes is None else 100 * (size / figure.bytes - 1),
    )


def size_at_equal(equal: AtEqual) -> float | None:
    """Bytes of the curve at the published PSNR, in percent less or more than published; None where not known."""
    return None if equal.ratio is None else 100 * (equal.ratio - 1)


def to_dict(table: PublishedTable) -> dict[str, Any]:
    """The table as JSON data."""
    groups = []
    for measured, found in table.groups:
        published = []
        for each in found:
            psnr, size = deltas(measured.values, each.figure)
            told: dict[str, Any] = {"same_rate": each.same_rate, "differences": list(each.differences)}
            equal = at_equal(measured.curve, each.figure.psnr, each.figure.bytes)
            told |= {"bytes_at_equal_psnr": equal.bytes, "size_at_equal_psnr_percent": size_at_equal(equal),
                     "psnr_gain_at_equal_bytes": equal.gain, "not_at_equal_psnr": equal.why}  # fmt: skip
            published.append(each.figure.model_dump() | told | {"delta_psnr": psnr, "delta_size_percent": size})
        groups.append({"measured": measured.label, **measured.values, "published": published})
    return {"title": table.title, "runs": groups, "others": [figure.model_dump() for figure in table.others],
            "left_out": [figure.model_dump() for figure in table.left_out]}  # fmt: skip


def _values(figure: Figure) -> dict[str, float | None]:
    return {name: getattr(figure, name) for name in VALUES}


def _cells(values: dict[str, float | None]) -> list[str]:
    scores = [numbers.score(metric, values[name]) for name, metric in METRICS.items()]
    return [*scores, numbers.megabytes(values["bytes"]), numbers.count(values["gaussians"])]


def _name(figure: Figure, number: int) -> str:
    return f"  [{number}] {figure.label} ({figure.year}){'' if figure.verified else NOT_READ}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{numbers.percent(value)} %"


def _note(number: int, figure: Figure, differences: Sequence[str], why: str = "") -> str:
    steps = "" if figure.steps is None else f"; {numbers.count(figure.steps)} steps"
    told = f"; differs: {'; '.join(differences)}" if differences else ""
    why = f"; {why}" if why else ""
    return f"[{number}] {figure.year}, {figure.source}{steps}; {figure.protocol.text}{told}{why}"
