"""Measure whether the start decides what HAC, HAC++ and CAT-3DGS reach: rate points x seeds x starting points.

    SPLATWIZARD_DATA=DATA python benchmarks/anchor_starts.py out/published --lego nerf_synthetic:PATH/lego --plan
    SPLATWIZARD_DATA=DATA python benchmarks/anchor_starts.py out/published --lego nerf_synthetic:PATH/lego \\
        --gpus 0,1,2,3 --jobs 20

On --scene each method runs at its lowest and its highest rate point with --seeds seeds from the default start, and with
one seed from each number of --starts random points (the first seed itself where the default is as many); --curves
methods run at every rate point with one seed. On --lego
(a small scene, left out where it is not given) the highest rate point alone, with --lego-seeds seeds. The background is
black, as the authors have it.

Cells are those of sweep_cells.py: one `sw bench`, resumed by the same command, and at the end stands which ran, were
there, are missing, unfinished or failed. In one folder with benchmarks/published.py both share their runs, and
`published.py OUT --only chair --table` puts the curves beside what was published.

The table: mean PSNR and bytes over the seeds, the spread (largest less smallest PSNR), and for each other start its
PSNR and that less the mean. `ok` where spread and differences are at most --bar dB.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from published import records, rows_of
from rich.console import Console
from rich.table import Table
from sw_report.facts import RunFacts
from sw_report.published_files import read_published
from sweep_cells import Cell, add_options, chosen, print_outcomes, run_cells

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve

METHODS, CURVES, STARTS = "hac,hac-plus,cat-3dgs", "hac,hac-plus", "10000,100000"
KEY = "init_points"
BLACK = "background=black"


@functools.cache
def default_points(method: str, scene: str, preset: str) -> int:
    """Random points that a method starts from on this scene if nothing is said."""
    plugins = load_plugins()
    return resolve(plugins.methods.load(method), preset, scene=scene, plugins=plugins).scene.init_points


def started(cell: Cell, points: int) -> Cell:
    """The run with the first seed from so many random points: that of `cell` where it starts from as many."""
    if points == default_points(cell.method, cell.scene, cell.preset):
        return dataclasses.replace(cell, label=cell.method, seed=0)
    sets = (*cell.sets, f"{KEY}={points}")
    return dataclasses.replace(cell, label=f"{cell.method}-{points}-points", seed=0, sets=sets)


def matrix(
    scene: str, methods: Sequence[str], rates: Mapping[str, Sequence[str]], seeds: int, starts: Sequence[int]
) -> list[Cell]:
    """The cells of a scene: every rate point with every seed from the default start, with one from each other start.

    Where a method's figures on this scene are published, with the values that they are to be measured by.
    """
    published = {(row.label, row.place): row for row in rows_of(read_published())}
    found = []
    for method in methods:
        row = published.get((method, scene))
        for rate in rates[method]:
            cell = row.cell(0, rate) if row is not None else Cell(method, method, scene, rate, sets=(BLACK,))
            found += [dataclasses.replace(cell, seed=seed) for seed in range(seeds)]
            found += [started(cell, points) for points in starts]
    return found


def all_cells(args: argparse.Namespace) -> list[Cell]:
    """The whole matrix of a command."""
    registry = load_plugins().methods
    methods, starts = args.methods.split(","), [int(n) for n in args.starts.split(",") if n]
    declared = {method: list(registry.entry(method).declared["rates"]) for method in methods}
    ends = {method: list(dict.fromkeys((rates[0], rates[-1]))) for method, rates in declared.items()}
    curves = [method for method in args.curves.split(",") if method in methods]
    found = matrix(args.scene, methods, ends, args.seeds, starts) + matrix(args.scene, curves, declared, 1, [])
    if args.lego:
        highest = {method: rates[-1:] for method, rates in declared.items()}
        found += matrix(args.lego, methods, highest, args.lego_seeds, starts)
    return list(dict.fromkeys(found))


def psnr_of(runs: Iterable[RunFacts]) -> list[float]:
    return [psnr for run in runs if (psnr := run.mean("psnr")) is not None]


def line_of(cells: Sequence[Cell], out: Path, starts: Sequence[int], bar: float) -> list[str]:
    """One method at one rate point on one scene: what its seeds reach, and how far the other starts are from that."""
    first = cells[0]
    default = [cell for cell in cells if cell.label == cell.method]
    runs = records(path for cell in default if (path := cell.directory(out) / "metrics.json").is_file())
    psnr = psnr_of(runs)
    mean = statistics.fmean(psnr) if psnr else None
    spread = max(psnr) - min(psnr) if len(psnr) > 1 else None
    apart: list[float | None] = []
    told = []
    for points in starts:
        cell = started(default[0] if default else first, points)
        found = psnr_of(records([path])) if (path := cell.directory(out) / "metrics.json").is_file() else []
        apart.append(found[0] - mean if found and mean is not None else None)
        told.append("-" if not found else f"{found[0]:.2f}" + ("" if apart[-1] is None else f" ({apart[-1]:+.2f})"))
    asked = len(default) > 1
    known = [spread, *apart]
    verdict = "" if not asked else "?" if None in known or len(psnr) < len(default) else (
        "ok" if all(abs(each) <= bar + 1e-9 for each in known if each is not None) else "APART"
    )  # fmt: skip
    counts = [str(next(iter(run.counts.values()))) for run in runs if run.counts]
    return [
        first.method, first.scene, first.rate, "-" if mean is None else f"{mean:.2f}",
        "-" if spread is None else f"{spread:.2f}", " ".join(f"{each:.2f}" for each in psnr),
        "-" if not runs else f"{statistics.fmean(run.file.bytes for run in runs):,.0f}",
        " ".join(counts) or "-", *told, f"{len(psnr)}/{len(default)}", verdict,
    ]  # fmt: skip


def print_matrix(cells: Sequence[Cell], out: Path, starts: Sequence[int], bar: float, console: Console) -> None:
    """Print the table of all cells."""
    table = Table(title=f"PSNR dB; bar {bar} dB", title_justify="left")
    heads = ("method", "scene", "rate", "mean", "spread", "by seed", "bytes", "primitives by seed")
    for head in (*heads, *(f"{points:,} points" for points in starts), "n", ""):
        table.add_column(head)
    groups: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.method, cell.scene, cell.rate), []).append(cell)
    for group in groups.values():
        table.add_row(*line_of(group, out, starts, bar))
    console.print(table)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where the runs are kept")
    add_options(parser)
    parser.add_argument("--scene", default="nerf_synthetic/chair", help="(default: nerf_synthetic/chair)")
    parser.add_argument("--lego", default="", help="a small scene, such as nerf_synthetic:PATH/lego (default: none)")
    parser.add_argument("--methods", default=METHODS, help=f"comma list (default: {METHODS})")
    parser.add_argument("--curves", default=CURVES, help=f"at every rate point with one seed (default: {CURVES})")
    parser.add_argument("--seeds", type=int, default=3, help="of both ends on --scene (default: 3)")
    parser.add_argument("--lego-seeds", type=int, default=5, help="on --lego (default: 5)")
    parser.add_argument("--starts", default=STARTS, help=f"numbers of random points (default: {STARTS})")
    parser.add_argument("--bar", type=float, default=0.2, help="dB (default: 0.2)")
    args = parser.parse_args()
    cells = chosen(all_cells(args), args)
    console = Console(width=200)
    outcomes = run_cells(cells, args.out, args)
    if not args.table:
        print_outcomes(outcomes, console, planned=args.plan)
    if not args.plan:
        print_matrix(cells, args.out, [int(n) for n in args.starts.split(",") if n], args.bar, console)
    return int(any(outcome.state == "failed" for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
