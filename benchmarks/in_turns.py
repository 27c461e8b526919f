"""Seconds that versions of the code take for one training, in turns on one machine: its speed changes, for both alike.

    python benchmarks/in_turns.py before=/tmp/before after=/tmp/after --scene DATA/room --preset paper --device cuda

A version is NAME=FOLDER[:FOLDER...], where Python finds its packages (`pip install --target FOLDER ...`). All begin and
are halted where their first stage begins to train, compiled kernels and scene in memory. Then each trains for a slice
of time while the others are halted (SIGSTOP), to the end of that stage. Seconds are those of its slices: pictures that
are read on the way count, checkpoints and the file at the end do not, there are none. Every version has a cache of its
own for compiled kernels, FOLDER.cache beside its first folder. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPORT = "IN_TURNS_REPORT"  # environment: descriptor to which a training writes how it ended


@dataclass
class Version:
    """One training under way."""

    name: str
    process: subprocess.Popen[bytes]
    report: int
    log: Path
    seconds: float = 0.0
    end: dict[str, Any] | None = None

    def wait_halted(self) -> None:
        """Return once it is halted or has ended as planned; leave the program if it failed."""
        found = os.waitid(os.P_PID, self.process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        if found is not None and found.si_code != os.CLD_STOPPED and found.si_status != 0:
            tail = "\n".join(self.log.read_text("utf-8", "replace").splitlines()[-5:])
            sys.exit(f"the training of {self.name} failed:\n{tail}")

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
            self.process.wait()
            return
        self.process.send_signal(signal.SIGSTOP)
        self.wait_halted()
        self.seconds += time.monotonic() - began


def start(name: str, folders: str, options: list[str], folder: Path) -> Version:
    """Start a training and return when it is about to begin."""
    paths = [str(Path(path).resolve()) for path in folders.split(":")]
    ours, theirs = os.pipe()
    log = folder / f"{name}.txt"
    environment = {
        **os.environ, "PYTHONPATH": ":".join(paths), "SPLATWIZARD_CACHE": f"{paths[0]}.cache", REPORT: str(theirs),
    }  # fmt: skip
    command = [sys.executable, __file__, "train", *options, "--out", str(folder / name)]
    with log.open("wb") as file:
        process = subprocess.Popen(
            command, env=environment, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, pass_fds=[theirs]
        )
    os.close(theirs)
    version = Version(name, process, ours, log)
    version.wait_halted()
    if process.poll() is not None:
        sys.exit(f"{name} ended before it trained")
    return version


def train_in_slices() -> None:
    """Run `sw` in this process; halt where training begins, and end where its first stage does."""
    from splatwizard_core.training.trainer import Trainer

    run = Trainer.run
    halted = False

    def run_in_slices(trainer: Any, *args: Any, **kwargs: Any) -> None:
        nonlocal halted
        if not halted:
            halted = True
            os.kill(os.getpid(), signal.SIGSTOP)
        run(trainer, *args, **kwargs)
        state = getattr(trainer, "state", trainer)  # before 0.3 the trainer had it all
        if state.step < state.stage.iterations and not state.stopped:
            return
        import torch

        if torch.cuda.is_available():
            torch.cuda.synchronize()
        end = {"at": time.monotonic(), "steps": state.step, "rows": state.model.num_rows}
        os.write(int(os.environ[REPORT]), json.dumps(end).encode())
        os._exit(0)  # no checkpoint is written while another version trains

    Trainer.run = run_in_slices  # type: ignore[method-assign]
    runpy.run_module("splatwizard_core", run_name="__main__", alter_sys=True)


def compare(versions: dict[str, str], args: argparse.Namespace, seed: int) -> dict[str, Version]:
    """Train each once with this seed, in turns."""
    options = ["--method", args.method, "--scene", args.scene, "--preset", args.preset]
    options += ["--device", args.device, "--seed", str(seed)]
    options += [part for assignment in args.set for part in ("--set", assignment)]
    options += ["--set", "checkpoint_every=1000000000"]
    with tempfile.TemporaryDirectory() as folder:
        running: dict[str, Version] = {}
        try:
            for name, folders in versions.items():
                running[name] = start(name, folders, options, Path(folder))
            while left := [v for v in running.values() if v.end is None]:
                for version in left:
                    version.train(args.slice)
        finally:
            for version in running.values():
                version.process.kill()
                version.process.wait()
                os.close(version.report)
    return running


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("versions", nargs="+", metavar="NAME=FOLDER", help="the first is what others are compared with")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--method", default="3dgs", help="(default: 3dgs)")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", default="0", help="comma list (default: 0)")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--slice", type=float, default=0.5, metavar="S", help="seconds at a time (default: 0.5)")
    args = parser.parse_args()
    versions: dict[str, str] = {}
    for text in args.versions:
        name, equals, folders = text.partition("=")
        if not name or not equals or not all(Path(folder).is_dir() for folder in folders.split(":")) or "/" in name:
            parser.error(f"'{text}' is not NAME=FOLDER with folders that exist")
        versions[name] = folders
    print(f"{args.method}, {args.scene}, preset {args.preset}, turns of {args.slice:g} s", flush=True)
    for seed in map(int, args.seeds.split(",")):
        found = compare(versions, args, seed)
        base = next(iter(found.values())).seconds
        for name, version in found.items():
            assert version.end is not None
            print(
                f"  seed {seed}  {name:12} {version.seconds:7.2f} s   {base / version.seconds:5.3f} times as fast   "
                f"{version.end['steps']:,} steps, {version.end['rows']:,} primitives at the end",
                flush=True,
            )


if __name__ == "__main__":
    if REPORT in os.environ and sys.argv[1:2] == ["train"]:
        train_in_slices()
    else:
        main()
