"""Curves of a training for TensorBoard, by its own library: `--set log.tensorboard=true`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatwizard_core.api import CapabilityError

if TYPE_CHECKING:
    from splatwizard_core.api import SplatModel

EVERY = 10
"""Steps between values; reading a loss waits for a GPU. Steps with curves of tasks and the last one are written too."""


class TensorBoardLog:
    """Observer that writes `<stage>/loss`, its parts, primitives and curves of tasks, by the step of the stage.

    A resumed training takes back what it does again. Raises CapabilityError without the package tensorboard.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            told = f"log.tensorboard needs a package ({error}): pip install 'sw-report[tensorboard]'"
            raise CapabilityError(told, missing=["tensorboard"]) from error
        self._folder, self._make = folder, SummaryWriter
        self._writers: dict[str, Any] = {}

    def after_step(self, model: SplatModel, record: Any) -> None:
        """Write a step, if it is one of those that are written."""
        if (record.step - 1) % EVERY and not record.scalars and record.step != record.iterations:
            return
        name = record.stage_name
        if name not in self._writers:
            self._writers[name] = self._make(str(self._folder / name), purge_step=record.step)
        values = {"loss": record.total, "primitives": record.num_rows}
        values |= {f"loss/{part}": value for part, value in record.parts.items()}
        values |= {f"tasks/{curve}": value for curve, value in record.scalars.items()}
        for tag, value in values.items():
            self._writers[name].add_scalar(tag, float(value), record.step)

    def finished(self) -> None:
        """Close the files."""
        for writer in self._writers.values():
            writer.close()
