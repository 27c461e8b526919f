"""Rate and distortion of every method on one scene: docs/images/rd-SCENE.svg from the small records, by sw-report.

A figure says in its metadata which points it shows, so that whether it is stale can be told without matplotlib.
"""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Sequence
from pathlib import Path

from result_groups import Rows, points, title
from result_records import RECORDS, ROOT, SmallRecord, read
from sw_report.figures import Line, Panel, write_panels
from sw_report.method_styles import styles_of_methods

IMAGES = ROOT / "docs" / "images"
METRICS = {"psnr": "PSNR, dB", "ssim": "SSIM"}


def path_of(scene: str) -> Path:
    """Return where the figure of a scene lies."""
    return IMAGES / f"rd-{scene}.svg"


def shown(scene: str, records_at: Path = RECORDS) -> str:
    """Write what stands in a page: the figure, its text for those who do not see it, and how it was made."""
    records = _records(scene, records_at)
    if not records:
        return f"*No records of {scene} yet.*\n"
    names = ", ".join(line.name for line in panels(records)[0].lines)
    return (
        f"![PSNR and SSIM over the bytes of the file on {records[0].scene}, on a logarithmic axis: {names}]"
        f"(images/{path_of(scene).name})\n\n"
        "Means over the runs, bars: one deviation; dashed: anchor methods.\n"
    )


def panels(records: Rows) -> list[Panel]:
    """Return the curves: a line for each method and variant, a point for each of its rates."""
    groups = points(records)
    styles = styles_of_methods({title(group): group[0].method for group in groups})
    found = []
    for metric, label in METRICS.items():
        lines: dict[str, Line] = {}
        for group in groups:
            point = _point(group, metric)
            if point is not None:
                name = title(group)
                line = lines.setdefault(name, Line(name, [], styles[name], any(r.anchors for r in group)))
                line.points.append(point)
        for line in lines.values():
            line.points.sort()
        found.append(Panel(label, list(lines.values())))
    return found


def digest(scene: str, records_at: Path = RECORDS) -> str:
    """Return what stands for the points of a figure."""
    told = [
        [panel.label, [[line.name, line.style, line.dashed, line.points] for line in panel.lines]]
        for panel in panels(_records(scene, records_at))
    ]
    return "points " + hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]


def is_stale(scene: str, records_at: Path = RECORDS, path: Path | None = None) -> bool:
    """Tell whether the figure shows other points than the records hold."""
    path = path or path_of(scene)
    if not _records(scene, records_at):
        return False
    return not path.exists() or digest(scene, records_at) not in path.read_text("utf-8")


def draw(scene: str, records_at: Path = RECORDS, path: Path | None = None) -> None:
    """Write the figure of a scene."""
    path = path or path_of(scene)
    write_panels(panels(_records(scene, records_at)), path, about=digest(scene, records_at))


def _records(scene: str, records_at: Path) -> list[SmallRecord]:
    path = records_at / f"{scene}.jsonl"
    return read(path) if path.exists() else []


def _point(group: Sequence[SmallRecord], metric: str) -> tuple[float, float, float | None] | None:
    """Return megabytes, value and its deviation; None where a run has no value."""
    values = [getattr(record, metric) for record in group]
    if None in values:
        return None
    size = statistics.fmean(record.bytes for record in group) / 1e6
    return size, statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None
