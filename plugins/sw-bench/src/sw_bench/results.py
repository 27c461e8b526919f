"""The table that a sweep ends with: every run of the plan, its scores over the seeds, or why it failed."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from splatwizard_core.tooling import MetricInfo, PluginManager, Record
from sw_bench.cells import Cell
from sw_bench.index import Index
from sw_bench.state import record_of

Facts = dict[str, Any]


def results(cells: Sequence[Cell], index: Index) -> list[Facts]:
    """Return a row for each method, scene and rate point, in the order of the plan, as plain values.

    `metrics` and `bytes` are means over the finished seeds, with `deviations` (of the sample, n - 1) where there are
    several; `steps` are those of the trained scenes that a training started from or was taught by, and its own, None of
    a scene from a file; `failed` maps a seed to the reason, also of a finished run that could not be done again.
    """
    groups: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.label, cell.scene, cell.rate), []).append(cell)
    return [_row(label, scene, rate, group, index) for (label, scene, rate), group in groups.items()]


def _row(label: str, scene: str, rate: str, group: Sequence[Cell], index: Index) -> Facts:
    records = {cell.seed: record for cell in group if (record := record_of(cell)) is not None}
    states = {cell.seed: index.row(cell) for cell in group}
    values: dict[str, list[float]] = {"bytes": [float(record.file.bytes) for record in records.values()]}
    for name in _shared_metrics(list(records.values())):
        values[name] = [float(record.metrics[name].mean or 0.0) for record in records.values()]
    return {
        "label": label, "method": group[0].resolved.method, "scene": scene, "rate": rate,
        "seeds": sorted(records),
        "steps": next(map(_steps, records.values()), []),
        "directories": [str(cell.directory) for cell in group],
        "means": {name: statistics.fmean(each) for name, each in values.items() if each},
        "deviations": {name: statistics.stdev(each) for name, each in values.items() if len(each) > 1},
        "failed": {str(seed): row.reason for seed, row in states.items() if row.status == "failed"},
        "waiting": [seed for seed, row in states.items() if row.status != "failed" and seed not in records],
    }  # fmt: skip


def _steps(record: Record) -> list[int | None]:
    """Steps of the trained scenes that a run started from or was taught by, and its own."""
    return [*(scene.steps for scene in record.train.pretraining.values()), record.train.steps]


def _shared_metrics(records: Sequence[Record]) -> list[str]:
    """Names of the metrics that every record knows, but for diagnostic ones."""
    if not records:
        return []
    return [
        name for name, block in records[0].metrics.items()
        if not block.diagnostic and all(r.metrics.get(name) and r.metrics[name].mean is not None for r in records)
    ]  # fmt: skip


def table_of(rows: Sequence[Facts], plugins: PluginManager) -> tuple[list[str], list[list[str]]]:
    """Return headings and cells of the table as text."""
    infos = {entry.name: MetricInfo.of(entry) for entry in plugins.metrics}
    order = {entry.name: float(entry.declared.get("position", 1e9)) for entry in plugins.metrics}
    names = sorted({name for row in rows for name in row["means"]} - {"bytes"}, key=lambda n: (order.get(n, 1e9), n))
    several = len({seed for row in rows for seed in row["seeds"]}) > 1
    headings = ["method", "scene", "rate", *(["n"] if several else [])]
    remarks = any(map(_remark, rows))
    headings += [infos[name].label if name in infos else name for name in names]
    headings += ["MB", "steps", *([""] if remarks else [])]
    lines = []
    for row in rows:
        cells = [row["label"], row["scene"], row["rate"], *([str(len(row["seeds"]))] if several else [])]
        for name in names:
            cells.append(_number(row, name, infos[name].digits if name in infos else 4, 1.0))
        steps = " + ".join("file" if each is None else f"{each:,}" for each in row["steps"])
        lines.append([*cells, _number(row, "bytes", 3, 1e-6), steps or "-", *([_remark(row)] if remarks else [])])
    return headings, lines


def _number(row: Facts, name: str, digits: int, scale: float) -> str:
    if name not in row["means"]:
        return "-"
    text = f"{row['means'][name] * scale:.{digits}f}"
    return text + (f" ± {row['deviations'][name] * scale:.{digits}f}" if name in row["deviations"] else "")


def _remark(row: Facts) -> str:
    by_reason: dict[str, list[str]] = {}
    for seed, reason in row["failed"].items():
        by_reason.setdefault(reason, []).append(seed)
    told = [f"failed (seed {', '.join(seeds)}): {reason}" for reason, seeds in by_reason.items()]
    return "; ".join(told + ([f"not run (seed {', '.join(map(str, row['waiting']))})"] if row["waiting"] else []))
