"""Errors of native modules and of the machine; each message says what is wrong and what to do."""

from __future__ import annotations

import errno
import re

MAX_WORD, MAX_MESSAGE = 1000, 8000
"""Characters of a word and of a message that are shown whole; no path that a system takes by name is much longer."""


def shortened(message: str) -> str:
    """A message in which only the ends are left of what is very long, such as a key of a stranger's file."""

    def ends(text: str, most: int) -> str:
        cut = f"{text[: most // 5]}... ({len(text):,} characters) ...{text[-most // 20 :]}"
        return text if len(text) <= most else cut

    return ends(re.sub(rf"\S{{{MAX_WORD},}}", lambda word: ends(word[0], MAX_WORD), message), MAX_MESSAGE)


class ForeseenError(Exception):
    """Base of all errors raised on purpose: a command line prints them without a traceback.

    exit_status     of a process that ends with it
    """

    exit_status = 1

    def __str__(self) -> str:
        return shortened(super().__str__())


class NativeBuildError(ForeseenError):
    """A native module cannot be compiled or loaded."""


class CompilerMissingError(NativeBuildError):
    """There is no compiler on this machine."""


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
