"""Targets of a compressed file: its size, its quality, or how much smaller it is."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from splatwizard_core.api import UserInputError, parse_size

LEAST_SHARE = 0.99
"""Share of the target that a file fills at least, where the source can."""
QUALITY_MARGIN = 0.2
"""Decibels by which a file may be better than asked for."""
USUAL_QUALITY = 40.0
"""dB against the source, where nothing is asked for."""
QUALITIES = (15.0, 70.0)


@dataclass(frozen=True)
class Target:
    """One of the two is None.

    size        bytes that the file may have at most
    quality     dB against the source that it has at least, by cameras that were held out
    """

    size: int | None = None
    quality: float | None = None

    @classmethod
    def of(
        cls, size: str | int | None, quality: str | float | None, ratio: str | float | None, source_bytes: int | None
    ) -> Target:
        """Return what is asked for, at most one of three; else 40 dB. Raises UserInputError.

        source_bytes    of the source file, which `ratio` divides
        """
        if sum(each is not None for each in (size, quality, ratio)) > 1:
            raise UserInputError("a target is a size, a quality or a ratio: give one of them")
        if size is not None:
            return cls(size=parse_size(size))
        if ratio is not None:
            factor = _number(ratio, "ratio", 1, 1e6)
            if source_bytes is None:
                raise UserInputError("a ratio needs a file whose size it divides: give a size")
            return cls(size=int(source_bytes / factor))
        return cls(quality=USUAL_QUALITY if quality is None else parse_quality(quality))

    def __str__(self) -> str:
        return f"{self.size:,} bytes" if self.size is not None else f"{self.quality:g} dB"


def parse_quality(text: str | float) -> float:
    """Return decibels of `45dB` or a number. Raises UserInputError."""
    spelled = re.fullmatch(r"(.*?)\s*(?:dB)?\s*", str(text), re.IGNORECASE | re.DOTALL)
    return _number(spelled[1] if spelled else text, "quality", *QUALITIES, shown=text)


def _number(value: str | float, what: str, low: float, high: float, *, shown: str | float | None = None) -> float:
    try:
        found = float(value)
    except ValueError:
        found = math.nan
    if not low <= found <= high:
        raise UserInputError(f"{what} '{value if shown is None else shown}' must be a number in {low:g} .. {high:g}")
    return found
