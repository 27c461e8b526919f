"""The decoding of a training step in tensors of one capacity: what it reads, what it computes.

Everything that `CodedAnchors.attributes` and `network_outputs` do, with masks in place of shapes that depend on values.
Nothing in `decode_rows` waits for a GPU, draws at random or writes into what it reads. Gaussians are decoded after it,
those that are visible alone: they are a tenth of all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs
from sw_anchors.anchors import AnchorSelection
from sw_anchors.coded_anchors import ENTROPY, MASK_THRESHOLD, QUANTIZED
from sw_anchors.fast.fused_ops import load_rows, noisy_rows
from sw_anchors.fast.pool_rows import PoolRows
from sw_anchors.fast.seen_rows import SeenRows
from sw_anchors.fast.step_graphs import Found
from sw_anchors.fast.view_networks import network_outputs
from sw_anchors.forecasts import AnchorRate
from sw_anchors.neural_gaussians import visible_gaussians

if TYPE_CHECKING:
    from sw_anchors.coded_anchors import CodedAnchors

PARAMETERS = ("features", "log_scales", "offsets", "mask_logits")
"""Parameters with a row for each anchor that the decoding depends on."""


@dataclass(frozen=True)
class FixedRows:
    """Rows of the visible anchors in tensors of capacity C; the first `count` hold, the rest is what was there before.

    count       scalar float
    center      [3] of the camera
    positions   [C,3]
    parameters  rows [C,...] of PARAMETERS, those of offsets flat; they take gradients
    weights     [C,1] of the masks, or None
    parts       rows of `CodedAnchors.context_rows`
    random      [C (numbers of an anchor + 1)] draws of U(-1/2, 1/2): noise of all numbers, then one for the sample
    """

    count: Tensor
    center: Tensor
    positions: Tensor
    parameters: tuple[Tensor, ...]
    weights: Tensor | None
    parts: tuple[Tensor, ...]
    random: Tensor

    def load(self, model: CodedAnchors, camera: Camera, rows: SeenRows, parts: Sequence[Tensor]) -> None:
        """Copy the anchors `rows` of the model, and draw anew; C is their capacity."""
        rows.write_number(self.count)
        self.center.copy_(camera.center)
        weights = model.mask_weights()
        pairs = [(model.positions(), self.positions), *zip(parts, self.parts, strict=True)]
        pairs += [(getattr(model, name).detach(), mine) for name, mine in zip(PARAMETERS, self.parameters, strict=True)]
        if weights is not None and self.weights is not None:
            pairs.append((weights, self.weights))
        load_rows(rows.loaded, [source for source, _ in pairs], [mine.detach() for _, mine in pairs])
        self.draw(model)

    def draw(self, model: CodedAnchors) -> None:
        """Draw noise and sample."""
        self.random.uniform_(-0.5, 0.5, generator=model.own_generator())


def decode_rows(model: CodedAnchors, at: FixedRows, pool: PoolRows | None) -> Found:
    """Compute all that does not depend on which Gaussians are visible; rows beyond the count have masks 0.

    Returns (the three outputs of the networks, offsets [C,k,3], scales [C,6], masks [C,k], then in the entropy phase
    bits and, if the context has any, own bits of `AnchorRate`), and (by_group and numbers of the rate).

    pool    what the rate is of; None: a sample of the visible anchors
    """
    capacity, k = at.parameters[-1].shape
    noise, draws = torch.split(at.random, [len(at.random) - capacity, capacity])
    steps: Tensor | None = None
    if model.phase == QUANTIZED:
        steps = model.base_steps_like(noise)[None] * model.noise_factor
    elif model.phase == ENTROPY:
        forecast = model.forecast_at(at.parts) if pool is None else model.forecast_pool(at.parts, pool.parts)
        steps = forecast.steps
    values, (own, scales, shifts), masks, kept = noisy_rows(
        at.parameters, at.weights, at.count, None if steps is None else noise, steps, MASK_THRESHOLD
    )
    valid = (torch.arange(capacity, device=values.device) < at.count).to(values)
    rate: list[Tensor] = []
    rate_counts: tuple[Tensor, ...] = ()
    if model.phase == ENTROPY:
        if pool is None:
            drawn, is_drawn = sample_of(draws + 0.5, valid, model.sample)
            counted = kept.index_select(0, drawn) * is_drawn
            share = kept.sum() / at.count.clamp(min=1)
            found_rate = model.rate_of(drawn, values, forecast, masks, counted, share)
        else:
            found_rate = model.pool_rate(pool, forecast)
        rate = [found_rate.bits] + ([] if found_rate.own_bits is None else [found_rate.own_bits])
        rate_counts = found_rate.by_group, found_rate.numbers
    # What is not valid may stand at the camera's centre, where a direction is none.
    positions = torch.where(valid[:, None] > 0, at.positions, at.center + 1)
    networks = (model.mlp_opacity, model.mlp_cov, model.mlp_color)
    outputs = network_outputs(at.center, positions, own, networks)
    return (*outputs, shifts.reshape(capacity, k, 3), scales, masks, *rate), rate_counts


def sample_of(draws: Tensor, valid: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """(rows [S] int64 whose draw [C] of U(0,1) is below `share` and that are valid, 1 where there was one, else 0).

    S is fixed: six standard deviations above the mean of C draws. Places that no row was drawn for name the last row,
    which must not be valid.
    """
    capacity = len(draws)
    size = sample_capacity(capacity, share)
    chosen = (draws < share) & (valid > 0)
    number = chosen.cumsum(0)
    wanted = torch.arange(1, size + 1, device=draws.device)
    found = torch.searchsorted(number, wanted).clamp_(max=capacity - 1)  # the first row that brings the number there
    return found, (wanted <= number[-1]).to(valid)


def sample_capacity(capacity: int, share: float) -> int:
    """Rows of a sample of `share` of `capacity` rows."""
    return min(capacity, math.ceil(capacity * share + 6 * math.sqrt(capacity * share * (1 - share)) + 8))


def inputs_of(model: CodedAnchors, at: FixedRows, rows: SeenRows, found: Found) -> GaussianInputs | None:
    """The Gaussians with opacity > 0, from what `decode_rows` found; anchors `rows` are those that were loaded.

    None: more anchors are seen than there were places for. Waits for the device once, for the number of Gaussians.
    """
    (alpha, geometry, color, offsets, scales, masks, *rate), counts = found
    spawned = visible_gaussians(alpha, geometry, color, at.positions, offsets, scales, masks)
    if not rows.fit():
        return None
    own = rows.placed()
    seen = spawned.alphas if model.COUNTS_MASKED else spawned.all_opacities
    extras: dict[str, Any] = {"masks": masks, "anchors": AnchorSelection(own, seen[: len(own)], spawned.drawn)}
    if rate:
        extras["rate"] = AnchorRate(rate[0], counts[0], counts[1], rate[1] if len(rate) > 1 else None)
    return GaussianInputs(
        means=spawned.means,
        opacities=spawned.opacities,
        scales=spawned.scales,
        quats=spawned.quats,
        colors=spawned.colors,
        extras=extras,
    )
