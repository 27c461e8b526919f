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
from sw_wisp.layers import Known
from sw_wisp.rounding import SOFT
from sw_wisp.splats import Draws, Shown

log = logging.getLogger(__name__)

Model = Any
"""A `WispModel`, which imports this."""

READ_ANEW = ("sharpness", "split_seed", "counted", "packets")
"""Numbers of the model that change no operator of a step, or decide which of its graphs is replayed."""


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
        self._steps: dict[tuple[bool, float], tuple[FixedStep, Draws]] = {}
        self._pool: tuple[int, int] | None = None

    def __call__(self, model: Model) -> Shown | None:
        """Return the splats of the next step; differentiable. None where no graph can be made, which is said once."""
        prepared = None if self._failed else self._prepared(model)
        if prepared is None:
            return None
        (step, draws), learning = prepared, self._watched.learning
        _draw_anew(model, draws)
        results: list[Tensor] = []
        found = list(_Replayed.apply(step, learning, results, learning[0]))  # type: ignore[no-untyped-call]
        bits = None if draws.sample is None else found.pop()
        return Shown(*found[:4], found[4] if draws.places is not None else None, bits, *results)

    def _prepared(self, model: Model) -> tuple[FixedStep, Draws] | None:
        parts = (model.network, model.rate, *model.rate.children())
        key = (model.cube, plain_values(model, READ_ANEW), *(plain_values(part) for part in parts))
        if key != self._key or not self._watched.unchanged():
            self._drop()
            self._key, self._watched = key, Watched.of(model)
        which = model.packets is None, model.counted
        if which not in self._steps:
            try:
                self._steps[which] = self._prepare(model)
            except RuntimeError as error:
                self._failed = True
                log.warning("training goes on without CUDA graphs, slower: %s", str(error).partition("\n")[0])
            if self._failed:  # beyond the handler, whose error holds what was made until then
                self._drop()
                torch.cuda.empty_cache()
        return self._steps.get(which)

    def _prepare(self, model: Model) -> tuple[FixedStep, Draws]:
        with torch.random.fork_rng([model.device] if model.device.type == "cuda" else []):  # steps draw, not captures
            draws = model.draws()
        if model.rounding.phase == SOFT:
            draws = draws._replace(soft=torch.ones(2, device=model.device))

        def compute() -> Found:
            *results, visible = model.shown(draws)
            return tuple(each for each in results if each is not None), () if visible is None else (visible,)

        self.captures += 1
        if not self._graphs:
            return PlainStep(compute, self._watched.learning), draws
        with torch.cuda.device(model.device):
            self._pool = self._pool or torch.cuda.graph_pool_handle()
            return CapturedStep(compute, self._watched.learning, self._pool), draws

    def _drop(self) -> None:
        """Drop all graphs. Waits for the device, which may be running one."""
        if self._steps and self._graphs:
            torch.cuda.synchronize()
        self._steps, self._pool, self._watched = {}, None, Watched([])


@torch.no_grad()
def _draw_anew(model: Model, draws: Draws) -> None:
    """Draw as `model.draws` does, where the tensors stand."""
    if draws.sample is not None:
        draws.sample.random_(0, model.num_rows)
    if draws.noise is not None:
        model.rounding.draw(draws.noise)
    if draws.places is not None:
        draws.places.uniform_()
    if draws.known is not None:
        told = Known.after(model.layers.order[: model.packets], model.layers, torch.device("cpu"))
        for mine, each in zip(draws.known, told, strict=True):
            mine.copy_(each, non_blocking=True)
    if draws.soft is not None:
        sharpness = model.rounding.sharpness
        for place, value in zip(draws.soft, (sharpness, 0.5 / math.tanh(0.5 * sharpness)), strict=True):
            place.fill_(value)


class _Replayed(torch.autograd.Function):
    """Results of a FixedStep, whose gradients go to `learning`; `leaf` is one of these, for the graph.

    They go there whoever asks, `torch.autograd.grad` too: what is measured between steps takes a model in eval mode.

    others  gets its results without gradients
    """

    @staticmethod
    def forward(
        ctx: Any, step: FixedStep, learning: list[Tensor], others: list[Tensor], leaf: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.step, ctx.learning = step, learning
        ctx.set_materialize_grads(False)
        results, constants = step.forward()
        others.extend(constants)
        # What is logged must still be there after the next step.
        return tuple(each.detach() if each.dim() else each.detach().clone() for each in results)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        add_gradients(ctx.learning, ctx.step.backward(slopes))
        return None, None, None, None


STEPS: WeakKeyDictionary[Model, FixedSplats] = WeakKeyDictionary()
"""Graphs of the models that train."""
