"""Anchor decoding of a training step in tensors of fixed capacity, for CUDA graphs.

Everything that `CodedAnchors.attributes` and `network_outputs` do, with masks in place of shapes that depend on values.
Nothing in `decode_rows` waits for a GPU, draws at random or writes into what it reads. Gaussians are decoded after it,
those that are visible alone: they are a tenth of all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from sw_gaussians.fast.graphs import Found
from torch import Tensor, nn

from splatwizard_core.api import Camera, GaussianInputs
from sw_anchors.fast.networks import network_outputs
from sw_anchors.fast.rows import AlikeRows, Way, noisy_rows, take_rows
from sw_anchors.fast.seen_rows import SeenRows
from sw_anchors.neural_gaussians import NeuralGaussians
from sw_anchors.noisy_values import ENTROPY, MASK_THRESHOLD, QUANTIZED
from sw_anchors.rate_model import AnchorForecast, AnchorRate, RateInputs, RateModel
from sw_anchors.shape import AnchorShape

PARAMETERS = ("features", "log_scales", "offsets", "mask_logits")
"""Per-anchor parameters that the decoding reads."""


class Model(Protocol):
    """Protocol of the `CodedAnchors` members that decoding reads."""

    phase: str
    sample: float
    mlp_opacity: nn.Sequential
    mlp_cov: nn.Sequential
    mlp_color: nn.Sequential

    @property
    def shape(self) -> AnchorShape:
        """Numbers of an anchor."""
        ...

    @property
    def rate_model(self) -> RateModel:
        """The rate model."""
        ...

    @property
    def num_rows(self) -> int:
        """Number of anchors."""
        ...

    def positions(self) -> Tensor:
        """Positions of all anchors."""
        ...

    def mask_weights(self) -> Tensor | None:
        """Factors of the soft masks."""
        ...

    def noise_steps(self, like: Tensor) -> Tensor:
        """Steps [1,3] of the noise in the phase QUANTIZED, on a device."""
        ...

    def own_generator(self) -> torch.Generator | None:
        """Generator of noise."""
        ...

    def uniform(self, *shape: int) -> Tensor:
        """Draws of U(0,1)."""
        ...

    def drawn(
        self, rows: Tensor, found: NeuralGaussians, masks: Tensor | None, extras: dict[str, Any]
    ) -> GaussianInputs:
        """Gaussians as inputs."""
        ...


@dataclass(frozen=True)
class FixedRows:
    """Rows of the visible anchors in tensors of capacity C; the first `count` are valid, the rest is stale.

    count       scalar float
    center      [3] of the camera
    positions   [C,3]
    parameters  rows [C,...] of PARAMETERS, those of offsets flat; they take gradients
    weights     [C,1] of the masks, or None
    parts       rows of the model's `context_rows`
    random      [C (numbers of an anchor + 1)] draws of U(-1/2, 1/2): noise of all numbers, then one for the sample
    copying     of the rows, for all loads
    """

    count: Tensor
    center: Tensor
    positions: Tensor
    parameters: tuple[Tensor, ...]
    weights: Tensor | None
    parts: tuple[Tensor, ...]
    random: Tensor
    copying: AlikeRows = field(default_factory=lambda: AlikeRows(Way.GATHER))

    def load(self, model: Model, camera: Camera, rows: SeenRows, parts: Sequence[Tensor]) -> None:
        """Copy the anchors `rows` of the model into the buffers of capacity C, and draw new noise."""
        rows.write_number(self.count)
        self.center.copy_(camera.center)
        weights = () if self.weights is None else (model.mask_weights(),)
        sources = [model.positions(), *parts, *(getattr(model, name) for name in PARAMETERS), *weights]
        into = [self.positions, *self.parts, *self.parameters, *(() if self.weights is None else (self.weights,))]
        self.copying.load(rows.loaded, sources, into)
        self.draw(model)

    def draw(self, model: Model) -> None:
        """Draw noise and sample."""
        self.random.uniform_(-0.5, 0.5, generator=model.own_generator())


@dataclass(frozen=True)
class PoolRows:
    """A sample of all anchors in S rows; unused rows repeat the last anchor and are not counted.

    rows        [S] int64 of the model
    counted     [S] 1 where an anchor was drawn, else 0
    size        scalar float, S
    parameters  rows of PARAMETERS, those of offsets flat; they take gradients
    parts       rows of the model's `context_rows`
    random      [S (numbers of an anchor)] draws of U(-1/2, 1/2)
    copying     of the rows, for all loads
    """

    rows: Tensor
    counted: Tensor
    size: Tensor
    parameters: tuple[Tensor, ...]
    parts: tuple[Tensor, ...]
    random: Tensor
    copying: AlikeRows = field(default_factory=lambda: AlikeRows(Way.GATHER))

    @torch.no_grad()
    def load(self, model: Model, sources: Sequence[Tensor], parts: Sequence[Tensor]) -> None:
        """Draw anchors and noise anew. sources: the model's PARAMETERS; parts: its `context_rows`."""
        rows, counted = bernoulli_rows(model.uniform(len(self.rows)), model.num_rows, model.sample)
        self.rows.copy_(rows)
        self.counted.copy_(counted)
        self.size.fill_(len(self.rows))
        self.copying.load(self.rows, [*sources, *parts], [*self.parameters, *self.parts])
        self.draw(model)

    def draw(self, model: Model) -> None:
        """Draw noise."""
        self.random.uniform_(-0.5, 0.5, generator=model.own_generator())


def decode_rows(model: Model, at: FixedRows, pool: PoolRows | None) -> Found:
    """Compute everything independent of which Gaussians are visible; rows beyond the count have masks 0.

    Returns (the three outputs of the networks, offsets [C,k,3], scales [C,6], masks [C,k], then with a rate its bits
    and, if the rate model has any, own bits), and (by_group and numbers of the rate).

    pool    what the rate is of; None: a sample of the visible anchors
    """
    capacity, k = at.parameters[-1].shape
    noise, draws = torch.split(at.random, [len(at.random) - capacity, capacity])
    valid = (torch.arange(capacity, device=noise.device) < at.count).to(noise)
    steps: Tensor | None = None
    if model.phase == QUANTIZED:
        steps = model.noise_steps(noise)
    elif model.phase == ENTROPY:
        if pool is None:
            drawn, is_drawn = sample_of(draws + 0.5, valid, model.sample)
            forecast = model.rate_model.forecast(at.parts, drawn)
            steps = forecast.steps
        else:
            both: RateInputs = tuple(torch.cat(pair) for pair in zip(at.parts, pool.parts, strict=True))
            forecast = model.rate_model.forecast(both, slice(capacity, None))
            steps = forecast.steps[:capacity]
    given = (at.parameters, at.weights, at.count, None if steps is None else noise, steps, MASK_THRESHOLD)
    values, (own, scales, shifts), masks, kept = noisy_rows(*given)
    rate: AnchorRate | None = None
    if model.phase == ENTROPY and pool is None:
        x, of_drawn = take_rows(drawn, values, masks)
        counted = kept.index_select(0, drawn) * is_drawn
        rate = _rate(model, x, forecast, of_drawn, counted, kept.sum() / at.count.clamp(min=1))
    elif model.phase == ENTROPY and pool is not None:
        x, _, of_drawn, _ = noisy_rows(
            pool.parameters, None, pool.size, pool.random, forecast.sample_steps, MASK_THRESHOLD
        )
        rate = _rate(model, x, forecast, of_drawn, pool.counted, None)
    # What is not valid may stand at the camera's centre, where a direction is none.
    positions = torch.where(valid[:, None] > 0, at.positions, at.center + 1)
    networks = (model.mlp_opacity, model.mlp_cov, model.mlp_color)
    outputs = (*network_outputs(at.center, positions, own, networks), shifts.reshape(capacity, k, 3), scales, masks)
    if rate is None:
        return outputs, ()
    own_bits = () if rate.own_bits is None else (rate.own_bits,)
    return (*outputs, rate.bits, *own_bits), (rate.by_group, rate.numbers)


def _rate(
    model: Model, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor, share: Tensor | None
) -> AnchorRate:
    """Rate of a sample, of which `counted` anchors count, times the share of visible ones that are kept."""
    bits, by_group = model.rate_model.rate(values, forecast, masks, counted)
    bits = bits if share is None else bits * share
    return AnchorRate.of(bits, by_group, counted.sum() * values.shape[1], forecast)


def sample_of(draws: Tensor, valid: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """Return valid rows [S] int64 whose sample of U(0,1) [C] is below `share`, and 1 per row used, else 0.

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
    """Return the capacity S of a sample of `share` of `capacity` rows."""
    return min(capacity, math.ceil(capacity * share + 6 * math.sqrt(capacity * share * (1 - share)) + 8))


def bernoulli_rows(uniform: Tensor, count: int, share: float) -> tuple[Tensor, Tensor]:
    """Sample each of `count` > 0 rows with probability `share`, without waiting for a GPU to count them.

    uniform     [S] draws of U(0,1), one for each place of the sample; what more were drawn is left out

    Returns (rows [S] int64 ascending, [S] 1 or 0); places that are left over have the last row, and 0. From one drawn
    row to the next it is a geometric number of rows.
    """
    if share >= 1:
        gaps = torch.ones_like(uniform, dtype=torch.int64)
    else:
        rate = max(-math.log1p(-share), 1e-30)
        gaps = uniform.log().mul_(-1 / rate).floor_().add_(1).clamp_(max=count + 1).to(torch.int64)
    places = gaps.cumsum(0)  # from 1 on; of floats a GPU may sum in any order
    return places.clamp(max=count).sub_(1), (places <= count).to(uniform)
