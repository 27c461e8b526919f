"""Clocks of a training loop: total time, and time per stage of a step."""

from __future__ import annotations

import torch

from splatwizard_core.base.memory import synchronize
from splatwizard_native import work_time

STAGES = ("pre", "render", "loss", "backward", "post", "optimize")
"""The five stages of a step; the third is timed in two halves."""


class LoopClock:
    """Wall clock of the loop minus housekeeping (evaluation, checkpoints, logs) and the loading of native modules.

    seconds     of the loop so far; starts at what an interrupted run had used
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self._seconds = seconds
        self._since: float | None = None

    @property
    def seconds(self) -> float:
        return self._seconds + (0.0 if self._since is None else work_time() - self._since)

    def start(self) -> None:
        """The loop begins, or goes on after housekeeping."""
        self._since = work_time()

    def stop(self) -> None:
        """Housekeeping inside the loop begins, or the loop ends."""
        self._seconds, self._since = self.seconds, None


class StageClock:
    """Seconds per stage of a step; synchronises the device at every mark, which is why it is opt-in.

    totals      over all steps
    last_step   of the last one
    """

    def __init__(self, device: torch.device, totals: dict[str, float] | None = None) -> None:
        self.device = device
        self.totals = dict.fromkeys(STAGES, 0.0) | (totals or {})
        self.last_step: dict[str, float] = {}
        self._since = 0.0

    def start(self) -> None:
        """A step begins."""
        self.last_step = {}
        synchronize(self.device)
        self._since = work_time()

    def mark(self, stage: str) -> None:
        """This stage ends here."""
        synchronize(self.device)
        now = work_time()
        self.last_step[stage] = now - self._since
        self.totals[stage] += now - self._since
        self._since = now
