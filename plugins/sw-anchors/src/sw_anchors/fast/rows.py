"""Gather, scatter and noise of anchor rows in a training step, each in one pass over memory on CUDA.

Gradients are written into place: rows are taken once each, so nothing has to be summed (indexing a CUDA tensor sorts
its index on the way back). Elsewhere the same by torch operations.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import Repeated, fast_enabled
from sw_anchors import cuda_face
from sw_anchors.native import ANCHORS
from sw_anchors.shape import AnchorShape
from sw_codecs.quantizers.straight_through import hard_mask

MAX_TENSORS = 12
"""Largest number of tensors per launch: `kTensors` of kernels/rows.h."""
GIVEN = ("features", "log_scales", "offsets", "logits", "weights", "valid", "noise", "steps")
"""Arguments that both operations of noisy rows read, as kernels/cuda/face.h names them."""


def fit_kernels(*tensors: Tensor) -> bool:
    """Whether there are kernels for these tensors, on CUDA, 4 bytes per number, contiguous rows; loads them."""
    if not tensors or len(tensors) > MAX_TENSORS:
        return False
    if not all(t.is_cuda and t.element_size() == 4 and t.dim() > 0 for t in tensors):
        return False
    contiguous = all(t.is_contiguous() or (t.dim() == 2 and t.stride(1) == 1) for t in tensors)
    return contiguous and fast_enabled() and ANCHORS.has_cuda()


def take_rows(rows: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Rows [S] (int64, each at most once) of each tensor; differentiable."""
    found: tuple[Tensor, ...] = _TakeRows.apply(rows, *tensors)  # type: ignore[no-untyped-call]
    return found


def load_rows(rows: Tensor, sources: Sequence[Tensor], into: Sequence[Tensor]) -> None:
    """Copy rows [V] (int64) of each source [N,...], flat, into the first V rows of its target [V or more, ...]."""
    if fit_kernels(*sources) and fit_kernels(*into):
        cuda_face.copy_rows(**_copied(rows, sources, into, Way.GATHER))
        return
    for source, mine in zip(sources, into, strict=True):
        flat = source if source.dim() == mine.dim() else source.flatten(1)
        torch.index_select(flat, 0, rows, out=mine[: len(rows)])


def put_rows(rows: Tensor, sources: Sequence[Tensor | None], count: int) -> list[Tensor | None]:
    """For each source [V or more,...] `count` rows of zeros, of which `rows` [V] are its first V; None for None."""
    given = [source for source in sources if source is not None]
    if fit_kernels(*given):
        found = [source.new_empty(count, *source.shape[1:]) for source in given]
        cuda_face.copy_rows(**_copied(rows, given, found, Way.SCATTER, cleared=count))
    else:
        found = [s.new_zeros(count, *s.shape[1:]).index_copy_(0, rows, s[: len(rows)]) for s in given]
    each = iter(found)
    return [None if source is None else next(each) for source in sources]


def add_rows(rows: Tensor, sources: Sequence[Tensor | None], into: Sequence[Tensor | None]) -> None:
    """Add row i of each float32 source [S,...] to row rows[i] of its target; a source that is None adds nothing.

    rows    [S] int64, which may name one more than once; on CUDA such sums have one order where all but one of the
            rows that are added to it are zeros
    """
    pairs = [(s, t) for s, t in zip(sources, into, strict=True) if s is not None and t is not None]
    given, targets = [s for s, _ in pairs], [t for _, t in pairs]
    if fit_kernels(*given) and fit_kernels(*targets):
        cuda_face.copy_rows(**_copied(rows, given, targets, Way.ADD))
        return
    for source, target in pairs:
        target.view(-1, *source.shape[1:]).index_add_(0, rows, source)


def gathered(rows: Tensor, tensors: Sequence[Tensor]) -> list[Tensor]:
    """Rows [S] (int64) of each tensor [N,...], which may be named more than once; without gradients."""
    if fit_kernels(*tensors):
        found = [t.new_empty(len(rows), *t.shape[1:]) for t in tensors]
        cuda_face.copy_rows(**_copied(rows, tensors, found, Way.GATHER))
        return found
    return [t.index_select(0, rows) for t in tensors]


class Way(IntEnum):
    """Direction in which rows are copied: `way` of kernels/cuda/face.h."""

    GATHER = 0
    SCATTER = 1
    ADD = 2


def _copied(
    rows: Tensor, sources: Sequence[Tensor], targets: Sequence[Tensor], way: Way, cleared: int = 0
) -> dict[str, Any]:
    """Arguments of `copy_rows` for tensors that fit the kernels. RuntimeError for rows of other sizes, or too few."""
    count, gather, words = len(rows), way is Way.GATHER, [math.prod(source.shape[1:]) for source in sources]
    for source, target, own in zip(sources, targets, words, strict=True):
        if own != math.prod(target.shape[1:]) or len(target if gather else source) < count:
            raise RuntimeError(f"{count} rows of {list(source.shape)} do not fit into {list(target.shape)}")
        if not gather and (source.dtype, target.dtype) != (torch.float32, torch.float32):
            raise RuntimeError(f"float32 rows are put and added, not {source.dtype} to {target.dtype}")
    far = [[n if t.is_contiguous() else t.stride(0) for t, n in zip(x, words, strict=True)] for x in (sources, targets)]
    return {
        "sources": sources, "targets": targets, "words": words, "source_rows": far[0], "target_rows": far[1],
        "tensors": len(words), "rows": rows.contiguous(), "cleared": cleared, "way": int(way),
    }  # fmt: skip


class AlikeRows(threading.local):
    """Copies of rows that are alike at each step of a training: a thread's first is checked, others for its form.

    Where there is no kernel for them they are those of `load_rows`, `put_rows` and `add_rows`.
    """

    def __init__(self, way: Way) -> None:
        self._way = way
        self._form: list[Any] | None = None
        self._call: Repeated | None = None

    def load(self, rows: Tensor, sources: Sequence[Tensor], into: Sequence[Tensor]) -> None:
        """As `load_rows`; the targets are the same each time."""
        if not self._copy(rows, sources, into, sources, into[0].shape[0]):
            load_rows(rows, sources, into)

    def put(self, rows: Tensor, sources: Sequence[Tensor | None], shapes: Sequence[torch.Size]) -> list[Tensor | None]:
        """As `put_rows`, where the results have these shapes."""
        given = [(source, shape) for source, shape in zip(sources, shapes, strict=True) if source is not None]
        own, found = [source for source, _ in given], [source.new_empty(shape) for source, shape in given]
        if given and not self._copy(rows, own, found, own, own[0].shape[0], cleared=shapes[0][0]):
            plain = put_rows(rows, own, shapes[0][0])
            found = [x.view(shape) for x, (_, shape) in zip(plain, given, strict=True) if x is not None]
        each = iter(found)
        return [None if source is None else next(each) for source in sources]

    def add(self, rows: Tensor, sources: Sequence[Tensor | None], into: Sequence[Tensor | None]) -> None:
        """As `add_rows`; rows of a source may be flat."""
        pairs = [(s, t) for s, t in zip(sources, into, strict=True) if s is not None and t is not None]
        given, targets = [s for s, _ in pairs], [t for _, t in pairs]
        if given and not self._copy(rows, given, targets, (*given, *targets), given[0].shape[0]):
            add_rows(rows, given, targets)

    def _copy(
        self,
        rows: Tensor,
        sources: Sequence[Tensor],
        targets: Sequence[Tensor],
        looked_at: Sequence[Tensor],
        most: int,
        cleared: int = 0,
    ) -> bool:
        """Copy at most `most` rows, if there are kernels; others are alike wherever those that are looked at are."""
        # The first stride of what is contiguous tells the size of a row.
        form = [looked_at[0].get_device(), *(x for t in looked_at for x in (t.dtype, t.stride()))]
        if form != self._form:
            fits = fit_kernels(*sources) and fit_kernels(*targets)
            # Of one row any stride is contiguous, but of more with the same strides no more.
            whole = (t.is_contiguous() and t.stride(0) == math.prod(t.shape[1:]) for t in (*sources, *targets))
            alike = fits and all(whole)
            self._form, self._call = form, Repeated(cuda_face, "copy_rows") if alike else None
        count = rows.shape[0]
        if self._call is None or count > most:
            return False
        now = {"sources": list(sources), "targets": list(targets), "rows": rows, "count": count, "cleared": cleared}
        kept = lambda: {x: y for x, y in _copied(rows, sources, targets, self._way).items() if x not in now}  # noqa: E731
        self._call(kept, **now)
        return True


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(rows)
        ctx.count = len(tensors[0])
        return tuple(gathered(rows, tensors))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (rows,) = ctx.saved_tensors
        wanted = zip(grads, ctx.needs_input_grad[1:], strict=True)
        return None, *put_rows(rows, [grad if needed else None for grad, needed in wanted], ctx.count)


def noisy_rows(
    parameters: Sequence[Tensor],
    mask_weights: Tensor | None,
    valid: Tensor,
    noise: Tensor | None,
    steps: Tensor | None,
    threshold: float,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor], Tensor, Tensor]:
    """Numbers and masks of C anchors, of which the first `valid` hold; those of others mean nothing, their masks are 0.

    parameters      features [C,F], log_scales [C,6], offsets [C,3k], mask_logits [C,k]
    mask_weights    [C,1] or None, as of `noisy_values`; `threshold` likewise
    valid           scalar float
    noise           [C (F+6+3k)] that the steps multiply, or None
    steps           [C,3] or [1,3] of the groups; differentiable if [C,3]

    Returns (values [C,F+6+3k], the same by group, masks [C,k], [C] whether any mask of an anchor is 1).
    """
    features, log_scales, offsets, logits = parameters
    if fit_kernels(*parameters):
        values, *groups, masks, kept = _NoisyRows.apply(*parameters, mask_weights, valid, noise, steps, threshold)  # type: ignore[no-untyped-call]
        return values, (groups[0], groups[1], groups[2]), masks, kept
    shape = AnchorShape(features.shape[1], logits.shape[1])
    values = torch.cat([features, log_scales.exp(), offsets], dim=1)
    masks = hard_mask(logits, threshold, 1.0 if mask_weights is None else mask_weights)
    masks = masks * (torch.arange(len(logits), device=values.device) < valid).to(values)[:, None]
    if noise is not None and steps is not None:
        values = torch.addcmul(values, noise.view_as(values), shape.widened(steps))
    own, scales, shifts = torch.split(values, list(shape.widths), dim=1)
    return values, (own, scales, shifts), masks, masks.detach().amax(dim=1)


class _NoisyRows(torch.autograd.Function):
    """Autograd node of `noisy_rows`: one kernel each for forward and backward."""

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        log_scales: Tensor,
        offsets: Tensor,
        mask_logits: Tensor,
        mask_weights: Tensor | None,
        valid: Tensor,
        noise: Tensor | None,
        steps: Tensor | None,
        threshold: float,
    ) -> tuple[Tensor, ...]:
        given = (features, log_scales, offsets, mask_logits, mask_weights, valid, noise, steps)
        count, k = mask_logits.shape
        values = features.new_empty(count, features.shape[1] + 6 + 3 * k)
        masks, kept = torch.empty_like(mask_logits), features.new_empty(count)
        cuda_face.row_values(
            **dict(zip(GIVEN, given, strict=True)), threshold=threshold, values=values, masks=masks, kept=kept
        )
        ctx.save_for_backward(*given)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(kept)
        groups = torch.split(values, [features.shape[1], 6, offsets.shape[1]], dim=1)
        return values, *groups, masks, kept

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        learns = ctx.needs_input_grad[7]
        rows = [s if s is None or s.stride(1) == 1 else s.contiguous() for s in slopes[:5]]
        by_values, by_features, by_scales, by_offsets, by_masks = rows
        found = [torch.empty_like(t) for t in ctx.saved_tensors[:4]]
        to_features, to_log_scales, to_offsets, to_logits = found
        to_steps = to_features.new_empty(len(to_features), 3) if learns else None
        cuda_face.row_values_backward(
            **dict(zip(GIVEN, ctx.saved_tensors, strict=True)), threshold=0.0,
            by_values=by_values, by_features=by_features, by_scales=by_scales, by_offsets=by_offsets,
            by_masks=by_masks, by_rows=[0 if s is None else s.stride(0) for s in rows],
            to_features=to_features, to_log_scales=to_log_scales, to_offsets=to_offsets, to_logits=to_logits,
            to_steps=to_steps,
        )  # fmt: skip
        return *found, None, None, None, to_steps, None
