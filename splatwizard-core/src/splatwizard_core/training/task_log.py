"""Messages and curve values from schedule tasks, for the terminal, log.jsonl, reports and observers."""

from __future__ import annotations

import torch
from torch import Tensor


class TaskLog:
    """Collects messages and values of one step's tasks; a task gets it through this annotation.

    task        name of the task that runs
    said        (task, line), in order; an empty line: it was registered with `log`
    scalars     curve -> value, float64, on the device that it came from
    """

    def __init__(self) -> None:
        self.task = ""
        self.said: list[tuple[str, str]] = []
        self.scalars: dict[str, Tensor] = {}

    def say(self, line: str) -> None:
        """Tell the user one line, in the terminal and in log.jsonl, with the step and the name of the task."""
        self.said.append((self.task, " ".join(line.split())))

    def scalar(self, name: str, value: float | Tensor) -> None:
        """Record the value of the curve `name` at this step; of several values the last one counts.

        value   number, or tensor of one element (else ValueError): it is read later, so that nobody waits for a GPU
        """
        number = torch.as_tensor(value, dtype=torch.float64).detach().clone()
        if not name or number.numel() != 1:
            raise ValueError(
                f"curve '{name}' needs a name, and one number per step, not the shape {list(number.shape)}"
            )
        self.scalars[name] = number
