"""The executor `slurm`: a job of a Slurm cluster for each process, through submitit (`pip install 'sw-bench[slurm]'`).

Compute nodes must see the output folder, the scenes and this Python under the same paths. A job that Slurm preempts, or
that reaches its time limit, lets its run write a checkpoint and goes back into the queue.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import write_json
from sw_bench.executor import LOST, PATIENCE_SECONDS, Site

FOLDER = ".slurm"  # in the output folder: what submitit writes
SUBMITTED = "submitted.json"  # in it: numbers of the jobs of a sweep that goes on, or was killed
MOMENT = 0.2
KILLED = 9  # SIGKILL
# The last two are of jobs on this machine.
STATES_OF_LOSS = ("NODE_FAIL", "BOOT_FAIL", "PREEMPTED", "REVOKED", "UNKNOWN", "INTERRUPTED", "FINISHED")


class SlurmOptions(BaseModel):
    """Options of the executor `slurm`."""

    model_config = ConfigDict(extra="forbid")

    cluster: Literal["slurm", "local", "debug"] = Field(
        "slurm", description="local and debug: submitit's processes on this machine, to try a plan"
    )
    minutes: int = Field(24 * 60, ge=1, description="time limit of a job; one that reaches it goes back into the queue")
    timeouts: int = Field(20, ge=0, description="how often it may")
    cores: int = Field(4, ge=1, description="CPU cores of a job")
    gpus: int = Field(0, ge=0, description="GPUs of a job")
    memory_gb: float | None = Field(None, gt=0, description="memory of a job, GB; none: the cluster's own")
    partition: str | None = Field(None, description="partition; none: the cluster's own")
    account: str | None = Field(None, description="account that pays")
    at_a_time: int = Field(0, ge=0, description="jobs in the queue at a time; 0: all")
    extra: dict[str, Any] = Field({}, description="further options of sbatch, such as extra.constraint")


@dataclass
class Work:
    """A process as submitit runs it on a node."""

    command: list[str]
    log: str
    _process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    def __call__(self) -> tuple[int, str]:
        """Run it; return its exit status and the machine."""
        with open(self.log, "ab") as output:
            self._process = subprocess.Popen(
                self.command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
            )
        try:
            # `wait` would hold the lock of the process, which `checkpoint` needs: a signal calls it in this thread.
            while (status := self._process.poll()) is None:
                time.sleep(MOMENT)
            return status, socket.gethostname()
        finally:
            self._end()

    def checkpoint(self) -> Any:
        """Let it write a checkpoint, and go back into the queue: submitit calls this when its time is up."""
        import submitit

        self._end()
        return submitit.helpers.DelayedSubmission(Work(self.command, self.log))

    def _end(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()  # which it takes for Ctrl-C
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(PATIENCE_SECONDS)


class SlurmExecutor:
    """Submits a job for each process."""

    Options = SlurmOptions

    def __init__(self, options: SlurmOptions, site: Site) -> None:
        try:
            import submitit
        except ImportError:
            raise UserInputError("executor 'slurm' needs submitit: pip install 'sw-bench[slurm]'") from None
        if options.cluster == "slurm" and shutil.which("sbatch") is None:
            raise UserInputError(
                "executor 'slurm': there is no sbatch here: start the sweep where jobs are submitted, or try it with "
                "-o cluster=local"
            )
        self.slots = options.at_a_time or None
        self._options, self._folder = options, site.out / FOLDER
        self._jobs: dict[str, Any] = {}
        self._logs: dict[str, Path] = {}
        self._executor = submitit.AutoExecutor(folder=self._folder / "%j", cluster=options.cluster,
                                               slurm_max_num_timeout=options.timeouts)  # fmt: skip
        self._executor.update_parameters(**self._parameters())

    def _parameters(self) -> dict[str, Any]:
        o = self._options
        asked = {"timeout_min": o.minutes, "cpus_per_task": o.cores, "gpus_per_node": o.gpus or None,
                 "mem_gb": o.memory_gb, "name": "sw-bench", "slurm_partition": o.partition,
                 "slurm_account": o.account, "slurm_additional_parameters": o.extra or None}  # fmt: skip
        return {name: value for name, value in asked.items() if value is not None}

    def start(self, ticket: str, command: Sequence[str], log: Path) -> None:
        """Submit a job; of the sweep before, which somebody killed, no job is left then."""
        if not self._jobs:
            self._cancel_those_before()
        self._jobs[ticket] = self._executor.submit(Work(list(command), str(log)))
        self._logs[ticket] = log
        self._note()

    def ended(self, timeout: float) -> list[tuple[str, int, str]]:
        """Return the jobs that ended; one that Slurm lost has the status LOST."""
        until = time.monotonic() + timeout
        while True:
            found = [
                (ticket, *self._result(job, self._logs[ticket]))
                for ticket, job in self._jobs.items() if self._is_done(job)
            ]  # fmt: skip
            for ticket, _, _ in found:
                del self._jobs[ticket], self._logs[ticket]
            if found:
                self._note()
            if found or not self._jobs or time.monotonic() >= until:
                return found
            time.sleep(MOMENT)

    def stop(self) -> None:
        """Cancel all jobs, and wait until they have written their checkpoints."""
        for job in self._jobs.values():
            with contextlib.suppress(Exception):  # one that has just ended
                job.cancel(check=False)
        until = time.monotonic() + PATIENCE_SECONDS
        while any(not job.done() for job in self._jobs.values()) and time.monotonic() < until:
            time.sleep(MOMENT)
        self._jobs.clear()
        self._note()

    def _is_done(self, job: Any) -> bool:
        if self._options.cluster == "debug":
            job.wait()
        return bool(job.done())

    def _result(self, job: Any, log: Path) -> tuple[int, str]:
        error = job.exception()
        if error is not None:
            place = f"job {job.job_id}"
            status, reason = _status_of(error, str(job.state))
            if reason:
                with open(log, "a", encoding="utf-8") as file:
                    file.write(f"error: {place}: {reason}\n")
            return status, place
        status, machine = job.result()
        return int(status), str(machine)

    def _note(self) -> None:
        """Keep the numbers of the jobs, for the next sweep to cancel if this one is killed."""
        self._folder.mkdir(parents=True, exist_ok=True)
        write_json(self._folder / SUBMITTED, [str(job.job_id) for job in self._jobs.values()])

    def _cancel_those_before(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            left = [str(number) for number in json.loads((self._folder / SUBMITTED).read_text("utf-8"))]
            if left and self._options.cluster == "slurm":
                subprocess.run(["scancel", *left], check=False)


def _status_of(error: Exception, state: str) -> tuple[int, str]:
    """Return the exit status for a job without a result, and the reason where the status does not tell it.

    state   of the job, as Slurm names it
    """
    if state.startswith("OUT_OF_ME"):
        return -KILLED, ""
    # The end of a traceback: what went wrong in Python on the node.
    told = [line for line in str(error).splitlines() if re.match(r"[A-Za-z_][\w.]*(Error|Exception|Exit)\b", line)]
    if told:
        return 1, told[-1]
    return (LOST, "") if state.startswith(STATES_OF_LOSS) else (1, f"no result, {state}")
