"""Schedule tasks that call the actions of a density control."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from splatwizard_core.api import DensityControl, TrainingState

Action = Callable[..., Mapping[str, int] | None]


class ControlTask:
    """Calls an action of a density control and records the curves that it reports.

    Does nothing at the last step of a stage, since no update follows. A full run ends long after the last densification
    and opacity reset. But a run cut to a multiple of 100 steps would lose about 0.8 dB (lego, 7,000 steps), one cut to
    a multiple of 3,000 almost everything. Published results of short runs are measured before that densification, too.
    """

    def __init__(self, do: Action) -> None:
        self.do = do

    def __call__(self, state: TrainingState) -> None:
        if state.step >= state.iterations:
            return
        for name, count in (self.do(state) or {}).items():
            state.log.scalar(name, count)


class Collect(ControlTask):
    """Collects statistics of a render; changes neither the model nor any gradient."""

    def __call__(self, state: TrainingState) -> None:
        self.do(state, state.result)


class Adjust(ControlTask):
    """Adds and removes primitives; its checkpoint state is that of the control."""

    def __init__(self, do: Action, control: DensityControl) -> None:
        super().__init__(do)
        self.control = control

    def state_dict(self) -> dict[str, Any]:
        return self.control.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.control.load_state_dict(state)


class Change(ControlTask):
    """Changes values of existing primitives, such as their opacities."""


def control_task(do: Action, control: DensityControl, adjust: Action) -> ControlTask:
    """Return the task for an action of a control's plan.

    adjust  what the stage does where the control would adjust
    """
    if do == control.adjust:
        return Adjust(adjust, control)
    return Collect(do) if len(inspect.signature(do).parameters) == 2 else Change(do)
