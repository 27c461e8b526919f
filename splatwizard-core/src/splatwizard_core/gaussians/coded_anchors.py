"""Anchors as methods train them that code each attribute under a distribution predicted from the anchor's position.

What HAC (arXiv 2403.14530) and CAT-3DGS (arXiv 2503.00357) share: 16-bit positions, learned offset masks, three phases
of quantisation, and the rate of a sample of the visible anchors. A method adds the model that predicts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from splatwizard_core.gaussians.anchor_lattice import Margin, bounds_of, coded_positions, position_codes
from splatwizard_core.gaussians.anchors import AnchorAttributes, AnchorModel

FULL, QUANTIZED, ENTROPY = "full precision", "quantized training", "entropy training"
"""Phases of training: raw values; noise of fixed steps; noise of predicted steps, with a rate."""

GROUPS = ("features", "scales", "offsets")
"""Coded attributes of an anchor, [F], [6] (linear, world units) and [3k]; the order of every triple below."""

MASK_THRESHOLD = 0.01
INITIAL_MASK_LOGIT = 1.0
INDEX_CLAMP = 15_000
"""Values are coded within this many steps of the mean over all kept anchors."""

Triple = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class AnchorContext:
    """What a context model predicts for V anchors, for each of GROUPS, in the units of the values.

    means, scales   [V,C] of each group: mean and standard deviation of every number; scales may be <= 0 (see `rate`)
    steps           [V,1] of each group: quantiser step of the anchor
    own_bits        scalar, differentiable: bits of all that the context model itself stores, if it has come along
    """

    means: Triple
    scales: Triple
    steps: Triple
    own_bits: Tensor | None = None


@dataclass(frozen=True)
class AnchorRate:
    """The rate of one view's anchors; `RenderResult.extras["rate"]` in the entropy phase.

    bits        scalar, differentiable: bits a number over a sample of visible, kept anchors, times the share of visible
                anchors that are kept; 0 for an empty sample
    by_group    [3] bits of features, scales and offsets in the sample, detached
    numbers     how many numbers the sample has
    own_bits    of the context
    """

    bits: Tensor
    by_group: Tensor
    numbers: int
    own_bits: Tensor | None = None


class CodedAnchors(AnchorModel):
    """An AnchorModel with 16-bit positions, offset masks and quantised attributes; subclasses override `predict`.

    mask_logits     [N,k] a Gaussian is kept if sigmoid(logit) times `mask_weights` exceeds 0.01
    bounds          [2,3] buffer: ends of the position lattice; `update_bounds` sets them
    phase           FULL, QUANTIZED or ENTROPY (scheduler.PhaseSwitch sets it)
    noise           generator of noise and samples; None: the default one of the device. Whoever trains sets it
    base_steps      quantiser step of each group before it is predicted
    """

    ROWS = (*AnchorModel.ROWS, "mask_logits")

    mask_logits: nn.Parameter
    bounds: Tensor

    def __init__(
        self,
        anchors: Tensor,
        features: Tensor,
        offsets: Tensor,
        log_scales: Tensor,
        *,
        entropy: Any,
        margin: Margin = "none",
        base_steps: tuple[float, float, float] = (1.0, 0.001, 0.2),
        noise_factor: float = 1.0,
        sample: float = 0.05,
        smallest_probability: float = 1e-6,
        **kwargs: Any,
    ) -> None:
        """As AnchorModel, whose other arguments are `kwargs`.

        entropy         entropy model with `bits` and `FloatContext` ("gaussian-exact" of the registry)
        margin          of the bounds, see `anchor_lattice.bounds_of`
        noise_factor    multiplies the base steps in the phase QUANTIZED
        sample          share of the visible anchors whose rate is computed
        smallest_probability    floor of the probability of a value, in training
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
        self.entropy = entropy
        self._lattice: tuple[tuple[Any, ...], Tensor, Tensor] | None = None

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
            codes = position_codes(self.anchors, self.bounds)
            kept = self._lattice = (state, codes, coded_positions(codes, self.bounds))
        return kept[1], kept[2]

    # Masks

    def mask_weights(self) -> Tensor | None:
        """[N,1] factors of sigmoid(mask_logits), or None for 1."""
        return None

    def soft_masks(self) -> Tensor:
        """[N,k] what is compared with the threshold; differentiable."""
        soft, weights = torch.sigmoid(self.mask_logits), self.mask_weights()
        return soft if weights is None else soft * weights

    def masks(self, rows: Tensor | None = None) -> Tensor:
        """[V,k] 0 or 1, with the gradient of `soft_masks`; None: all rows."""
        soft = self.soft_masks()
        soft = soft if rows is None else soft[rows]
        return soft + ((soft > MASK_THRESHOLD).to(soft) - soft).detach()

    @torch.no_grad()
    def kept(self) -> Tensor:
        """[N] bool: anchors with a Gaussian left; others are not in the file."""
        return (self.soft_masks() > MASK_THRESHOLD).any(dim=1)

    @torch.no_grad()
    def counts(self) -> dict[str, int]:
        """Anchors and Gaussians that the file will have."""
        masks = self.soft_masks() > MASK_THRESHOLD
        return {"num_anchors": int(masks.any(dim=1).sum()), "num_gaussians": int(masks.sum())}

    # Attributes

    def raw(self, rows: Tensor) -> Triple:
        """Values of GROUPS as they are, [V,C] each."""
        return self.features[rows], self.log_scales[rows].exp(), self.offsets[rows].flatten(1)

    def predict(self, rows: Tensor) -> AnchorContext:
        """The context of the anchors `rows`, from their positions; differentiable."""
        raise NotImplementedError

    def refine(self, context: AnchorContext, features: Tensor) -> AnchorContext:
        """The context once (noisy or rounded) features [V,F] are known; here it stays as it is."""
        return context

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        values, masks = self.raw(rows), self.masks(rows)
        extras: dict[str, Any] = {}
        if self.phase == QUANTIZED:
            steps = [
                values[0].new_tensor(step * (self.noise_factor if self.training else 1)) for step in self.base_steps
            ]
            values = self._noisy(values, steps) if self.training else self._rounded(values, steps)
        elif self.phase == ENTROPY:
            context = self.predict(rows)
            if self.training:
                values = self._noisy(values, context.steps)
                extras["rate"] = self.rate(rows, values, self.refine(context, values[0]), masks)
            else:
                values = self._rounded(values, context.steps)
        features, scales, offsets = values
        return AnchorAttributes(
            self.positions()[rows],
            features,
            offsets.view(len(rows), self.num_offsets, 3),
            scales,
            masks=masks,
            extras=extras,
        )

    def uniform(self, *shape: int) -> Tensor:
        """Draws of U(0,1) on the model's device."""
        own = self.noise is not None and self.noise.device.type == self.device.type
        return torch.rand(shape, generator=self.noise if own else None, device=self.device)

    def _noisy(self, values: Triple, steps: Any) -> Triple:
        draws = self.uniform(len(values[0]), sum(v.shape[1] for v in values)) - 0.5
        noise = torch.split(draws, [v.shape[1] for v in values], dim=1)
        features, scales, offsets = (v + u * step for v, u, step in zip(values, noise, steps, strict=True))
        return features, scales, offsets

    @torch.no_grad()
    def _rounded(self, values: Triple, steps: Any) -> Triple:
        centres = self.centres()
        features, scales, offsets = (
            rounded_indices(v, step, centre) * step for v, step, centre in zip(values, steps, centres, strict=True)
        )
        return features, scales, offsets

    @torch.no_grad()
    def centres(self) -> Triple:
        """Mean of each group over all numbers of the kept anchors; where indices are clamped to (INDEX_CLAMP)."""
        features, scales, offsets = (v.double().mean() if v.numel() else v.new_zeros(()).double()
                                     for v in self.raw(torch.nonzero(self.kept()).squeeze(1)))  # fmt: skip
        return features, scales, offsets

    def rate(self, rows: Tensor, values: Triple, context: AnchorContext, masks: Tensor) -> AnchorRate:
        """Bits of a sample of the anchors `rows`, each drawn with probability `sample` if it is kept.

        values      [V,C] of each group, noisy
        masks       [V,k], with gradient: the bits of a masked offset do not count, its numbers do
        """
        kept = masks.detach().amax(dim=1) > 0
        drawn = torch.nonzero((self.uniform(len(rows)) < self.sample) & kept).squeeze(1)
        numbers = len(drawn) * sum(v.shape[1] for v in values)
        if numbers == 0:
            nothing = self.mask_logits.new_zeros(())
            return AnchorRate(nothing, nothing.new_zeros(3), 0, context.own_bits)
        # An anchor's three coordinates of an offset share its mask.
        factors = (None, None, masks[drawn].repeat_interleave(3, dim=1))
        bits = []
        for value, mean, scale, step, factor in zip(
            values, context.means, context.scales, context.steps, factors, strict=True
        ):
            distribution = self.entropy.FloatContext(
                mean[drawn], scale[drawn].clamp(min=1e-9), step[drawn], smallest_probability=self.smallest_probability
            )
            found = self.entropy.bits(value[drawn], distribution)
            bits.append((found if factor is None else found * factor).sum())
        share = kept.to(bits[0]).mean()
        total = torch.stack(bits)
        return AnchorRate(total.sum() / numbers * share, total.detach(), numbers, context.own_bits)

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


def rounded_indices(values: Tensor, steps: Tensor, centre: Tensor) -> Tensor:
    """Indices round(x / step), within INDEX_CLAMP of that of `centre`; the dtype of `values`."""
    index, middle = torch.round(values / steps), torch.round(centre.to(steps) / steps)
    return torch.minimum(torch.maximum(index, middle - INDEX_CLAMP), middle + INDEX_CLAMP)
