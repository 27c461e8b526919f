"""Overhead of `sw bench`: (seconds of the sweep - seconds of its runs' processes) / the latter, one process at a time.

    python benchmarks/bench_overhead.py                                        # 2 methods x 3 scenes, some minutes
    python benchmarks/bench_overhead.py --set iterations=20 --scenes 1         # less work: the share is larger

Prints where it went: before the first process (imports, the plan's configurations, the index), between the end of a
process and the start of the next one, and after the last one (the table). Bar: 2 %.

A process is what `sw run` by hand would be, and begins with imports as that does. What it takes before it works is
measured beside, by `sw run` on a run that is finished, and is counted as work; "beyond bare work" adds it instead.
`benchmarks/sweeps.py` measures larger sweeps, several processes at a time, kills and GPUs.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from sweeps import SW, sweep

BAR = 0.02
REPEATS = 3


def processes_of(out: Path) -> tuple[list[float], list[str]]:
    """Seconds of each process of a finished sweep, and the commands of its runs."""
    index = sqlite3.connect(out / "bench.sqlite")
    seconds = [row[0] for row in index.execute("SELECT seconds FROM jobs")]
    commands = sorted({row[0] for row in index.execute("SELECT command FROM runs")})
    index.close()
    return seconds, commands


def startup(command: str) -> float:
    """Median seconds of a process that finds its run finished."""
    found = []
    for _ in range(REPEATS):
        began = time.monotonic()
        subprocess.run([*SW, *shlex.split(command)[1:]], check=True, capture_output=True)
        found.append(time.monotonic() - began)
    return statistics.median(found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", default="3dgs,speedy-splat")
    parser.add_argument("--scenes", type=int, default=3, help="small ones, made here (default: 3)")
    parser.add_argument("--size", default="tiny", choices=("tiny", "demo"), help="of the scenes (default: tiny)")
    parser.add_argument("--rates", default="r1,r2")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for all runs")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        scenes = [str(root / f"scene-{i}") for i in range(args.scenes)]
        for scene in scenes:
            subprocess.run([*SW, "data", "synth", scene, "--size", args.size], check=True, capture_output=True)
        words = [
            "bench",
            "--method",
            args.methods,
            "--scene",
            ",".join(scenes),
            "--rate",
            args.rates,
            "-o",
            "workers=1",
        ]
        words += ["--preset", "quick", "--device", args.device, *(w for value in args.set for w in ("--set", value))]
        course = sweep(words, root / "out")
        seconds, commands = processes_of(root / "out")
        runs = len(list((root / "out").rglob("metrics.json")))
        each = startup(commands[0])
    work = sum(seconds)
    share = (course.seconds - work) / work
    bare = work - each * len(seconds)
    parts = ", ".join(f"{name} {spent:.1f} s" for name, spent in course.cost(1).items())
    print(f"{runs} runs in {course.seconds:.1f} s, status {course.status}; {len(seconds)} processes {work:.1f} s")
    print(f"overhead {course.seconds - work:.1f} s = {share:.2%} (bar {BAR:.0%}): {parts}")
    print(f"start of a process {each:.1f} s: beyond bare work {(course.seconds - bare) / bare:.2%}")
    print(json.dumps({"overhead": share, "seconds": course.seconds, "work": work, "startup": each}))
    return int(course.status != 0 or share > BAR)


if __name__ == "__main__":
    sys.exit(main())
