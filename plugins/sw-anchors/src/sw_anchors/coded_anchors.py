"""Anchors whose attributes are coded under distributions predicted from their positions: the model with a rate.

As in HAC (arXiv 2403.14530) and CAT-3DGS (arXiv 2503.00357): 16-bit positions, learned offset masks, three phases of
quantisation, and the rate of a sample of the visible anchors. A method adds the context model that predicts.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from sw_anchors.anchors import AnchorAttributes, AnchorModel
from sw_anchors.fast.fused_ops import anchor_values, sample_bits, take_rows, widen
from sw_anchors.fast.mixture_bits import MaskKind, Predicted, fit_mixture_kernel, mixture_bits
from sw_anchors.fast.pool_rows import bernoulli_rows
from sw_anchors.fast.seen_rows import ExpectedRows, SeenRows
from sw_anchors.forecasts import AnchorContext, AnchorForecast, AnchorRate, Triple, triple
from sw_anchors.lattice import Margin, bounds_of, coded_positions, position_codes
from sw_anchors.noisy_values import Noise, Tables, draws, noisy_values
from sw_codecs.entropy.rates import lower_bound
from sw_codecs.positions.morton import interleave
from sw_codecs.quantizers.binary import SteMask
from sw_codecs.quantizers.rounding import SteRound

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, GaussianInputs, Rasterizer
    from sw_anchors.fast.fixed_decoder import FixedDecoder
    from sw_anchors.fast.pool_rows import PoolRows

FULL, QUANTIZED, ENTROPY = "full precision", "quantized training", "entropy training"
"""Phases of training: raw values; noise of fixed steps; noise of predicted steps, with a rate."""

MASK_THRESHOLD = 0.01
SMALLEST_SCALE = 1e-9
"""Floor of a predicted deviation, as published."""
INITIAL_MASK_LOGIT = 1.0


class CodedAnchors(AnchorModel):
    """An AnchorModel with 16-bit positions, offset masks and quantised attributes; subclasses override `predict`.

    mask_logits     [N,k] a Gaussian is kept if sigmoid(logit) times `mask_weights` exceeds 0.01
    bounds          [2,3] buffer: ends of the position lattice; `update_bounds` sets them
    phase           FULL, QUANTIZED or ENTROPY (`PhaseSwitch` sets it)
    noise           generator of noise and samples; None: the default one of the device. Whoever trains sets it
    fixed           decodes in training in tensors of fixed sizes; None: nothing does. Whoever trains sets it
    base_steps      quantiser step of each group before it is predicted
    """

    ROWS = (*AnchorModel.ROWS, "mask_logits")

    mask_logits: nn.Parameter
    bounds: Tensor

    HAS_FIXED_FORM: ClassVar[bool] = True
    """Whether `sw_anchors.fast.fixed_step` computes what a training step of this class does."""

    SAMPLES_ALL: ClassVar[bool] = False
    """Whether the rate is of a sample of all anchors, not of the visible ones; then there is `pool_rate`."""

    def __init__(
        self,
        anchors: Tensor,
        features: Tensor,
        offsets: Tensor,
        log_scales: Tensor,
        *,
        margin: Margin = "none",
        base_steps: tuple[float, float, float] = (1.0, 0.001, 0.2),
        noise_factor: float = 1.0,
        sample: float = 0.05,
        smallest_probability: float = 1e-6,
        scale_floor: float = 0.0,
        **kwargs: Any,
    ) -> None:
        """As AnchorModel, whose other arguments are `kwargs`.

        margin          of the bounds, see `lattice.bounds_of`
        noise_factor    multiplies the base steps in the phase QUANTIZED
        sample          share of the visible anchors whose rate is computed
        smallest_probability    floor of the probability of a value, in training
        scale_floor     floor of a predicted deviation in training, quantiser steps; the gradient that would raise one
                        from below passes. 0: SMALLEST_SCALE, below which there is none
        """
        super().__init__(anchors, features, offsets, log_scales, **kwargs)
        n, k = offsets.shape[:2]
        self.mask_logits = nn.Parameter(anchors.new_full((n, k), INITIAL_MASK_LOGIT))
        self.register_buffer("bounds", bounds_of(anchors, margin) if n else anchors.new_zeros(2, 3))
        self.phase = FULL
        self.noise: torch.Generator | None = None
        self.margin: Margin = margin
        self.base_steps, self.noise_factor = base_steps, noise_factor
        self.sample, self.smallest_probability = sample, smallest_probability
        self.scale_floor = scale_floor
        self._mask, self._round = SteMask(MASK_THRESHOLD), SteRound()
        self._lattice: tuple[tuple[Any, ...], Tensor, Tensor] | None = None
        self._order: tuple[Tensor, Tensor] | None = None
        self._groups: dict[tuple[Any, ...], Triple] = {}
        self.fixed: FixedDecoder | None = None

    def __getstate__(self) -> dict[str, Any]:
        """A copy decodes by itself: graphs of a GPU belong to one model. It sorts anew."""
        return {**self.__dict__, "fixed": None, "_order": None}

    # Positions

    def update_bounds(self, margin: Margin | None = None) -> None:
        """Fit the lattice to the anchors of now; None: the margin that the model was made with."""
        self.bounds = bounds_of(self.anchors, self.margin if margin is None else margin)

    def codes(self) -> Tensor:
        """[N,3] int64: positions on the lattice."""
        return self._on_lattice()[0]

    def positions(self) -> Tensor:
        return self._on_lattice()[1]

    def _on_lattice(self) -> tuple[Tensor, Tensor]:
        """Codes and positions, kept until anchors or bounds are others."""
        # The objects, not their ids, which are used again. A version counts changes in place.
        state = (self.anchors, self.anchors._version, self.bounds, self.bounds._version)
        kept = self._lattice
        if kept is None or any(
            a is not b if isinstance(a, Tensor) else a != b for a, b in zip(kept[0], state, strict=True)
        ):
            kept = self._lattice = (state, *self.lattice_places())
        return kept[1], kept[2]

    def lattice_places(self) -> tuple[Tensor, Tensor]:
        """Codes [N,3] of the anchors on the 16-bit lattice, and where they are taken to be [N,3]."""
        codes = position_codes(self.anchors, self.bounds)
        return codes, coded_positions(codes, self.bounds)

    @torch.no_grad()
    def visible_anchors(self, camera: Camera, rasterizer: Rasterizer) -> Tensor:
        """As of AnchorModel. In training on a GPU neighbours follow one another, whose gradients meet in the same cells
        of grids and planes: kernels add those up before they write."""
        if not (self.training and self.device.type == "cuda"):
            return super().visible_anchors(camera, rasterizer)
        order, seen = self._seen_in_order(camera, rasterizer)
        return order[seen]

    def _seen_in_order(self, camera: Camera, rasterizer: Rasterizer) -> tuple[Tensor, Tensor]:
        """Rows [N] int64 of all anchors, neighbours together, and whether each is visible [N]."""
        codes = self.codes()
        if self._order is None or self._order[0] is not codes:
            self._order = codes, torch.argsort(interleave(codes))
        order = self._order[1]
        return order, rasterizer.visible_filter(self.balls(), camera).index_select(0, order) > 0

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """As of AnchorModel. A view that was drawn before is decoded before the host knows how many anchors it sees."""
        fixed = self._replaying()
        # What a subclass has of its own gives or takes rows that are known, and would be left out.
        cls = type(self)
        own = cls.visible_anchors is not CodedAnchors.visible_anchors or cls.decode is not CodedAnchors.decode
        places = None if fixed is None or own else fixed.expected(camera, self.num_rows)
        if places is None:
            return super().gaussians(camera, rasterizer)
        with torch.no_grad():
            rows = ExpectedRows(*self._seen_in_order(camera, rasterizer), places)
        return self.decode_seen(camera, rows)

    # Masks

    def mask_weights(self) -> Tensor | None:
        """[N,1] factors of sigmoid(mask_logits), or None for 1."""
        return None

    def soft_masks(self) -> Tensor:
        """[N,k] values that the threshold of the masks applies to; differentiable."""
        soft, weights = torch.sigmoid(self.mask_logits), self.mask_weights()
        return soft if weights is None else soft * weights

    def masks(self, rows: Tensor | None = None) -> Tensor:
        """[V,k] 0 or 1, with the gradient of `soft_masks`; None: all rows."""
        weights = self.mask_weights()
        masks = self._mask.forward(self.mask_logits, 1.0 if weights is None else weights)
        return masks if rows is None else masks[rows]

    @torch.no_grad()
    def kept(self) -> Tensor:
        """[N] bool: anchors that keep a Gaussian; others are not in the file."""
        return (self.soft_masks() > MASK_THRESHOLD).any(dim=1)

    @torch.no_grad()
    def counts(self) -> dict[str, int]:
        """Numbers of anchors and Gaussians that the file will have."""
        masks = self.soft_masks() > MASK_THRESHOLD
        return {"num_anchors": int(masks.any(dim=1).sum()), "num_gaussians": int(masks.sum())}

    # Attributes

    def raw(self, rows: Tensor) -> Triple:
        """Full-precision values of the groups, [V,C] each."""
        return self.features[rows], self.log_scales[rows].exp(), self.offsets[rows].flatten(1)

    def predict(self, rows: Tensor) -> AnchorContext:
        """Predict steps and distributions of the anchors `rows` from their positions; differentiable."""
        raise NotImplementedError

    def refine(self, context: AnchorContext, features: Tensor) -> AnchorContext:
        """Refine the context by (noisy or rounded) features [V,F]; by default it stays as it is."""
        return context

    def forecast(self, rows: Tensor) -> AnchorForecast:
        """Predict for training: `forecast_at` the rows of `context_rows`, where there are any.

        Otherwise `predict`, then `refine` for a sample of the anchors `rows` alone.
        """
        parts = self.context_rows()
        if parts is not None:
            return self.forecast_at(tuple(part.index_select(0, rows) for part in parts))
        context = self.predict(rows)

        def sample(drawn: Tensor, hidden: Tensor | None, values: Tensor) -> tuple[Tensor, Tensor]:
            parts = (*context.means, *context.scales, *context.steps)
            taken = [part.index_select(0, drawn) for part in parts]
            known = AnchorContext(triple(taken[:3]), triple(taken[3:6]), triple(taken[6:]))
            known = self.refine(known, values[:, : self.features.shape[1]])
            return torch.cat(known.means, dim=1), torch.cat(known.scales, dim=1)

        return AnchorForecast(torch.cat(context.steps, dim=1), context.own_bits, None, sample)

    def context_rows(self) -> tuple[Tensor, ...] | None:
        """Tensors with a row for each anchor that `forecast_at` starts from, without gradients; or None.

        A method whose network need not compute all distributions for training overrides both.
        """
        return None

    def forecast_at(self, parts: tuple[Tensor, ...]) -> AnchorForecast:
        """Predict for training from rows of `context_rows`, without waiting for a GPU."""
        raise NotImplementedError

    def forecast_pool(self, parts: tuple[Tensor, ...], pool: tuple[Tensor, ...]) -> AnchorForecast:
        """As `forecast_at`, and of the sample of all anchors what `pool_rate` takes; rows of `context_rows` of both."""
        raise NotImplementedError

    def pool_rate(self, pool: PoolRows, forecast: AnchorForecast) -> AnchorRate:
        """Estimate the bits of a sample of all anchors, with the forecast of `forecast_pool`."""
        raise NotImplementedError

    @torch.no_grad()
    def pool_sample(self, size: int) -> tuple[Tensor, Tensor]:
        """Draw a sample of all anchors into `size` places, see `pool_rows.bernoulli_rows`."""
        return bernoulli_rows(self.uniform(size), self.num_rows, self.sample)

    def step_key(self) -> tuple[Any, ...]:
        """Plain values that decide which operators a step of training runs."""
        rate = self.sample, self.smallest_probability, self.scale_floor
        return self.phase, *rate, self.noise_factor, tuple(self.base_steps)

    def _replaying(self) -> FixedDecoder | None:
        """Decoder of fixed sizes, where there is one and it decodes: in a step of training."""
        return self.fixed if self.training and torch.is_grad_enabled() and self.features.requires_grad else None

    def decode(self, camera: Camera, rows: Tensor) -> GaussianInputs:
        return self.decode_seen(camera, SeenRows(rows))

    def decode_seen(self, camera: Camera, rows: SeenRows) -> GaussianInputs:
        """As `decode`, of rows whose number the host need not know yet.

        A subclass overrides this rather than `decode`: with a `decode` or `visible_anchors` of its own each view waits
        for that number.
        """
        fixed = self._replaying()
        found = None if fixed is None else fixed.decode(self, camera, rows)
        return super().decode(camera, rows.known()) if found is None else found

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        """Full-precision, noisy or rounded attributes, by phase and mode; each of `rows` at most once."""
        if self.phase != FULL and not self.training:
            return self._final(rows)
        noise: Noise | None = None
        forecast: AnchorForecast | None = None
        drawn = rows[:0]
        if self.phase != FULL:
            steps = self.base_steps_like(self.features) * self.noise_factor
            if self.phase == ENTROPY:
                forecast = self.forecast(rows)
                steps = forecast.steps
            uniform = self.draw_noise(len(rows), sum(self.shape.widths))
            noise = Noise(steps, uniform, self._columns(steps))
            drawn = self.sampled(len(rows)) if forecast is not None else drawn
        found = noisy_values(rows, self._tables, self.mask_weights(), MASK_THRESHOLD, noise, drawn)
        extras = {} if forecast is None else {"rate": self.rate(drawn, found.sample, forecast, found.masks)}
        positions = self.positions().index_select(0, rows)
        return AnchorAttributes(
            positions, found.features, found.offsets, found.scales, masks=found.masks, extras=extras
        )

    def _final(self, rows: Tensor) -> AnchorAttributes:
        """Rounded attributes."""
        values, masks = anchor_values(rows, *self._tables, self.mask_weights(), MASK_THRESHOLD)
        groups = triple(torch.split(values, list(self.shape.widths), dim=1))
        steps = self.base_steps_like(values) if self.phase == QUANTIZED else self.predict(rows).steps
        features, scales, offsets = self._rounded(groups, steps)
        offsets = offsets.reshape(-1, self.num_offsets, 3)
        return AnchorAttributes(self.positions().index_select(0, rows), features, offsets, scales, masks=masks)

    @property
    def _tables(self) -> Tables:
        return self.features, self.log_scales, self.offsets, self.mask_logits

    def wide_base_steps(self, like: Tensor) -> Tensor:
        """[C] steps of the noise in the phase QUANTIZED, one for each column of `like` [V,C]."""
        group, _ = self._columns(like)
        return self.base_steps_like(like).index_select(0, group) * self.noise_factor

    def widened(self, steps: Tensor) -> Tensor:
        """[V,C] from steps [V,3] of the groups, one for each column; differentiable."""
        return widen(steps, *self._columns(steps))

    def _columns(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """The group of each number of an anchor [C], and the same as zeros and ones [C,3]; kept on the device."""
        return self._constants(like)[:2]

    def base_steps_like(self, like: Tensor) -> Tensor:
        """[3] base_steps on the device and in the dtype of `like`: made anew, they would be waited for."""
        return self._constants(like)[2]

    def _constants(self, like: Tensor) -> Triple:
        """Tensors of `_columns` and `base_steps_like`; none replaces another: graphs read them where they stand."""
        widths, steps = self.shape.widths, tuple(self.base_steps)
        key = (like.device, like.dtype, widths, steps)
        if key not in self._groups:
            group = torch.arange(3).repeat_interleave(torch.tensor(widths))
            one_hot = torch.nn.functional.one_hot(group, 3).to(like)
            self._groups[key] = (group.to(like.device), one_hot, like.new_tensor(steps))
        return self._groups[key]

    def uniform(self, *shape: int) -> Tensor:
        """Draws of U(0,1) on the model's device."""
        return torch.rand(shape, generator=self.own_generator(), device=self.device)

    def draw_noise(self, rows: int, numbers: int) -> Tensor:
        """[rows, numbers] draws of U(0,1) for noise, see `noisy_values.draws`."""
        return draws((rows, numbers), self.own_generator(), self.device)

    def own_generator(self) -> torch.Generator | None:
        """Generator of noise, if it draws on the model's device."""
        own = self.noise is not None and self.noise.device.type == self.device.type
        return self.noise if own else None

    def sampled(self, count: int) -> Tensor:
        """[S] int64: those of `count` visible anchors whose bits are counted in this step."""
        return self.draw_sample(count)

    def draw_sample(self, count: int) -> Tensor:
        """[S] int64: a sample of `count` anchors, drawn on the host: to count it, one would wait for a GPU."""
        on_host = self.noise is None or self.noise.device.type == "cpu"
        where = "cpu" if on_host else self.device
        drawn = torch.rand(count, generator=self.noise, device=where) < self.sample
        return torch.nonzero(drawn).squeeze(1).to(self.device, non_blocking=True)

    @torch.no_grad()
    def _rounded(self, values: Triple, steps: Iterable[Tensor]) -> Triple:
        return triple(
            self._round.forward(v, step, mean=centre)
            for v, step, centre in zip(values, steps, self.centres(), strict=True)
        )

    @torch.no_grad()
    def centres(self) -> Triple:
        """Mean of each group over all numbers of the kept anchors: the index of a value is limited about it."""
        kept = self.raw(torch.nonzero(self.kept()).squeeze(1))
        return triple(v.double().mean() if v.numel() else v.new_zeros(()).double() for v in kept)

    def rate(self, drawn: Tensor, sample: Tensor, forecast: AnchorForecast, masks: Tensor) -> AnchorRate:
        """Estimate the bits of V anchors by a sample: each is drawn with probability `sample` and counts if it is kept.

        drawn   [S] as of `sampled`
        sample  [S,C] their noisy numbers of all groups
        masks   [V,k], with gradient: the bits of a masked offset do not count, its numbers do
        """
        kept = masks.detach().amax(dim=1)
        if not len(drawn):
            nothing = self.mask_logits.new_zeros(())
            return AnchorRate(nothing, nothing.new_zeros(3), nothing, forecast.own_bits)
        taken = take_rows(drawn, forecast.steps, masks, *([] if forecast.hidden is None else [forecast.hidden]))
        return self._rate_of_sample(drawn, (sample, *taken), forecast, kept.index_select(0, drawn), kept.mean())

    def floored(self, scale: Tensor, steps: Tensor) -> Tensor:
        """Keep predicted deviations [S,C] to `scale_floor`, for quantiser steps [S,C]; differentiable.

        Of a column whose deviations are all at SMALLEST_SCALE no value lies where a gradient would tell: none learns.
        """
        if self.scale_floor:
            return lower_bound(scale, self.scale_floor * steps.detach())
        return scale.clamp(min=SMALLEST_SCALE)

    def rate_of(
        self,
        drawn: Tensor,
        values: Tensor,
        forecast: AnchorForecast,
        masks: Tensor,
        counted: Tensor,
        share: Tensor,
    ) -> AnchorRate:
        """Estimate the bits of a sample `drawn` [S] of the V anchors; other arguments as of `rate`.

        values      [V,C] noisy numbers of all groups
        counted     [S] 1 where the anchor is kept, else 0
        share       scalar: kept anchors over visible ones
        """
        hidden = [] if forecast.hidden is None else [forecast.hidden]
        taken = take_rows(drawn, values, forecast.steps, masks, *hidden)
        return self._rate_of_sample(drawn, taken, forecast, counted, share)

    def _rate_of_sample(
        self, drawn: Tensor, taken: tuple[Tensor, ...], forecast: AnchorForecast, counted: Tensor, share: Tensor
    ) -> AnchorRate:
        """`rate_of` values, steps and masks `taken` of the sample, and of what the forecast starts from."""
        x, step, mask = taken[:3]
        hidden = taken[3] if len(taken) > 3 else None
        outputs_of, units = forecast.outputs_of, forecast.units
        if outputs_of and hidden is not None and units is not None and fit_mixture_kernel(x, hidden, step, mask):
            predicted = self.read_as(units, MaskKind.ALONE)
            bits, by_group = mixture_bits(x, outputs_of(hidden), step, mask, counted, predicted)
        else:
            mean, scale = forecast.sample(drawn, hidden, x)
            if self.scale_floor:
                scale = self.floored(scale, self.widened(step))
            bits, by_group = sample_bits(
                x, mean, scale, step, mask, counted, p_min=self.smallest_probability, smallest_scale=SMALLEST_SCALE
            )
        numbers = counted.sum() * sum(self.shape.widths)
        return AnchorRate(bits * (share / numbers.clamp(min=1)), by_group, numbers, forecast.own_bits)

    def read_as(self, units: Tensor, masks: MaskKind) -> Predicted:
        """Reading of the context network: `units` [W] of its outputs, and the effect of masks on bits."""
        bounds = (self.smallest_probability, SMALLEST_SCALE, self.scale_floor)
        return Predicted(units, self.base_steps[0], *bounds, masks)

    # State

    def rows_at(self, positions: Tensor, features: Tensor, size: float) -> dict[str, Tensor]:
        found = super().rows_at(positions, features, size)
        found["mask_logits"] = positions.new_full((len(positions), self.num_offsets), INITIAL_MASK_LOGIT)
        return found

    def state_dict_extra(self) -> dict[str, Any]:
        return {**super().state_dict_extra(), "phase": self.phase}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        super().load_state_dict_extra(extra)
        self.phase = str(extra["phase"])
