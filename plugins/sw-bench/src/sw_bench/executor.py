"""The contract of executors: where the processes of a sweep run. Any package may register one.

An executor is a class; `executor = "NAME"` of a plan chooses it, and the table `[options]` holds its options.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from pydantic import BaseModel


@dataclass(frozen=True)
class Site:
    """Facts that an executor is made with.

    out     the output folder, absolute; every machine of an executor sees it under the same name
    device  cpu or cuda: where the runs will compute; for other machines also auto
    """

    out: Path
    device: str


class Executor(Protocol):
    """Runs processes somewhere.

    Options     pydantic model of its options
    slots       processes that it runs at a time; more are not handed to it. None: it queues by itself
    """

    Options: ClassVar[type[BaseModel]]
    slots: int | None

    def __init__(self, options: Any, site: Site) -> None:
        """Get ready; raises UserInputError where that cannot be."""

    def start(self, ticket: str, command: Sequence[str], log: Path) -> None:
        """Start `command`, stdout and stderr appended to `log`, stdin open as long as this executor holds it."""

    def ended(self, timeout: float) -> list[tuple[str, int, str]]:
        """Return (ticket, exit status, where it ran) of processes that ended since the last call.

        Waits up to `timeout` seconds for the first. A negative status is the signal that killed the process; of one
        that was lost with its machine it is LOST; where its own machinery failed it is 1, and the last line of
        `log` says why: `error: ...`.
        """

    def stop(self) -> None:
        """Let all processes end as with Ctrl-C, and return when they have; called once, whatever happens."""


LOST = -1000
"""Status of a process whose machine is gone."""

PATIENCE_SECONDS = 70.0
"""Time for a process that is asked to end: more than it gives itself to write its checkpoint."""
