"""Seconds and memory of the stages of one compression."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field


@dataclass
class Stages:
    """Seconds by name of the stage, summed where it comes again."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Count the time of a block."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def rounded(self) -> dict[str, float]:
        """Seconds to the millisecond, and their sum as `total`."""
        found = {name: round(value, 3) for name, value in self.seconds.items()}
        return {**found, "total": round(sum(self.seconds.values()), 3)}
