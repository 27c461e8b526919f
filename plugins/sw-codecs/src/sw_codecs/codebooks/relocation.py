"""Take entries from where they are hardly needed to where the error is, if that lowers the error for certain."""

from __future__ import annotations

import torch
from torch import Tensor

from sw_codecs.codebooks.nearest import nearest
from sw_codecs.codebooks.weighted_rows import gather, log_uniform

ROWS = 1 << 14


def relocate(
    x: Tensor,
    weights: Tensor,
    index: Tensor,
    distance: Tensor,
    counts: Tensor,
    sums: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Counts [K] and sums [K, d] after entries have moved; entry k is then sums[k] / counts[k].

    index, distance   [N], the assignment that counts and sums belong to, and its squared distances

    Merging the rows of an entry with those of its neighbour raises the error by n m / (n + m) |c - c'|^2 (Ward);
    splitting the rows of another in two lowers it by the same expression of the two halves. Entries are merged and
    split in pairs while a split gains more than a merge costs, so each move lowers the error. An entry without rows
    costs nothing. Moving entries by their utility is the idea of ELBG (Patane and Russo, Neural Networks 14, 2001).
    """
    size = len(counts)
    if size < 2:
        return counts, sums
    means = sums / counts.clamp_min(1e-300)[:, None]
    half_counts, half_sums = _halves(x, weights, index, distance, means, generator)
    rest_counts, rest_sums = counts - half_counts, sums - half_sums
    split = (half_counts > 1e-9 * counts) & (rest_counts > 1e-9 * counts)
    gain = torch.where(split, _ward(half_counts, half_sums, rest_counts, rest_sums), 0.0)

    used = torch.nonzero(counts > 0).squeeze(1)
    if len(used) < 2:
        cost, near = torch.where(counts > 0, torch.inf, 0.0).to(counts), torch.full_like(index[:1], -1).expand(size)
    else:
        entries = means[used].to(x.dtype)
        near = torch.full((size,), -1, dtype=torch.int64, device=x.device)
        near[used] = used[nearest(entries, entries, others=True)[0]]
        cost = torch.where(counts > 0, _ward(counts, sums, counts[near], sums[near]), 0.0)
    moves = _pairs(cost.tolist(), gain.tolist(), near.tolist())
    if moves:
        moved, split_at = torch.tensor(moves, device=x.device).T
        counts, sums = counts.clone(), sums.clone()
        for target, part in ((counts, (half_counts, rest_counts)), (sums, (half_sums, rest_sums))):
            merged = near[moved]
            full = merged >= 0
            target[merged[full]] += target[moved[full]]  # each neighbour takes in one entry at most
            target[moved], target[split_at] = part[0][split_at], part[1][split_at]
    return counts, sums


def _halves(
    x: Tensor, weights: Tensor, index: Tensor, distance: Tensor, means: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Counts and sums of the rows of each entry that are nearer to one of them, drawn by error, than to the mean."""
    size = len(means)
    key = log_uniform(len(x), generator, x.device) / (distance * weights).to(torch.float64).clamp_min(1e-300)
    best = torch.full((size,), -torch.inf, dtype=torch.float64, device=x.device).scatter_reduce_(0, index, key, "amax")
    drawn = torch.nonzero(key == best[index]).squeeze(1)
    pick = torch.zeros(size, dtype=torch.int64, device=x.device)
    pick[index[drawn]] = drawn
    ends, middles = x[pick], means.to(x.dtype)
    nearer = torch.empty(len(x), dtype=torch.bool, device=x.device)
    for start in range(0, len(x), ROWS):
        rows, cell = x[start : start + ROWS], index[start : start + ROWS]
        nearer[start : start + ROWS] = (rows - ends[cell]).square().sum(1) < (rows - middles[cell]).square().sum(1)
    chosen = torch.nonzero(nearer).squeeze(1)
    return gather(x[chosen], weights[chosen], index[chosen], size)


def _ward(n: Tensor, sum_n: Tensor, m: Tensor, sum_m: Tensor) -> Tensor:
    """By how much the error of two sets of rows grows if they share their mean, [K]."""
    gap = sum_n / n.clamp_min(1e-300)[:, None] - sum_m / m.clamp_min(1e-300)[:, None]
    return n * m / (n + m).clamp_min(1e-300) * gap.square().sum(1)


def _pairs(cost: list[float], gain: list[float], near: list[int]) -> list[tuple[int, int]]:
    """(entry to move, entry to split), cheapest with best. None has two parts in it: the bounds would not add up."""
    moves: list[tuple[int, int]] = []
    taken: set[int] = set()
    best = iter(sorted(range(len(gain)), key=lambda k: (-gain[k], k)))
    split = next(best)
    for moved in sorted(range(len(cost)), key=lambda k: (cost[k], k)):
        if moved in taken or near[moved] in taken:
            continue
        while split in taken or split in (moved, near[moved]):
            following = next(best, None)
            if following is None:
                return moves
            split = following
        if not gain[split] > cost[moved] * (1 + 1e-6):  # a gain of rounding errors is none
            return moves
        moves.append((moved, split))
        taken |= {moved, split} | ({near[moved]} if near[moved] >= 0 else set())
    return moves
