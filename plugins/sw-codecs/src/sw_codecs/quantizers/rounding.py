"""Quantizer `ste-round` with a step. Round means half to even (torch.round); `multiples` has its plain functions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.quantizers.multiples import INDEX_CLAMP, INDEX_LIMIT, checked
from sw_codecs.quantizers.multiples import add_noise as add_noise
from sw_codecs.quantizers.side_information import finite_values, fits, within


class _RoundThrough(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, step: Tensor, low: Tensor | None, high: Tensor | None, step_gradient: bool
    ) -> Tensor:
        index = torch.round(x / step)
        residual = index - x / step if step_gradient else None
        inside = None
        if low is not None and high is not None:
            inside = (index >= low) & (index <= high)
            index = torch.clamp(index, low, high)
            residual = None if residual is None else torch.where(inside, residual, index)
        ctx.inside, ctx.step_shape = inside, step.shape
        ctx.save_for_backward(residual)
        return index * step

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (residual,) = ctx.saved_tensors
        to_step = None if residual is None else (grad * residual).sum_to_size(ctx.step_shape)
        return (grad if ctx.inside is None else grad * ctx.inside), to_step, None, None, None


class SteRound:
    """k = round(x / step), x^ = k * step; gradient 1 for x (0 where `index_clamp` acts).

    step            > 0, a number or a tensor that broadcasts with x (a step per element, row or group); also an
                    argument of each call
    step_gradient   gradient k - x / step for the step, as in LSQ (k where `index_clamp` acts), instead of none
    index_clamp     keep indices within this distance of k0 = round(mean(x) / step), the index of the global mean;
                    None: no limit

    Every call takes `mean`: the mean of the whole tensor, where x is only a part of it (a chunk, the rows that are
    drawn). Without it that of x is taken; two calls that must agree have to name one mean.
    Source: HAC (arXiv 2403.14530) for the limit of indices.
    """

    def __init__(
        self, step: float | Tensor = 1.0, *, step_gradient: bool = False, index_clamp: int | None = INDEX_CLAMP
    ) -> None:
        self.step, self.step_gradient, self.index_clamp = step, step_gradient, index_clamp

    def _step(self, x: Tensor, step: float | Tensor | None, *, check: bool = False) -> Tensor:
        given = self.step if step is None else step
        found = torch.as_tensor(given, dtype=x.dtype, device=x.device)
        if not isinstance(given, Tensor):
            good = 0 < given < math.inf
        elif check or given.device.type == "cpu":  # a look at a GPU waits for it, which a training step should not
            good = bool((given.detach() > 0).all() and torch.isfinite(given.detach()).all())
        else:
            good = True
        if not good:
            raise ValueError("a quantizer step must be positive and finite")
        return found

    def _limits(self, x: Tensor, step: Tensor, mean: float | Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """The least and the largest index, of the shape of the step; None without a limit."""
        if self.index_clamp is None or x.numel() == 0:
            return None, None
        whole = x.detach().mean(dtype=torch.float64) if mean is None else torch.as_tensor(mean, device=x.device)
        centre = torch.round(whole.detach().to(x.dtype) / step.detach())
        return centre - self.index_clamp, centre + self.index_clamp

    def forward(self, x: Tensor, step: float | Tensor | None = None, *, mean: float | Tensor | None = None) -> Tensor:
        q = self._step(x, step)
        return _RoundThrough.apply(x, q, *self._limits(x, q, mean), self.step_gradient)

    __call__ = forward

    def encode(
        self, x: Tensor, step: float | Tensor | None = None, *, mean: float | Tensor | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Indices int64 of the shape of x, and {"step"} float64 as a numpy array that broadcasts with x.

        Decoded float32 values give the same indices again while |k| < 2^22 and `mean` is the same. Raises ValueError
        for values that are not finite and for |k| >= 2^30.
        """
        if x.numel() and not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        q = self._step(x, step, check=True)
        index = torch.round(x.detach() / q.detach())
        low, high = self._limits(x, q, mean)
        if low is not None and high is not None:
            index = torch.clamp(index, low, high)
        return checked(index), {"step": q.detach().cpu().numpy().astype(np.float64)}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """x^ float32. Raises BitstreamError if the step does not fit, or a value is not finite."""
        step = np.asarray(side.get("step"))
        if step.dtype.kind != "f" or not (np.isfinite(step).all() and (step > 0).all()):
            raise BitstreamError("a quantizer step is missing, not finite or not positive")
        if not fits(step.shape, tuple(symbols.shape)):
            raise BitstreamError(f"quantizer steps {list(step.shape)} do not fit {list(symbols.shape)}")
        step64 = torch.as_tensor(step.astype(np.float64), device=symbols.device)
        return finite_values(within(symbols, -INDEX_LIMIT, INDEX_LIMIT).to(torch.float64) * step64)
