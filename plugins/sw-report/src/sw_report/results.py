"""Output at the end of `sw run`: one table, the rate-distortion curves on a terminal, and where everything lies."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from splatwizard_core.tooling import Record

SHOWN_RECORDS = 3  # paths that are printed one by one
COLOURS = ("blue", "dark_orange", "green", "magenta", "yellow", "red", "cyan", "bright_black")
PLOT_WIDTH = 72


def print_results(done: Sequence[tuple[Record, Path]], written: Sequence[Path], out: Console) -> None:
    """Print the table of finished runs, their curves on a terminal, and where everything lies, `written` too."""
    from rich.markup import escape

    records = [record for record, _ in done]
    print_table(records, out)
    for line in notes(records):
        out.print(escape(line), soft_wrap=True)
    if len(done) > 1:
        directories = [directory for _, directory in done]
        if out.is_terminal:
            print_plot(directories, out)
        for line in bd_lines(directories):
            out.print(escape(line), soft_wrap=True)
    if len(done) <= SHOWN_RECORDS:
        for _, directory in done:
            out.print(f"{escape(str(directory))}/metrics.json", soft_wrap=True)
    else:
        root = done[0][1].parent.parent
        out.print(escape(f"{len(done)} records: {root}/<method>/<rate>/metrics.json"), soft_wrap=True)
    for path in written:
        out.print(escape(str(path)), soft_wrap=True)


def print_table(records: Sequence[Record], out: Console) -> None:
    """Print one row per run, the rows of a method together; the best value of a column is marked if there is a choice.

    Columns that do not fit are left out, and named.
    """
    from rich.markup import escape
    from rich.table import Table

    from sw_report.numbers import SHARED_NOTE, heading, order_after_run

    first = records[0]
    # A metric that nobody could compute has its reason below, and no column.
    names = list(dict.fromkeys(
        name for record in records for name, metric in record.metrics.items()
        if not metric.diagnostic and (metric.mean is not None or metric.per_view)
    ))  # fmt: skip
    names.sort(key=lambda name: (order_after_run(name), name))
    best = _best(records, names) if len({record.method for record in records}) > 1 else {}
    columns: dict[str, list[str]] = {}
    digits = 3 if min(record.file.bytes for record in records) >= 100_000 else 4
    for i, record in enumerate(records):
        for name, text in _cells(record, names, digits).items():
            columns.setdefault(name, []).append(f"*{text}" if i in best.get(name, ()) else text)
    fixed = {"method": [record.method for record in records], "rate": [_rate(record) for record in records]}
    heads = {name: heading(name) if name in names else name for name in columns}
    left_out = _too_wide(fixed, columns, heads, names, out.width)

    table = Table(
        title=f"{escape(first.scene)}: {first.test_views} test views, protocol {escape(first.protocol.id)}",
        title_justify="left",
    )
    table.add_column("method", no_wrap=True, min_width=max(len(name) for name in fixed["method"]))
    table.add_column("rate", no_wrap=True)
    kept = [name for name in columns if name not in left_out]
    for name in kept:
        # Heads may break into lines, numbers may not.
        head = textwrap.fill(heads[name], _content(heads[name], columns[name]), break_long_words=False)
        table.add_column(head, justify="right", no_wrap=True)
    for i, record in enumerate(records):
        cells = [columns[name][i] for name in kept]
        same = i > 0 and records[i - 1].method == record.method
        last = i + 1 < len(records) and records[i + 1].method != record.method
        table.add_row(
            "" if same else escape(record.method), escape(_rate(record)),
            *(f"[bold]{text}[/bold]" if text.startswith("*") else text for text in cells), end_section=last,
        )  # fmt: skip
    out.print(table)
    if best:
        out.print("* best of its column")
    if any(record.contended for record in records):
        out.print(SHARED_NOTE, soft_wrap=True)
    if left_out:
        told = ", ".join(heads[name] for name in columns if name in left_out)
        out.print(f"no room for {told}: metrics.json has them, and `sw report`", soft_wrap=True)


def _stored(record: Record) -> str:
    """Number format of the parameters in the file, where nothing in it is compressed; empty otherwise."""
    from sw_report.declared import uncompressed

    return uncompressed(_encoders(record))


def _float32(record: Record) -> int | None:
    """Bytes of the file's Gaussians as float32, where they are compressed; None where that cannot be told."""
    from sw_report.declared import float32_bytes

    return float32_bytes(_encoders(record), record.counts, (record.config or {}).get("config"))


def _encoders(record: Record) -> list[tuple[str, str]]:
    encoded = (phase for phase in record.phases if phase.phase == "encode")
    return [(part.kind, part.name) for phase in encoded for part in phase.provided_by]


def _rate(record: Record) -> str:
    return ", ".join(filter(None, (record.rate, _stored(record)))) or "-"


def _cells(record: Record, names: Sequence[str], digits: int) -> dict[str, str]:
    """Column -> text; megabytes with so many digits."""
    means = {name: record.metrics[name].mean if name in record.metrics else None for name in names}
    from sw_report.numbers import shared

    contended = record.contended
    return {
        **{name: _number(name, value) for name, value in means.items()},
        "MB": f"{record.file.bytes / 1e6:.{digits}f}",
        "primitives": " / ".join(f"{n:,}" for n in record.counts.values()),
        "train s": shared(_seconds(record.train.with_pretraining_s), "train" in contended),
        "encode s": shared(_seconds(record.codec.encode_s), "encode" in contended),
        "decode s": shared(_seconds(record.codec.decode_s), "decode" in contended),
        "FPS": shared(f"{record.speed.fps:.1f}", "render" in contended),
    }


def _too_wide(
    fixed: dict[str, list[str]], columns: dict[str, list[str]], heads: dict[str, str], names: Sequence[str], room: int
) -> set[str]:
    """Choose the columns to leave out so that the rest fits: metrics after the first three, then times, and so on."""
    needed = 1 + sum(3 + _content(name, cells) for name, cells in fixed.items())
    needed += sum(3 + _content(heads[name], cells) for name, cells in columns.items())
    found: set[str] = set()
    for name in (*reversed(names[3:]), "encode s", "decode s", *reversed(names[1:3]), "train s", "primitives", "FPS"):
        if needed <= room:
            break
        found.add(name)
        needed -= 3 + _content(heads[name], columns[name])
    return found


def _content(head: str, cells: Sequence[str]) -> int:
    """Characters that a column takes, its head broken between words."""
    return max(max(map(len, head.split()), default=0), *map(len, cells))


def _best(records: Sequence[Record], names: Sequence[str]) -> dict[str, set[int]]:
    """Column -> the rows with its best value, equal ones included: quality, size and speed."""
    found: dict[str, set[int]] = {}

    def mark(name: str, values: Sequence[float | None], *, highest: bool) -> None:
        known = [value for value in values if value is not None]
        if known:
            top = max(known) if highest else min(known)
            rows = {i for i, value in enumerate(values) if value == top}
            if len(rows) < len(values):  # a mark on every row says nothing
                found[name] = rows

    for name in names:
        metrics = [record.metrics.get(name) for record in records]
        highest = next((m.direction == "higher" for m in metrics if m is not None), True)
        mark(name, [None if m is None else m.mean for m in metrics], highest=highest)
    mark("MB", [float(record.file.bytes) for record in records], highest=False)
    if not any("render" in record.contended for record in records):  # else the quickest is the least disturbed
        mark("FPS", [record.speed.fps for record in records], highest=True)
    return found


def notes(records: Sequence[Record]) -> list[str]:
    """Lines under the table: which times include another training, what is not compressed, why values are missing."""
    from sw_report.numbers import FLOAT32_NOTE, UNCOMPRESSED_NOTE

    found = []
    before: dict[str, dict[str, None]] = {}
    for record in records:
        for name, scene in (record.train.pretraining or {}).items():
            if scene.train_s is not None:
                before.setdefault(name, {})[record.method] = None
    for name, methods in before.items():
        found.append(f"train s of {', '.join(methods)}: with that of the {name} scene that it starts from")
    missing: dict[str, dict[str, None]] = {}
    for record in records:
        if record.train.with_pretraining_s is None:
            why = record.unknown.get("train.with_pretraining_s", "the record gives no reason")
            missing.setdefault(why, {})[record.method] = None
    found += [f"train s of {', '.join(methods)} is not known: {why}" for why, methods in missing.items()]
    found += [UNCOMPRESSED_NOTE.format(name) for name in dict.fromkeys(map(_stored, records)) if name]
    stored = {record.method for record in records if _stored(record)}  # their table has that size already
    sizes = {record.method: size for record in records if (size := _float32(record)) and record.method not in stored}
    found += [FLOAT32_NOTE.format(method, f"{size / 1e6:.2g}") for method, size in sizes.items()]
    found += [f"{', '.join(affected)}: {reason}" for reason, affected in reasons_of_metrics(records).items()]
    return found


def reasons_of_metrics(records: Sequence[Record]) -> dict[str, list[str]]:
    """Reason -> metrics that have no mean for it."""
    from splatwizard_core.tooling import short_reason

    found: dict[str, dict[str, None]] = {}
    for record in records:
        for key, why in record.unknown.items():
            block, _, name = key.partition(".")
            if block == "metrics":
                found.setdefault(short_reason(why), {})[name.removesuffix(".mean")] = None
    return {why: list(names) for why, names in found.items()}


def print_plot(directories: Sequence[Path], out: Console) -> None:
    """Print PSNR against bytes, in characters."""
    from rich.text import Text

    from sw_report.runs import collect
    from sw_report.text_plot import Curve, text_plot

    curves: dict[str, list[tuple[float, float]]] = {}
    for run in collect(directories).runs:
        value = run.mean("psnr")
        if value is not None:
            curves.setdefault(run.variant, []).append((run.size / 1e6, value))
    if not curves:
        return
    unicode = (getattr(sys.stdout, "encoding", None) or "").lower().startswith("utf")
    lines = text_plot(
        [Curve(name, points) for name, points in curves.items()],
        "PSNR dB", "file size, MB (logarithmic)", width=min(PLOT_WIDTH, max(out.width - 12, 20)), unicode=unicode,
    )  # fmt: skip
    for line in lines:
        text = Text(no_wrap=True)
        for part, index in line:
            text.append(part, None if index < 0 else COLOURS[index % len(COLOURS)])
        out.print(text)


def bd_lines(directories: Sequence[Path]) -> list[str]:
    """BD-rates of the methods against the usual anchor, by PSNR; nothing for a single method."""
    from sw_report.distortion import bd_tables, choose_anchor, why_anchor, with_values
    from sw_report.numbers import percent
    from sw_report.runs import collect

    runs = collect(directories).runs
    anchor = choose_anchor(runs, None)
    if anchor is None:
        return []
    tables, missing = with_values(table for table in bd_tables(runs, anchor) if table.metric == "psnr")
    if not tables:
        return missing
    found: list[str] = []
    marks: dict[str, None] = {}
    for table in tables:
        told = []
        for row in table.rows:
            value, why = row.rate.value, row.rate.reason
            mark = " *" if value is not None and why else ""
            told.append(
                f"{row.variant} {percent(value)} %{mark}" if value is not None else f"{row.variant} none ({why})"
            )
            if mark:
                marks[why] = None
        found.append(f"BD-rate against {anchor} by PSNR (negative saves): {', '.join(told)}")
    chosen = why_anchor(runs, anchor)
    return [*found, *([chosen] if ";" in chosen else []), *(f"* {why}" for why in marks)]


def _number(metric: str, value: float | None) -> str:
    from sw_report.declared import metric_style

    if value is None:
        return "-"
    style = metric_style(metric)
    # Rate points of one scene may lie less than 0.01 dB apart.
    return f"{value:.{style.digits + (style.unit == 'dB')}f}"


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
