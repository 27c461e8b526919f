"""Tables in Markdown, a line a row; None is a dash."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any


def head(cells: Sequence[str]) -> list[str]:
    return [line(cells), line(["---"] * len(cells))]


def line(cells: Iterable[Any]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    return "-" if value is None else f"{value:+.1f}"
