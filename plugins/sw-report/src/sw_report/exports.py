"""Results for other programs: CSV, JSON, JSON lines, Markdown."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splatwizard_core.tooling import write_atomic
from sw_report import numbers
from sw_report.aggregate import dataset_tables
from sw_report.blocks import Cell, Table
from sw_report.configurations import seed_of
from sw_report.distortion import bd_tables, with_values
from sw_report.dtu_table import dtu_table
from sw_report.prefixes import prefixes_table, with_prefixes
from sw_report.results_tables import bd_table, means_table, metric_names, runs_table
from sw_report.runs import Collection, Run, machine

# What the survey of 3DGS compression asks of a table of one method on one scene.
SURVEY_COLUMNS = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")


def survey_row(run: Run, lpips: str | None = numbers.FIELD_LPIPS) -> list[str]:
    """One run as the survey wants it; unknown values are empty.

    lpips   the form that stands under "LPIPS"; the survey's own is the default, and nothing else may pass for it
    """

    def value(name: str | None, digits: int) -> str:
        mean = run.mean(name) if name is not None else None
        return "" if mean is None else f"{mean:.{digits}f}"

    primitives = run.counts.get("num_gaussians")
    return [
        _cell(run.facts.rate or run.facts.preset or ""), value("psnr", 4), value("ssim", 5), value(lpips, 5),
        str(round(run.size)), "" if primitives is None else str(round(primitives)),
    ]  # fmt: skip


def to_csv(runs: Sequence[Run]) -> str:
    """One table of all runs: what tells them apart, the survey's columns, the number of seeds and their deviations.

    The prefixes of a file with cuts follow its row, but for the whole file, with their packets: `r3 packets 1`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    deviations = [f"{name} deviation" for name in SURVEY_COLUMNS[1:4]]
    writer.writerow(["Dataset", "Scene", "Protocol", "Method", *SURVEY_COLUMNS, "LPIPS variant", "Seeds", *deviations])
    for run in runs:
        facts = run.facts
        where = [facts.dataset, facts.scene, facts.protocol.id, run.variant]
        lpips = numbers.main_lpips(name for name in facts.metrics if run.mean(name) is not None)
        spread = [None if name is None else run.deviation(name) for name in ("psnr", "ssim", lpips)]
        told = ["" if value is None else f"{value:.5f}" for value in spread]
        writer.writerow([*map(_cell, where), *survey_row(run, lpips), lpips or "", str(len(run.seeds)), *told])
        for prefix in facts.prefixes[:-1]:
            means = [(prefix.metrics.get(name or ""), d) for name, d in (("psnr", 4), ("ssim", 5), (lpips, 5))]
            scores = ["" if mean is None else f"{mean:.{digits}f}" for mean, digits in means]
            part = _cell(f"{facts.rate or facts.preset or ''} packets {prefix.packets}".strip())
            number = prefix.counts.get("num_gaussians", "")
            rest = [lpips if lpips in prefix.metrics else "", "1", "", "", ""]
            writer.writerow([*map(_cell, where), part, *scores, str(prefix.bytes), str(number), *rest])
    return text.getvalue()


def write_survey(runs: Sequence[Run], folder: Path) -> list[Path]:
    """The survey's own layout: folder/<dataset>/<scene>/<method>.csv, rate points as submethods.

    Runs of one scene under different protocols get folders of their own: <scene>@<number>. Returns the files.
    """
    files: dict[Path, list[Run]] = {}
    places = list(dict.fromkeys(run.place for run in runs))
    for run in runs:
        same = [place for place in places if place[0] == run.facts.scene]
        scene = _name(run.facts.scene) + (f"@{same.index(run.place) + 1}" if len(same) > 1 else "")
        files.setdefault(folder / _name(run.facts.dataset) / scene / f"{_name(run.variant)}.csv", []).append(run)
    for path, group in files.items():
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(SURVEY_COLUMNS)
        writer.writerows(survey_row(run) for run in group)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, text.getvalue())
    return list(files)


def to_dict(collection: Collection, *, anchor: str | None, partial: bool, pareto: bool) -> dict[str, Any]:
    """Everything that the tables hold, as plain values: what `sw report --json` prints."""
    return {
        "runs": [run_dict(run) for run in collection.runs],
        "means": [asdict(table) for table in dataset_tables(collection.runs, partial=partial)],
        "anchor": anchor,
        "bd": [asdict(table) for table in bd_tables(collection.runs, anchor, pareto=pareto, partial=partial)],
        "notes": collection.notes,
    }


def run_dict(run: Run) -> dict[str, Any]:
    """One run, or the mean over its seeds, as plain values."""
    facts, names = run.facts, metric_names([run], diagnostic=True)
    deviations = {name: found for name in names if (found := run.deviation(name)) is not None}
    return {
        "directory": str(run.directory),
        "method": run.variant,
        "rate": facts.rate,
        "preset": facts.preset,
        "dataset": facts.dataset,
        "scene": facts.scene,
        "protocol": facts.protocol.id,
        "metrics": {name: run.mean(name) for name in names},
        "deviations": deviations,
        "seeds": [seed_of(each) for each in run.seeds],
        "bytes": round(run.size),
        "sections": facts.file.sections,
        "prefixes": [prefix.model_dump() for prefix in facts.prefixes],
        "counts": {unit: round(n) for unit, n in run.counts.items()},
        "steps": facts.train.steps,
        "pretraining_steps": {name: scene.steps for name, scene in (facts.train.pretraining or {}).items()},
        "train_s": run.over_seeds(lambda each: each.train.train_s)[0],
        "with_pretraining_s": run.over_seeds(lambda each: each.train.with_pretraining_s)[0],
        "encode_s": run.over_seeds(lambda each: each.codec.encode_s)[0],
        "decode_s": run.over_seeds(lambda each: each.codec.decode_s)[0],
        "fps": run.over_seeds(lambda each: each.speed.fps)[0],
        "machines": list(dict.fromkeys(map(machine, run.seeds))),
        "contended": {phase: share for each in run.seeds for phase, share in each.contended.items()},
        "flags": facts.flags,
        "unknown": facts.unknown,
        "date": facts.date,
    }


def to_json_lines(runs: Sequence[Run]) -> str:
    """One JSON object a run and line, every seed by itself."""
    each = [single for run in runs for single in run.repeats or (run,)]
    return "".join(json.dumps(run_dict(run), allow_nan=False) + "\n" for run in each)


def tables_of(
    collection: Collection, *, anchor: str | None, partial: bool, pareto: bool, diagnostic: bool = False
) -> list[tuple[str, Table]]:
    """(title, table): the runs of each scene and protocol, means over data sets, DTU's distances, BD values.

    diagnostic  with the metrics that tell conventions apart
    """
    runs = collection.runs
    found = []
    for place in dict.fromkeys(run.place for run in runs):
        table = runs_table([run for run in runs if run.place == place], diagnostic=diagnostic)
        found.append((f"{place[0]}, protocol {place[1]}", table))
    found += [(prefixes_table(run).title, prefixes_table(run)) for run in with_prefixes(runs)]
    for means in dataset_tables(runs, partial=partial, diagnostic=diagnostic):
        found.append((f"{means.title}, protocol {', '.join(means.protocols)}", means_table(means)))
    if (dtu := dtu_table(runs)) is not None:
        found.append((dtu.title, dtu))
    for bd in with_values(bd_tables(runs, anchor, pareto=pareto, partial=partial))[0]:
        found.append((f"{numbers.heading(bd.metric)} against {bd.anchor}, protocol {bd.protocol}", bd_table(bd)))
    return found


def to_markdown(tables: Sequence[tuple[str, Table]], notes: Sequence[str]) -> str:
    """Tables as GitHub reads them."""
    blocks = []
    for title, table in tables:
        lines = [f"**{_markdown(title)}**", "", "| " + " | ".join(_markdown(c.name) for c in table.columns) + " |"]
        lines.append("|" + "|".join("---" if c.text or not i else "---:" for i, c in enumerate(table.columns)) + "|")
        lines += ["| " + " | ".join(map(_marked, row.cells)) + " |" for row in table.rows]
        lines += ["", *(f"{_markdown(note)}  " for note in [table.caption, *table.notes] if note)]
        blocks.append("\n".join(lines).rstrip() + "\n")
    if notes:
        blocks.append("\n".join(f"- {_markdown(note)}" for note in notes) + "\n")
    return "\n".join(blocks)


def _cell(text: str) -> str:
    """Text that a spreadsheet does not take for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") else text


def _name(text: str) -> str:
    """A file name from whatever a record calls something."""
    return re.sub(r"[^\w.+@()\[\]-]+", "_", text).strip(".") or "_"


def _marked(cell: Cell) -> str:
    return f"**{_markdown(cell.text)}**" if cell.best else _markdown(cell.text)


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", text.replace("\n", " "))
