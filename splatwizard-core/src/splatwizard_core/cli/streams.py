"""Streams of a command, which a shell may close or stop reading, and its requests to end."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator

from splatwizard_core.base.interrupt import ASKED_TO_END


def open_streams() -> None:
    """Let standard streams that the caller closed (`sw info x >&-`) lead to nowhere, and take every character.

    Else the next file that is opened takes the number of the closed one, and whoever prints writes into it; and a name
    that the terminal's encoding lacks would end the command.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            stream = open(descriptor, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 (as long as the process)
            setattr(sys, name, stream)
        if isinstance(stream, io.TextIOWrapper):
            # What cannot be shown is escaped. Bytes of a file name that are no text pass where UTF-8 lets them.
            passes = stream.errors == "surrogateescape" and codecs.lookup(stream.encoding).name == "utf-8"
            stream.reconfigure(errors="surrogateescape" if passes else "backslashreplace")


# C0 but tab and line feed, DEL, C1, and what turns the direction of writing: a terminal obeys these.
_ORDERS = {c: "\N{REPLACEMENT CHARACTER}" for c in [*range(32), *range(0x7F, 0xA0), *range(0x202A, 0x202F),
                                                   *range(0x2066, 0x206A)] if chr(c) not in "\t\n"}  # fmt: skip


def without_orders(text: str) -> str:
    """Text from a stranger's file or folder name that a terminal shows and does not obey."""
    return text.translate(_ORDERS)


def abandon_streams() -> None:
    """After a reader has gone: what is still buffered leads to nowhere, so that the interpreter ends without a word."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


@contextlib.contextmanager
def ended_like_ctrl_c() -> Iterator[None]:
    """In the block, a request to end (SIGTERM) or a terminal that closes (SIGHUP) does what Ctrl-C does.

    So a training that a cluster stops writes a checkpoint first, also where Ctrl-C itself is ignored, as it is for what
    a script starts in the background. What ignores SIGHUP already (`nohup`) goes on so.
    """
    main = threading.current_thread() is threading.main_thread()
    ended = [number for number in ASKED_TO_END if main and signal.getsignal(number) is signal.SIG_DFL]
    for number in ended:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number in ended:
            signal.signal(number, signal.SIG_DFL)
