"""Rows of what a camera sees, taken and put back; gradients too are copied by reading, in no order and without sums.

On CUDA torch's own gradient of `index_select` and its `index_copy` sort their rows where algorithms must be
deterministic, since rows could be named twice. Those of a mask are not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Copying = Callable[[Tensor], Tensor]


class SeenRows:
    """The V rows of `seen` [N] bool that are true, in their order. Waits for the device, for V."""

    def __init__(self, seen: Tensor) -> None:
        self._unseen = ~seen
        self._rows = torch.nonzero(seen).squeeze(1)
        self._places = (seen.cumsum(0) - 1).clamp_(min=0)  # of each row among the seen ones

    def take(self, values: Tensor) -> Tensor:
        """[N,C] -> [V,C]; differentiable."""
        found: Tensor = _Copy.apply(values, self.taken, self.placed)  # type: ignore[no-untyped-call]
        return found

    def put(self, values: Tensor) -> Tensor:
        """[V,C] -> [N,C], zeros where nothing is seen; differentiable."""
        found: Tensor = _Copy.apply(values, self.placed, self.taken)  # type: ignore[no-untyped-call]
        return found

    def taken(self, values: Tensor) -> Tensor:
        """As `take`, without a gradient."""
        return values.index_select(0, self._rows)

    def placed(self, values: Tensor) -> Tensor:
        """As `put`, without a gradient."""
        if not len(values):
            return values.new_zeros(len(self._unseen), *values.shape[1:])
        return values.index_select(0, self._places).masked_fill_(self._unseen[:, None], 0)


class _Copy(torch.autograd.Function):
    """Copies rows by one function; the other one copies their gradient back."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, there: Copying, back: Copying) -> Tensor:
        ctx.back = back
        return there(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.back(gradient), None, None
