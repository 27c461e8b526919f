"""Small records beside the published figures of the scene that they were cut down from: `table published SCENE`.

Figures are those of the method's package (published.toml), of the same rate point. Runs of the preset that a figure is
to be measured by come first, then those of `paper`, and the table says which.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from result_groups import BASE, NONE, TITLES, Rows, points, spread
from result_records import FROM, RECORDS, SmallRecord, read
from sw_report.published import standing_for
from sw_report.published_files import Figure, read_published

SCENES = {"lego": ("nerf_synthetic", ["lego"]), "chair": ("nerf_synthetic", ["chair", "chair-black"])}
"""Published scene -> its data set, and the records of it, or of what is cut down from it."""
HEAD = (
    "method", "rate", "PSNR dB, published", "here", "SSIM, published", "here", "LPIPS, published", "here",
    "bytes, published", "here", "Gaussians, published", "here", "n", "source", "differs besides",
)  # fmt: skip


BRIEF = {"method": 0, "rate": 1, "PSNR dB": 3, "published": 2, "bytes": 9, "published bytes": 8, "n": 12}
"""Column of the short form -> its place in a whole row."""


def table(scene: str, records_at: Path = RECORDS, *, brief: bool = False) -> str:
    """Write a row for each published figure with records. Raises SystemExit for a scene of no data set."""
    if scene not in SCENES:
        raise SystemExit(f"no published scene is known for '{scene}'; one of {', '.join(SCENES)}")
    dataset, names = SCENES[scene]
    records = [record for name in names for record in read(records_at / f"{name}.jsonl")]
    figures = [f for f in read_published() if (f.dataset, f.scene) == (dataset, scene) and f.rate]
    order = list(TITLES)
    figures.sort(key=lambda f: (order.index(f.method) if f.method in order else len(order), -(f.bytes or 0)))
    rows = [_row(figure, group, records) for figure in figures if (group := _group(figure, records))]
    whole: Sequence[Sequence[str]] = [HEAD, *rows]
    if brief:
        whole = [list(BRIEF), *([row[place] for place in BRIEF.values()] for row in rows)]
    lines = [f"| {' | '.join(cells)} |" for cells in whole]
    return "\n".join([lines[0], "|---" * len(whole[0]) + "|", *lines[1:], ""])


def _group(figure: Figure, records: Rows) -> Rows:
    """Return the runs that stand for a figure, of one preset and its usual start; none where there are none."""
    groups = points([
        r for r in records if (r.method, r.rate) == (figure.method, figure.rate) and FROM not in r.variant
    ])  # fmt: skip
    return standing_for(figure.preset, [r for group in groups for r in group])


def _row(figure: Figure, group: Rows, records: Rows) -> list[str]:
    return [
        TITLES.get(figure.method, figure.method), figure.rate or NONE,
        _shown(figure.psnr, 2), spread([r.psnr for r in group], 2),
        _shown(figure.ssim, 4), spread([r.ssim for r in group], 4),
        _shown(figure.lpips, 4), spread([r.lpips for r in group], 4),
        _shown(figure.bytes, 0), spread([r.bytes for r in group], 0),
        _shown(figure.gaussians, 0), spread([r.gaussians for r in group], 0), str(len(group)),
        f"{figure.source}, {figure.year}{'' if figure.verified or 're-read' in figure.source else ' (not re-read)'}",
        "<br>".join(_differences(figure, group, records)) or NONE,
    ]  # fmt: skip


def _differences(figure: Figure, group: Rows, records: Rows) -> list[str]:
    """Name what differs besides pictures and views: background, preset, steps of all training, the figure's own."""
    first, found = group[0], []
    published, here = figure.protocol.rules.get("background"), first.protocol.split("/")[4]
    if published is None:
        found.append("background not stated there")
    elif here not in (published if isinstance(published, list) else [published]):
        found.append(f"background {here} here, {published} there")
    if figure.preset not in (None, first.preset):
        found.append(f"preset {first.preset} here, {figure.preset} there")
    steps = _all_steps(first, records)
    if None not in (steps, figure.steps) and steps != figure.steps:
        found.append(f"{steps:,} steps here, {figure.steps:,} there")
    return [*found, *figure.differs]


def _all_steps(record: SmallRecord, records: Sequence[SmallRecord]) -> int | None:
    """Return the steps of a run and of the 3DGS scene of the same matrix that it starts from; None: not known."""
    if record.starts_from != BASE:
        return record.steps
    start = {r.steps for r in records if (r.method, r.preset) == (BASE, record.preset)}
    return None if record.steps is None or len(start) != 1 or None in start else record.steps + (start.pop() or 0)


def _shown(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:,.{digits}f}"
