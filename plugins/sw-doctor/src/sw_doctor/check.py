"""One finding: what was looked at, how it is, and what mends it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

State = Literal["ok", "missing", "broken"]
SLOWLY = "slowly: the pure-torch reference draws, some hundred times slower than compiled kernels"


@dataclass(frozen=True)
class Check:
    """What one test found.

    group, name     what was tested: ("kernels", "sw_rasterizers")
    state           ok: it was tried and works; missing: it is not there; broken: it is there and does not work
    detail          what is there, or why it does not work, in one line
    mend            one command, or one sentence that says what to do; None if there is nothing to do
    needed          `sw run` on the demo scene cannot run without it
    facts           numbers and versions behind `detail`, plain values
    """

    group: str
    name: str
    state: State
    detail: str
    mend: str | None = None
    needed: bool = False
    facts: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as they are printed and passed between processes."""
        return dataclasses.asdict(self)


def one_line(text: object, limit: int = 300) -> str:
    """Text of a stranger (an exception, a compiler) as one line of bounded length."""
    words = " ".join(str(text).split())
    return words if len(words) <= limit else f"{words[:limit]} ..."


def gigabytes(size: float) -> str:
    """`1.5 GB`; two digits below ten, which are what matters when space runs out."""
    amount = size / 1e9
    return f"{amount:.2f} GB" if amount < 10 else f"{amount:,.0f} GB"
