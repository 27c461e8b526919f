"""Errors of native modules; each message says what is wrong and what to do."""

import re

MAX_WORD, MAX_MESSAGE = 1000, 8000
"""Characters of a word and of a message that are shown whole; no path that a system takes by name is much longer."""


def shortened(message: str) -> str:
    """A message in which only the ends are left of what is very long, such as a key of a stranger's file."""

    def ends(text: str, most: int) -> str:
        cut = f"{text[: most // 5]}... ({len(text):,} characters) ...{text[-most // 20 :]}"
        return text if len(text) <= most else cut

    return ends(re.sub(rf"(?<!\S)\S{{{MAX_WORD},}}", lambda word: ends(word[0], MAX_WORD), message), MAX_MESSAGE)


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
