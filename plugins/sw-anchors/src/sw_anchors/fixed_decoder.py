"""Decoding of the visible anchors of a training step in tensors of fixed sizes, for CUDA graphs.

How many anchors a view sees differs from step to step. Here their rows are copied into tensors of a capacity, a few of
which serve all views, and rows beyond the count are masked. So no shape depends on a value, and on a GPU the host
starts values, noise, prediction, rate and the three networks with one call, and their gradients with another.
"""

from __future__ import annotations

import functools
import logging
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_core.api import Camera, GaussianInputs
from sw_anchors.coded_anchors import ENTROPY
from sw_anchors.fixed_step import PARAMETERS, FixedRows, decode_rows, inputs_of
from sw_anchors.fused_ops import put_rows
from sw_anchors.step_graphs import CapturedStep, FixedStep, PlainStep, Watched, add_gradients

if TYPE_CHECKING:
    from sw_anchors.coded_anchors import CodedAnchors

log = logging.getLogger(__name__)

SMALLEST = 256
KEPT = 16
"""Capacities whose steps are kept; views of one scene ask for fewer."""


class FixedDecoder:
    """Decodes one CodedAnchors in training. A step is prepared when its capacity is first asked for.

    All are prepared anew after a change of what decides the operators (`CodedAnchors.step_key`) or of a tensor of the
    model that does not belong to single anchors (a network was replaced). Growth changes neither.

    captures    how many steps were prepared, since this was made
    """

    def __init__(self, *, graphs: bool = True) -> None:
        """graphs: as CUDA graphs; else operator by operator, on any device, which is slower than no FixedDecoder."""
        self.captures = 0
        self._graphs = graphs
        self._failed = False
        self._pool: tuple[int, int] | None = None
        self._steps: dict[int, tuple[FixedStep, FixedRows]] = {}
        self._key: tuple[Any, ...] = ()
        self._watched = Watched([])
        self._shared: dict[str, Tensor] = {}

    def decode(self, model: CodedAnchors, camera: Camera, rows: Tensor) -> GaussianInputs | None:
        """Decode the anchors `rows` [V]: their Gaussians with opacity > 0.

        None where the model has no form for it, or the GPU refused a graph or had no memory for it; that is said once.
        """
        parts = model.context_rows() if model.phase == ENTROPY else ()
        if self._failed or parts is None:
            return None
        try:
            step, at = self._prepared(model, parts, capacity_of(len(rows)))
        except RuntimeError as error:
            self._failed = True
            log.warning("training goes on without CUDA graphs, slower: %s", str(error).partition("\n")[0])
        if self._failed:  # beyond the handler, whose error holds what was made until then
            self._drop()
            torch.cuda.empty_cache()
            return None
        with torch.no_grad():
            at.load(model, camera, rows, parts)
        sources = [getattr(model, name) for name in PARAMETERS]
        results, others = _Decoded.found(step, rows, self._watched.learning, sources)
        return inputs_of(at, rows, (results, others))

    def _prepared(self, model: CodedAnchors, parts: tuple[Tensor, ...], capacity: int) -> tuple[FixedStep, FixedRows]:
        key = (*model.step_key(), *(part.shape[1:] for part in parts))
        if key != self._key or not self._watched.unchanged() or capacity > self._rows_held():
            self._drop()
            self._key, self._watched = key, Watched.of(model, {*model.ROWS, "bounds"})
        found = self._steps.get(capacity)
        if found is None:
            if len(self._steps) >= KEPT:
                held = self._shared
                self._drop()
                self._shared = held
            found = self._steps[capacity] = self._prepare(model, parts, capacity)
        return found

    def _prepare(self, model: CodedAnchors, parts: tuple[Tensor, ...], capacity: int) -> tuple[FixedStep, FixedRows]:
        self.captures += 1
        size = max(self._rows_held(), 1 << (capacity - 1).bit_length())

        def rows_like(name: str, tensor: Tensor) -> Tensor:
            if name not in self._shared:
                self._shared[name] = tensor.new_zeros(size, *tensor.shape[1:])
            return self._shared[name][:capacity]

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
        compute = functools.partial(decode_rows, model, at)
        inputs = [*at.parameters, *self._watched.learning]
        if not self._graphs:
            return PlainStep(compute, inputs), at
        with torch.cuda.device(model.device):
            if self._pool is None:
                self._pool = torch.cuda.graph_pool_handle()
            return CapturedStep(compute, inputs, self._pool), at

    def _rows_held(self) -> int:
        held = self._shared.get("positions")
        return 0 if held is None else len(held)

    def _drop(self) -> None:
        """Forget all steps. Waits for the device, which may be at one."""
        if self._steps and self._graphs:
            torch.cuda.synchronize()
        self._steps, self._shared, self._pool = {}, {}, None


class _Decoded(torch.autograd.Function):
    """Results of a FixedStep, with the gradients of rows at their places among all anchors.

    Those of networks are not returned but added where the optimizer looks for them.
    """

    @classmethod
    def found(
        cls, step: FixedStep, rows: Tensor, networks: list[Tensor], sources: list[Tensor]
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """(differentiable results, others)."""
        counts: list[int] = []
        found = cls.apply(step, rows, networks, counts, *sources)  # type: ignore[no-untyped-call]
        return found[: counts[0]], found[counts[0] :]

    @staticmethod
    def forward(
        ctx: Any, step: FixedStep, rows: Tensor, networks: list[Tensor], counts: list[int], *sources: Tensor
    ) -> tuple[Tensor, ...]:
        results, others = step.forward()
        ctx.step, ctx.networks, ctx.count = step, networks, len(results)
        ctx.shapes = [source.shape for source in sources]
        ctx.save_for_backward(rows)
        ctx.set_materialize_grads(False)
        counts.append(len(results))
        results, others = tuple(each.detach() for each in results), tuple(each.detach() for each in others)
        ctx.mark_non_differentiable(*others)
        return *results, *others

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        (rows,) = ctx.saved_tensors
        grads = ctx.step.backward(slopes[: ctx.count])
        add_gradients(ctx.networks, grads[len(ctx.shapes) :])
        own = grads[: len(ctx.shapes)]
        found = put_rows(rows, own, ctx.shapes[0][0])
        shaped = (None if grad is None else grad.view(shape) for grad, shape in zip(found, ctx.shapes, strict=True))
        return None, None, None, None, *shaped


def capacity_of(count: int) -> int:
    """Rows of the tensors for `count` anchors: more than these, in four sizes an octave."""
    size = max(count + 1, SMALLEST)
    unit = 1 << (size.bit_length() - 3)
    return -(-size // unit) * unit
