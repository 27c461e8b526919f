"""Networks that predict the 22 numbers of a splat from the running means around it, as they are trained.

Features (`pyramid.walked_features`) are constants, rows of the model that follow the splats. A file's integers are the
closed loop: a training that fixes them takes those of `file.encode`, not its own rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sw_codecs.context.two_layers import two_layers
from sw_codecs.entropy.exact_tables import exact_tables
from sw_wisp.eight_bits import EXACT_EXPONENT, EightBitLayer, rounded_weights
from sw_wisp.nested import UNIT
from sw_wisp.numbers import BASE_STEPS, BLOCKS, NUMBERS, PARTS
from sw_wisp.predicting import STEPS_OF, PyramidContext, network_shapes
from sw_wisp.rate import Forecast, level_of, sigma_of
from sw_wisp.rounding import AS_THEY_ARE, Rounding
from sw_wisp.static import MEAN_UNIT
from sw_wisp.ties import LARGEST_SIZE, ROUNDING, tie_shapes

LARGEST_PRIOR = 32767 * MEAN_UNIT


def _residuals(drawn: Tensor, known: Forecast, unit: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals [N,c] in base steps, and their sizes: over the deviation of drawn numbers, at most 4; constants."""
    mean, scale, steps = (each.detach() for each in known)
    deviation = (sigma_of(scale, steps).square() + ROUNDING * steps.square()).sqrt()
    residual = drawn - mean
    return residual / unit, (residual.abs() / deviation).clamp_max(LARGEST_SIZE)


class ContextNetworks(nn.Module):
    """Four networks, for opacity; shape and size; colour; latents; ties of 120 numbers within their blocks.

    size        large, of 13,353 numbers, or small, of 6,701
    base_steps  [22] quantiser steps for a multiplier of 1
    prior       [22] int64 means where nothing is known, base steps with 12 fractional bits, multiples of 16
    adaptive    whether steps are what the networks say, or base steps
    rounds      whether weights are those of the file, of eight bits, with straight-through gradients
    """

    base_steps: Tensor
    prior: Tensor
    multipliers: Tensor

    def __init__(
        self, base_steps: Tensor | None = None, *, size: str = "large", adaptive: bool = True,
        generator: torch.Generator | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.adaptive, self.rounds = adaptive, False
        self.ties = nn.ParameterList(torch.zeros(shape) for shape in tie_shapes())
        self.networks = nn.ModuleList(
            two_layers(inputs, hidden, outputs, generator, start="silent")
            for inputs, hidden, outputs in network_shapes(size)
        )
        steps = torch.tensor(BASE_STEPS) if base_steps is None else base_steps
        self.register_buffer("base_steps", steps.float())
        self.register_buffer("prior", torch.zeros(NUMBERS, dtype=torch.int64))
        table = torch.from_numpy(exact_tables().multipliers / UNIT).float()
        self.register_buffer("multipliers", table, persistent=False)

    def forward(
        self, features: Tensor, view_features: Tensor, values: Tensor, rounding: Rounding = AS_THEY_ARE, *,
        moves_steps: bool = True,
    ) -> tuple[Forecast, Tensor]:  # fmt: skip
        """Forecast for splats of features [N,69] (those of latents: `view_features`) and values [N,22], and the drawn.

        rounding        what stands in for it: the next network sees what is drawn of one block
        moves_steps     whether steps have a gradient
        """
        parts: list[Forecast] = []
        noise = rounding.noise(values)
        ties = iter(self.ties)
        drawn = values[:, :0]
        for number, block in enumerate(BLOCKS):
            own = view_features if number == len(BLOCKS) - 1 else features
            unit, width = self.base_steps[block], block.stop - block.start
            known = (drawn / self.base_steps[: block.start]).detach()
            out = self._evaluate(number, torch.cat([own, known], dim=1))
            mean = (own[:, block] + out[:, :width]) * unit
            steps = (self._multipliers(out[:, 2 * width :])[:, STEPS_OF[number]] * unit).expand(len(values), -1)
            steps = steps if moves_steps else steps.detach()
            found = Forecast(mean, out[:, width : 2 * width], steps)
            told: list[tuple[Tensor, Tensor]] = []
            for columns in PARTS[number]:
                own = Forecast(*(t[:, columns.start - block.start : columns.stop - block.start] for t in found))
                if told:
                    own = self._tied(next(ties), own, told, self.base_steps[columns])
                own_noise = None if noise is None else noise[:, columns]
                taken = rounding.drawn(values[:, columns], own.mean, own.steps, own_noise)
                told.append(_residuals(taken.detach(), own, self.base_steps[columns]))
                drawn = torch.cat([drawn, taken], dim=1)
                parts.append(own)
        mean, scale, steps = (torch.cat(each, dim=1) for each in zip(*parts, strict=True))
        return Forecast(mean, scale, steps), drawn

    def _tied(self, tie: Tensor, own: Forecast, told: list[tuple[Tensor, Tensor]], unit: Tensor) -> Forecast:
        """Forecast of a part, given residuals and sizes of those before it in its block."""
        weights = rounded_weights(tie, EXACT_EXPONENT) if self.rounds else tie
        half = len(weights) // 2
        residuals, sizes = (torch.cat(each, dim=1) for each in zip(*told, strict=True))
        mean = own.mean + F.linear(residuals, weights[:half]) * unit
        return Forecast(mean, own.scale + F.linear(sizes, weights[half:]), own.steps)

    def latents(self, view_features: Tensor, told: Tensor) -> Tensor:
        """Means [N,12] of latents that a decoder lacks, from numbers [N,22] that it has of the same splats."""
        block = BLOCKS[-1]
        known = (told / self.base_steps)[:, : block.start].detach()
        out = self._evaluate(len(BLOCKS) - 1, torch.cat([view_features, known], dim=1))
        return (view_features[:, block] + out[:, : block.stop - block.start]) * self.base_steps[block]

    def _evaluate(self, number: int, inputs: Tensor) -> Tensor:
        first, _, last = self.networks[number]  # type: ignore[misc, union-attr]
        weights = [layer.weight for layer in (first, last)]
        if self.rounds:
            weights = [rounded_weights(weight, EXACT_EXPONENT) for weight in weights]
        found: Tensor = F.linear(torch.relu(F.linear(inputs, weights[0], first.bias)), weights[1], last.bias)
        return found

    def _multipliers(self, t: Tensor) -> Tensor:
        """Steps in base steps for outputs t: those of the table, with the gradient of 1 + tanh t."""
        if not self.adaptive:
            return torch.ones_like(t)
        place = ((t.detach() + 8) * 8).floor().clamp(0, len(self.multipliers) - 1).long()
        smooth = torch.tanh(t)
        return self.multipliers[place] + (smooth - smooth.detach())

    @torch.no_grad()
    def measure_prior(self, values: Tensor) -> None:
        """Take the means of values [N,22] in base steps."""
        mean = (values.double().mean(0) * (UNIT / MEAN_UNIT)).round().long() * MEAN_UNIT
        self.prior.copy_(mean.clamp(-LARGEST_PRIOR, LARGEST_PRIOR))

    @torch.no_grad()
    def start(self, features: Tensor, view_features: Tensor, values: Tensor) -> None:
        """Predict the running means, with the deviation from them that values [N,22] (base steps) have on the whole."""
        for number, block in enumerate(BLOCKS):
            own = view_features if number == len(BLOCKS) - 1 else features
            last = self.networks[number][-1]  # type: ignore[index]
            last.weight.zero_()
            last.bias.zero_()
            width = block.stop - block.start
            step = float(self._multipliers(last.bias[:1]))
            sigma = (values[:, block] - own[:, block]).square().mean(0).sqrt()
            last.bias[width : 2 * width] = level_of(sigma.clamp_min(1e-6), step)

    def exact(self) -> PyramidContext:
        """The same as the file holds it."""
        layers = []
        ties = [
            EightBitLayer.nearest(t.detach().cpu().double().numpy(), None, lowest=EXACT_EXPONENT) for t in self.ties
        ]
        for network in self.networks:
            for layer in (network[0], network[-1]):  # type: ignore[index]
                arrays = [each.detach().cpu().double().numpy() for each in (layer.weight, layer.bias)]
                layers.append(EightBitLayer.nearest(*arrays, lowest=EXACT_EXPONENT))
        return PyramidContext(self.prior.cpu().numpy(), tuple(layers), tuple(ties), self.adaptive)
