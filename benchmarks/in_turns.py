"""Seconds that versions of the code take for one training, in turns on one machine: its speed changes, for both alike.

    python benchmarks/in_turns.py before=/tmp/before after=/tmp/after --scene DATA/room --preset paper --device cuda

A version is NAME=FOLDER[:FOLDER...], where Python finds its packages (`pip install --target FOLDER ...`). All begin and
are halted once their first stage has taken --skip steps, compiled kernels and scene in memory. Then each trains for a
slice of time while the others are halted (SIGSTOP), to the end of that stage, or until --seconds are over. Seconds
are those of its slices: pictures that are read on the way count, checkpoints and the file at the end do not, there are
none. Two figures compare a version with the first: all steps that both took, and the median over tenths of them, which
a burst of other work changes little. Every version has a cache of its own for compiled kernels, FOLDER.cache beside
its first folder. Of several methods all begin at once and train one after the other. Linux only.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import runpy
import select
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

REPORT = "IN_TURNS_REPORT"  # environment: descriptor to which a training writes how it ended
STEPS = "IN_TURNS_STEPS"  # environment: file in which it counts its steps
SKIP = "IN_TURNS_SKIP"  # environment: steps after which it halts
PARTS = 10


@dataclass
class Version:
    """One training under way.

    points  (seconds, steps) after each slice
    """

    name: str
    process: subprocess.Popen[bytes]
    report: int
    log: Path
    counter: Path
    seconds: float = 0.0
    points: list[tuple[float, int]] = field(default_factory=list)
    end: dict[str, Any] | None = None

    def wait_halted(self) -> None:
        """Return once it is halted or has ended as planned; leave the program if it failed."""
        found = os.waitid(os.P_PID, self.process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        if found is not None and found.si_code != os.CLD_STOPPED and found.si_status != 0:
            tail = "\n".join(self.log.read_text("utf-8", "replace").splitlines()[-5:])
            sys.exit(f"the training of {self.name} failed:\n{tail}")

    def mark(self) -> None:
        """Note how many steps it has taken."""
        self.points.append((self.seconds, struct.unpack("q", self.counter.read_bytes())[0]))

    def train(self, seconds: float) -> None:
        """Let it go on for so long, or to its end."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGCONT)
        if select.select([self.report], [], [], seconds)[0]:
            line = os.read(self.report, 4096)
            if not line:
                self.wait_halted()
                sys.exit(f"the training of {self.name} ended early")
            self.end = json.loads(line)
            self.seconds += self.end["at"] - began
            self.points.append((self.seconds, self.end["steps"]))
            self.process.wait()
            return
        self.process.send_signal(signal.SIGSTOP)
        self.wait_halted()
        self.seconds += time.monotonic() - began
        self.mark()

    def seconds_at(self, step: float) -> float:
        """Seconds that it had taken at this step."""
        for (at, first), (later, last) in zip(self.points, self.points[1:], strict=False):
            if last >= step > first:
                return at + (later - at) * (step - first) / (last - first)
        return 0.0


def start(name: str, folders: str, options: list[str], folder: Path, skip: int) -> Version:
    """Start a training."""
    paths = [str(Path(path).resolve()) for path in folders.split(":")]
    ours, theirs = os.pipe()
    log, counter = folder / f"{name}.txt", folder / f"{name}.steps"
    counter.write_bytes(bytes(8))
    environment = {
        **os.environ, "PYTHONPATH": ":".join(paths), "SPLATWIZARD_CACHE": f"{paths[0]}.cache", REPORT: str(theirs),
        STEPS: str(counter), SKIP: str(skip),
    }  # fmt: skip
    command = [sys.executable, __file__, "train", *options, "--out", str(folder / name)]
    with log.open("wb") as file:
        process = subprocess.Popen(
            command, env=environment, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, pass_fds=[theirs]
        )
    os.close(theirs)
    return Version(name, process, ours, log, counter)


def train_in_slices() -> None:
    """Run `sw` in this process; halt after so many steps of the first stage, and end where that does."""
    from splatwizard_core.training.trainer import Trainer

    named = "run_step" if hasattr(Trainer, "run_step") else "_run_step"  # as it was in 0.2
    run, run_step = Trainer.run, getattr(Trainer, named)
    skip, taken = int(os.environ[SKIP]), 0
    with open(os.environ[STEPS], "r+b") as file:
        counter = mmap.mmap(file.fileno(), 8)

    def run_and_count(trainer: Any, *args: Any, **kwargs: Any) -> Any:
        nonlocal taken
        if taken == skip:
            _wait_for_gpu()
            os.kill(os.getpid(), signal.SIGSTOP)
        found = run_step(trainer, *args, **kwargs)
        taken += 1
        struct.pack_into("q", counter, 0, taken)
        return found

    def run_to_the_end(trainer: Any, *args: Any, **kwargs: Any) -> None:
        run(trainer, *args, **kwargs)
        state = getattr(trainer, "state", None) or trainer  # before 0.3 the trainer had it all
        if state.step < state.stage.iterations and not state.stopped:
            return
        _wait_for_gpu()
        end = {"at": time.monotonic(), "steps": state.step, "rows": state.model.num_rows}
        os.write(int(os.environ[REPORT]), json.dumps(end).encode())
        os._exit(0)  # no checkpoint is written while another version trains

    Trainer.run = run_to_the_end  # type: ignore[method-assign]
    setattr(Trainer, named, run_and_count)
    runpy.run_module("splatwizard_core", run_name="__main__", alter_sys=True)


def _wait_for_gpu() -> None:
    import torch

    if torch.cuda.is_available():
        torch.cuda.synchronize()


def compare(versions: dict[str, str], args: argparse.Namespace, seed: int) -> Iterator[tuple[str, list[Version]]]:
    """Train each once by each method with this seed, in turns; yield the methods and what was found of each."""
    options = ["--scene", args.scene, "--preset", args.preset, "--device", args.device, "--seed", str(seed)]
    options += [part for assignment in args.set for part in ("--set", assignment)]
    options += ["--set", "checkpoint_every=1000000000"]
    with tempfile.TemporaryDirectory() as folder:
        running: dict[str, list[Version]] = {}
        try:
            for asked in args.method.split(","):
                method, _, steps = asked.partition("@")
                own = ["--method", method, *options, *(["--set", f"iterations={steps}"] if steps else [])]
                place = Path(folder) / method
                place.mkdir()
                running[method] = [start(n, folders, own, place, args.skip) for n, folders in versions.items()]
            for version in (v for found in running.values() for v in found):
                version.wait_halted()
                if version.process.poll() is not None:
                    sys.exit(f"{version.name} ended within {args.skip} steps")
                version.mark()
            for method, found in running.items():
                while left := [v for v in found if v.end is None]:
                    if args.seconds and sum(v.seconds for v in found) >= args.seconds:
                        break
                    for version in left:
                        version.train(args.slice)
                for version in found:
                    version.process.kill()
                yield method, found
        finally:
            for version in (v for found in running.values() for v in found):
                version.process.kill()
                version.process.wait()
                os.close(version.report)


def times_as_fast(base: Version, version: Version) -> tuple[int, float, float]:
    """Return the last step that both took, how much faster to that step, and the median of that over parts."""
    first, last = base.points[0][1], min(base.points[-1][1], version.points[-1][1])
    edges = [first + (last - first) * i / PARTS for i in range(PARTS + 1)]
    ours, theirs = ([v.seconds_at(edge) for edge in edges] for v in (version, base))
    parts = [(b - a) / (d - c) for a, b, c, d in zip(theirs, theirs[1:], ours, ours[1:], strict=False) if d > c]
    return last, theirs[-1] / ours[-1], statistics.median(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("versions", nargs="+", metavar="NAME=FOLDER", help="the first is what others are compared with")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--method", default="3dgs", help="or several, NAME[@STEPS],... (default: 3dgs)")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", default="0", help="comma list (default: 0)")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--slice", type=float, default=0.5, metavar="S", help="seconds at a time (default: 0.5)")
    parser.add_argument("--skip", type=int, default=0, metavar="N", help="steps before the first slice (default: 0)")
    parser.add_argument("--seconds", type=float, metavar="S", help="of all versions of a method together, then stop")
    args = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))  # halted trainings do not end by themselves
    versions: dict[str, str] = {}
    for text in args.versions:
        name, equals, folders = text.partition("=")
        if not name or not equals or not all(Path(folder).is_dir() for folder in folders.split(":")) or "/" in name:
            parser.error(f"'{text}' is not NAME=FOLDER with folders that exist")
        versions[name] = folders
    print(f"{args.method}, {args.scene}, preset {args.preset}, turns of {args.slice:g} s", flush=True)
    for seed in map(int, args.seeds.split(",")):
        for method, found in compare(versions, args, seed):
            for version in found:
                last, whole, median = times_as_fast(found[0], version)
                rows = "" if version.end is None else f", {version.end['rows']:,} primitives at the end"
                took = f"{version.seconds_at(last):7.2f} s   {whole:5.3f} times as fast, median of parts {median:5.3f}"
                print(f"  {method:9} seed {seed}  {version.name:12} {took}   {last:,} steps{rows}", flush=True)


if __name__ == "__main__":
    if REPORT in os.environ and sys.argv[1:2] == ["train"]:
        train_in_slices()
    else:
        main()
