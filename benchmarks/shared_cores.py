"""Cost of company: how much longer work takes beside others on the same cores, in ratios.

    python benchmarks/shared_cores.py [--cores 0,1] [--jobs train,plain,decode] [--seconds 60] [--file cat.swz]

Pins itself, and so all that it starts, to the cores named, which nobody else should use meanwhile. The jobs, each in
a process of its own: `train`, the demo scene by 3DGS through `sw`; `plain`, both passes of the rasterizer `standard`
from a few lines of Python; `decode`, a file of a method whose decoder computes (`--file`; without one, CAT-3DGS is
trained for 300 steps on the demo scene). Each alone without the watch over the cores (the least of `--repeats`), two
side by side, and beside busy processes of plain Python. Times are those that the jobs take themselves, without
imports. What the watch costs alone is measured within one process by watch_cost.py, `--seconds` for each job, and
given with its 95 % interval. `share` is what a record says: the part of the CPU time that a job wanted and had; 1 where
hardly any was missing.

Bars: the watch alone at most 1.03; two at most 2.3; beside n busy ones on c cores at most 2 (c + n) / c, twice what is
left of the cores if every thread gets the same. `--unwatched` adds these rows with SPLATWIZARD_SHARE_CORES=0, which
show what the watch is for and can take many minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import watch_cost
from watch_cost import SETTINGS, SWITCH

HERE = Path(__file__).resolve()
BUSY = "while True: pass"
SW = [sys.executable, "-m", "splatwizard_core"]


def plain(frames: int) -> None:
    """Draw and differentiate frames; print seconds and share as JSON. Runs in a process of its own."""
    from splatwizard_native import CoreTime

    rounds = watch_cost.frames(frames // 4)
    next(rounds)
    cores, began = CoreTime(), time.perf_counter()
    for _ in rounds:
        pass
    seconds, share = time.perf_counter() - began, cores.shortage()
    print(json.dumps({"seconds": seconds, "share": share}))


class Job:
    """One of the jobs; `start` gives a process, `seconds` what it told when it ended."""

    def __init__(self, name: str, options: argparse.Namespace, scratch: Path) -> None:
        self.name, self.options, self.scratch, self.count = name, options, scratch, 0

    def command(self) -> list[str]:
        if self.name == "plain":
            return [sys.executable, str(HERE), "--child", str(self.options.frames)]
        if self.name == "decode":
            return [*SW, "decode", self.options.file, "--repeats", "1", "--device", "cpu", "--json"]
        self.count += 1
        out = str(self.scratch / f"train-{self.count}")
        steps = f"iterations={self.options.steps}"
        return [*SW, "train", "--scene", "demo", "--method", "3dgs", "--device", "cpu", "--set", steps, "--out", out]

    def start(self, *, watch: bool) -> tuple[subprocess.Popen[str], list[str]]:
        command = self.command()
        environment = {k: v for k, v in os.environ.items() if k not in SETTINGS}
        environment[SWITCH] = "1" if watch else "0"
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        return process, command

    def result(self, process: subprocess.Popen[str], command: list[str]) -> tuple[float, float]:
        """Seconds and share of one that was started. Raises RuntimeError if it failed."""
        told = process.communicate()[0]
        if process.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} failed with status {process.returncode}")
        if self.name == "plain":
            facts = json.loads(told)
            return facts["seconds"], facts["share"] or 1.0
        if self.name == "decode":
            facts = json.loads(told)
            return facts["decode_s"], facts["contended"].get("decode", 1.0)
        steps = next(Path(command[-1]).rglob("steps.json"))
        facts = json.loads(steps.read_text())["train"]["facts"]
        return facts["train_s"], facts["contended"].get("train", 1.0)

    def run(self, *, watch: bool = True, together: int = 1, busy: int = 0) -> tuple[float, float]:
        """The longest time of all that run together, and the smallest share."""
        others = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(busy)]
        try:
            started = [self.start(watch=watch) for _ in range(together)]
            results = [self.result(*each) for each in started]
        finally:
            for each in others:
                each.kill()
                each.wait()
        return max(seconds for seconds, _ in results), min(share for _, share in results)


def make_file(scratch: Path) -> str:
    """Train CAT-3DGS a little and encode it."""
    environment = {k: v for k, v in os.environ.items() if k not in SETTINGS}
    out = scratch / "cat"
    train = [*SW, "train", "--scene", "demo", "--method", "cat-3dgs", "--device", "cpu", "--set", "iterations=300"]
    subprocess.run([*train, "--out", str(out)], check=True, env=environment, stdout=subprocess.DEVNULL)
    directory = next(out.rglob("config.toml")).parent
    file = str(scratch / "cat.swz")
    subprocess.run([*SW, "encode", str(directory), "--out", file, "--device", "cpu"], check=True, env=environment)
    return file


def show(job: str, base: float, what: str, found: tuple[float, float], bar: float | None) -> None:
    """Print a row."""
    limit = "" if bar is None else f"{bar:.2f}"
    print(f"{job:8}{what:24}{found[0]:8.2f}{found[0] / base:8.2f}{limit:>8}{found[1]:8.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--jobs", type=watch_cost.job_names, default="train,plain,decode")
    watch_cost.add_options(parser, seconds=60)
    parser.add_argument("--frames", type=int, default=200, help="of the plain job")
    parser.add_argument("--busy", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=3, help="of the runs alone")
    parser.add_argument("--unwatched", action="store_true", help="also the rows without the watch, which take long")
    parser.add_argument("--child", type=int, metavar="FRAMES", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        plain(options.child)
        return
    cores = {int(core) for core in options.cores.split(",")}
    os.sched_setaffinity(0, cores)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"cores {options.cores} of {os.cpu_count()}, load average {load}\n")
    print(f"{'job':8}{'':24}{'s':>8}{'ratio':>8}{'bar':>8}{'share':>8}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        for name in options.jobs:
            if name == "decode" and options.file is None:
                options.file = make_file(scratch)
            job = Job(name, options, scratch)
            alone = [job.run(watch=False) for _ in range(options.repeats)]
            base, _ = min(alone)

            crowd = f"beside {options.busy} busy"
            allowed = 2 * (len(cores) + options.busy) / len(cores)
            show(job.name, base, "alone, unwatched", min(alone), None)
            print(watch_cost.rows(name, options), flush=True)
            show(job.name, base, "two", job.run(together=2), 2.3)
            show(job.name, base, crowd, job.run(busy=options.busy), allowed)
            if options.unwatched:
                show(job.name, base, "two, unwatched", job.run(watch=False, together=2), 2.3)
                show(
                    job.name,
                    base,
                    f"{crowd}, unwatched",
                    job.run(watch=False, busy=options.busy),
                    allowed,
                )


if __name__ == "__main__":
    main()
