"""Codebooks trained by many small weighted batches: the published loops, each with its own start and update.

rule          start                        update of entry k; n, m: weighted count and sum of its rows in the batch
ema           rows by weight, distinct     N = g N + (1-g) n, M = g M + (1-g) m, c = M / N'
official      U(-b, b), b = sqrt(6/(K d))  N = g N + (1-g) n,                    c = g c + (1-g) m / N'
batch-mean    U(min x, max x)                                                    c = g c + (1-g) m / (n + 1e-5)

`ema` also mends its start: starved entries begin again where the error is largest, and in the first half entries move
as those of k-means do (`relocation.py`). Without it, what is reached depends on which rows were drawn first.
N' is N with Laplace smoothing, (N + e) / (sum N + K e) * sum N, e = 1e-5. Under `official` and `batch-mean` an entry
without rows shrinks towards 0; with these starts that is what brings it to the data.
`ema` is ours. `official` is the loop that came with LightGaussian (arXiv 2311.17245) and that ChimeraGS uses;
`batch-mean` that of C3DGS (arXiv 2401.02436) and MesonGS (arXiv 2409.09756).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from splatwizard_core.api import track
from sw_codecs.codebooks.nearest import nearest
from sw_codecs.codebooks.relocation import relocate
from sw_codecs.codebooks.weighted_rows import draw, gather

RULES = ("ema", "official", "batch-mean")
EPSILON = 1e-5
SETTLED = 0.9  # ema seeds no entries anew in the last tenth
STARVED = 0.05  # nor those with more than this share of the mean count
MOVES_EVERY = 10  # iterations; ema moves entries in the first half alone, since a batch is but a sample


def train_codebook(
    x: Tensor,
    weights: Tensor,
    *,
    size: int,
    rule: str,
    iterations: int,
    batch: int,
    decay: float,
    reseed: int,
    generator: torch.Generator,
    start: Tensor | None = None,
    project: Callable[[Tensor], Tensor] | None = None,
    block: int | None = None,
    label: str = "codebook",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Codebook [K, d], counts [K] and sums [K, d] (float64), and the weighted error of each batch before its update.

    x, weights   [N, d] with N >= 1, [N] >= 0; rows are drawn with replacement, all alike; their weights are rescaled to
                 mean 1 in the batch (`batch-mean`: to maximum 1 over all), and are 1 if all are 0
    The rest is described at VectorQuantizer.train.
    """
    entries = _start(x, weights, size, rule, generator) if start is None else start.to(x)
    counts = torch.full((size,), float(rule == "ema"), dtype=torch.float64, device=x.device)
    sums = entries.to(torch.float64) * counts[:, None]
    errors = x.new_zeros(iterations)
    largest = weights.max()
    with track(label, total=iterations) as bar:
        for i in range(iterations):
            drawn = torch.randint(len(x), (min(batch, len(x)),), generator=generator, device=generator.device)
            drawn, times = drawn.to(x.device), None
            if rule == "batch-mean" and 2 * len(drawn) >= len(x):
                drawn, times = _counted(drawn, len(x))
            rows, importance = x[drawn], weights[drawn]
            scale = largest if rule == "batch-mean" else importance.mean()
            importance = torch.where(scale > 0, importance / scale.clamp_min(1e-30), 1.0).to(x.dtype)
            if times is not None:
                importance = importance * times
            index, distance = nearest(rows, entries, block=block)
            errors[i] = (distance * importance).sum() / importance.sum().clamp_min(1e-30)
            n, m = gather(rows, importance, index, size)
            if rule == "batch-mean":
                entries = (decay * entries + (1 - decay) * (m / (n + EPSILON)[:, None])).to(x.dtype)
            else:
                counts = decay * counts + (1 - decay) * n
                if rule == "ema":
                    sums = decay * sums + (1 - decay) * m
                    if reseed and i % MOVES_EVERY == MOVES_EVERY - 1 and i < iterations // 2:
                        _move(counts, sums, n, m, relocate(rows, importance, index, distance, n, m, generator))
                    entries = (sums / smoothed(counts)[:, None]).to(x.dtype)
                else:
                    entries = (decay * entries + (1 - decay) * m / smoothed(counts)[:, None]).to(x.dtype)
                if reseed and (rule == "official" or i < SETTLED * iterations):
                    # Ours goes by what an entry at the row would spare: weights, equal ones above all, hardly ever
                    # point to a cluster that has no entry yet.
                    worth = importance * distance if rule == "ema" else importance
                    _reseed(entries, counts, sums, rows, worth, drawn, reseed, starved_only=rule == "ema")
            if project is not None:
                entries = project(entries)
            bar.advance(1, error=errors[i])
    if rule != "ema":  # what the EMA steps of VectorQuantizer.update go on from
        counts, sums = torch.ones_like(counts), entries.to(torch.float64)
    return entries, counts, sums, errors


def _counted(drawn: Tensor, rows: int) -> tuple[Tensor, Tensor]:
    """Return the distinct numbers below `rows` that were drawn, ascending, and how often each was, both [n].

    Of as many draws as there are rows a third are repetitions, which would be searched in vain.
    """
    times = torch.bincount(drawn, minlength=rows)
    distinct = times.nonzero().squeeze(1)
    return distinct, times[distinct]


def smoothed(counts: Tensor) -> Tensor:
    """Counts with Laplace smoothing: none is 0, their sum stays."""
    total = counts.sum()
    return ((counts + EPSILON) / (total + len(counts) * EPSILON) * total).clamp_min(1e-30)


def _move(counts: Tensor, sums: Tensor, n: Tensor, m: Tensor, moved: tuple[Tensor, Tensor]) -> None:
    """Reset, in place, the state of entries whose `moved` sums differ from the batch's n and m."""
    anew = (moved[0] != n) | (moved[1] != m).any(1)
    counts[anew], sums[anew] = moved[0][anew], moved[1][anew]


def _start(x: Tensor, weights: Tensor, size: int, rule: str, generator: torch.Generator) -> Tensor:
    if rule == "ema":
        if int((weights > 0).sum()) < min(size, len(x)):
            weights = torch.ones_like(weights)
        entries = x[draw(weights, size, generator)]
        return torch.cat([entries, entries[-1:].expand(size - len(entries), -1)])
    u = torch.rand(size, x.shape[1], generator=generator, device=generator.device, dtype=x.dtype).to(x.device)
    if rule == "official":
        bound = (6 / (size * x.shape[1])) ** 0.5
        return (2 * u - 1) * bound
    return x.min() + u * (x.max() - x.min())


def _reseed(
    entries: Tensor,
    counts: Tensor,
    sums: Tensor,
    rows: Tensor,
    worth: Tensor,
    drawn: Tensor,
    most: int,
    *,
    starved_only: bool,
) -> None:
    """Overwrite up to `most` entries of the smallest counts with the rows of the largest `worth`, in place."""
    weakest = torch.topk(counts, min(most, len(counts)), largest=False).indices
    best = torch.topk(worth, min(8 * most if starved_only else most, len(rows))).indices
    if starved_only:
        mean = counts.sum() / len(counts)
        weakest = weakest[counts[weakest] < STARVED * mean]
        # A row that the batch holds twice makes one entry.
        rows_once = dict(zip(reversed(drawn[best].tolist()), reversed(best.tolist()), strict=True))
        best = best.new_tensor(list(reversed(rows_once.values())))
    weakest, best = weakest[: len(best)], best[: len(weakest)]
    entries[weakest] = rows[best]
    if starved_only:
        counts[weakest] = mean
        sums[weakest] = mean * entries[weakest].to(torch.float64)
