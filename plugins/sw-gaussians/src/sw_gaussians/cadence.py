"""Adam that updates some parameters only every k-th step, on the sum of their gradients since."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from splatwizard_core.api import SplatOptimizer
from sw_gaussians.sparse_adam import SparseSplatOptimizer

if TYPE_CHECKING:
    from splatwizard_core.api import ParamGroup, SplatModel
    from splatwizard_native import AdamUpdate

PENDING = "pending"
"""Key of a parameter's state: the sum of the gradients since its last update, of the parameter's shape."""


@torch.no_grad()
def gather(optimizer: SplatOptimizer, names: Iterable[str], *, update: bool) -> None:
    """Add to the gradients of parameters what was kept of earlier steps; without an update keep the sums, too."""
    for name in names:
        param = optimizer.model.get_parameter(name)
        gradient, state = param.grad, optimizer.states.get(name)
        if gradient is None:
            continue
        kept = None if state is None else state.tensors.pop(PENDING, None)
        if kept is not None:
            gradient = kept.add_(gradient)
        if update:
            param.grad = gradient
            continue
        param.grad = None
        if state is None:
            state = optimizer.fresh_state(name, param)
        state.tensors[PENDING] = gradient


class CadencedOptimizer(SplatOptimizer):
    """Updates `slow` parameters at every `every`-th update of the parameter `pace`; in between their gradients add up.

    The sums are part of the parameters' state: they follow rows that come, go or are put in another order, and are in
    checkpoints. Adam does not see the factor between a sum and a mean, so the learning rate stays as it is.
    Source: Taming 3DGS (arXiv 2406.15643), for bands 1 to 3 of the spherical harmonics.
    """

    def __init__(
        self,
        model: SplatModel,
        groups: Iterable[ParamGroup],
        *,
        every: int,
        slow: tuple[str, ...] = ("sh_rest",),
        pace: str = "sh_dc",
        **settings: Any,
    ) -> None:
        super().__init__(model, groups, **settings)
        self.every, self.slow, self.pace = every, slow, pace

    def due(self) -> Iterator[tuple[str, AdamUpdate]]:
        """Each parameter that is updated now, as `SplatOptimizer.due`."""
        pace = self.states.get(self.pace)
        # This update of `pace` is the next one: nobody has counted it yet.
        gather(self, self.slow, update=((0 if pace is None else pace.step) + 1) % self.every == 0)
        yield from super().due()


class SparseCadencedOptimizer(CadencedOptimizer, SparseSplatOptimizer):
    """Both: of the slow parameters, too, only the rows are updated that the view of that step shows.

    What the others have gathered waits for the first such view that shows them.
    """

    @torch.no_grad()
    def step_rows(self, rows: Tensor | None) -> None:
        super().step_rows(rows)
        if rows is None:
            return
        for name in self.slow:
            gradient = self.model.get_parameter(name).grad
            if gradient is not None:  # updated just now
                shown = rows.view(-1, *[1] * (gradient.dim() - 1))
                self.states[name].tensors[PENDING] = gradient.masked_fill(shown, 0.0)
