"""Base of typed blocks of figures, in the result record and elsewhere, and the marks of their fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel, ConfigDict

MemoryKind = Literal["cuda", "rss"]
"""Kind of memory that was measured: torch's allocator, or the growth of the resident set."""


class Block(BaseModel):
    """Base of every block: no number that is not finite; keys that only another release has are passed over."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False, populate_by_name=True)


@dataclass(frozen=True)
class WhyNull:
    """Marks a field with the reason of its null, where whoever measured it told none."""

    reason: str


@dataclass(frozen=True)
class Shown:
    """Marks a field that the report of a run shows among times and memory, its description beside it.

    unit    "s", "bytes", or "" for a count
    """

    label: str
    unit: Literal["s", "bytes", ""] = ""
