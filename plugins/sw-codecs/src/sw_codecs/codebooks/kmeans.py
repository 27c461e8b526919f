"""k-means in bounded memory: spread seeds, Lloyd's iterations, and entries that move to where they help more.

Plain Lloyd iterations never move an entry out of a cluster that has too many; the relocation of `relocation.py` does.
A pass over N rows costs N * K distances; the start costs 80 K * K more, nothing beside a pass at N = 10^6, K = 8192.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import track
from sw_codecs.codebooks.nearest import nearest
from sw_codecs.codebooks.relocation import relocate
from sw_codecs.codebooks.weighted_rows import draw, gather

SAMPLE = 16  # rows per entry that the start looks at
ROUNDS = 8  # the first entries are 1/8 of all, drawn blindly
WARM_UP = 4  # iterations on the sample


def kmeans(
    x: Tensor,
    weights: Tensor,
    *,
    size: int,
    iterations: int,
    generator: torch.Generator,
    spread: bool = True,
    block: int | None = None,
    label: str = "codebook",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Codebook [K, d], its counts [K] and sums [K, d] (float64), and the error of each iteration before its update.

    x          [N, d], N >= 1; with fewer rows (of positive weight) than entries the last entry repeats
    weights    [N] >= 0, not all zero
    spread     start from rows far from each other, as k-means++ does, instead of rows drawn by weight alone

    The error, sum(w |x - c|^2) / sum(w), never rises from one iteration to the next, up to rounding.
    """
    if spread:
        chosen = torch.nonzero(weights > 0).squeeze(1)
        chosen = chosen[_shuffled(len(chosen), generator, x.device)[: SAMPLE * size]]
        sample, sample_weights = x[chosen], weights[chosen]
        entries = _spread_seeds(sample, sample_weights, size, generator, block)
        if iterations and len(entries) == size and len(sample) < len(x):
            entries, *_ = _lloyd(sample, sample_weights, entries, WARM_UP, generator, block, f"{label}: sample")
    else:
        entries = x[draw(weights, size, generator)]
    if len(entries) < size:
        entries = torch.cat([entries, entries[-1:].expand(size - len(entries), -1)])
    return _lloyd(x, weights, entries, iterations, generator, block, label)


def _lloyd(
    x: Tensor,
    weights: Tensor,
    entries: Tensor,
    iterations: int,
    generator: torch.Generator,
    block: int | None,
    label: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    total = weights.to(torch.float64).sum()
    counts = torch.zeros(len(entries), dtype=torch.float64, device=x.device)
    sums = torch.zeros(entries.shape, dtype=torch.float64, device=x.device)
    errors = x.new_zeros(iterations, dtype=torch.float64)
    with track(label, total=iterations) as bar:
        for i in range(iterations):
            index, distance = nearest(x, entries, block=block)
            errors[i] = (distance.to(torch.float64) * weights).sum() / total
            counts, sums = gather(x, weights, index, len(entries))
            counts, sums = relocate(x, weights, index, distance, counts, sums, generator)
            entries = torch.where(counts[:, None] > 0, sums / counts.clamp_min(1e-300)[:, None], entries).to(x.dtype)
            bar.advance(1, error=errors[i])
    if not iterations:
        index, _ = nearest(x, entries, block=block)
        counts, sums = gather(x, weights, index, len(entries))
    return entries, counts, sums, errors.to(x.dtype)


def _shuffled(count: int, generator: torch.Generator, device: torch.device) -> Tensor:
    return torch.randperm(count, generator=generator, device=generator.device).to(device)


def _spread_seeds(x: Tensor, weights: Tensor, size: int, generator: torch.Generator, block: int | None) -> Tensor:
    """Rows drawn by weight times squared distance to those drawn before, several at a time. [min(K, N), d].

    Source: k-means++ (Arthur and Vassilvitskii, 2007), in the rounds of k-means|| (Bahmani et al., arXiv 1203.6402).
    """
    size = min(size, len(x))
    entries = x[draw(weights, max(1, size // ROUNDS), generator)]
    distance = nearest(x, entries, block=block)[1]
    while len(entries) < size:
        # A third of what is missing: the fewer are missing, the less two draws of a round may fall together.
        left = size - len(entries)
        wanted = min(left, max(1, size // (2 * ROUNDS), left // 3))
        likely = draw(distance * weights, wanted, generator)
        if len(likely) == 0:  # every row is an entry already: repeat
            return torch.cat([entries, entries[-1:].expand(left, -1)])
        entries = torch.cat([entries, x[likely]])
        distance = torch.minimum(distance, nearest(x, x[likely], block=block)[1])
    return entries
