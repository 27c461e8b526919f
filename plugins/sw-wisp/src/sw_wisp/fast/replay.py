"""Splats of a training step as CUDA graphs: of its operators the host starts two, forward and backward.

All splats are drawn whatever the view, so no size depends on one, and a graph reads parameters and features where they
stand. What a step draws at random, and the sharpness of soft rounding, is written into tensors of its own before.
"""

from __future__ import annotations

import logging
import math
from typing import Any
from weakref import WeakKeyDictionary

import torch
from sw_gaussians.fast.graphs import CapturedStep, FixedStep, Found, PlainStep, Watched, add_gradients, plain_values
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled
from sw_wisp.fast.native import WISP
from sw_wisp.rounding import SOFT
from sw_wisp.splats import Draws, Shown

log = logging.getLogger(__name__)

Model = Any
"""A `WispModel`, which imports this."""

READ_ANEW = ("sharpness", "split_seed")
"""Numbers of the model that change no operator of a step."""


def fits(model: Model) -> bool:
    """Whether splats of a model are taken from graphs: in training on a GPU, if kernels compute its networks."""
    if not (fast_enabled() and model.training and torch.is_grad_enabled() and model.opacity.requires_grad):
        return False
    has_networks = next(model.rate.children(), None) is not None  # others take the sharpness as it is
    return has_networks and (model in STEPS or (model.device.type == "cuda" and WISP.has_cuda()))


def shown(model: Model) -> Shown | None:
    """As `model.shown` of new draws; None where no graph can be made."""
    if model not in STEPS:
        STEPS[model] = FixedSplats()
    return STEPS[model](model)


def release(model: Model) -> None:
    """Free a model's graphs and their GPU memory."""
    STEPS.pop(model, None)


class FixedSplats:
    """`model.shown` of one model, as graphs that are made anew when a switch of it, or where a tensor stands, changes.

    captures    how many were made
    """

    def __init__(self, *, graphs: bool = True) -> None:
        """graphs: as CUDA graphs; else operator by operator, on any device."""
        self.captures = 0
        self._graphs, self._failed = graphs, False
        self._key: tuple[Any, ...] = ()
        self._watched = Watched([])
        self._step: FixedStep | None = None
        self._draws = Draws()

    def __call__(self, model: Model) -> Shown | None:
        """Return the splats of the next step; differentiable. None where no graph can be made, which is said once."""
        if self._failed:
            return None
        parts = (model.network, model.rate, *model.rate.children())
        key = (model.cube, plain_values(model, READ_ANEW), *(plain_values(part) for part in parts))
        if self._step is None or key != self._key or not self._watched.unchanged():
            self._prepare(model, key)
        if self._step is None:
            return None
        draws, learning = self._draw_anew(model), self._watched.learning
        found = list(_Replayed.apply(self._step, learning, learning[0]))  # type: ignore[no-untyped-call]
        means = None if draws.places is None else found[4]
        return Shown(*found[:4], means, None if draws.sample is None else found[-1])

    def _draw_anew(self, model: Model) -> Draws:
        """Draw as `model.draws`, where the tensors stand."""
        sample, noise, places, soft = self._draws
        if sample is not None:
            sample.random_(0, model.num_rows)
        if noise is not None:
            model.rounding.draw(noise)
        if places is not None:
            places.uniform_()
        if soft is not None:
            sharpness = model.rounding.sharpness
            for place, value in zip(soft, (sharpness, 0.5 / math.tanh(0.5 * sharpness)), strict=True):
                place.fill_(value)
        return self._draws

    def _prepare(self, model: Model, key: tuple[Any, ...]) -> None:
        if self._step is not None and self._graphs:
            torch.cuda.synchronize()
        self._step = None
        self._key, self._watched = key, Watched.of(model)
        with torch.random.fork_rng([model.device] if model.device.type == "cuda" else []):  # steps draw, not captures
            self._draws = draws = model.draws()
        if model.rounding.phase == SOFT:
            self._draws = draws = draws._replace(soft=torch.ones(2, device=model.device))

        def compute() -> Found:
            return tuple(each for each in model.shown(draws) if each is not None), ()

        self.captures += 1
        if not self._graphs:
            self._step = PlainStep(compute, self._watched.learning)
            return
        try:
            with torch.cuda.device(model.device):
                pool = torch.cuda.graph_pool_handle()
                self._step = CapturedStep(compute, self._watched.learning, pool)
        except RuntimeError as error:
            self._failed = True
            log.warning("training goes on without CUDA graphs, slower: %s", str(error).partition("\n")[0])
        if self._failed:  # beyond the handler, whose error holds what was made until then
            self._watched, self._draws = Watched([]), Draws()
            del compute, draws
            torch.cuda.empty_cache()


class _Replayed(torch.autograd.Function):
    """Results of a FixedStep, whose gradients go to `learning`; `leaf` is one of these, for the graph."""

    @staticmethod
    def forward(ctx: Any, step: FixedStep, learning: list[Tensor], leaf: Tensor) -> tuple[Tensor, ...]:
        ctx.step, ctx.learning = step, learning
        ctx.set_materialize_grads(False)
        results, _ = step.forward()
        # What is logged must still be there after the next step.
        return tuple(each.detach() if each.dim() else each.detach().clone() for each in results)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        add_gradients(ctx.learning, ctx.step.backward(slopes))
        return None, None, None


STEPS: WeakKeyDictionary[Model, FixedSplats] = WeakKeyDictionary()
"""Graphs of the models that train."""
