"""Entropy model `factorised`: a trained density for each channel, of no fixed shape.

The cumulative distribution of a channel is a small monotone network: four layers with positive weights and gated
nonlinearities, then a sigmoid. Source: Balle et al., Variational image compression with a scale hyperprior (arXiv
1802.01436), appendix 6.1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from sw_codecs.entropy import density_tables
from sw_codecs.entropy.columns import as_matrix
from sw_codecs.entropy.rates import CODER_FLOOR, bits_of

BRACKET = 60  # doublings of the interval in which a quantile is sought
BISECTIONS = 80


@dataclass(frozen=True)
class FactorisedContext:
    """step: the width of a bin, a number or one per channel [C], in the unit of the values.

    smallest_probability, grad_below_bound     as in `FloatContext` of `gaussian`
    """

    step: Tensor | float = 1.0
    smallest_probability: float = CODER_FLOOR
    grad_below_bound: bool = True


class Factorised(nn.Module):
    """Densities of `channels` channels; with one channel, of values of any shape.

    filters     widths of the hidden layers
    init_scale  spread of the values at which training starts: about their standard deviation times 10 at most
    tail_mass   what lies outside of the quantiles tail_mass / 2 and 1 - tail_mass / 2 gets no count, but an escape code

    Train `bits(...)` with the method's other parameters. The file holds integer counts made from the density: decoding
    needs nothing of the network. `Factorised.Context(step=...)` is the context of `bits` and `encode`, the
    shape that of `decode`.
    """

    Context = FactorisedContext

    def __init__(
        self,
        channels: int = 1,
        *,
        filters: Sequence[int] = (3, 3, 3),
        init_scale: float = 10.0,
        tail_mass: float = 1e-9,
    ) -> None:
        super().__init__()
        if channels < 1 or not 0 < tail_mass < 1 or not init_scale > 0:
            raise ValueError(
                f"{channels} channels, init_scale {init_scale}, tail_mass {tail_mass}: all must be positive"
            )
        self.channels, self.tail_mass = channels, tail_mass
        widths = (1, *filters, 1)
        scale = init_scale ** (1 / (len(widths) - 1))
        self.matrices, self.biases, self.gates = nn.ParameterList(), nn.ParameterList(), nn.ParameterList()
        for before, after in itertools.pairwise(widths):
            weight = math.log(math.expm1(1 / scale / after))
            self.matrices.append(nn.Parameter(torch.full((channels, after, before), weight)))
            self.biases.append(nn.Parameter(torch.rand(channels, after, 1) - 0.5))
            if len(self.gates) < len(filters):
                self.gates.append(nn.Parameter(torch.zeros(channels, after, 1)))

    def logits(self, x: Tensor, channels: slice = slice(None)) -> Tensor:
        """The logit of the cumulative distribution at x [C, n], in the dtype of x; rises with x.

        channels    which ones the rows of x are of
        """
        z = x[:, None]
        for layer, (matrix, bias) in enumerate(zip(self.matrices, self.biases, strict=True)):
            z = softplus(matrix[channels].to(x)) @ z + bias[channels].to(x)
            if layer < len(self.gates):
                z = z + torch.tanh(self.gates[layer][channels].to(x)) * torch.tanh(z)
        return z[:, 0]

    def mass(self, x: Tensor, step: Tensor | float, channels: slice = slice(None)) -> Tensor:
        """Probability of the bins [x - step/2, x + step/2], x [C, n], step a number or [C, 1]."""
        low, high = self.logits(x - step / 2, channels), self.logits(x + step / 2, channels)
        # Mirrored into the lower half, where a sigmoid keeps its digits.
        sign = -torch.sign(low + high).detach()
        return (torch.sigmoid(sign * high) - torch.sigmoid(sign * low)).abs()

    def bits(self, symbols: Tensor, context: FactorisedContext | None = None) -> Tensor:
        """Bits of each value [..., C] (rounded, or with noise added); differentiable, shape of `symbols`.

        The unit is that of training: values with a step, or indices with a step of 1.
        """
        context = context or FactorisedContext()
        if self.channels != 1 and (symbols.ndim == 0 or symbols.shape[-1] != self.channels):
            raise ValueError(f"values of shape {list(symbols.shape)} do not end in {self.channels} channels")
        if not symbols.is_floating_point():
            symbols = symbols.to(torch.get_default_dtype())
        p = self.mass(symbols.reshape(-1, self.channels).T, self._step(context, symbols))
        return bits_of(p, context.smallest_probability, context.grad_below_bound).T.reshape(symbols.shape)

    def encode(self, symbols: np.ndarray, context: FactorisedContext | None = None) -> bytes:
        """Bytes of indices k [N, C] or [N] integers, whose values are k * step: density_tables has the layout.

        Raises ValueError for another number of channels and for indices beyond 2^38.
        """
        matrix = as_matrix(symbols)
        if matrix.shape[1] != self.channels:
            raise ValueError(f"symbols of shape {list(np.shape(symbols))} do not have {self.channels} channels")
        ends = self.quantiles()
        steps = torch.as_tensor(self._step(context or FactorisedContext(), ends)).to(ends).expand(self.channels, 1)
        if not bool((steps > 0).all()):
            raise ValueError("the step must be positive")
        limits = (ends / steps).cpu().numpy()

        def mass(column: int, integers: np.ndarray) -> np.ndarray:
            x = torch.from_numpy(integers).to(steps) * steps[column]
            with torch.no_grad():
                return self.mass(x[None], steps[column], slice(column, column + 1))[0].cpu().numpy()

        return density_tables.encode(matrix, density_tables.windows(matrix, *limits.T), mass)

    def decode(self, data: bytes, context: tuple[int, ...]) -> np.ndarray:
        """int64 of the shape `context`: (N, C) or (N,). Raises BitstreamError. Needs no parameters of this object."""
        return density_tables.decode(data, context)

    @torch.no_grad()
    def quantiles(self) -> Tensor:
        """[C, 2] float64: where the distribution reaches tail_mass / 2 and 1 - tail_mass / 2, by bisection."""
        target = torch.tensor([math.log(self.tail_mass / 2), -math.log(self.tail_mass / 2)], dtype=torch.float64)
        target = target.to(self._device).expand(self.channels, 2)
        low, high = -torch.ones_like(target), torch.ones_like(target)
        for _ in range(BRACKET):
            low = torch.where(self.logits(low) > target, 2 * low, low)
            high = torch.where(self.logits(high) < target, 2 * high, high)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            is_below = self.logits(middle) < target
            low, high = torch.where(is_below, middle, low), torch.where(is_below, high, middle)
        return (low + high) / 2

    @property
    def _device(self) -> torch.device:
        return self.biases[0].device

    def _step(self, context: FactorisedContext, like: Tensor) -> Tensor | float:
        """A number, or [C, 1] in dtype and device of `like`."""
        if isinstance(context.step, Tensor):
            return context.step.to(like).reshape(-1, 1).expand(self.channels, 1)
        return context.step
