"""Operators of a training step on anchors, each one node of the graph of derivatives.

Noise, rate and decoding of a step share one matrix of all numbers of an anchor. Gradients are written into place: rows
are taken once each, so nothing has to be summed (indexing a CUDA tensor sorts its index on the way back).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors.fast import row_kernels
from sw_anchors.fast.row_kernels import NoisyRows, SampleBits, bits_fit_kernel, fit_kernels
from sw_codecs.entropy.rates import gaussian_bits


def anchor_values(
    rows: Tensor | None,
    features: Tensor,
    log_scales: Tensor,
    offsets: Tensor,
    mask_logits: Tensor,
    mask_weights: Tensor | None,
    threshold: float,
) -> tuple[Tensor, Tensor]:
    """(values [V, F+6+3k]: features, exp(log_scales) and offsets of the anchors `rows`; their masks [V,k]).

    rows            [V] int64, each at most once; None: all
    mask_weights    [N,1] or None for 1: a mask is 1 where sigmoid(logit) times its weight exceeds `threshold`, else 0;
                    its gradient is that of sigmoid(logit) times the weight, and none goes to the weight
    """
    found = _Values.apply(rows, features, log_scales, offsets, mask_logits, mask_weights, threshold)  # type: ignore[no-untyped-call]
    values, masks = found
    return values, masks


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
    mask_weights    [C,1] or None, as of `anchor_values`; `threshold` likewise
    valid           scalar float
    noise           [C (F+6+3k)] that the steps multiply, or None
    steps           [C,3] or [1,3] of the groups; differentiable if [C,3]

    Returns (values [C,F+6+3k], the same by group, masks [C,k], [C] whether any mask of an anchor is 1).
    """
    features, log_scales, offsets, logits = parameters
    if fit_kernels(*parameters):
        values, *groups, masks, kept = NoisyRows.apply(*parameters, mask_weights, valid, noise, steps, threshold)  # type: ignore[no-untyped-call]
        return values, (groups[0], groups[1], groups[2]), masks, kept
    capacity, k = logits.shape
    values, masks = anchor_values(
        None, features, log_scales, offsets.view(capacity, k, 3), logits, mask_weights, threshold
    )
    masks = masks * (torch.arange(capacity, device=values.device) < valid).to(values)[:, None]
    widths = [features.shape[1], 6, 3 * k]
    if noise is not None and steps is not None:
        wide = torch.cat([step.expand(-1, width) for step, width in zip(steps.split(1, 1), widths, strict=True)], dim=1)
        values = torch.addcmul(values, noise.view_as(values), wide)
    own, scales, shifts = torch.split(values, widths, dim=1)
    return values, (own, scales, shifts), masks, masks.detach().amax(dim=1)


def sample_bits(
    x: Tensor,
    mean: Tensor,
    scale: Tensor,
    steps: Tensor,
    masks: Tensor,
    counted: Tensor,
    *,
    p_min: float,
    smallest_scale: float,
) -> tuple[Tensor, Tensor]:
    """(bits of S anchors, differentiable; the same by group [3]) under Gaussians.

    x, mean, scale      [S,F+6+3k]; scales below `smallest_scale` are taken for that
    steps               [S,3] widths of the bins by group
    masks               [S,k] factors of the bits of an offset
    counted             [S] factors of the bits of all other numbers

    The derivative by the bits must not be negative.
    """
    if bits_fit_kernel(x, mean, scale, steps, masks, counted):
        bits, by_group = SampleBits.apply(x, mean, scale, steps, masks, counted, p_min, smallest_scale)  # type: ignore[no-untyped-call]
        return bits, by_group
    offsets = 3 * masks.shape[1]
    widths = [x.shape[1] - 6 - offsets, 6, offsets]
    alone = counted[:, None].expand(-1, widths[0] + widths[1])
    factors = torch.cat([alone, masks[:, :, None].expand(-1, -1, 3).flatten(1)], dim=1)
    wide = torch.cat([step.expand(-1, width) for step, width in zip(steps.split(1, 1), widths, strict=True)], dim=1)
    each = gaussian_bits(x, mean, scale.clamp(min=smallest_scale), wide, p_min=p_min) * factors
    return each.sum(), torch.stack([part.sum() for part in each.detach().split(widths, dim=1)])


class _Values(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor | None,
        features: Tensor,
        log_scales: Tensor,
        offsets: Tensor,
        mask_logits: Tensor,
        mask_weights: Tensor | None,
        threshold: float,
    ) -> tuple[Tensor, Tensor]:
        def taken(tensor: Tensor) -> Tensor:
            return tensor if rows is None else tensor.index_select(0, rows)

        scales = taken(log_scales).exp()
        values = torch.cat([taken(features), scales, taken(offsets.flatten(1))], dim=1)
        soft = taken(mask_logits).sigmoid()
        weights = None if mask_weights is None else taken(mask_weights)
        weighted = soft if weights is None else soft * weights
        ctx.save_for_backward(rows, scales, soft, weights)
        ctx.shapes = [t.shape for t in (features, log_scales, offsets, mask_logits)]
        return values, (weighted > threshold).to(soft.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_values: Tensor, to_masks: Tensor) -> tuple[Tensor | None, ...]:
        rows, scales, soft, weights = ctx.saved_tensors
        shapes = ctx.shapes
        widths = [shapes[0][1], 6, shapes[2][1] * shapes[2][2]]
        to_features, to_scales, to_offsets = torch.split(to_values, widths, dim=1)
        to_soft = torch.ops.aten.sigmoid_backward(to_masks if weights is None else to_masks * weights, soft)
        sources = (to_features, to_scales * scales, to_offsets.reshape(-1, *shapes[2][1:]), to_soft)
        if rows is None:
            return None, *sources, None, None
        found = [s.new_zeros(shape).index_copy_(0, rows, s) for s, shape in zip(sources, shapes, strict=True)]
        return None, *found, None, None


def take_rows(rows: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Rows [S] (int64, each at most once) of each tensor; differentiable."""
    found: tuple[Tensor, ...] = _TakeRows.apply(rows, *tensors)  # type: ignore[no-untyped-call]
    return found


def load_rows(rows: Tensor, sources: Sequence[Tensor], into: Sequence[Tensor]) -> None:
    """Copy rows [V] (int64) of each source [N,...], flat, into the first V rows of its target [V or more, ...]."""
    if fit_kernels(*sources) and fit_kernels(*into):
        row_kernels.load_rows(rows, sources, into)
        return
    for source, mine in zip(sources, into, strict=True):
        flat = source if source.dim() == mine.dim() else source.flatten(1)
        torch.index_select(flat, 0, rows, out=mine[: len(rows)])


def put_rows(rows: Tensor, sources: Sequence[Tensor | None], count: int) -> list[Tensor | None]:
    """For each source [V or more,...] `count` rows of zeros, of which `rows` [V] are its first V; None for None."""
    given = [source for source in sources if source is not None]
    if fit_kernels(*given):
        found = iter(row_kernels.scatter_rows(rows, given, count))
        return [None if source is None else next(found) for source in sources]
    return [
        None if s is None else s.new_zeros(count, *s.shape[1:]).index_copy_(0, rows, s[: len(rows)]) for s in sources
    ]


def add_rows(rows: Tensor, sources: Sequence[Tensor | None], into: Sequence[Tensor | None]) -> None:
    """Add row i of each float32 source [S,...] to row rows[i] of its target; a source that is None adds nothing.

    rows    [S] int64, which may name one more than once; on CUDA such sums have one order where all but one of the
            rows that are added to it are zeros
    """
    pairs = [(s, t) for s, t in zip(sources, into, strict=True) if s is not None and t is not None]
    given, targets = [s for s, _ in pairs], [t for _, t in pairs]
    if fit_kernels(*given) and fit_kernels(*targets):
        row_kernels.add_rows(rows, given, targets)
        return
    for source, target in pairs:
        target.index_add_(0, rows, source)


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(rows)
        ctx.count = len(tensors[0])
        if fit_kernels(*tensors):
            return tuple(row_kernels.take_rows(rows, tensors))
        return tuple(t.index_select(0, rows) for t in tensors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (rows,) = ctx.saved_tensors
        wanted = zip(grads, ctx.needs_input_grad[1:], strict=True)
        return None, *put_rows(rows, [grad if needed else None for grad, needed in wanted], ctx.count)


def times_ones(values: Tensor, factors: Tensor, rows: Tensor) -> Tensor:
    """Values [M,C] times the factors [...] at `rows` [M] (int64, each at most once) of them all, which are 1.

    So it is the same values, and the factors get their gradient.
    """
    found: Tensor = _TimesOnes.apply(values, factors, rows)  # type: ignore[no-untyped-call]
    return found


class _TimesOnes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factors: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(values, rows)
        ctx.shape = factors.shape
        return values.view_as(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        values, rows = ctx.saved_tensors
        (to_factors,) = put_rows(rows, [(grad * values).sum(dim=1)], ctx.shape.numel())
        assert to_factors is not None
        return grad, to_factors.view(ctx.shape), None


def widen(steps: Tensor, group: Tensor, one_hot: Tensor) -> Tensor:
    """Steps [V,3] of the groups, one for each column: [V,C].

    group       [C] int64: the group of each column
    one_hot     [C,3] the same as zeros and ones
    """
    found: Tensor = _Widen.apply(steps, group, one_hot)  # type: ignore[no-untyped-call]
    return found


class _Widen(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, steps: Tensor, group: Tensor, one_hot: Tensor) -> Tensor:
        ctx.save_for_backward(one_hot)
        return steps.index_select(1, group)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (one_hot,) = ctx.saved_tensors
        return torch.mm(grad, one_hot), None, None


def mean_product(scales: Tensor) -> Tensor:
    """Mean over the rows of scales [M,3] of their product, 0 for none; a scalar, differentiable.

    As `scales.prod(dim=1).mean()`, whose backward looks for zeros and so waits for a GPU.
    """
    found: Tensor = _MeanProduct.apply(scales)  # type: ignore[no-untyped-call]
    return found


class _MeanProduct(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor) -> Tensor:
        ctx.save_for_backward(scales)
        x, y, z = scales.unbind(1)
        total: Tensor = (x * y * z).sum() / max(len(scales), 1)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (scales,) = ctx.saved_tensors
        found: Tensor = grad / max(len(scales), 1) * scales.roll(1, 1) * scales.roll(-1, 1)
        return found


Weighted = tuple[float, Tensor]
"""Weight of a scalar in a sum, and the scalar."""


def weighted_sum(start: Tensor, *terms: Weighted) -> tuple[Tensor, ...]:
    """(start plus all terms times their weights; the weighted terms, without gradient); all scalars of one device.

    A product and a sum a term would launch four kernels each, forward and backward, for one number.
    """
    found: tuple[Tensor, ...] = _WeightedSum.apply([weight for weight, _ in terms], start, *(t for _, t in terms))  # type: ignore[no-untyped-call]
    return found


class _WeightedSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: list[float], start: Tensor, *terms: Tensor) -> tuple[Tensor, ...]:
        ctx.weights = weights
        weighted = torch._foreach_mul(terms, weights) if terms else []
        ctx.mark_non_differentiable(*weighted)
        return torch.stack([start, *weighted]).sum(), *weighted

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        slopes = torch._foreach_mul([slope] * len(ctx.weights), ctx.weights) if ctx.weights else []
        return None, slope, *slopes
