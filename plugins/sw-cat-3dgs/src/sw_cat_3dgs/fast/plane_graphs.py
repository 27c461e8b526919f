"""Bits of the triplane in a training step as CUDA graphs: of hundreds of operators the host starts two."""

from __future__ import annotations

import functools
import logging
import math
from typing import Any
from weakref import WeakKeyDictionary

import torch
from sw_gaussians.fast.graphs import CapturedStep, FixedStep, Found, PlainStep, Watched, add_gradients
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled
from sw_cat_3dgs.context import CatContext
from sw_cat_3dgs.context import plane_bits as plain_bits

log = logging.getLogger(__name__)


def fits(context: CatContext) -> bool:
    """Whether the bits of its planes are taken from graphs: in training on a GPU."""
    return fast_enabled() and torch.is_grad_enabled() and (context in ESTIMATORS or context.frame.is_cuda)


def plane_bits(context: CatContext, share: float, generator: torch.Generator | None) -> Tensor:
    """As `context.plane_bits`."""
    if context not in ESTIMATORS:
        ESTIMATORS[context] = FixedPlaneBits()
    found = ESTIMATORS[context](context, share, generator)
    return plain_bits(context, share, generator) if found is None else found


def release(context: CatContext) -> None:
    """Forget the graphs of a context, which hold memory."""
    ESTIMATORS.pop(context, None)


class FixedPlaneBits:
    """`context.plane_bits` of one context, as graphs that are made anew when planes or networks are others."""

    def __init__(self, *, graphs: bool = True) -> None:
        """graphs: as CUDA graphs; else operator by operator, on any device."""
        self.captures = 0
        self._graphs, self._failed = graphs, False
        self._watched = Watched([])
        self._share = 0.0
        self._step: FixedStep | None = None
        self._noise = torch.empty(0)

    def __call__(self, context: CatContext, share: float, generator: torch.Generator | None) -> Tensor | None:
        """Estimate the bits; differentiable. None where no graph can be made or none has room, which is said once.

        share, generator    as of `context.plane_bits`
        """
        if self._failed:
            return None
        if self._step is None or share != self._share or not self._watched.unchanged():
            self._prepare(context, share)
        learning = self._watched.learning
        if self._step is None or not learning:
            return None
        self._noise.uniform_(generator=generator)
        found: Tensor = _Bits.apply(self._step, learning, learning[0])  # type: ignore[no-untyped-call]
        return found

    def _prepare(self, context: CatContext, share: float) -> None:
        if self._step is not None and self._graphs:
            torch.cuda.synchronize()
        self._step = None
        self._watched, self._share = Watched.of(context), share
        # More than any share of the channels takes: a draw for each channel, and one for each value.
        planes = context.triplane.planes
        self._noise = planes[0].new_empty(context.shape.channels + sum(plane.numel() for plane in planes))
        compute = functools.partial(_bits, context, share, self._noise)
        if not self._watched.learning:
            return
        self.captures += 1
        if not self._graphs:
            self._step = PlainStep(compute, self._watched.learning)
            return
        try:
            with torch.cuda.device(planes[0].device):
                self._step = CapturedStep(compute, self._watched.learning)
        except RuntimeError as error:
            self._failed = True
            log.warning("the planes' bits go on without CUDA graphs: %s", str(error).partition("\n")[0])
        if self._failed:  # beyond the handler, whose error holds what was made until then
            self._noise, self._watched = torch.empty(0), Watched([])
            del compute
            torch.cuda.empty_cache()


def _bits(context: CatContext, share: float, noise: Tensor) -> Found:
    """The bits of the planes with draws from `noise`, which is left as it is."""
    used = 0

    def drawn(*shape: int) -> Tensor:
        nonlocal used
        first, used = used, used + math.prod(shape)
        return noise[first:used].view(shape).clone()

    return (context.triplane_bits(drawn, share),), ()


class _Bits(torch.autograd.Function):
    """The result of a FixedStep, whose gradients go to `learning`; `leaf` is one of these, for the graph."""

    @staticmethod
    def forward(ctx: Any, step: FixedStep, learning: list[Tensor], leaf: Tensor) -> Tensor:
        ctx.step, ctx.learning = step, learning
        (bits,), _ = step.forward()
        return bits.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        add_gradients(ctx.learning, ctx.step.backward([slope]))
        return None, None, None


ESTIMATORS: WeakKeyDictionary[CatContext, FixedPlaneBits] = WeakKeyDictionary()
"""Graphs of the contexts that train."""
