"""Anchor model with a rate: attributes are coded under distributions predicted from anchor positions.

Common parts of HAC (arXiv 2403.14530) and CAT-3DGS (arXiv 2503.00357): 16-bit positions, learned offset masks, three
phases of quantisation, and the rate of a sample. A method adds its rate model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from sw_anchors.anchors import AnchorAttributes, AnchorModel
from sw_anchors.fast import noisy_values as fast_values
from sw_anchors.fast import replay
from sw_anchors.lattice import Margin, bounds_of, coded_positions, position_codes
from sw_anchors.noisy_values import ENTROPY as ENTROPY
from sw_anchors.noisy_values import FULL as FULL
from sw_anchors.noisy_values import MASK_THRESHOLD, Noise, NoisyValues, draws, noisy_values
from sw_anchors.noisy_values import QUANTIZED as QUANTIZED
from sw_anchors.older_coded_anchors import PredictedRate
from sw_anchors.rate_model import AnchorRate, Floors, RateInputs, RateModel, Triple, triple
from sw_codecs.quantizers.multiples import nearest_index
from sw_codecs.quantizers.straight_through import hard_mask

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, GaussianInputs, Rasterizer

INITIAL_MASK_LOGIT = 1.0


class CodedAnchors(AnchorModel):
    """An AnchorModel with 16-bit positions, offset masks and quantised attributes.

    A subclass has a `rate_model`, and `context_rows` for it.

    mask_logits     [N,k] a Gaussian is kept if sigmoid(logit) times `mask_weights` exceeds 0.01
    bounds          [2,3] buffer: ends of the position lattice; `update_bounds` sets them
    phase           FULL, QUANTIZED or ENTROPY (`PhaseSwitch` sets it)
    noise           generator of noise and samples; None: the default one of the device. Whoever trains sets it
    base_steps      quantiser step of each group before it is predicted
    """

    ROWS = (*AnchorModel.ROWS, "mask_logits")

    STEP_POWERS: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """By group, of the factor by which quantiser steps fill a size; 0: a network has learnt values of one step."""
    RATE_OF: ClassVar[Literal["visible", "all"]] = "visible"
    """Anchors that the rate samples from: the visible ones, or all (with separate noise)."""

    mask_logits: nn.Parameter
    bounds: Tensor

    def __init__(
        self, anchors: Tensor, features: Tensor, offsets: Tensor, log_scales: Tensor, *, margin: Margin = "none",
        base_steps: tuple[float, float, float] = (1.0, 0.001, 0.2), sample: float = 0.05,
        smallest_probability: float = 1e-6, scale_floor: float = 0.0, **kwargs: Any,
    ) -> None:  # fmt: skip
        """Initialise like AnchorModel, which gets `kwargs`.

        margin          of the bounds, see `lattice.bounds_of`
        sample          share of the anchors whose rate is computed
        smallest_probability, scale_floor   floors of the rate in training, see `rate_model.Floors`
        """
        super().__init__(anchors, features, offsets, log_scales, **kwargs)
        n, k = offsets.shape[:2]
        self.mask_logits = nn.Parameter(anchors.new_full((n, k), INITIAL_MASK_LOGIT))
        self.register_buffer("bounds", bounds_of(anchors, margin) if n else anchors.new_zeros(2, 3))
        self.phase = FULL
        self.noise: torch.Generator | None = None
        self.margin: Margin = margin
        self.base_steps = base_steps
        self.sample, self.smallest_probability = sample, smallest_probability
        self.scale_floor = scale_floor
        self.led: dict[str, Any] = {}  # by a task that leads the training to a size: "steps", factors by group
        self._lattice: tuple[tuple[Any, ...], Tensor, Tensor] | None = None
        self._steps: dict[tuple[Any, ...], Tensor] = {}

    # Positions

    def update_bounds(self, margin: Margin | None = None) -> None:
        """Fit the lattice to the current anchors; margin None: the one given at construction."""
        self.bounds = bounds_of(self.anchors, self.margin if margin is None else margin)

    def codes(self) -> Tensor:
        """Return lattice codes [N,3] int64 of the positions."""
        return self._on_lattice()[0]

    def positions(self) -> Tensor:
        return self._on_lattice()[1]

    def _on_lattice(self) -> tuple[Tensor, Tensor]:
        """Return codes and positions, cached until anchors or bounds change."""
        # The objects, not their ids, which are used again. A version counts changes in place.
        state = (self.anchors, self.anchors._version, self.bounds, self.bounds._version)
        kept = self._lattice
        if kept is None or any(
            a is not b if isinstance(a, Tensor) else a != b for a, b in zip(kept[0], state, strict=True)
        ):
            kept = self._lattice = (state, *self.lattice_places())
        return kept[1], kept[2]

    def lattice_places(self) -> tuple[Tensor, Tensor]:
        """Return codes [N,3] on the 16-bit lattice and the positions [N,3] that they decode to."""
        codes = position_codes(self.anchors, self.bounds)
        return codes, coded_positions(codes, self.bounds)

    # Masks

    def mask_weights(self) -> Tensor | None:
        """Return factors [N,1] of sigmoid(mask_logits), or None for 1."""
        return None

    def soft_masks(self) -> Tensor:
        """Return soft masks [N,k], which are thresholded into masks; differentiable."""
        soft, weights = torch.sigmoid(self.mask_logits), self.mask_weights()
        return soft if weights is None else soft * weights

    def masks(self, rows: Tensor | None = None) -> Tensor:
        """Return binary masks [V,k] with the gradient of `soft_masks`; rows None: all."""
        weights = self.mask_weights()
        masks = hard_mask(self.mask_logits, MASK_THRESHOLD, 1.0 if weights is None else weights)
        return masks if rows is None else masks[rows]

    @torch.no_grad()
    def kept(self) -> Tensor:
        """Return [N] bool: anchors with at least one unmasked Gaussian; the others are not in the file."""
        return (self.soft_masks() > MASK_THRESHOLD).any(dim=1)

    @torch.no_grad()
    def counts(self) -> dict[str, int]:
        """Return the numbers of anchors and Gaussians that the file will have."""
        masks = self.soft_masks() > MASK_THRESHOLD
        return {"num_anchors": int(masks.any(dim=1).sum()), "num_gaussians": int(masks.sum())}

    # Rendering

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """Return the Gaussians of the visible anchors; in the entropy phase `extras["rate"]` is the AnchorRate."""
        draw = replay.gaussians if replay.fits(self, CodedAnchors) else AnchorModel.gaussians
        return draw(self, camera, rasterizer)

    # Attributes

    def raw(self, rows: Tensor) -> Triple:
        """Return full-precision values of the groups, [V,C] each."""
        return self.features[rows], self.log_scales[rows].exp(), self.offsets[rows].flatten(1)

    @property
    def rate_model(self) -> RateModel:
        """Return the rate model, which predicts quantiser steps and distributions in training and for the file."""
        return PredictedRate(self)

    def context_rows(self) -> RateInputs:
        """Return the inputs of the rate model, one row per anchor of the model."""
        return (torch.arange(self.num_rows, device=self.device),)

    def context_of(self, rows: Tensor) -> RateInputs:
        """Return the inputs of the rate model for the anchors `rows`."""
        return tuple(part.index_select(0, rows) for part in self.context_rows())

    @property
    def floors(self) -> Floors:
        """Return the lower bounds of scales and likelihoods in the training rate."""
        return Floors(self.smallest_probability, self.scale_floor)

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        """Return full-precision, noisy or rounded attributes, by phase and mode; `rows` are unique."""
        if self.phase != FULL and not self.training:
            return self._rounded(rows)
        rate: dict[str, AnchorRate] = {}
        if self.phase == FULL:
            values = self.noisy(rows, None)
        elif self.phase == QUANTIZED:
            values = self.noisy(rows, Noise(self.noise_steps(self.features), self._draw_noise(rows)))
        elif self.RATE_OF == "visible":
            values, rate["rate"] = self._with_rate_of_visible(rows)
        else:
            values, rate["rate"] = self._with_rate_of_all(rows)
        positions = self.positions().index_select(0, rows)
        return AnchorAttributes(positions, values.features, values.offsets, values.scales, values.masks, rate)

    def _with_rate_of_visible(self, rows: Tensor) -> tuple[NoisyValues, AnchorRate]:
        """Return noisy values of the anchors `rows`, and the rate of a sample of them.

        Each is drawn with probability `sample`, and counts if it is kept. The bits of a masked offset do not count, its
        numbers do.
        """
        uniform, drawn = self._draw_noise(rows), self.draw_sample(len(rows))
        forecast = self.rate_model.forecast(self.context_of(rows), drawn)
        values = self.noisy(rows, Noise(forecast.steps, uniform), drawn)
        kept = values.masks.detach().amax(dim=1)
        counted, masks = kept.index_select(0, drawn), values.masks.index_select(0, drawn)
        bits, by_group = self.rate_model.rate(values.sample, forecast, masks, counted)
        share = kept.mean() if len(kept) else kept.sum()
        return values, AnchorRate.of(bits * share, by_group, counted.sum() * values.sample.shape[1], forecast)

    def _with_rate_of_all(self, rows: Tensor) -> tuple[NoisyValues, AnchorRate]:
        """Return noisy values of the anchors `rows`, and the rate of a sample of all anchors with separate noise."""
        drawn = self.draw_sample(self.num_rows)
        sample = slice(len(rows), None)
        forecast = self.rate_model.forecast(self.context_of(torch.cat([rows, drawn])), sample)
        values = self.noisy(rows, Noise(forecast.steps[: len(rows)], self._draw_noise(rows)))
        every = torch.arange(len(drawn), device=self.device)
        own = self.noisy(drawn, Noise(forecast.sample_steps, self._draw_noise(drawn)), every)
        counted = own.sample.new_ones(len(drawn))
        bits, by_group = self.rate_model.rate(own.sample, forecast, own.masks, counted)
        return values, AnchorRate.of(bits, by_group, counted.sum() * own.sample.shape[1], forecast)

    def noisy(self, rows: Tensor, noise: Noise | None, drawn: Tensor | None = None) -> NoisyValues:
        """Return values of the anchors `rows`; `sample` holds those at the positions `drawn` in it."""
        tables, weights = self._tables, self.mask_weights()
        compute = fast_values.noisy_values if fast_values.fits(tables, weights) else noisy_values
        return compute(rows, tables, weights, MASK_THRESHOLD, noise, rows[:0] if drawn is None else drawn)

    @property
    def _tables(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.features, self.log_scales, self.offsets, self.mask_logits

    def noise_steps(self, like: Tensor) -> Tensor:
        """Return the steps [1,3] of the noise in the phase QUANTIZED: the base steps."""
        return self.base_steps_like(like)[None]

    def base_steps_like(self, like: Tensor) -> Tensor:
        """Return base steps [3] with device and dtype of `like`, cached to avoid a host-device wait per step."""
        key = (like.device, like.dtype, tuple(self.base_steps))
        if key not in self._steps:
            self._steps[key] = like.new_tensor(self.base_steps)
        return self._steps[key]

    @torch.no_grad()
    def _rounded(self, rows: Tensor) -> AnchorAttributes:
        """Return rounded attributes, as the file holds them."""
        steps = self.base_steps_like(self.features)[None]
        if self.phase == ENTROPY:
            steps = self.rate_model.forecast(self.context_of(rows), rows[:0]).steps
        groups = zip(self.raw(rows), steps.split(1, dim=1), self.centres(), strict=True)
        features, scales, offsets = (nearest_index(v, step, centre) * step for v, step, centre in groups)
        offsets = offsets.reshape(-1, self.num_offsets, 3)
        positions = self.positions().index_select(0, rows)
        return AnchorAttributes(positions, features, offsets, scales, self.masks(rows).detach())

    @torch.no_grad()
    def centres(self) -> Triple:
        """Return the mean of each group over the kept anchors; quantisation indices are clamped around it."""
        kept = self.raw(torch.nonzero(self.kept()).squeeze(1))
        return triple(v.double().mean() if v.numel() else v.new_zeros(()).double() for v in kept)

    # Draws

    def _draw_noise(self, rows: Tensor) -> Tensor:
        """Return samples [V,C] of U(0,1) for all numbers of the anchors `rows`."""
        return self.draw_noise(len(rows), sum(self.shape.widths))

    def draw_noise(self, rows: int, numbers: int) -> Tensor:
        """Return samples [rows, numbers] of U(0,1) for noise, see `noisy_values.draws`."""
        return draws((rows, numbers), self.own_generator(), self.device)

    def uniform(self, *shape: int) -> Tensor:
        """Return samples of U(0,1) on the model's device."""
        return torch.rand(shape, generator=self.own_generator(), device=self.device)

    def own_generator(self) -> torch.Generator | None:
        """Return the noise generator if it is on the model's device."""
        own = self.noise is not None and self.noise.device.type == self.device.type
        return self.noise if own else None

    def draw_sample(self, count: int) -> Tensor:
        """Return a sample [S] int64, ascending, of `count` anchors; drawn on the host to avoid waiting for a GPU."""
        on_host = self.noise is None or self.noise.device.type == "cpu"
        where = "cpu" if on_host else self.device
        drawn = torch.rand(count, generator=self.noise, device=where) < self.sample
        return torch.nonzero(drawn).squeeze(1).to(self.device, non_blocking=True)

    # State

    def rows_at(self, positions: Tensor, features: Tensor, size: float) -> dict[str, Tensor]:
        found = super().rows_at(positions, features, size)
        found["mask_logits"] = positions.new_full((len(positions), self.num_offsets), INITIAL_MASK_LOGIT)
        return found

    def state_dict_extra(self) -> dict[str, Any]:
        return {**super().state_dict_extra(), "phase": self.phase, **({"led": dict(self.led)} if self.led else {})}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        super().load_state_dict_extra(extra)
        self.phase, self.led = str(extra["phase"]), dict(extra.get("led", {}))
