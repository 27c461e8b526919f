"""Cost of the watch over the cores where nobody else wants them: a ratio with its 95 % interval.

    python benchmarks/watch_cost.py [--jobs train,plain] [--cores 0,1] [--threads 2] [--seconds 90]

Runs of one program differ by some per cent from process to process, more than the watch could cost. So each job runs
in one process, which begins and ends the watch in blocks of half a second, in the order with-without-without-with or
its opposite, by lot: what drifts evenly, as a scene that grows, cancels within the four. A ratio is the geometric mean
over all fours: time of a step with the watch over that without. Its interval is a bootstrap over the fours. `wall`
needs cores that nobody else uses. `CPU` is user and system time; with `--threads 1`, where nobody spins, it holds
beside other work too. `--looks 100` looks 25 times as often as the watch does: what a look costs shows where the
cost of four a second is lost in the noise.

Jobs: `train`, steps of 3DGS on the demo scene, by `splatwizard_core.train`; `plain`, both passes of the rasterizer
`standard`, four frames per step; `decode`, the .swz that `--file` names. `s` is the least time of a step. `share`: part
of the wanted CPU time that the job had; `asleep`: part of the looks after which OpenMP's threads slept, 0 on quiet
cores.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import os
import random
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
SWITCH = "SPLATWIZARD_SHARE_CORES"
SETTINGS = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "MKL_NUM_THREADS")
JOBS = ("train", "plain", "decode")
WARM_UP = 5  # s before the first block
FEWEST = 8  # fours: of fewer a bootstrap tells nothing
HEAD = f"{'job':8}{'':24}{'s':>8}{'ratio':>8}{'bar':>8}{'share':>8}"


class Enough(Exception):  # noqa: N818
    """Raised in the middle of a job once it has been measured for long enough."""


class Blocks:
    """Switches the watch on and off while work goes on, and keeps what a unit of work took in each block.

    fours       for each, four pairs: watched, (wall, CPU) seconds of a unit
    """

    def __init__(self, seconds: float, block: float, seed: int = 0) -> None:
        self.fours: list[list[tuple[bool, tuple[float, float]]]] = []
        self.looks: list[bool] = []
        self._seconds, self._block, self._lot = seconds, block, random.Random(seed)
        self._began, self._watch, self._marks = time.perf_counter(), None, None
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget a four that is not complete: a new training begins."""
        self._end_watch()
        first = self._lot.random() < 0.5
        self._order, self._four, self._marks = [first, not first, not first, first], [], None

    def unit_done(self) -> None:
        """Note that a unit of work has ended; begin or end a block where it is time. Raises Enough."""
        now = time.perf_counter()
        if now - self._began < WARM_UP:
            return
        if self._marks is None:
            self._begin_block()
            return
        wall, cpu, units = self._marks
        self._marks = wall, cpu, units + 1
        if now - wall < self._block:
            return
        self._end_watch()  # inside of the block: its end is part of its cost
        spent = time.perf_counter() - wall, cpu_seconds() - cpu
        self._four.append((self._order[len(self._four)], (spent[0] / (units + 1), spent[1] / (units + 1))))
        if len(self._four) == 4:
            self.fours.append(self._four)
            self.begin_anew()
            if len(self.fours) >= FEWEST and now - self._began > WARM_UP + self._seconds:
                raise Enough
        self._begin_block()

    def _begin_block(self) -> None:
        from splatwizard_native.waiting import Watch

        self._marks = time.perf_counter(), cpu_seconds(), 0
        if self._order[len(self._four)]:
            self._watch = Watch()  # beginning and ending it costs about a look: counted against it

    def _end_watch(self) -> None:
        if self._watch is not None:
            self._watch.end()
            self._watch = None

    def ratios(self, which: int) -> list[float]:
        """List the logarithms of the ratio with over without, one a four; `which`: 0 wall, 1 CPU."""
        return [sum(math.log(spent[which]) * (1 if on else -1) for on, spent in four) / 2 for four in self.fours]


def cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def interval(logs: list[float], resamples: int = 4000, seed: int = 0) -> tuple[float, float, float]:
    """Return the geometric mean of ratios and its 95 % interval, by bootstrap.

    logs        logarithms of the ratios, at least one
    """
    lot = random.Random(seed)
    means = sorted(statistics.fmean(lot.choices(logs, k=len(logs))) for _ in range(resamples))
    low, high = means[int(0.025 * resamples)], means[int(0.975 * resamples)]
    return math.exp(statistics.fmean(logs)), math.exp(low), math.exp(high)


def frames(rounds: int | None = None) -> Iterator[None]:
    """Draw and differentiate the pictures of four cameras, a round at a time; `rounds` None: for ever."""
    import torch

    sys.path.insert(0, str(HERE.parent))
    from scene import make_splats, orbit_cameras

    from splatwizard_core.api import RasterOptions
    from sw_rasterizers.standard import StandardRasterizer

    rasterizer, splats = StandardRasterizer(), make_splats(20_000)
    for x in splats.tensors().values():
        x.requires_grad_(True)
    cameras = orbit_cameras(4, 480, 270)
    rasterizer.render(splats, cameras[0], RasterOptions())  # loads the kernels
    for _ in itertools.count() if rounds is None else range(rounds):
        yield
        for camera in cameras:
            image = rasterizer.render(splats, camera, RasterOptions()).image
            torch.autograd.backward([image.square().mean()])


def files(file: str) -> Iterator[None]:
    """Decode a file for ever."""
    import splatwizard_core as sw

    while True:
        yield
        sw.decode(file, device="cpu")


def train(blocks: Blocks, steps: int) -> None:
    """Train the demo scene again and again, until it is enough."""
    import splatwizard_core as sw
    from splatwizard_core.training.trainer import Trainer

    run = Trainer.run

    def measured(self: Trainer, until: int, after_step: Callable[[Any], None]) -> None:
        def after(record: Any) -> None:
            after_step(record)
            blocks.unit_done()

        blocks.begin_anew()
        run(self, until, after)

    Trainer.run = measured  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder:
        for i in itertools.count():
            sw.train("3dgs", "demo", out=f"{folder}/{i}", device="cpu", iterations=steps)


def measure(job: str, options: argparse.Namespace) -> dict[str, Any]:
    """Measure in this process, where the watch does not begin by itself."""
    from splatwizard_native import CoreTime, waiting

    blocks, cores = Blocks(options.seconds, options.block), CoreTime()
    waiting.INTERVAL = 1 / options.looks
    look = waiting.Judge.look

    def seen(self: waiting.Judge, lap: Any) -> bool:
        blocks.looks.append(look(self, lap))
        return blocks.looks[-1]

    waiting.Judge.look = seen  # type: ignore[method-assign]
    with contextlib.suppress(Enough):
        if job == "train":
            train(blocks, options.steps)
        else:
            for _ in frames() if job == "plain" else files(options.file):
                blocks.unit_done()
    return {
        "seconds": min(spent[0] for four in blocks.fours for _, spent in four),
        "wall": blocks.ratios(0),
        "CPU": blocks.ratios(1),
        "share": cores.lap().share,
        "asleep": statistics.fmean(blocks.looks) if blocks.looks else 0.0,
    }


def rows(job: str, options: argparse.Namespace) -> str:
    """Measure in a process of its own and return the rows of wall and CPU time."""
    environment = {k: v for k, v in os.environ.items() if k not in SETTINGS}
    environment[SWITCH] = "0"
    if options.threads:
        environment["OMP_NUM_THREADS"] = str(options.threads)
    command = [sys.executable, str(HERE), "--child", job, "--steps", str(options.steps)]
    command += ["--seconds", str(options.seconds), "--block", str(options.block), "--looks", str(options.looks)]
    if options.file:
        command += ["--file", options.file]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    facts = json.loads(done.stdout.splitlines()[-1])
    lines = []
    for what, bar in (("wall", "1.03"), ("CPU", "")):
        ratio, low, high = interval(facts[what])
        lines.append(
            f"{job:8}{f'watch, {what} time':24}{facts['seconds']:8.3f}{ratio:8.3f}{bar:>8}{facts['share']:8.2f}"
            f"  {low:.3f} to {high:.3f}, {len(facts[what])} fours, asleep {facts['asleep']:.2f}"
        )
    return "\n".join(lines)


def job_names(text: str) -> list[str]:
    """Split the names of jobs, for argparse. Raises ArgumentTypeError that names one that does not exist."""
    names = text.split(",")
    for name in names:
        if name not in JOBS:
            raise argparse.ArgumentTypeError(f"no job '{name}', choose from {', '.join(JOBS)}")
    return names


def positive(text: str) -> float:
    """Read a finite number above 0, for argparse. Raises ArgumentTypeError."""
    with contextlib.suppress(ValueError):
        value = float(text)
        if 0 < value < math.inf:
            return value
    raise argparse.ArgumentTypeError(f"'{text}' is no number above 0")


def add_options(parser: argparse.ArgumentParser, seconds: float) -> None:
    """Add those that `rows` reads."""
    parser.add_argument("--seconds", type=positive, default=seconds, help="to measure the watch, each job, or longer")
    parser.add_argument("--block", type=positive, default=0.5, help="seconds, at least, between two switches")
    parser.add_argument("--looks", type=positive, default=4, help="a second, of the watch")
    parser.add_argument("--threads", type=int, default=0, help="of the job; 0: as many as there are cores")
    parser.add_argument("--steps", type=int, default=900, help="of a training")
    parser.add_argument("--file", help="to decode")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--jobs", type=job_names, default="train,plain", help=f"some of {', '.join(JOBS)}")
    add_options(parser, seconds=90)
    parser.add_argument("--child", metavar="JOB", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        print(json.dumps(measure(options.child, options)))
        return
    if "decode" in options.jobs and options.file is None:
        parser.error("the job 'decode' needs --file")
    os.sched_setaffinity(0, {int(core) for core in options.cores.split(",")})
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"cores {options.cores} of {os.cpu_count()}, load average {load}\n\n{HEAD}", flush=True)
    for job in options.jobs:
        print(rows(job, options), flush=True)


if __name__ == "__main__":
    main()
