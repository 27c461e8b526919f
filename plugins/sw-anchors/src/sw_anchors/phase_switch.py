"""Schedule task that switches the model's training phase."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from splatwizard_core.api import Scheduler, SplatModel


class PhaseSwitch:
    """Change of the model's phase at a step: `PhaseSwitch(10_000, "entropy").register(scheduler)`.

    At `step` it sets `model.phase = name`, or runs `task` instead if there is one. The plan shows it as
    "switch to <name>". The model keeps its phase in `state_dict_extra()["phase"]`, so that a resumed run has it.
    """

    def __init__(self, step: int, name: str, task: Callable[..., Any] | None = None) -> None:
        self.step, self.name, self.task = step, name, task

    def register(self, scheduler: Scheduler, *, priority: int = 0) -> None:
        """Register it; the same errors as `register_task`."""
        scheduler.register_task(self.step, self.task or self._switch, priority=priority, name=f"switch to {self.name}")

    def _switch(self, model: SplatModel) -> None:
        model.phase = self.name  # type: ignore[assignment]
        if model.state_dict_extra().get("phase") != self.name:
            raise TypeError(f"{type(model).__name__}.state_dict_extra() must hold 'phase', or a resumed run loses it")
