"""The executor `ray`: a task of a Ray cluster for each process of a sweep.

All nodes must see the output folder, the scenes and this Python under the same paths. A process that is lost with its
node is reported so; the sweep starts it again, on another node, from its last checkpoint.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from splatwizard_core.api import UserInputError
from sw_bench.ray_work import PATIENCE_SECONDS, work

LOST = -1000  # by the contract of executors
KILLED = -9  # SIGKILL
# Exceptions of Ray that say that the worker or its node is gone.
LOSSES = ("WorkerCrashedError", "NodeDiedError", "LocalRayletDiedError", "ObjectLostError")
SENT = "SPLATWIZARD_"  # environment variables that a process gets from the sweep


class RayOptions(BaseModel):
    """Options of the executor `ray`."""

    model_config = ConfigDict(extra="forbid")

    address: str = Field("auto", description="of the cluster; auto: the one on this machine; local: one is started")
    cores: int = Field(4, ge=1, description="CPU cores of a process")
    gpus: float = Field(0, ge=0, description="GPUs of a process; 0.5: two processes on each")
    memory_gb: float = Field(0, ge=0, description="memory of a process, GB, for Ray's account; 0: any")

    @field_validator("gpus")
    @classmethod
    def _whole_above_one(cls, value: float) -> float:
        if value > 1 and value != int(value):
            raise ValueError("a part of one GPU, or a whole number")
        return value


class RayExecutor:
    """Runs processes as tasks of Ray."""

    Options = RayOptions

    def __init__(self, options: RayOptions, site: Any) -> None:
        try:
            import ray
        except ImportError:
            raise UserInputError("executor 'ray' needs Ray: pip install 'sw-bench[ray]'") from None
        self._ray: Any = ray
        self._options = options
        self._tasks: dict[Any, tuple[str, Path]] = {}
        self._owns = not ray.is_initialized()
        if self._owns:
            address = None if options.address == "local" else options.address
            try:
                ray.init(address=address, log_to_driver=False, configure_logging=False)
            except (ConnectionError, ValueError) as error:
                told = " ".join(str(error).split())
                raise UserInputError(
                    f"no Ray cluster at '{options.address}': start one (`ray start --head`), name it (-o address=...), "
                    f"or take -o address=local: {told:.200}"
                ) from None
        # A process that is lost is started again by the sweep, which counts and tells it.
        self._remote = ray.remote(max_retries=0)(work).options(
            num_cpus=options.cores, num_gpus=options.gpus, memory=int(options.memory_gb * 1e9) or None, name="sw-bench"
        )
        if not self._fits():
            more = [f"{n:g} {unit}" for n, unit in ((options.gpus, "GPUs"), (options.memory_gb, "GB of memory")) if n]
            asked = " and ".join([f"{options.cores} cores", *more])
            self._disconnect()
            raise UserInputError(
                f"no node of the Ray cluster has {asked}: set -o cores=N, -o gpus=N or -o memory_gb=N to what "
                "nodes have"
            )

    @property
    def slots(self) -> int | None:
        """Processes that the cluster has room for now, one at least: nodes come and go."""
        return max(1, sum(map(self._places, self._nodes())))

    def _nodes(self) -> list[dict[str, float]]:
        return [node["Resources"] for node in self._ray.nodes() if node["Alive"]]

    def _places(self, node: dict[str, float]) -> int:
        places = int(node.get("CPU", 0) // self._options.cores)
        if self._options.gpus:
            places = min(places, int(node.get("GPU", 0) / self._options.gpus))
        memory = int(self._options.memory_gb * 1e9)
        return min(places, int(node.get("memory", 0) // memory)) if memory else places

    def _fits(self) -> bool:
        return any(map(self._places, self._nodes()))

    def start(self, ticket: str, command: Sequence[str], log: Path) -> None:
        """Hand a process to the cluster."""
        variables = {name: value for name, value in os.environ.items() if name.startswith(SENT)}
        self._tasks[self._remote.remote(list(command), str(log), os.getcwd(), variables)] = ticket, log

    def ended(self, timeout: float) -> list[tuple[str, int, str]]:
        """Return the processes that ended, waiting up to `timeout` seconds for the first."""
        if not self._tasks:
            time.sleep(timeout)
            return []
        ready, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=timeout)
        more, _ = self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=0)
        found = []
        for task in dict.fromkeys([*ready, *more]):
            ticket, log = self._tasks.pop(task)
            found.append((ticket, *self._result(task, log)))
        return found

    def _result(self, task: Any, log: Path) -> tuple[int, str]:
        try:
            status, machine = self._ray.get(task)
        except self._ray.exceptions.RayError as error:
            status, reason = status_of(error)
            if reason:
                with open(log, "a", encoding="utf-8") as file:
                    file.write(f"error: {reason}\n")
            return status, ""
        return int(status), str(machine)

    def stop(self) -> None:
        """Cancel all tasks, and wait until their processes have written their checkpoints."""
        for task in self._tasks:
            with contextlib.suppress(Exception):  # one that has just ended
                self._ray.cancel(task, force=False)
        if self._tasks:
            self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=PATIENCE_SECONDS)
        self._tasks.clear()
        self._disconnect()

    def _disconnect(self) -> None:
        if self._owns:
            self._ray.shutdown()


def status_of(error: Exception) -> tuple[int, str]:
    """Return the exit status for an exception of Ray, and the reason where the status does not tell it."""
    names = [each.__name__ for each in type(error).__mro__]
    if "OutOfMemoryError" in names:
        return KILLED, ""
    if any(name in LOSSES for name in names):
        return LOST, ""
    cause = getattr(error, "cause", None) or error  # of what was raised in the task
    told = " ".join(str(cause).split())
    return 1, f"{type(cause).__name__}: {told:.250}"
