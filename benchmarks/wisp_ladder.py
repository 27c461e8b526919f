"""Measure what each part of wisp brings on a scene, and its bytes beside HAC++ and CAT-3DGS at equal PSNR.

    SPLATWIZARD_DATA=DATA python benchmarks/wisp_ladder.py OUT --scene DATA/fox --images images_2 --jobs 6
    python benchmarks/wisp_ladder.py OUT --scene DATA/fox --images images_2 --only "without" --deadline 480
    python benchmarks/wisp_ladder.py OUT --scene DATA/fox --images images_2 --table
    python benchmarks/wisp_ladder.py OUT --scene DATA/lego --set resolution=2 --preset quick --table

Cells are those of sweep_cells.py: one `sw bench`, resumed by the same command; at the end stands which ran, were there,
are missing, unfinished or failed. Families, each at r1 to r5:

wisp         as its preset has it
progressive  with layers
mcmc         from a scene that MCMC grows; fast: from one of preset `fast` (one of the two is what the preset has)

Rungs: wisp at r3, one thing changed, names in RUNGS. Their table has the difference in dB, the factor of the bytes, and
both as one: ln(bytes over bytes) less the dB times ln(bytes) per dB of the family wisp between r2 and r4.

Prefixes: of each file with layers, each cut beside the family wisp of the same scene: bytes that its hull has at that
PSNR, and the factor; the BD rate of the whole curve, and the share of the dB that a quarter of the bytes has.

Ratio: at the PSNR of each point of a baseline, bytes on the lower hull of a family, linear in log bytes, over that
point's bytes; a point below the hull counts at its smallest file, one above is not reached. Bars: 0.50 and 0.75.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from published import records
from rich.console import Console
from rich.table import Table
from sw_report.rate_distortion import bd_rate
from sweep_cells import Cell, add_options, chosen, print_outcomes, run_cells

from sw_wisp.presets import GROWN, PHOTOGRAPHS

RATES = ("r1", "r2", "r3", "r4", "r5")
COLUMNS = ("PSNR dB", "of training views", "SSIM", "bytes", "splats", "train s", "encode s", "decode s")
BASELINES = {"hac-plus": (0.50, ("r1", "r3", "r5")), "cat-3dgs": (0.75, ("r1", "r3", "r6"))}
"""Method -> bar of the mean ratio, and its rate points."""
FAMILIES: Mapping[str, Sequence[str]] = {
    "wisp": [],
    "progressive": ["layers.progressive=true"],
    "mcmc": [f"{key}={value}".lower() for key, value in GROWN.items()],
    "fast": [f"{key}={value}" for key, value in PHOTOGRAPHS.items()],
}
"""Family -> its values."""
LAYERED = tuple(family for family, values in FAMILIES.items() if "layers.progressive=true" in values)
SLOW = {"means": (1.6e-6, 1.6e-7), "shape": (1.3e-3, 1.3e-4), "opacity": (8e-3, 8e-4), "colour": (8e-4, 8e-5)}
RUNGS: Mapping[str, Sequence[str]] = {
    "without removal": ["prune.rd=false"],
    "without copies": ["prune.respawn=0"],
    "without context": ["context.kind=none"],
    "without adaptive steps": ["steps.adaptive=false"],
    "without fits": ["context.fit=0"],
    "small networks": ["context.networks=small"],
    "cells of the middle scale": ["positions.rule=mid"],
    "latents by sensitivity": ["appearance.steps=sensitivity"],
    "longer start": ["pretrained.iterations=18000"],
    "slow": [
        f"lr.{name}.{end}={value}"
        for name, pair in (SLOW | {"latents": (5e-4, 5e-5)}).items()
        for end, value in zip(("first", "last"), pair, strict=True)
    ],
    "slow latents": ["lr.latents.first=5e-4", "lr.latents.last=5e-5"],
}
"""Rung -> the values that it changes."""


def cells_of(scene: str, images: str, seeds: int, preset: str = "paper") -> dict[str, list[Cell]]:
    """Row group -> its cells: families, rungs, baselines."""

    def cells(label: str, method: str, rates: Sequence[str], values: Sequence[str]) -> list[Cell]:
        return [
            Cell(label.replace(" ", "-"), method, scene, rate, seed, preset, images, tuple(values))
            for seed in range(seeds) for rate in rates
        ]  # fmt: skip

    found = {family: cells(family, "wisp", RATES, values) for family, values in FAMILIES.items()}
    found |= {rung: cells(rung, "wisp", ("r3",), values) for rung, values in RUNGS.items()}
    return found | {method: cells(method, method, rates, ()) for method, (_, rates) in BASELINES.items()}


def measured(cell: Cell, out: Path) -> list[tuple[float, int]]:
    """(PSNR, bytes) of a finished cell, or nothing."""
    path = cell.directory(out) / "metrics.json"
    runs = records([path]) if path.is_file() else []
    return [(psnr, run.file.bytes) for run in runs if (psnr := run.mean("psnr")) is not None]


def lower_hull(found: Sequence[tuple[float, int]]) -> list[tuple[float, float]]:
    """Points (PSNR, log bytes) of the convex hull on its side of few bytes, from the smallest file to the best PSNR."""
    smallest = min(found, key=lambda each: (each[1], -each[0]))
    hull: list[tuple[float, float]] = []
    for psnr, size in sorted({(psnr, size) for psnr, size in found if psnr >= smallest[0]}):
        point = (psnr, math.log(size))
        if hull and hull[-1][0] == psnr:
            continue  # the smaller file of an equal PSNR stands first
        while len(hull) > 1 and _slope(hull[-2], hull[-1]) >= _slope(hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _slope(one: tuple[float, float], other: tuple[float, float]) -> float:
    return (other[1] - one[1]) / (other[0] - one[0])


def ratio(found: Sequence[tuple[float, int]], psnr: float, size: int) -> float | None:
    """Bytes on the hull of a family at a PSNR over `size`; below the hull its smallest file; None: not reached."""
    hull = lower_hull(found)
    if psnr > hull[-1][0]:
        return None
    if psnr <= hull[0][0]:
        return math.exp(hull[0][1]) / size
    (low, at_low), (high, at_high) = next((a, b) for a, b in itertools.pairwise(hull) if psnr <= b[0])
    return math.exp(at_low + (at_high - at_low) * (psnr - low) / (high - low)) / size


def print_cells(groups: Mapping[str, Sequence[Cell]], out: Path, console: Console) -> None:
    """Print what is finished, a row a cell."""
    table = Table(title="wisp and baselines", title_justify="left")
    for head in ("", "rate", "seed", *COLUMNS):
        table.add_column(head)
    for cell in (cell for cells in groups.values() for cell in cells):
        path = cell.directory(out) / "metrics.json"
        for run in records([path]) if path.is_file() else []:
            training = getattr(run.training_psnr, "mean", None)
            numbers = [f"{number:.4f}" if number else "" for number in (run.mean("psnr"), training, run.mean("ssim"))]
            seconds = (run.train.with_pretraining_s or run.train.train_s, run.codec.encode_s, run.codec.decode_s)
            table.add_row(
                cell.label, cell.rate, str(cell.seed),
                *numbers, f"{run.file.bytes:,}", f"{next(iter(run.counts.values()), 0):,}",
                *("" if number is None else f"{number:.1f}" for number in seconds),
            )  # fmt: skip
    console.print(table)


def mean_of(cells: Sequence[Cell], out: Path) -> tuple[float, float] | None:
    """Mean PSNR and mean log bytes of those that are finished; None: none is."""
    found = [each for cell in cells for each in measured(cell, out)]
    if not found:
        return None
    return statistics.fmean(psnr for psnr, _ in found), statistics.fmean(math.log(size) for _, size in found)


def print_rungs(groups: Mapping[str, Sequence[Cell]], out: Path, console: Console) -> None:
    """Print what each rung changes at r3, a row a rung."""
    low, own, high = (mean_of([c for c in groups["wisp"] if c.rate == r], out) for r in ("r2", "r3", "r4"))
    if own is None:
        return
    slope = (high[1] - low[1]) / (high[0] - low[0]) if low and high and high[0] != low[0] else None
    table = Table(title=f"rungs at r3, {own[0]:.2f} dB in {math.exp(own[1]):,.0f} bytes", title_justify="left")
    for head in ("rung", "dB", "bytes x", "bytes x at equal PSNR", "n"):
        table.add_column(head)
    for rung in RUNGS:
        if each := mean_of(groups[rung], out):
            gain, more = each[0] - own[0], each[1] - own[1]
            equal = "" if slope is None else f"{math.exp(more - slope * gain):.3f}"
            n = sum(bool(measured(cell, out)) for cell in groups[rung])
            table.add_row(rung, f"{gain:+.2f}", f"{math.exp(more):.3f}", equal, str(n))
    console.print(table)


def curve(cell: Cell, out: Path) -> list[tuple[float, int]]:
    """(PSNR, bytes) of each cut of a finished cell, the whole file last; nothing for a file without layers."""
    path = cell.directory(out) / "metrics.json"
    runs = records([path]) if path.is_file() else []
    return [(part.metrics["psnr"], part.bytes) for run in runs if len(run.prefixes) > 2 for part in run.prefixes]


def quarter(found: Sequence[tuple[float, int]]) -> float:
    """PSNR that a quarter of the bytes of the last of these has over its own, linear in log bytes between them."""
    psnr, size = found[-1]
    wanted = math.log(size / 4)
    if wanted <= math.log(found[0][1]):
        return found[0][0] / psnr
    (low, at_low), (high, at_high) = next((a, b) for a, b in itertools.pairwise(found) if wanted <= math.log(b[1]))
    share = (wanted - math.log(at_low)) / math.log(at_high / at_low)
    return (low + share * (high - low)) / psnr


def print_prefixes(groups: Mapping[str, Sequence[Cell]], out: Path, console: Console) -> None:
    """Print the cuts of each file with layers beside the files without layers, a table a file."""
    flat = [each for cell in groups["wisp"] if cell.seed == 0 for each in measured(cell, out)]
    for cell in (cell for family in LAYERED for cell in groups[family]):
        found = curve(cell, out)
        if not found:
            continue
        table = Table(title=cell.name, title_justify="left")
        for head in ("cut", "PSNR dB", "bytes", "without layers", "bytes x"):
            table.add_column(head)
        lowest = lower_hull(flat)[0][0] if flat else math.inf
        for number, (psnr, size) in enumerate(found, 1):
            factor = ratio(flat, psnr, size) if psnr >= lowest else None
            beside = ["", ""] if factor is None else [f"{factor * size:,.0f}", f"{1 / factor:.3f}"]
            table.add_row(str(number), f"{psnr:.2f}", f"{size:,}", *beside)
        console.print(table)
        need = next(size for psnr, size in found if psnr >= 0.9 * found[-1][0])
        told = f"of the dB {quarter(found):.0%} with 25 % of the bytes, 90 % with {need / found[-1][1]:.0%}"
        if len(flat) > 1:
            sides = [([size for _, size in each], [psnr for psnr, _ in each]) for each in (flat, found)]
            bd = bd_rate(sides[0], sides[1], pareto=True)
            if bd.value is not None:
                told += f"; BD rate of the curve {bd.value:+.1f} % over {bd.overlap:.0%} of the range"
        console.print(told, highlight=False)


def print_ratios(groups: Mapping[str, Sequence[Cell]], out: Path, console: Console) -> None:
    """Print the mean ratio of each family and baseline, seed 0, and what is not reached."""
    for method, (bar, _) in BASELINES.items():
        theirs = {cell.rate: measured(cell, out) for cell in groups[method] if cell.seed == 0}
        for family in FAMILIES:
            ours = [each for cell in groups[family] if cell.seed == 0 for each in measured(cell, out)]
            if not ours or not any(theirs.values()):
                continue
            parts = {rate: ratio(ours, *each[0]) for rate, each in theirs.items() if each}
            reached = [each for each in parts.values() if each is not None]
            mean = f"{statistics.fmean(reached):.2f}" if reached else "none"
            told = ", ".join(
                f"{rate} {'not reached' if each is None else f'{each:.2f}'}" for rate, each in parts.items()
            )
            console.print(f"{family} over {method}: {mean} of bytes at equal PSNR (bar {bar}): {told}", highlight=False)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where the runs are kept")
    add_options(parser)
    parser.add_argument("--scene", required=True, help="as `sw run --scene` takes it")
    parser.add_argument("--images", default="", help="folder of pictures (default: the scene's own)")
    parser.add_argument("--preset", default="paper", help="of all of them (default: paper)")
    parser.add_argument("--seeds", type=int, default=1, help="(default: 1)")
    args = parser.parse_args()
    groups = cells_of(args.scene, args.images, args.seeds, args.preset)
    cells = chosen((cell for each in groups.values() for cell in each), args)
    console = Console(width=200)
    outcomes = run_cells(cells, args.out, args)
    if not args.table:
        print_outcomes(outcomes, console, planned=args.plan)
    if not args.plan:
        print_cells(groups, args.out, console)
        print_rungs(groups, args.out, console)
        print_prefixes(groups, args.out, console)
        print_ratios(groups, args.out, console)
    return int(any(outcome.state == "failed" for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
