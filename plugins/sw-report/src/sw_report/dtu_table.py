"""The table of DTU: Chamfer distances of meshes, scan by scan, measured beside published ones (dtu.json)."""

from __future__ import annotations

import functools
import json
import re
import statistics
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from sw_report.blocks import Table, columns, row
from sw_report.numbers import MISSING
from sw_report.runs import Run

METRIC = "chamfer_dtu"


@functools.cache
def published() -> Mapping[str, Any]:
    """Return the published figures: `scans`, `rows` (method, values in mm, mean, source, remark) and `remarks`."""
    found: Mapping[str, Any] = json.loads((files("sw_report") / "dtu.json").read_text("utf-8"))
    return found


def dtu_table(runs: Sequence[Run]) -> Table | None:
    """Measured distances by scan, then the published ones; None where no run was measured on DTU.

    A mean is that of all 15 scans: where one is missing there is none.
    """
    measured: dict[str, dict[int, float]] = {}
    for run in runs:
        number, value = re.search(r"\d+", run.facts.scene), run.mean(METRIC)
        if run.facts.dataset == "dtu" and number is not None and value is not None:
            measured.setdefault(run.label, {})[int(number.group())] = value
    if not measured:
        return None
    known = published()
    scans, marks = known["scans"], {name: "*" * (i + 1) for i, name in enumerate(known["remarks"])}
    rows = []
    for label, values in measured.items():
        whole = statistics.fmean(values[scan] for scan in scans) if set(scans) <= set(values) else None
        rows.append(row([label, "measured", *_cells([values.get(scan) for scan in scans]), *_cells([whole])]))
    for each in known["rows"]:
        name = f"{each['method']} {marks.get(each.get('remark'), '')}".strip()
        rows.append(row([name, "published", *_cells(each["values"]), *_cells([each["mean"]])]))
    heads = ["method", "figures", *map(str, scans), "mean"]
    sources = "; ".join(f"{each['method']}: {each['source']}" for each in known["rows"])
    return Table(
        "DTU, Chamfer distance of the mesh, mm", columns(heads, text=("method", "figures")), rows,
        "Lower is better. Published figures have protocols of their own: culling, voxels and alignment differ.",
        [*(f"{marks[name]} {text}." for name, text in known["remarks"].items()), f"Published in {sources}."],
        wide=True,
    )  # fmt: skip


def _cells(values: Sequence[float | None]) -> list[str]:
    return [MISSING if value is None else f"{value:.2f}" for value in values]
