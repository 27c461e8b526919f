"""Sweeps: what `sw bench` costs beside its work, whether kills change its table, and how several GPUs share it.

    python benchmarks/sweeps.py                              # 8 methods x 3 scenes x 2 rates, quick presets, CPU
    python benchmarks/sweeps.py --set iterations=60 --set pretrained.iterations=60       # the same in minutes
    python benchmarks/sweeps.py --device cuda --workers 2 --compare-workers 1            # two GPUs against one

Three parts, each a sweep of the same plan into a folder of its own:

quiet       nobody interrupts it. Cost: seconds from its start to its first process, from the end of its last process to
            its end, and between the end of a process and the start of the next one on its place while one was waiting;
            as a share of the seconds of all processes. Bar: 2 %.
killed      killed at random --kills times (SIGKILL or SIGTERM to the sweep alone), then left to end. Bar: the SHA-256
            of every file and every score are those of `quiet`. On CUDA sums have no fixed order, so it is only counted
            how many files are equal.
compared    with --compare-workers N: the same plan with so many processes at a time; its time over that of `quiet`.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

METHODS = "3dgs,lightgaussian,mesongs,c3dgs,trimming-the-fat,pup-3dgs,speedy-splat,compact3dgs"
SCENES = 3
EVENT = re.compile(r"^\[ *\d+/\d+\] (started|finished|failed|again) +(.*?)(: .*)?$")
SW = [sys.executable, "-m", "splatwizard_core"]


@dataclass
class Course:
    """A sweep that was watched.

    events      (seconds since its start, what, name of the process)
    """

    seconds: float = 0.0
    status: int = 0
    events: list[tuple[float, str, str]] = field(default_factory=list)

    @property
    def work(self) -> float:
        """Seconds of all processes."""
        began: dict[str, float] = {}
        total = 0.0
        for at, what, name in self.events:
            if what == "started":
                began[name] = at
            else:
                total += at - began.pop(name, at)
        return total

    def cost(self, places: int) -> dict[str, float]:
        """Seconds that the sweep itself took: before, after, and between processes while a place was free for one."""
        starts = [at for at, what, _ in self.events if what == "started"]
        ends = [at for at, what, _ in self.events if what != "started"]
        between, running, free_since = 0.0, 0, None
        for at, what, _ in self.events:
            if what == "started":
                between += 0.0 if free_since is None else at - free_since
                running += 1
                free_since = None
            else:
                running -= 1
                free_since = at if running == places - 1 and any(later > at for later in starts) else None
        return {"before": starts[0], "between": between, "after": self.seconds - ends[-1]}


def sweep(words: list[str], out: Path, kill_after: float | None = None, how: int = signal.SIGKILL) -> Course:
    """Run a sweep, or kill it after some seconds."""
    course, began = Course(), time.monotonic()
    process = subprocess.Popen([*SW, *words, "--out", str(out), "--json"], stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE, text=True)  # fmt: skip
    assert process.stderr is not None
    if kill_after is not None:
        time.sleep(kill_after)
        process.send_signal(how)
    for line in process.stderr:
        found = EVENT.match(line.rstrip())
        if found:
            name = re.sub(r" \(start \d+\)$", "", found[2])
            course.events.append((time.monotonic() - began, found[1], name))
        elif kill_after is None and "error" in line:
            print(line, end="", file=sys.stderr)
    course.status = process.wait()
    course.seconds = time.monotonic() - began
    return course


def table(out: Path) -> dict[str, tuple[str, dict[str, float]]]:
    """Checksum and scores of every run by its place."""
    found = {}
    for path in sorted(out.rglob("metrics.json")):
        record = json.loads(path.read_text("utf-8"))
        scores = {name: block["mean"] for name, block in record["metrics"].items()}
        found[str(path.parent.relative_to(out))] = (record["file"]["sha256"], scores)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--scenes", type=int, default=SCENES, help="small ones, made here (default: 3)")
    parser.add_argument("--size", default="tiny", choices=("tiny", "demo"), help="of the scenes (default: tiny)")
    parser.add_argument("--rates", default="r1,r2")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--compare-workers", type=int, default=0, metavar="N", help="also measure with so many")
    parser.add_argument("--kills", type=int, default=3, help="0: leave that part out (default: 3)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for all runs")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        scenes = []
        for i in range(args.scenes):
            scenes.append(str(root / f"scene-{i}"))
            subprocess.run([*SW, "data", "synth", scenes[-1], "--size", args.size], check=True, capture_output=True)
        words = ["bench", "--method", args.methods, "--scene", ",".join(scenes), "--rate", args.rates]
        words += ["--preset", "quick", "--device", args.device, *(w for value in args.set for w in ("--set", value))]
        on = [*words, "-o", f"workers={args.workers}"]

        quiet = sweep(on, root / "quiet")
        expected = table(root / "quiet")
        cost = quiet.cost(args.workers)
        share = sum(cost.values()) / quiet.work
        told = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in cost.items())
        print(f"quiet: {len(expected)} runs in {quiet.seconds:.0f} s, {args.workers} at a time, status {quiet.status}; "
              f"processes {quiet.work:.0f} s; cost {told}: {share:.2%} (bar 2 %)", flush=True)  # fmt: skip
        failed = quiet.status != 0
        if args.kills:
            rng = random.Random(args.seed)
            for _ in range(args.kills):
                after, how = rng.uniform(0.1, 0.4) * quiet.seconds, rng.choice([signal.SIGKILL, signal.SIGTERM])
                sweep(on, root / "killed", after, how)
                print(
                    f"killed by {how.name} after {after:.0f} s: {len(table(root / 'killed'))} runs finished", flush=True
                )
            last = sweep(on, root / "killed")
            found = table(root / "killed")
            equal = sum(found.get(place) == row for place, row in expected.items())
            print(f"killed: ended with status {last.status}; {equal} of {len(expected)} runs equal, file and scores "
                  f"(bar on a CPU: all), {len(set(found) - set(expected))} besides", flush=True)  # fmt: skip
            failed |= last.status != 0 or set(found) != set(expected)
            failed |= args.device == "cpu" and equal < len(expected)
        if args.compare_workers:
            other = sweep([*words, "-o", f"workers={args.compare_workers}"], root / "compared")
            ratio = other.seconds / quiet.seconds
            print(f"compared: {other.seconds:.0f} s with {args.compare_workers} at a time, {ratio:.2f} times quiet")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
