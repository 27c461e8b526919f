"""Tables of what was measured and, below it, what was published: a scene each, and the means over data sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from splatwizard_core.api import UserInputError
from sw_report import numbers
from sw_report.aggregate import dataset_tables
from sw_report.blocks import Row, Table, columns, row
from sw_report.declared import dataset_facts
from sw_report.facts import RunFacts
from sw_report.published import METRICS, Beside, Figure, beside, read_published
from sw_report.runs import Run

VALUES = (*METRICS, "bytes", "gaussians")
NOT_READ = "*"


@dataclass(frozen=True)
class Measured:
    """A run, or a mean over the scenes of a data set: its name, its values by figure, and a record that tells how."""

    label: str
    values: dict[str, float | None]
    facts: RunFacts


@dataclass(frozen=True)
class BesideTable:
    """A scene, or the mean over a data set.

    groups      what was measured, each with the published figures of its method
    others      published figures of methods that were not measured
    """

    title: str
    groups: list[tuple[Measured, list[Beside]]]
    others: list[Figure]

    def drawn(self) -> Table:
        """The table as text; each figure has a number, under which the notes tell its source and what differs."""
        heads = [*(numbers.heading(METRICS[name]) for name in METRICS), "MB", "primitives", "Δ PSNR", "Δ size"]
        rows: list[Row] = []
        notes: list[str] = []
        for measured, found in self.groups:
            rows.append(row([measured.label, *_cells(measured.values), "", ""], emphasis=not found))
            for i, each in enumerate(found):
                notes.append(_note(len(notes) + 1, each.figure, each.differences))
                psnr, size = deltas(measured.values, each.figure)
                told = [numbers.signed(psnr), "" if size is None else f"{numbers.percent(size)} %"]
                rows.append(row([_name(each.figure, len(notes)), *_cells(_values(each.figure)), *told],
                                emphasis=i == len(found) - 1))  # fmt: skip
        for figure in self.others:
            notes.append(_note(len(notes) + 1, figure, ()))
            rows.append(row([_name(figure, len(notes)), *_cells(_values(figure)), "", ""]))
        notes.insert(0, "Δ: measured less published. Measured rows first, then published ones by number:")
        if any(not figure.verified for figure in self.figures):
            notes.append(f"{NOT_READ} second-hand or recalled, not re-read at its source")
        return Table(self.title, columns(["", *heads]), rows, notes=notes)

    @property
    def figures(self) -> list[Figure]:
        """All published figures of the table."""
        return [*(each.figure for _, found in self.groups for each in found), *self.others]


def beside_tables(runs: Sequence[Run], *, others: bool = True) -> list[BesideTable]:
    """Put runs beside the published figures of their scenes, and means over whole data sets beside published means.

    others  with the figures of methods that were not measured
    Raises UserInputError if nothing is published for any of the scenes.
    """
    figures = read_published()
    places: dict[tuple[str, str, str], list[Measured]] = {}
    for run in runs:
        facts = run.facts
        scene = dataset_facts(facts.dataset).scene_of(facts.scene)
        values = {name: run.mean(metric) for name, metric in METRICS.items()}
        sizes = {"bytes": run.size, "gaussians": run.counts.get("num_gaussians")}
        places.setdefault((facts.dataset, scene, facts.protocol.id), []).append(
            Measured(run.label, values | sizes, facts)
        )
    found = [_table(f"{scene}, {id_}", dataset, scene, rows, figures, others)
             for (dataset, scene, id_), rows in places.items()]  # fmt: skip
    for table in dataset_tables(runs):
        rows = []
        for mean in table.rows if table.published else ():
            facts = next(r.facts for r in runs if (r.variant, r.facts.rate) == (mean.variant, mean.rate)
                         and r.facts.protocol.id in table.protocols)  # fmt: skip
            values = {name: mean.metrics.get(metric) for name, metric in METRICS.items()}
            sizes = {"bytes": mean.size, "gaussians": (mean.counts or {}).get("num_gaussians")}
            if not mean.missing:
                rows.append(Measured(f"{mean.variant} {mean.rate or ''}".rstrip(), values | sizes, facts))
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
) -> BesideTable:
    groups = [(each, beside(each.facts, scene, figures)) for each in rows]
    methods = {each.facts.method for each in rows}
    left = [f for f in figures if (f.dataset, f.scene) == (dataset, scene) and f.method not in methods]
    return BesideTable(title, groups, left if others else [])


def deltas(measured: dict[str, float | None], figure: Figure) -> tuple[float | None, float | None]:
    """Measured less published: PSNR in dB, and the size in percent of the published one; None where one is unknown."""
    psnr, size = measured["psnr"], measured["bytes"]
    return (
        None if psnr is None or figure.psnr is None else psnr - figure.psnr,
        None if size is None or figure.bytes is None else 100 * (size / figure.bytes - 1),
    )


def to_dict(table: BesideTable) -> dict[str, Any]:
    """The table as JSON data."""
    groups = []
    for measured, found in table.groups:
        published = []
        for each in found:
            psnr, size = deltas(measured.values, each.figure)
            told = {"same_rate": each.same_rate, "differences": list(each.differences)}
            published.append(each.figure.model_dump() | told | {"delta_psnr": psnr, "delta_size_percent": size})
        groups.append({"measured": measured.label, **measured.values, "published": published})
    return {"title": table.title, "runs": groups, "others": [figure.model_dump() for figure in table.others]}


def _values(figure: Figure) -> dict[str, float | None]:
    return {name: getattr(figure, name) for name in VALUES}


def _cells(values: dict[str, float | None]) -> list[str]:
    scores = [numbers.score(metric, values[name]) for name, metric in METRICS.items()]
    return [*scores, numbers.megabytes(values["bytes"]), numbers.count(values["gaussians"])]


def _name(figure: Figure, number: int) -> str:
    return f"  [{number}] {figure.label} ({figure.year}){'' if figure.verified else NOT_READ}"


def _note(number: int, figure: Figure, differences: Sequence[str]) -> str:
    steps = "" if figure.steps is None else f"; {numbers.count(figure.steps)} steps"
    told = f"; differs: {'; '.join(differences)}" if differences else ""
    return f"[{number}] {figure.year}, {figure.source}{steps}; {figure.protocol.text}{told}"
