"""Quantizer `lsq`: a step that is learned with the network, its gradient scaled to those of the weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError, ShapeError
from sw_codecs.side_information import finite_values, floats, integers, within

MAX_BITS = 16
SMALLEST_STEP = 1e-12


class _LearnedStep(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, step: Tensor, low: int, high: int) -> Tensor:
        scaled = x / step
        free = torch.round(scaled)
        index = free.clamp(low, high)
        inside = index == free
        ctx.save_for_backward(torch.where(inside, free - scaled, index), inside)
        ctx.step_shape = step.shape
        ctx.factor = (step.numel() / (max(x.numel(), 1) * high)) ** 0.5
        return index * step

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:  # type: ignore[override]
        to_step, inside = ctx.saved_tensors
        return grad * inside, (grad * to_step).sum_to_size(ctx.step_shape) * ctx.factor, None, None


class Lsq(nn.Module):
    """k = clamp(round(x / s), n, p), x^ = k s, with a learnable step s.

    bits       1..16 (2..16 signed); signed: n = -2^(bits-1), p = 2^(bits-1) - 1; unsigned: n = 0, p = 2^bits - 1
    channels   C: a step for each column of x [N, C]; None: one for all of x, of any shape
    step       where it starts; None: at 2 mean|x| / sqrt(p) of the first x that `forward` or `encode` sees

    Gradients, with g = 1 / sqrt(p * elements that share the step): for x 1 where n <= round(x / s) <= p, else 0; for s
    g (round(x / s) - x / s) there, g n or g p beyond. (The paper compares x / s before rounding, which differs only
    within half a step of the ends; this one is the derivative of the formula above with rounding passed through.)
    The absolute value of the parameter `step` is used, so an optimizer that steps through 0 does no harm.
    State (in state_dict): step [C] or [], and whether it is set; it follows x to its device.
    Source: LSQ (Esser et al., arXiv 1902.08153).
    """

    is_set: Tensor

    def __init__(
        self, bits: int = 8, *, signed: bool = True, channels: int | None = None, step: float | None = None
    ) -> None:
        super().__init__()
        if not (2 if signed else 1) <= bits <= MAX_BITS:
            raise ValueError(f"bits are {bits}, must be in {2 if signed else 1}..{MAX_BITS}")
        if step is not None and not 0 < step < float("inf"):
            raise ValueError("a quantizer step must be positive and finite")
        self.low = -(2 ** (bits - 1)) if signed else 0
        self.high = self.low + 2**bits - 1
        self.channels = channels
        self.step = nn.Parameter(torch.full(() if channels is None else (channels,), 1.0 if step is None else step))
        self.register_buffer("is_set", torch.tensor(step is not None))
        self._started = False  # is_set, once it was seen: looking at it each time would make a GPU wait

    def forward(self, x: Tensor) -> Tensor:
        """x^ of the shape of x; differentiable in x and the step."""
        self._check(x)
        self._start(x)
        return _LearnedStep.apply(x, self._positive(x.dtype), self.low, self.high)

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """k int64 of the shape of x, and {"step"} float32 [C] or [], {"range"} int32 [2], n and p.

        Raises ValueError for values or steps that are not finite.
        """
        self._check(x)
        if x.numel() and not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        self._start(x)
        step = self._positive(torch.float32).detach()
        if not bool(torch.isfinite(step).all()):
            raise ValueError("a quantizer step must be positive and finite")
        index = torch.round(x.detach() / step.to(x.dtype)).clamp(self.low, self.high)
        side = {"step": step.cpu().numpy(), "range": np.array([self.low, self.high], np.int32)}
        return index.to(torch.int64), side

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """x^ float32 of the shape of `symbols`. Raises BitstreamError if the side information does not fit."""
        shape = np.asarray(side.get("step")).shape
        if shape != () and (symbols.ndim != 2 or shape != (symbols.shape[1],)):
            raise BitstreamError(f"quantizer steps {list(shape)} do not fit {list(symbols.shape)}")
        step = floats(side, "step", shape, positive=True, dtype=np.float32)
        low, high = integers(side, "range", (2,), -(1 << MAX_BITS), 1 << MAX_BITS).tolist()
        index = within(symbols, low, high)
        return finite_values(index.to(torch.float32) * torch.as_tensor(step, device=symbols.device))

    def _positive(self, dtype: torch.dtype) -> Tensor:
        return self.step.abs().clamp_min(SMALLEST_STEP).to(dtype)

    @torch.no_grad()
    def _start(self, x: Tensor) -> None:
        if self.step.device != x.device:
            self.to(x.device)
        if self._started or x.numel() == 0:
            return
        self._started = True
        if not bool(self.is_set):
            size = x.abs().mean() if self.channels is None else x.abs().mean(0)
            self.step.copy_((2 * size / self.high**0.5).clamp_min(SMALLEST_STEP))
            self.is_set.fill_(True)

    def _check(self, x: Tensor) -> None:
        if self.channels is not None and (x.ndim != 2 or x.shape[1] != self.channels):
            raise ShapeError(f"values have shape {list(x.shape)}", actual=x.shape, expected=("N", self.channels))
