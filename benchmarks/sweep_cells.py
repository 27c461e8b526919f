"""Cells of a benchmark, run as one `sw bench`: several processes a GPU, resumed, and what became of each cell.

For published.py and anchor_starts.py. A cell is one run: a method with its values on a scene, at a rate point, with a
seed. `sw bench` trains what several cells start from once, before them, so that no two processes race for it; finished
cells are not run again, interrupted ones go on; the same command with other values needs --bench=--rerun-changed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from splatwizard_core.api import SplatwizardError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.scene.locate import is_procedural, locate

PATIENCE = 60.0  # seconds from the deadline to the checkpoints of everything that runs
INTERRUPTED = 130  # exit status of `sw`
STATES = ("ran", "was there", "unfinished", "failed", "missing")


@dataclass(frozen=True)
class Cell:
    """One run.

    label   the sweep's name of the method with these values: cells of one label and scene differ in rate and seed alone
    scene   as `sw run --scene` takes it
    sets    "KEY=VALUE"
    """

    label: str
    method: str
    scene: str
    rate: str
    seed: int = 0
    preset: str = "paper"
    images: str = ""
    sets: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return f"{self.label} {self.rate} {self.scene} seed {self.seed}"

    def directory(self, out: Path) -> Path:
        """Its run directory, where `sw bench` puts it."""
        root = f"seed-{self.seed}" + (f"-{self.label}" if self.label != self.method else "")
        path = Path(self.scene)
        folder = (path.resolve() if path.exists() else path).name.replace(":", "-")
        return out / root / folder / self.method / self.rate


@dataclass(frozen=True)
class Outcome:
    """End of a cell: one of STATES, and why where it failed or its scene is missing."""

    state: str
    why: str = ""


def plan_text(cells: Sequence[Cell]) -> str:
    """Write the plan of these cells, TOML: a table for each label, the rest of the product skipped.

    Raises ValueError where cells of one label on one scene have other values.
    """
    labels, scenes = (list(dict.fromkeys(getattr(cell, name) for cell in cells)) for name in ("label", "scene"))
    seeds = sorted({cell.seed for cell in cells})
    lines = [f"methods = {json.dumps(labels)}", f"scenes = {json.dumps(scenes)}", f"seeds = {json.dumps(seeds)}"]
    for label in labels:
        methods = {cell.method for cell in cells if cell.label == label}
        if len(methods) != 1:
            raise ValueError(f"label '{label}' is of several methods: {', '.join(sorted(methods))}")
        lines += [f"[method.{json.dumps(label)}]", f"method = {json.dumps(methods.pop())}"]
    for label in labels:
        for scene in scenes:
            here = [cell for cell in cells if (cell.label, cell.scene) == (label, scene)]
            values = {(cell.preset, cell.images, cell.sets) for cell in here}
            if len(values) > 1:
                raise ValueError(f"'{label}' on {scene} stands for several configurations")
            by_rates: dict[tuple[str, ...], list[int]] = {}
            for seed in seeds:
                by_rates.setdefault(tuple(sorted({c.rate for c in here if c.seed == seed})), []).append(seed)
            for rates, of in by_rates.items():
                about = [f"methods = {json.dumps([label])}", f"scenes = {json.dumps([scene])}"]
                about.append(f"seeds = {json.dumps(of)}")
                lines += ["[[override]]", *about, *(_values(here[0], rates) if rates else ["skip = true"])]
    return "\n".join(lines) + "\n"


def _values(cell: Cell, rates: Iterable[str]) -> list[str]:
    lines = [f"rates = {json.dumps([*rates])}", f"preset = {json.dumps(cell.preset)}"]
    lines += [f"images = {json.dumps(cell.images)}"] if cell.images else []
    pairs = (text.partition("=") for text in cell.sets)
    inner = ", ".join(f"{json.dumps(key)} = {json.dumps(value)}" for key, _, value in pairs)
    return [*lines, f"set = {{ {inner} }}"] if inner else lines


def missing_scene(scene: str) -> str:
    """Tell why a scene is not there; empty: it is."""
    families = load_plugins().datasets
    first, colon, rest = scene.partition(":")
    if is_procedural(families, first):
        return ""
    try:
        locate(rest if colon and first in families else scene, families)
    except SplatwizardError as error:
        return str(error)
    return ""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of everything that runs cells."""
    parser.add_argument("--only", action="append", default=[], metavar="TEXT",
                        help="cells whose name, LABEL RATE SCENE seed N, holds this text; repeatable")  # fmt: skip
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for all cells, on top")
    parser.add_argument("--jobs", type=int, default=0, metavar="N",
                        help="processes at a time, spread over the GPUs (default: one per GPU)")  # fmt: skip
    parser.add_argument("--gpus", default="", metavar="LIST", help="such as 0,1,2,3 (default: all that are visible)")
    parser.add_argument("--device", default="", help="auto, cpu or cuda (default: auto)")
    parser.add_argument("--deadline", type=float, metavar="SECONDS",
                        help="stop after so many seconds, with checkpoints; the same command goes on")  # fmt: skip
    parser.add_argument("--plan", action="store_true", help="list the cells and run nothing")
    parser.add_argument("--table", action="store_true", help="no runs, only the table of what is finished")
    parser.add_argument("--bench", action="append", default=[], metavar="OPTION",
                        help="option of `sw bench`, such as --bench=--rerun-changed; repeatable")  # fmt: skip


def chosen(cells: Iterable[Cell], args: argparse.Namespace) -> list[Cell]:
    """The cells whose name holds one of the texts of `--only` (all without any), with the values of `--set` on top."""
    wanted = [cell for cell in dict.fromkeys(cells) if not args.only or any(text in cell.name for text in args.only)]
    return [replace(cell, sets=(*cell.sets, *args.set)) for cell in wanted]


def run_cells(cells: Sequence[Cell], out: Path, args: argparse.Namespace) -> dict[Cell, Outcome]:
    """Run the cells whose scene is there and that are not finished, and tell what became of every one.

    args    of `add_options`; with `plan` or `table` nothing is run
    """
    scenes = dict.fromkeys(cell.scene for cell in cells)
    absent: Mapping[str, str] = {scene: why for scene in scenes if (why := missing_scene(scene))}
    there = [cell for cell in cells if cell.scene not in absent]
    before = {cell: _stamp(cell, out) for cell in there}
    status = 0
    if there and not (args.plan or args.table):
        status = _bench(plan_text(there), out, args)
    reasons = _failures(out)
    found = {}
    for cell in cells:
        stamp = _stamp(cell, out)
        key = cell.label, cell.scene, cell.seed, cell.rate
        if cell.scene in absent and stamp is None:
            found[cell] = Outcome("missing", absent[cell.scene])
        elif stamp is not None and stamp == before.get(cell, stamp):
            found[cell] = Outcome("was there")
        elif stamp is not None:
            found[cell] = Outcome("ran")
        elif key in reasons:
            found[cell] = Outcome("failed", reasons[key])
        else:
            found[cell] = Outcome("unfinished", _why(status))
    return found


def _why(status: int) -> str:
    """Tell what the exit status of `sw bench` says of a cell without a record; empty: nothing."""
    told = {0: "", 1: "", INTERRUPTED: "interrupted, the same command goes on"}
    return told.get(status, f"`sw bench` ended with {status}, see above")


def _bench(plan: str, out: Path, args: argparse.Namespace) -> int:
    out.mkdir(parents=True, exist_ok=True)
    file = out / "cells.toml"
    file.write_text(plan, encoding="utf-8")
    words = ["bench", str(file), "--out", str(out), *args.bench]
    words += ["-o", f"workers={args.jobs}"] if args.jobs else []
    words += ["--device", args.device] if args.device else []
    environment = {**os.environ, **({"CUDA_VISIBLE_DEVICES": args.gpus} if args.gpus else {})}
    process = subprocess.Popen([sys.executable, "-m", "splatwizard_core", *words], env=environment)
    try:
        return process.wait(args.deadline)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.send_signal(signal.SIGTERM)  # which makes everything that runs write a checkpoint
        try:
            return process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()


def _stamp(cell: Cell, out: Path) -> int | None:
    """Return the time at which the record of a cell was written; None: there is none."""
    record = cell.directory(out) / "metrics.json"
    return record.stat().st_mtime_ns if record.is_file() else None


def _failures(out: Path) -> dict[tuple[str, str, int, str], str]:
    """Reasons of the runs that the last sweep in this folder says have failed."""
    index = out / "bench.sqlite"
    if not index.is_file():
        return {}
    file = sqlite3.connect(f"{index.resolve().as_uri()}?mode=ro", uri=True)
    try:
        rows = file.execute("SELECT label, scene, seed, rate, reason FROM runs WHERE status = 'failed'").fetchall()
    finally:
        file.close()
    return {(label, scene, int(seed), rate): str(reason) for label, scene, seed, rate, reason in rows}


def print_outcomes(outcomes: Mapping[Cell, Outcome], console: Console, *, planned: bool) -> None:
    """Say of every cell what became of it, counts last; missing scenes and failures with their reasons."""
    table = Table(title="cells", title_justify="left")
    for column in ("", "method", "rate", "scene", "seed", "preset", "values"):
        table.add_column(column)
    names = {"unfinished": "to run"} if planned else {}
    for cell, outcome in outcomes.items():
        values = " ".join((*cell.sets, *([f"images={cell.images}"] if cell.images else [])))
        state = names.get(outcome.state, outcome.state)
        table.add_row(state, cell.label, cell.rate, cell.scene, str(cell.seed), cell.preset, values)
    console.print(table)
    told = dict.fromkeys(
        f"{outcome.state}: {cell.name if outcome.state == 'failed' else ''} {outcome.why}".replace("  ", " ")
        for cell, outcome in outcomes.items()
        if outcome.why
    )
    counts = Counter(names.get(outcome.state, outcome.state) for outcome in outcomes.values())
    for line in (*told, f"{len(outcomes)} cells: {', '.join(f'{n} {state}' for state, n in counts.items())}"):
        console.print(line, markup=False, highlight=False)
