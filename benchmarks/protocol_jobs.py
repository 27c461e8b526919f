"""Processes of `sw` side by side, each known by the file that says it has ended well."""

from __future__ import annotations

import argparse
import itertools
import math
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

SW = [sys.executable, "-m", "splatwizard_core"]


@dataclass(frozen=True)
class Job:
    """A process: its name, its words after `sw`, and the file whose presence says that it has ended well.

    stdout  where what it prints goes; None: its log alone
    """

    name: str
    words: tuple[str, ...]
    done: Path
    stdout: Path | None = None


def run_jobs(jobs: Sequence[Job], args: argparse.Namespace) -> Counter[str]:
    """Run processes side by side, those whose result is not there; say what became of each."""
    gpus = itertools.cycle(args.gpus.split(",")) if args.gpus else None
    states: Counter[str] = Counter()
    lock = threading.Lock()

    def work(job: Job) -> None:
        left = math.inf if args.deadline is None else args.deadline - (time.monotonic() - args.begun)
        if job.done.is_file():
            state, seconds = "was there", 0.0
        elif left <= 0:
            state, seconds = "unfinished", 0.0
        else:
            with lock:
                gpu = {} if gpus is None else {"CUDA_VISIBLE_DEVICES": next(gpus)}
            began = time.monotonic()
            state = _process(job, {"OMP_NUM_THREADS": str(args.threads), **os.environ, **gpu}, left)
            seconds = time.monotonic() - began
        with lock:
            states[state] += 1
            print(f"{state}: {job.name}" + (f", {seconds:.0f} s" if seconds else ""), flush=True)

    with ThreadPoolExecutor(args.gsc_jobs) as pool:
        list(pool.map(work, jobs))
    return states


def _process(job: Job, environment: dict[str, str], left: float) -> str:
    """Run one; its standard output is kept only if it ends well."""
    log = job.done.with_name(f"{job.done.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    printed = log if job.stdout is None else job.stdout.with_name(f"{job.stdout.name}.part")
    with log.open("wb") as err, open(os.devnull, "wb") if job.stdout is None else printed.open("wb") as out:
        try:
            status = subprocess.run(
                [*SW, *job.words], stdout=out, stderr=err, env=environment, stdin=subprocess.DEVNULL,
                timeout=None if left == math.inf else left,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            return "unfinished"
    if status != 0:
        lines = log.read_text(errors="replace").strip().splitlines()
        return f"failed ({lines[-1][:200] if lines else f'status {status}'})"
    if job.stdout is not None:
        printed.replace(job.stdout)
    return "ran"
