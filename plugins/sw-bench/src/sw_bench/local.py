"""The executor `local`: processes of this machine, one per GPU, or a share of the cores each."""

from __future__ import annotations

import os
import queue
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from splatwizard_core.api import UserInputError
from splatwizard_native import available_cores
from sw_bench.executor import PATIENCE_SECONDS, Site

CORES_EACH = 4  # on a CPU: a training scales well up to about four cores


class LocalOptions(BaseModel):
    """Options of the executor `local`."""

    model_config = ConfigDict(extra="forbid")

    workers: int = Field(0, ge=0, description="processes at a time; 0: one per GPU, or one for each four cores")
    per_gpu: int = Field(1, ge=1, description="processes on each GPU")


@dataclass
class Running:
    """A process and the place that it takes."""

    process: subprocess.Popen[bytes]
    gpu: str


class LocalExecutor:
    """Runs processes on this machine, each with its share of the cores and, on CUDA, a GPU."""

    Options = LocalOptions

    def __init__(self, options: LocalOptions, site: Site) -> None:
        cores = available_cores()
        gpus = visible_gpus() if site.device == "cuda" else []
        places = gpus * options.per_gpu or [""] * max(1, cores // CORES_EACH)
        if options.workers:
            if not gpus and options.workers > cores:
                raise UserInputError(f"workers = {options.workers}: this machine has {cores} cores: at most so many")
            places = [(gpus or [""])[i % max(1, len(gpus))] for i in range(options.workers)]
        self.slots: int | None = len(places)
        self._free = places[::-1]
        # More threads than cores wait for one another in loops.
        self.threads = max(1, cores // len(places))
        self._running: dict[str, Running] = {}
        self._ended: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()

    def start(self, ticket: str, command: Sequence[str], log: Path) -> None:
        """Start a process; its group is its own, so that Ctrl-C at the terminal reaches the sweep alone."""
        gpu = self._free.pop()
        with open(log, "ab") as output:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
                env=environment(self.threads, gpu),
            )  # fmt: skip
        self._running[ticket] = Running(process, gpu)
        # The place is free the moment the process ends, and waiting for it takes nothing from those that run.
        threading.Thread(target=lambda: self._ended.put((ticket, process.wait())), name=ticket, daemon=True).start()

    def ended(self, timeout: float) -> list[tuple[str, int, str]]:
        """Return the processes that ended, waiting up to `timeout` seconds for the first."""
        found: list[tuple[str, int, str]] = []
        while self._running:
            try:
                ticket, status = self._ended.get(timeout=0 if found else timeout)
            except queue.Empty:
                break
            if ticket in self._running:  # else `stop` has seen to it
                gpu = self._let_go(ticket)
                found.append((ticket, status, f"GPU {gpu}" if gpu else ""))
        return found

    def stop(self) -> None:
        """Ask all processes to end, and wait until they have."""
        for running in self._running.values():
            assert running.process.stdin is not None
            running.process.stdin.close()  # which they take for Ctrl-C
        until = time.monotonic() + PATIENCE_SECONDS
        for running in self._running.values():
            try:
                running.process.wait(max(0.1, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                running.process.kill()
                running.process.wait()
        for ticket in list(self._running):
            self._let_go(ticket)

    def _let_go(self, ticket: str) -> str:
        """Take the place of a process that has ended back; return its GPU."""
        running = self._running.pop(ticket)
        self._free.append(running.gpu)
        if running.process.stdin is not None:
            running.process.stdin.close()
        return running.gpu


def environment(threads: int, gpu: str) -> Mapping[str, str]:
    """Return the environment of a process that has so many cores and one GPU ("": whatever there is)."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    found = {**os.environ, "OMP_NUM_THREADS": str(min(threads, int(asked)) if asked.isdecimal() else threads)}
    return found | ({"CUDA_VISIBLE_DEVICES": gpu} if gpu else {})


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    named = [gpu for gpu in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if gpu]
    if named:
        return named
    import torch

    return [str(i) for i in range(torch.cuda.device_count())]
