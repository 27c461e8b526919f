"""Training a codebook in batches, where important vectors count more.

Source: LightGaussian (arXiv 2311.17245), section on vector quantisation, and facts about the authors' code.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

Training = Literal["ema", "official"]
EPSILON = 1e-5  # Laplace smoothing of the counts


def weights_of(importance: Tensor) -> Tensor:
    """[n] weights of a batch: `importance` [n] >= 0 scaled to mean 1; ones if all of it is zero."""
    mean = importance.double().mean()
    return (importance.double() / mean).float() if float(mean) > 0 else torch.ones_like(importance, dtype=torch.float32)


def train_codebook(
    quantizer: Any,
    x: Tensor,
    importance: Tensor,
    *,
    iterations: int,
    batch: int,
    reseed: int,
    training: Training,
    generator: torch.Generator,
) -> None:
    """Give `quantizer` (the quantizer `vq`, of `quantizer.size` entries) a codebook for `x`.

    x           [n,d] float32, n >= 1
    importance  [n] >= 0
    iterations, batch   updates, and rows of each, drawn with replacement
    reseed      at most so many entries start afresh after an update
    training    "ema": entries start as rows and are moving averages of theirs; "official": as the authors' code does
    """
    batch = min(batch, len(x))

    def drawn() -> tuple[Tensor, Tensor]:
        rows = torch.randint(len(x), (batch,), generator=generator, device=generator.device).to(x.device)
        return x[rows], weights_of(importance[rows])

    if training == "official":
        _official(quantizer, drawn, x.shape[1], iterations, reseed, generator, x.device)
        return
    positive = importance if float(importance.sum()) > 0 else torch.ones_like(importance)
    quantizer.fit(x, generator=generator, weights=positive.float(), iterations=0)
    for _ in range(iterations):
        rows, weights = drawn()
        quantizer.update(rows, generator=generator, weights=weights)


def _official(
    quantizer: Any, drawn: Any, width: int, iterations: int, reseed: int, generator: torch.Generator, device: Any
) -> None:
    """The rule of the authors' code: a start near zero, and only the counts are moving averages.

    The sums are those of the batch alone, so an entry that a batch does not hit shrinks by the decay; after every
    update the `reseed` entries of smallest count become the most important rows of the batch, their counts untouched.
    """
    size, decay = quantizer.size, quantizer.decay
    bound = (6 / (size * width)) ** 0.5
    start = torch.rand(size, width, generator=generator, device=generator.device).to(device)
    codebook = (2 * start - 1) * bound
    counts = torch.zeros(size, device=device, dtype=torch.float64)
    for _ in range(iterations):
        rows, weights = drawn()
        quantizer.codebook = codebook
        index = quantizer.assign(rows)
        hits = torch.zeros_like(counts).index_add_(0, index, weights.double())
        sums = torch.zeros(size, width, dtype=torch.float64, device=device)
        sums.index_add_(0, index, rows.double() * weights.double()[:, None])
        counts = decay * counts + (1 - decay) * hits
        smooth = (counts + EPSILON) / (counts.sum() + size * EPSILON) * counts.sum()
        codebook = (decay * codebook.double() + (1 - decay) * sums / smooth[:, None]).float()
        count = min(reseed, size, len(rows))
        rarest = torch.topk(counts, count, largest=False).indices
        codebook[rarest] = rows[torch.topk(weights, count).indices]
    quantizer.codebook = codebook
