"""Updates on the summed gradients of several views, for the end of a training: less noise, and less work for Adam."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from splatwizard_core.api import SplatOptimizer
from sw_gaussians.cadence import gather

if TYPE_CHECKING:
    from splatwizard_native import AdamUpdate


class BatchingOptimizer(SplatOptimizer):
    """Dense Adam that adds gradients up while it `waits`, and then updates with the sum.

    The sums follow rows that come, go or are put in another order, and are in checkpoints. Adam does not see the factor
    between a sum and a mean, so learning rates stay as they are.
    """

    waits = False

    def due(self) -> Iterator[tuple[str, AdamUpdate]]:
        """Each parameter that is updated now, as `SplatOptimizer.due`."""
        gather(self, list(self._group_of), update=not self.waits)
        yield from super().due()


class SumViews:
    """Lets the optimizer update at every `views`-th step, from step `first` on, with the sum of the views in between.

    last    step that updates with what there is by then, be it fewer views; None: what is left is lost

    Source: FastGS (arXiv 2511.04283). Raises ValueError for less than one view.
    """

    def __init__(self, *, views: int = 8, first: int = 8_000, last: int | None = None) -> None:
        if views < 1:
            raise ValueError(f"views is {views}: it must be at least 1")
        self.views, self.first, self.last = views, first, last

    def __call__(self, optimizer: BatchingOptimizer, step: int) -> None:
        whole = (step - self.first + 1) % self.views == 0
        optimizer.waits = step >= self.first and step != self.last and not whole
