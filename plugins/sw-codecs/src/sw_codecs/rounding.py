"""Quantizers with a step: straight-through rounding, uniform noise, and the two binary ones.

Source: specification of the codec library, quantisers. Round means half to even (torch.round).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.errors import BitstreamError

INDEX_CLAMP = 15_000  # index ranges then fit int16 (HAC)
INDEX_LIMIT = 1 << 30


class _RoundThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, step: Tensor, step_gradient: bool) -> Tensor:
        index = torch.round(x / step)
        ctx.step_gradient, ctx.step_shape = step_gradient, step.shape
        if step_gradient:
            ctx.save_for_backward(index - x / step)
        return index * step

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor | None, None]:  # type: ignore[override]
        if not ctx.step_gradient:
            return grad, None, None
        (residual,) = ctx.saved_tensors
        return grad, (grad * residual).sum_to_size(ctx.step_shape), None


class SteRound:
    """x^ = round(x / step) * step; gradient 1 for x (0 where `index_clamp` acts).

    step            > 0, a number or a tensor that broadcasts with x; also an argument of each call
    step_gradient   gradient (k - x / step) for the step (as in LSQ) instead of none
    index_clamp     keep indices within this distance of the index of the global mean of x; None: no limit
    """

    def __init__(
        self, step: float | Tensor = 1.0, *, step_gradient: bool = False, index_clamp: int | None = INDEX_CLAMP
    ) -> None:
        self.step, self.step_gradient, self.index_clamp = step, step_gradient, index_clamp

    def _step(self, x: Tensor, step: float | Tensor | None) -> Tensor:
        found = torch.as_tensor(self.step if step is None else step, dtype=x.dtype, device=x.device)
        if not bool((found.detach() > 0).all() and torch.isfinite(found.detach()).all()):
            raise ValueError("a quantizer step must be positive and finite")
        return found

    def _clamped(self, x: Tensor, step: Tensor) -> Tensor:
        """x within index_clamp steps of the rounded global mean."""
        if self.index_clamp is None or x.numel() == 0:
            return x
        fixed = step.detach()
        centre = torch.round(x.detach().mean() / fixed)
        return torch.minimum(torch.maximum(x, (centre - self.index_clamp) * fixed), (centre + self.index_clamp) * fixed)

    def forward(self, x: Tensor, step: float | Tensor | None = None) -> Tensor:
        q = self._step(x, step)
        return _RoundThrough.apply(self._clamped(x, q), q, self.step_gradient)

    __call__ = forward

    def encode(self, x: Tensor, step: float | Tensor | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Indices int64, and {"step"} float64 as a numpy array that broadcasts with x."""
        if x.numel() and not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        q = self._step(x, step)
        index = torch.round(self._clamped(x, q) / q)
        if x.numel() and float(index.abs().max()) >= INDEX_LIMIT:
            raise ValueError("a quantizer index is beyond 2^30: the step is too small")
        return index.to(torch.int64), {"step": q.detach().cpu().numpy().astype(np.float64)}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """x^ float32. Raises BitstreamError if the step does not fit."""
        step = np.asarray(side.get("step"))
        if step.dtype.kind != "f" or not (np.isfinite(step).all() and (step > 0).all()):
            raise BitstreamError("a quantizer step is missing, not finite or not positive")
        try:
            values = symbols.to(torch.float64) * torch.as_tensor(step, dtype=torch.float64, device=symbols.device)
        except RuntimeError as error:
            raise BitstreamError(f"quantizer steps {list(step.shape)} do not fit {list(symbols.shape)}") from error
        return values.to(torch.float32)


class UniformNoise(SteRound):
    """x + step * u with u ~ U(-1/2, 1/2) in training; the gradient is 1 for x and u for the step. Files are rounded."""

    def forward(
        self, x: Tensor, step: float | Tensor | None = None, generator: torch.Generator | None = None
    ) -> Tensor:
        u = torch.rand(x.shape, generator=generator, device=x.device, dtype=x.dtype) - 0.5
        q = self._step(x, step)
        return self._clamped(x, q) + q * u

    __call__ = forward


class _BinaryThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.where(x >= 0, 1.0, -1.0).to(x.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        return grad * (x.abs() <= 1)


class SteBinary:
    """+1 where x >= 0, else -1; gradient 1 for |x| <= 1, else 0. Symbols are 1 and 0."""

    def forward(self, x: Tensor) -> Tensor:
        return _BinaryThrough.apply(x)

    __call__ = forward

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Symbols int64 in {0, 1}; no side information."""
        return (x >= 0).to(torch.int64), {}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """-1 or +1, float32."""
        return symbols.to(torch.float32) * 2 - 1


class SteMask:
    """1 where sigmoid(a) * weight > threshold, else 0; the gradient is that of sigmoid(a) * weight."""

    def __init__(self, threshold: float = 0.01) -> None:
        self.threshold = threshold

    def forward(self, x: Tensor, weight: float | Tensor = 1.0) -> Tensor:
        soft = torch.sigmoid(x) * weight
        return soft + ((soft > self.threshold).to(soft.dtype) - soft).detach()

    __call__ = forward

    def encode(self, x: Tensor, weight: float | Tensor = 1.0) -> tuple[Tensor, dict[str, Any]]:
        """Symbols int64 in {0, 1}; no side information."""
        return (torch.sigmoid(x) * weight > self.threshold).to(torch.int64), {}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """0 or 1, float32."""
        return symbols.to(torch.float32)
