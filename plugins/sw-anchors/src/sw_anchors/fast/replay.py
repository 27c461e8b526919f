"""Replay of `CodedAnchors` training steps as CUDA graphs, in tensors of fixed sizes.

How many anchors a view sees differs from step to step. Here their rows are copied into tensors of a capacity, a few of
which serve all views, and rows beyond the count are masked. So no shape depends on a value, and on a GPU the host
starts values, noise, prediction, rate and the three networks with one call, and their gradients with another.
"""

from __future__ import annotations

import functools
import logging
import math
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import torch
from sw_gaussians.fast.graphs import CapturedStep, FixedStep, PlainStep, Watched, add_gradients, plain_values
from sw_gaussians.morton import interleave
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from splatwizard_core.api import Camera, GaussianInputs, Rasterizer
from splatwizard_native import fast_enabled
from sw_anchors.fast.fixed_step import (
    PARAMETERS,
    FixedRows,
    PoolRows,
    decode_rows,
    sample_capacity,
)
from sw_anchors.fast.kernels import room_for_gaussians
from sw_anchors.fast.rows import AlikeRows, Way
from sw_anchors.fast.seen_rows import AnchorOrder, ExpectedRows, SeenRows, capacity_of
from sw_anchors.fast.spawn import AlikeGaussians, drawn_of
from sw_anchors.native import ANCHORS
from sw_anchors.neural_gaussians import NeuralGaussians
from sw_anchors.noisy_values import ENTROPY
from sw_anchors.rate_model import AnchorRate

log = logging.getLogger(__name__)

CAPACITY_MARGIN = 1.04
"""Head-room over the number of anchors that this camera saw last time."""
MAX_STEPS = 16
"""Steps kept per model; the views of one scene ask for fewer capacities."""

GAUSSIANS, OUTPUTS = 5, 6
"""Numbers of tensors that spawned Gaussians have, and of those of `decode_rows` that they are spawned from."""

Model = Any
"""A `CodedAnchors`, which imports this: see `fixed_step.Model`."""


def fits(model: Model, made_for: type) -> bool:
    """Whether the steps of a model are replayed: in training on a GPU, if it draws Gaussians as `made_for` does."""
    if not (fast_enabled() and model.training and torch.is_grad_enabled() and model.features.requires_grad):
        return False
    own = any(getattr(type(model), name) is not getattr(made_for, name) for name in _REPLACED)
    return not own and (model in DECODERS or (model.device.type == "cuda" and ANCHORS.has_cuda()))


_REPLACED = ("visible_anchors", "decode", "attributes")


def gaussians(model: Model, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
    """Fast version of `CodedAnchors.gaussians`; decodes views seen before without waiting for the visible count."""
    decoder = DECODERS.get(model)
    if decoder is None:
        decoder = DECODERS[model] = FixedDecoder()
    return decoder.gaussians(model, camera, rasterizer)


def release(model: Model) -> None:
    """Free a model's captured steps and their GPU memory."""
    DECODERS.pop(model, None)


@dataclass(frozen=True)
class _Prepared:
    """A step of one size, what it reads of the visible anchors, and of a sample of all; what calls of it have kept.

    put, add    of gradients to their places among all anchors
    """

    step: FixedStep
    at: FixedRows
    pool: PoolRows | None
    gaussians: AlikeGaussians = field(default_factory=AlikeGaussians)
    put: AlikeRows = field(default_factory=lambda: AlikeRows(Way.SCATTER))
    add: AlikeRows = field(default_factory=lambda: AlikeRows(Way.ADD))


class FixedDecoder:
    """Decodes one CodedAnchors in training; captures a step when its capacity is first needed.

    All steps are captured again if a plain value of the model or its rate model changes, since it may select operators,
    or if a tensor without anchor rows is replaced (such as a network weight). Growth changes neither.

    captures    how many steps were prepared, since this was made
    """

    def __init__(self, *, graphs: bool = True) -> None:
        """graphs: as CUDA graphs; else operator by operator, on any device, which is slower than no FixedDecoder."""
        self.captures = 0
        self._graphs = graphs
        self._failed = False
        self._pool: tuple[int, int] | None = None
        self._steps: dict[tuple[int, int], _Prepared] = {}
        self._key: tuple[Any, ...] = ()
        self._watched = Watched([])
        self._shared: dict[str, Tensor] = {}
        self._seen: WeakKeyDictionary[Camera, tuple[int, int]] = WeakKeyDictionary()  # anchors, and of how many
        self._order: tuple[Tensor, AnchorOrder] | None = None

    def gaussians(self, model: Model, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """The Gaussians of the visible anchors."""
        places = self.expected(camera, model.num_rows)
        with torch.no_grad():
            order, seen = self._in_order(model, rasterizer.visible_filter(model.balls(), camera) > 0)
            rows = SeenRows(order.rows[seen]) if places is None else ExpectedRows(order, seen, places)
        found = self.decode(model, camera, rows)
        if found is None:
            with torch.no_grad():
                known = rows.known()
            return model.decode(camera, known)
        return found

    def _in_order(self, model: Model, visible: Tensor) -> tuple[AnchorOrder, Tensor]:
        """All anchors, neighbours together, and whether each is visible [N] bool.

        Gradients of neighbours meet in the same cells of grids and planes: kernels add those up before they write.
        """
        codes = model.codes()
        if self._order is None or self._order[0] is not codes:
            self._order = codes, AnchorOrder(torch.argsort(interleave(codes)))
        order = self._order[1]
        return order, visible.index_select(0, order.rows)

    def expected(self, camera: Camera, num_rows: int) -> int | None:
        """Return the expected capacity for this camera's anchors; None: camera not seen before, or none visible.

        A little more than it saw last: between two of its turns anchors grow, are pruned and change their size.
        """
        seen, of = self._seen.get(camera, (0, 0))
        if self._failed or not of or not num_rows:
            return None
        return capacity_of(min(math.ceil(seen * num_rows / of * CAPACITY_MARGIN), num_rows))

    def decode(self, model: Model, camera: Camera, rows: SeenRows) -> GaussianInputs | None:
        """Return Gaussians with opacity > 0 of the anchors `rows`; decode again if the capacity was too small.

        None where the GPU refused a graph or had no memory for it; that is said once.
        """
        found = self._decode(model, camera, rows)
        if found is None and not rows.fit():
            found = self._decode(model, camera, SeenRows(rows.known()))
        if found is not None:
            self._seen[camera] = len(found.extras["anchors"].rows), model.num_rows
        return found

    def _decode(self, model: Model, camera: Camera, rows: SeenRows) -> GaussianInputs | None:
        """Decode once; None if the capacity was too small."""
        if self._failed:
            return None
        parts = model.context_rows() if model.phase == ENTROPY else ()
        pooled = model.RATE_OF == "all" and model.phase == ENTROPY
        places = capacity_of(sample_capacity(model.num_rows, model.sample)) if pooled else 0
        try:
            prepared = self._prepared(model, parts, rows.capacity, places)
        except RuntimeError as error:
            self._failed = True
            log.warning("training goes on without CUDA graphs, slower: %s", str(error).partition("\n")[0])
        if self._failed:  # beyond the handler, whose error holds what was made until then
            self._drop()
            torch.cuda.empty_cache()
            return None
        sources = [getattr(model, name) for name in PARAMETERS]
        at, pool = prepared.at, prepared.pool
        with torch.no_grad():
            at.load(model, camera, rows, parts)
            if pool is not None:
                pool.load(model, [source.detach() for source in sources], parts)
        spawned, masks, extras = _Decoded.found(prepared, rows, self._watched.learning, sources)
        return model.drawn(rows.placed(), spawned, masks, extras) if rows.fit() else None

    def _prepared(self, model: Model, parts: tuple[Tensor, ...], capacity: int, places: int) -> _Prepared:
        rate_model = model.rate_model if model.phase == ENTROPY else None
        parts_of_it = [] if rate_model is None else [rate_model, *vars(rate_model).values()]
        deciding = [model, *(each for each in parts_of_it if each is rate_model or isinstance(each, nn.Module))]
        key = (*(plain_values(each) for each in deciding), *(part.shape[1:] for part in parts))
        room = capacity <= self._rows_held("positions") and places <= self._rows_held("pool counted")
        if key != self._key or not self._watched.unchanged() or not room:
            self._drop()
            self._key, self._watched = key, Watched.of(model, {*model.ROWS, "bounds"})
        found = self._steps.get((capacity, places))
        if found is None:
            if len(self._steps) >= MAX_STEPS:
                held = self._shared
                self._drop()
                self._shared = held
            found = self._steps[capacity, places] = self._prepare(model, parts, capacity, places)
        return found

    def _prepare(self, model: Model, parts: tuple[Tensor, ...], capacity: int, places: int) -> _Prepared:
        self.captures += 1

        def rows_like(name: str, tensor: Tensor, count: int = capacity) -> Tensor:
            if name not in self._shared:
                self._shared[name] = tensor.new_zeros(1 << (count - 1).bit_length(), *tensor.shape[1:])
            return self._shared[name][:count]

        with torch.no_grad():
            weights = model.mask_weights()
            numbers = sum(model.shape.widths)
            at = FixedRows(
                model.features.new_zeros(()),
                model.positions().new_zeros(3),
                rows_like("positions", model.positions()),
                tuple(
                    rows_like(name, getattr(model, name).detach().flatten(1)).requires_grad_() for name in PARAMETERS
                ),
                None if weights is None else rows_like("weights", weights),
                tuple(rows_like(f"part {i}", part) for i, part in enumerate(parts)),
                rows_like("random", model.features.new_zeros(0, numbers + 1)).view(-1),
            )
            pool = None
            if places:
                counted = rows_like("pool counted", at.count.new_zeros(0), places)
                pool = PoolRows(
                    rows_like("pool rows", torch.zeros(0, dtype=torch.int64, device=model.device), places),
                    counted,
                    counted.new_zeros(()),
                    tuple(
                        rows_like(f"pool {name}", getattr(model, name).detach().flatten(1), places).requires_grad_()
                        for name in PARAMETERS
                    ),
                    tuple(rows_like(f"pool part {i}", part, places) for i, part in enumerate(parts)),
                    rows_like("pool random", model.features.new_zeros(0, numbers), places).view(-1),
                )
        compute = functools.partial(decode_rows, model, at, pool)
        inputs = [*at.parameters, *(() if pool is None else pool.parameters), *self._watched.learning]
        if not self._graphs:
            return _Prepared(PlainStep(compute, inputs), at, pool)
        with torch.cuda.device(model.device):
            if self._pool is None:
                self._pool = torch.cuda.graph_pool_handle()
            return _Prepared(CapturedStep(compute, inputs, self._pool), at, pool)

    def _rows_held(self, name: str) -> int:
        """Rows of a shared tensor: without the phase that it belongs to there is none."""
        held = self._shared.get(name)
        return 0 if held is None else len(held)

    def _drop(self) -> None:
        """Drop all captured steps. Waits for the device, which may be running one."""
        if self._steps and self._graphs:
            torch.cuda.synchronize()
        self._steps, self._shared, self._pool = {}, {}, None


DECODERS: WeakKeyDictionary[Any, FixedDecoder] = WeakKeyDictionary()


class _Decoded(torch.autograd.Function):
    """The Gaussians with opacity > 0 of a FixedStep, with the gradients of rows at their places among all anchors.

    Those of networks are not returned but added where the optimizer looks for them.
    """

    @classmethod
    def found(
        cls, prepared: _Prepared, rows: SeenRows, networks: list[Tensor], sources: list[Tensor]
    ) -> tuple[NeuralGaussians, Tensor, dict[str, Any]]:
        """(Gaussians, masks [C,k], perhaps the rate) of the loaded anchors `rows`. Waits for the device once."""
        beside: list[Any] = []
        found = cls.apply(prepared, rows, networks, beside, *sources)  # type: ignore[no-untyped-call]
        (opacities, alphas, drawn, counts), (masks, *rate) = beside, found[GAUSSIANS:]
        extras = {"rate": AnchorRate(rate[0], *counts, *rate[1:])} if rate else {}
        return NeuralGaussians(*found[:GAUSSIANS], opacities, alphas, drawn), masks, extras

    @staticmethod
    def forward(
        ctx: Any, prepared: _Prepared, rows: SeenRows, networks: list[Tensor], beside: list[Any], *sources: Tensor
    ) -> tuple[Tensor, ...]:
        results, others = prepared.step.forward()
        alpha, geometry, color, offsets, scales, masks = results[:OUTPUTS]
        opacities, drawn = drawn_of(alpha, masks)
        ctx.given = alpha, geometry, color, prepared.at.positions, offsets, scales, masks
        ctx.prepared, ctx.rows, ctx.networks, ctx.drawn = prepared, rows, networks, drawn
        ctx.shapes = [source.shape for source in sources]
        ctx.set_materialize_grads(False)
        beside += opacities, alpha.detach(), drawn, [each.detach() for each in others]
        rest = [each.detach() for each in results[OUTPUTS - 1 :]]  # masks, and perhaps the rate
        return *prepared.gaussians.spawned(drawn, ctx.given), *rest

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        prepared, drawn, count = ctx.prepared, ctx.drawn, len(ctx.shapes)
        of_gaussians, to_masks, rate = slopes[:GAUSSIANS], slopes[GAUSSIANS], slopes[GAUSSIANS + 1 :]
        into = prepared.step.room()[:OUTPUTS]
        if any(slope is not None for slope in of_gaussians):
            whole = [None if slope is None else slope.contiguous() for slope in of_gaussians]
            if any(slope is None for slope in whole):
                forms = room_for_gaussians(len(drawn), ctx.given[0])
                whole = [form.zero_() if slope is None else slope for form, slope in zip(forms, whole, strict=True)]
            prepared.gaussians.add_gradients(drawn, ctx.given, whole, into)
        if to_masks is not None:
            into[-1].add_(to_masks)
        grads = prepared.step.backward([*into, *rate])
        add_gradients(ctx.networks, grads[count * (1 if prepared.pool is None else 2) :])
        found = prepared.put.put(ctx.rows.placed(), grads[:count], ctx.shapes)
        if prepared.pool is not None:
            own = grads[count : 2 * count]
            found = [
                grad.new_zeros(shape) if into is None and grad is not None else into
                for into, grad, shape in zip(found, own, ctx.shapes, strict=True)
            ]
            prepared.add.add(prepared.pool.rows, own, found)
        return None, None, None, None, *found
