"""The finding of a check: what was looked at, how it is, and what mends it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

State = Literal["ok", "missing", "broken"]


@dataclass(frozen=True)
class Check:
    """One finding about the machine; a registered check is a callable () -> list[Check].

    group, name     what was tested: ("metrics", "LPIPS package")
    state           ok: it was tried and works; missing: it is not there; broken: it is there and does not work
    detail          what is there, or why it does not work, in one line
    mend            one command, or one sentence that says what to do; None if there is nothing to do
    needed          `sw run` on the default scene cannot run without it; counts only from the diagnosis itself
    facts           numbers and versions behind `detail`, plain values

    Raises ValueError for any other state.
    """

    group: str
    name: str
    state: State
    detail: str
    mend: str | None = None
    needed: bool = False
    facts: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.state not in get_args(State):
            raise ValueError(f"the state of '{self.name}' is {self.state!r}; it must be one of {get_args(State)}")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as they are printed and passed between processes."""
        return dataclasses.asdict(self)
