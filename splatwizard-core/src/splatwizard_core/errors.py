"""Every error a user may see, each with the facts as attributes and the process exit status it leads to.

A message says what is wrong (with the value), where, and what to do, in one or two lines.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterable
from pathlib import Path

from splatwizard_native import ForeseenError


class SplatwizardError(ForeseenError):
    """Base of all errors of ours that are raised on purpose."""


class UserInputError(SplatwizardError):
    """Wrong input: a path, key, value, scene or file. Exit status 2."""

    exit_status = 2


def no_file(path: Path) -> str:
    """Say why there is no file to read, for after its name: nothing is there, or what is has no size and no end."""
    if path.exists() and not path.is_dir():
        return "no file but a pipe or a device: write what comes out of it into a file first"
    return "there is no such file"


class ConfigError(UserInputError):
    """A configuration key or value is unknown or out of bounds."""

    def __init__(self, message: str, *, key: str | None = None) -> None:
        super().__init__(message)
        self.key = key


def _in_one_line(message: str) -> str:
    """A message in which names and values from a stranger's file are shown escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in message)


class SceneError(UserInputError):
    """A scene folder cannot be read or makes no sense."""

    def __init__(self, message: str, *, path: str | None = None) -> None:
        super().__init__(_in_one_line(message))
        self.path = path


class BitstreamError(UserInputError):
    """A file is damaged, truncated, hostile or of an unknown version."""

    def __init__(self, message: str, *, section: str | None = None) -> None:
        super().__init__(_in_one_line(message))
        self.section = section


class ShapeError(UserInputError):
    """A tensor does not have the shape, dtype or device that a function documents."""

    def __init__(self, message: str, **_: object) -> None:  # `actual` and `expected` of 0.2, which nothing read
        super().__init__(message)


class PluginError(UserInputError):
    """A plugin is missing, broken, or collides with another one.

    kind, name  what was asked for and is not there, if that is what happened
    """

    def __init__(self, message: str, *, kind: str | None = None, name: str | None = None) -> None:
        super().__init__(message)
        self.kind, self.name = kind, name


class CapabilityError(UserInputError):
    """Nothing installed offers what was asked for."""

    def __init__(self, message: str, *, missing: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.missing = frozenset(missing)


class CheckpointError(UserInputError):
    """A checkpoint is damaged or belongs to another plan or configuration."""


class NothingToDo(UserInputError):  # noqa: N818 (the specification names it)
    """A run is asked to resume at or past its last step."""


class RunLockedError(UserInputError):
    """Another process is writing into this run directory, or may be."""


class TaskSignatureError(SplatwizardError):
    """A schedule task asks for an argument that cannot be supplied."""


class TaskError(SplatwizardError):
    """A schedule task raised; the cause is chained."""

    def __init__(self, stage: str, step: int, task: str, cause: BaseException) -> None:
        told = f"{cause}" if isinstance(cause, UserInputError) else f"{type(cause).__name__}: {cause}"
        super().__init__(f"task '{task}' ({stage}) failed at step {step}: {told}")
        if isinstance(cause, UserInputError):
            self.exit_status = cause.exit_status
        self.stage, self.step, self.task = stage, step, task


class TrainingDiverged(SplatwizardError):  # noqa: N818 (the specification names it)
    """The loss is not finite."""

    def __init__(self, step: int, camera: str, part: str, value: float) -> None:
        super().__init__(
            f"training diverged at step {step}: loss part '{part}' is {value} on view '{camera}'; "
            "lower the learning rates or inspect that view"
        )
        self.step, self.camera, self.part, self.value = step, camera, part, value


class EmptyModel(SplatwizardError):  # noqa: N818 (the specification names it)
    """Pruning removed every primitive."""

    def __init__(self, step: int) -> None:
        super().__init__(f"no primitive is left after pruning at step {step}; lower the pruning thresholds")
        self.step = step


FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file may not grow that large here (file system, or `ulimit -f`)",
}
"""Error number of a disk that takes no more -> reason for the message."""


class DiskFullError(ForeseenError):
    """There is no space for a file; what stood in its place still does.

    path    of the file
    reason  what the system says
    wanted, free    bytes, if known
    """

    def __init__(self, path: str, reason: str, wanted: int | None = None, free: int | None = None) -> None:
        figures = _figures(("bytes wanted", wanted), ("free", free))
        super().__init__(
            f"{path}: {reason}{f' ({figures})' if figures else ''}; nothing half-written was kept. "
            "Make space and give the same command again: a run goes on from what is there"
        )
        self.path, self.reason, self.wanted, self.free = path, reason, wanted, free


class DeviceMemoryError(ForeseenError):
    """A GPU has too little memory left.

    wanted, free, total     bytes, if known
    """

    def __init__(
        self, doing: str, advice: str, wanted: int | None = None, free: int | None = None, total: int | None = None
    ) -> None:
        figures = _figures(("bytes wanted at once", wanted), ("bytes free", free), ("bytes in all", total))
        super().__init__(f"the GPU has too little memory for {doing} ({figures or 'no figures'}); {advice}")
        self.wanted, self.free, self.total = wanted, free, total


def out_of_memory(error: Exception, doing: str, advice: str) -> DeviceMemoryError:
    """Return the error that says what torch's out-of-memory error does, and what was being done: counts, resolution."""
    import torch

    found = re.search(r"allocate ([\d.]+) (bytes|KiB|MiB|GiB)", str(error))
    units = {"bytes": 1, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
    wanted = None if found is None else round(float(found[1]) * units[found[2]])
    free, total = torch.cuda.mem_get_info() if torch.cuda.is_available() else (None, None)
    return DeviceMemoryError(doing, advice, wanted, free, total)


def _figures(*counts: tuple[str, int | None]) -> str:
    """`1,024 bytes wanted, 12 free`, of what is known."""
    return ", ".join(f"{count:,} {what}" for what, count in counts if count is not None)
