"""Methods side by side on real scenes: quality, size, speed and memory in one table, and what the papers claim.

    python benchmarks/methods.py ../shared/data/fox:images_2 out/methods
    python benchmarks/methods.py ../shared/data/mug ../shared/data/lego out/methods --shrink 3
    python benchmarks/methods.py demo out/methods --preset quick --methods 3dgs,lightgaussian,chimerags --rates all

A scene is what `--scene` takes, with `:PICTURES` for a COLMAP scene's picture folder. Runs are those of `sw run`:
finished ones are not repeated, and the trained 3DGS scene that many methods start from is trained once, before the
others. --shrink K divides every plan and iteration count by K; the records say so. --parallel N runs N of them at a
time, spread over the GPUs, which spoils their times. One that fails is told at the end and does not stop the others.

The claims compare with 3DGS of the same run: a trained scene of 30,000 steps (or its K-th part). A float32 .ply has 248
bytes a Gaussian. Rate and distortion of all that lies in OUT/<scene> are drawn as rd.svg there, and told with
BD-rates in report.html.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from sw_report.after_run import plot_above, report_above

from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.runs.pretrained import named_scenes
from splatwizard_native import available_cores

EXPLICIT = ("3dgs", "trimming-the-fat", "pup-3dgs", "speedy-splat", "lightgaussian", "chimerags")
ANCHORS = ("hac", "cat-3dgs")
SWEEPS = ("3dgs",)  # whose rate points all share one training
PLY_BYTES = 248

console = Console(width=150)


@dataclass(frozen=True)
class Run:
    """Facts of a record, in the units of the table."""

    directory: Path
    method: str
    rate: str
    psnr: float
    ssim: float
    size: int
    gaussians: int
    record: dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE[:PICTURES]")
    parser.add_argument("out", type=Path, help="where the runs are kept")
    parser.add_argument("--methods", default=",".join((*EXPLICIT, *ANCHORS)), help="comma list (default: all)")
    parser.add_argument("--rates", default="", help="of every method (default: all of 3dgs, the default of the others)")
    parser.add_argument("--preset", default="paper", help="of every method (default: paper)")
    parser.add_argument("--shrink", type=int, default=1, help="divide every schedule by this (default: 1)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    parser.add_argument("--set", dest="sets", action="append", default=[], metavar="KEY=VALUE", help="for all runs")
    parser.add_argument("--parallel", type=int, default=1, help="runs at a time (default: 1)")
    args = parser.parse_args()
    names = args.methods.split(",")
    failed: list[str] = []
    visible = [gpu for gpu in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if gpu]
    visible = visible or [str(i) for i in range(torch.cuda.device_count())] or [""]
    gpus = queue.SimpleQueue[str]()
    for place in range(args.parallel):
        gpus.put(visible[place % len(visible)])
    for first in (True, False):  # what the others start from, then the others
        work = [(scene, name) for scene in args.scenes for name in names if (name == SWEEPS[0]) == first]
        with ThreadPoolExecutor(args.parallel) as pool:
            jobs = [pool.submit(run, args, gpus, *what) for what in work]
            failed += [told for job in jobs if (told := job.result()) is not None]
    for scene in args.scenes:
        folder = args.out / Path(scene.partition(":")[0]).name
        if runs := read(folder):
            print_table(folder.name, runs)
            print_claims(runs)
            directories = [run.directory for run in runs]
            for made in (report_above(directories, console.print), plot_above(directories, console.print)):
                if made is not None:
                    console.print(str(made))
    if failed:
        sys.exit("\n".join(failed))


def run(args: argparse.Namespace, gpus: queue.SimpleQueue[str], scene: str, method: str) -> str | None:
    """`sw run` of one method on one scene; what to tell if it fails."""
    spec, _, pictures = scene.partition(":")
    rates = args.rates or ("all" if method in SWEEPS else "default")
    command = [sys.executable, "-m", "splatwizard_core", "run", "--method", method, "--scene", spec]
    command += ["--rate", rates, "--preset", args.preset, "--device", args.device, "--out", str(args.out)]
    command += ["--images", pictures] if pictures else []
    for value in (*shrunk(method, args.shrink), *args.sets):
        command += ["--set", value]
    gpu = gpus.get()
    try:
        # More threads than cores wait for one another in loops: two runs with two threads each on two cores take
        # fifteen times as long.
        environment = {"OMP_NUM_THREADS": str(max(1, available_cores() // args.parallel)), **os.environ}
        environment |= {"CUDA_VISIBLE_DEVICES": gpu} if gpu else {}
        status = subprocess.run(command, check=False, stdout=subprocess.DEVNULL, env=environment).returncode
    finally:
        gpus.put(gpu)
    return None if status == 0 else f"{method} on {spec} failed with exit status {status}, see above"


def shrunk(method: str, factor: int) -> list[str]:
    """The settings that divide all schedules of a method, and of the scene that it starts from, by `factor`."""
    if factor == 1:
        return []
    plugins = load_plugins()
    cls = plugins.methods.load(method)
    found = ["scale_schedule=true", f"iterations={cls.Config.FULL_ITERATIONS // factor}"]
    for base in named_scenes(cls(plugins, cls.Config())):
        full = plugins.methods.load(base).Config.FULL_ITERATIONS
        found += ["pretrained.scale_schedule=true", f"pretrained.iterations={full // factor}"]
    return found


def read(folder: Path) -> list[Run]:
    """The records of a scene by method and rate, methods in the order of this file."""
    found = []
    for path in folder.glob("*/*/metrics.json"):
        record = json.loads(path.read_text())
        metrics = record["metrics"]
        found.append(
            Run(
                path.parent, record["method"], record["rate"], metrics["psnr"]["mean"], metrics["ssim"]["mean"],
                record["file"]["bytes"], record["counts"].get("num_gaussians", 0), record,
            )
        )  # fmt: skip
    order = (*EXPLICIT, *ANCHORS)
    return sorted(found, key=lambda r: (order.index(r.method) if r.method in order else len(order), r.size))


def print_table(scene: str, runs: list[Run]) -> None:
    first = runs[0].record
    device = first["environment"].get("device")
    table = Table(title=f"{scene}, {first['protocol']['id']}, {device}", title_justify="left")
    for column in ("method", "rate", "PSNR dB", "SSIM", "bytes", "Gaussians", "encode s", "decode s", "FPS",
                   "train s", "with base s", "peak MiB"):  # fmt: skip
        table.add_column(column, justify="left" if column in ("method", "rate") else "right")
    for run in runs:
        record, train = run.record, run.record["train"]
        table.add_row(
            run.method, run.rate, f"{run.psnr:.3f}", f"{run.ssim:.4f}", f"{run.size:,}", f"{run.gaussians:,}",
            f"{record['codec']['encode_s']:.2f}", f"{record['codec']['decode_s']:.2f}", f"{record['speed']['fps']:.0f}",
            _number(train["train_s"], 1), _number(train["with_pretraining_s"], 1),
            _number(None if train["peak_bytes"] is None else train["peak_bytes"] / 2**20, 0),
        )  # fmt: skip
    console.print(table)


def print_claims(runs: list[Run]) -> None:
    """Print the claims of the papers beside what is measured here."""
    of = {(run.method, run.rate): run for run in runs}
    default = {name: _default(name, of) for name in (*EXPLICIT, *ANCHORS)}
    base = default["3dgs"]
    if base is None:
        return
    table = Table(title="claims", title_justify="left")
    for column in ("method", "claim", "measured", ""):
        table.add_column(column)

    def row(method: str, claim: str, measured: str, holds: bool) -> None:
        table.add_row(method, claim, measured, "holds" if holds else "does NOT hold")

    ply = base.gaussians * PLY_BYTES
    if speedy := default["speedy-splat"]:
        gone, lost = 1 - speedy.gaussians / base.gaussians, base.psnr - speedy.psnr
        row("speedy-splat", "removes >= 85 % for <= 0.8 dB", f"{gone:.1%}, {-lost:+.2f} dB",
            gone >= 0.85 and lost <= 0.8)  # fmt: skip
    if light := default["lightgaussian"]:
        ratio, lost = ply / light.size, base.psnr - light.psnr
        row("lightgaussian", ">= 12x below the float32 .ply for <= 0.5 dB", f"{ratio:.1f}x, {-lost:+.2f} dB",
            ratio >= 12 and lost <= 0.5)  # fmt: skip
        for own in (run for run in runs if run.method == "chimerags"):
            row("chimerags", f"{own.rate}: fewer bytes than lightgaussian at no less PSNR",
                f"{own.size / light.size:.2f} of the bytes, {own.psnr - light.psnr:+.2f} dB",
                own.size < light.size and own.psnr >= light.psnr)  # fmt: skip
    if hac := default["hac"]:
        good = [r for r in runs if r.method == "hac" and r.psnr >= base.psnr - 0.3]
        best = min(good, key=lambda r: r.size, default=hac)
        ratio, lost = ply / best.size, base.psnr - best.psnr
        row("hac", "3DGS - 0.3 dB at <= 1/40 of the float32 .ply", f"{ratio:.1f}x, {-lost:+.2f} dB",
            ratio >= 40 and lost <= 0.3)  # fmt: skip
    console.print(table)


def _default(method: str, of: dict[tuple[str, str], Run]) -> Run | None:
    """The run at a method's default rate point, if there is one."""
    plugins = load_plugins()
    if method not in plugins.methods:
        return None
    return of.get((method, plugins.methods.load(method).DEFAULT_RATE))


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


if __name__ == "__main__":
    main()
