"""Entropy model `mixture`: a weighted sum of K Gaussians or Laplacians, per symbol in training, per column in the file.

For values with several modes, or tails heavier than a Gaussian's. The file holds integer counts made from the densities
(a mixture of floats could not be recomputed exactly), therefore one mixture for each column; what varies from symbol to
symbol goes through `gaussian-exact`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sw_codecs.entropy import density_tables
from sw_codecs.entropy.columns import as_matrix
from sw_codecs.entropy.rates import CODER_FLOOR, MASSES, mixture_bits

# Scales within which a density has all but 1e-9 of its mass.
REACH = {"gaussian": 6.2, "laplace": 20.8}


@dataclass(frozen=True)
class MixtureContext:
    """Context of `bits` and `encode`; all in the unit of the values, float tensors.

    logits  [..., K] weights are their softmax; [C, K] or [K] for `encode`
    mean    [..., K]
    scale   [..., K] > 0: standard deviation, or b of a Laplacian
    step    the width of a bin, a number or one per channel [C]
    family  "gaussian" or "laplace"
    smallest_probability, grad_below_bound     as in `FloatContext` of `gaussian-exact`
    """

    logits: Tensor
    mean: Tensor
    scale: Tensor
    step: Tensor | float = 1.0
    family: str = "gaussian"
    smallest_probability: float = CODER_FLOOR
    grad_below_bound: bool = True

    def __post_init__(self) -> None:
        if self.family not in MASSES:
            raise ValueError(f"a mixture of '{self.family}' is not known, only of {' or '.join(MASSES)}")


class Mixture:
    """`Mixture.Context(logits, mean, scale)` is the context of `bits` and `encode`, the shape that of `decode`."""

    Context = MixtureContext

    def bits(self, symbols: Tensor, context: MixtureContext) -> Tensor:
        """Bits of each value (rounded, or with noise added): [..., C] under parameters that broadcast with it and have
        an axis for the components besides. Differentiable in everything; shape of `symbols`.
        """
        return mixture_bits(
            symbols,
            context.logits,
            context.mean,
            context.scale,
            context.step,
            family=context.family,
            p_min=context.smallest_probability,
            grad_below_bound=context.grad_below_bound,
        )

    def encode(self, symbols: np.ndarray, context: MixtureContext) -> bytes:
        """Bytes of indices k [N, C] or [N] integers, whose values are k * step: density_tables has the layout.

        Raises ValueError for parameters of other shapes than [C, K] (or [K]), not finite or not positive, and for
        indices beyond 2^38.
        """
        matrix = as_matrix(symbols)
        columns = matrix.shape[1]
        parameters = [t.detach().cpu().double() for t in (context.logits, context.mean, context.scale)]
        if any(t.ndim not in (1, 2) or t.shape[0] not in (1, columns) for t in parameters if t.ndim != 1):
            raise ValueError(f"the file has one mixture a column: parameters must be [{columns}, K] or [K]")
        step = torch.as_tensor(context.step).detach().cpu().double().reshape(-1, 1).expand(columns, 1)
        k = max(t.shape[-1] for t in parameters)
        logits, mean, scale = (t.expand(columns, k) for t in parameters)
        if not all(bool(torch.isfinite(t).all()) for t in (logits, mean, scale)) or not bool((scale > 0).all()):
            raise ValueError("a mixture has parameters that are not finite, or scales that are not positive")
        if not bool((step > 0).all()):
            raise ValueError("the step must be positive")
        reach = REACH[context.family] * scale
        low, high = (mean - reach).amin(1) / step[:, 0], (mean + reach).amax(1) / step[:, 0]

        def mass(column: int, integers: np.ndarray) -> np.ndarray:
            x = torch.from_numpy(integers.astype(np.float64))[:, None] * step[column]
            parts = MASSES[context.family](x, mean[column], scale[column], step[column])
            return (parts * torch.softmax(logits[column], 0)).sum(1).numpy()

        return density_tables.encode(matrix, density_tables.windows(matrix, low.numpy(), high.numpy()), mass)

    def decode(self, data: bytes, context: tuple[int, ...]) -> np.ndarray:
        """int64 of the shape `context`: (N, C) or (N,). Raises BitstreamError."""
        return density_tables.decode(data, context)
