"""A process of a sweep, as a worker of Ray runs it."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from collections.abc import Mapping

PATIENCE_SECONDS = 70.0  # more than a process gives itself to write its checkpoint


def work(command: list[str], log: str, directory: str, variables: Mapping[str, str]) -> tuple[int, str]:
    """Run a process in a directory, its output appended to `log`; return its exit status and the machine.

    It ends with the worker: its standard input is a pipe that the worker holds. Ray has set the number of threads and
    the visible GPUs in the environment; `variables` are added to it.
    """
    with open(log, "ab") as output:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, cwd=directory,
            env={**os.environ, **variables},
        )  # fmt: skip
    try:
        return process.wait(), socket.gethostname()
    finally:  # cancelled, most likely
        if process.stdin is not None:
            process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE_SECONDS)
