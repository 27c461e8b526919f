"""Measure rungs of wisp's training on a scene, its rate points, and its bytes beside HAC++ and CAT-3DGS at equal PSNR.

    SPLATWIZARD_DATA=DATA python benchmarks/wisp_ladder.py OUT --scene DATA/fox --images images_2 --cap 74000 --jobs 6
    python benchmarks/wisp_ladder.py OUT --scene DATA/fox --images images_2 --cap 74000 --only "half r3" --deadline 480
    python benchmarks/wisp_ladder.py OUT --scene DATA/fox --images images_2 --cap 74000 --table

Cells are those of sweep_cells.py: one `sw bench`, resumed by the same command; at the end stands which ran, were there,
are missing, unfinished or failed. Families, each at r1, r3, r5 and two points beyond:

wisp        as its preset has it
half        --cap 1.6 times as many grown, 0.81 caps begin at factor 1: the worthier half
fast        the same from a scene of preset `fast` of 3dgs: of few photographs the better one

Rungs, at r3 and once: half with

settled     the last quarter of the grown scene without noise and loss terms, and the mean of its last tenth
long        30,000 steps of growing
slow        step sizes of a training that goes on: positions and latents a tenth, shapes, opacities and colours a third
view        latents alone a tenth
latents     steps of the latents by what the pictures depend on

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
from sweep_cells import Cell, add_options, chosen, print_outcomes, run_cells

RATES = ("r1", "r3", "r5")
BEYOND = {"high": (1.25e-5, 1.6, 0.3), "highest": (6e-6, 2.0, 0.25)}
"""Name of a point beyond r5 -> lambda, factor of the cap, eta."""
COLUMNS = ("PSNR dB", "of training views", "SSIM", "bytes", "splats", "train s", "encode s", "decode s")
BASELINES = {"hac-plus": (0.50, RATES), "cat-3dgs": (0.75, ("r1", "r3", "r6"))}
"""Method -> bar of the mean ratio, and its rate points."""
GROWN = "pretrained.density.settings"
SLOW = {"shape": (1.3e-3, 1.3e-4), "opacity": (8e-3, 8e-4), "colour": (8e-4, 8e-5)}
TENTH = {"latents": (5e-4, 5e-5)}
RUNGS: Mapping[str, Sequence[str]] = {
    "settled": [
        *(f"{GROWN}.{key}=22500" for key in ("stop", "noise_stop", "terms_stop")),
        "pretrained.fast.average=0.1",
    ],
    "long": ["pretrained.iterations=30000"],
    "slow": [
        f"lr.{name}.{end}={value}"
        for name, pair in ({"means": (1.6e-6, 1.6e-7)} | SLOW | TENTH).items()
        for end, value in zip(("first", "last"), pair, strict=True)
    ],
    "view": ["lr.latents.first=5e-4", "lr.latents.last=5e-5"],
    "latents": ["appearance.steps=sensitivity"],
}


def families(cap: int) -> dict[str, list[str]]:
    """Family -> its values."""
    half = [f"{GROWN}.cap={round(1.6 * cap)}", f"budget.cap={round(0.54 * cap)}", "budget.cap_factor=1"]
    return {"wisp": [], "half": half, "fast": [*half, "pretrained.preset=fast", "pretrained.iterations=9000"]}


def points(family: str, scene: str, images: str, seed: int, values: Sequence[str]) -> list[Cell]:
    """A family at its rate points and the two beyond."""
    found = [Cell(family, "wisp", scene, rate, seed, images=images, sets=tuple(values)) for rate in RATES]
    for name, (weight, factor, eta) in BEYOND.items():
        own = (f"budget.cap_factor={factor}", f"rate_term.lambda_={weight}", f"positions.eta={eta}")
        kept = [each for each in values if not each.startswith("budget.cap_factor=")]
        found.append(Cell(f"{family}-{name}", "wisp", scene, "r5", seed, images=images, sets=(*kept, *own)))
    return found


def cells_of(scene: str, images: str, cap: int, seeds: int) -> dict[str, list[Cell]]:
    """Row group -> its cells: families, rungs, baselines."""
    found: dict[str, list[Cell]] = {}
    every = families(cap)
    for seed in range(seeds):
        for family, sets in every.items():
            found.setdefault(family, []).extend(points(family, scene, images, seed, sets))
        for rung, sets in RUNGS.items():
            values = (*every["half"], *sets)
            found.setdefault(rung, []).append(Cell(rung, "wisp", scene, "r3", seed, images=images, sets=values))
        for method, (_, rates) in BASELINES.items():
            found.setdefault(method, []).extend(
                Cell(method, method, scene, rate, seed, images=images) for rate in rates
            )
    return found


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


def print_ratios(groups: Mapping[str, Sequence[Cell]], out: Path, console: Console) -> None:
    """Print the mean ratio of each family and baseline, seed 0, and what is not reached."""
    for method, (bar, _) in BASELINES.items():
        theirs = {cell.rate: measured(cell, out) for cell in groups[method] if cell.seed == 0}
        for family in families(0):
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
    parser.add_argument("--cap", type=int, required=True, help="wisp's own for the scene: 31.25 times the root of its "
                        "training pixels")  # fmt: skip
    parser.add_argument("--seeds", type=int, default=1, help="(default: 1)")
    args = parser.parse_args()
    groups = cells_of(args.scene, args.images, args.cap, args.seeds)
    cells = chosen((cell for each in groups.values() for cell in each), args)
    console = Console(width=200)
    outcomes = run_cells(cells, args.out, args)
    if not args.table:
        print_outcomes(outcomes, console, planned=args.plan)
    if not args.plan:
        print_cells(groups, args.out, console)
        print_ratios(groups, args.out, console)
    return int(any(outcome.state == "failed" for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
