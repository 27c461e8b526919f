"""Codebooks: of single numbers, and of vectors of SH coefficients."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sw_interchange.bands import Array

Labels = npt.NDArray[np.intp]
Numbers = npt.NDArray[np.float64]

DIRECT = 4e9
"""Multiplications an iteration up to which every vector meets every entry; beyond it entries form a tree."""
AT_ONCE = 1 << 22
"""Products of vectors and entries that are in memory together."""


def scalar_codebook(values: Array, size: int = 256) -> Array:
    """Ascending codebook [size] float32 of numbers: the best one for bins that weigh the square root of what they hold.

    The root leaves entries to rare large numbers; plain k-means would spend nearly all on the crowded middle.
    """
    numbers = np.sort(values.reshape(-1).astype(np.float64))
    even = np.linspace(numbers[0], numbers[-1], 3 * size // 2)
    edges = np.union1d(even, np.quantile(numbers, np.linspace(0, 1, size // 2)))[1:-1]
    cuts = np.r_[0, np.searchsorted(numbers, edges, "right"), len(numbers)]
    counts = np.diff(cuts)
    points = np.add.reduceat(numbers, cuts[:-1][counts > 0]) / counts[counts > 0]
    if len(points) > size:
        points = _best_centres(points, np.sqrt(counts[counts > 0]), size)
    return np.r_[points, np.full(size - len(points), points[-1])].astype(np.float32)


def _best_centres(points: Numbers, weights: Numbers, size: int) -> Numbers:
    """Centres [size] of the partition of ascending points into runs with the least weighted squares, by dynamic
    programming."""
    mass, first, second = (np.r_[0, np.cumsum(weights * points**power)] for power in range(3))
    own = np.subtract.outer(mass, mass).T
    with np.errstate(all="ignore"):
        cost = np.subtract.outer(second, second).T - np.subtract.outer(first, first).T ** 2 / own  # [from, to]
    cost[own <= 0] = np.inf
    best, begins = cost[0], np.empty((size, len(mass)), np.intp)
    for run in range(1, size):
        total = best[:, None] + cost
        begins[run] = total.argmin(0)
        best = total[begins[run], np.arange(len(mass))]
    end, bounds = len(points), [len(points)]
    for run in range(size - 1, 0, -1):
        end = int(begins[run, end])
        bounds.append(end)
    bounds = [0, *reversed(bounds)]
    return np.diff(first[bounds]) / np.diff(mass[bounds])


def nearest_entry(values: Array, codebook: Array) -> npt.NDArray[np.uint8]:
    """Index of the entry nearest to each number; the codebook is ascending."""
    return np.searchsorted((codebook[1:] + codebook[:-1]) / 2, values).astype(np.uint8)


def vector_palette(vectors: Array, size: int, iterations: int, rng: np.random.Generator) -> tuple[Array, Labels]:
    """Palette [<= size, D] of vectors [N,D], and each vector's entry [N].

    Where N times `size` is large, k-means runs on two levels: coarse cells, then entries within each.
    """
    if len(vectors) <= size:
        return vectors.copy(), np.arange(len(vectors))
    if float(len(vectors)) * size * vectors.shape[1] <= DIRECT or size <= 256:
        return _k_means(vectors, size, iterations, rng)
    coarse, cells = _k_means(vectors, round(size**0.5), iterations, rng)
    order = np.argsort(cells, kind="stable")
    ends = np.cumsum(np.bincount(cells, minlength=len(coarse)))
    wanted = _shares(vectors, coarse, cells, size)
    palette, labels, start, used = [], np.empty(len(vectors), np.intp), 0, 0
    for cell, end in enumerate(ends):
        rows = order[start:end]
        start = end
        if not len(rows):
            continue
        inside = vectors[rows]
        if len(rows) <= wanted[cell]:
            entries, own = inside, np.arange(len(rows))
        else:
            entries, own = _k_means(inside, int(wanted[cell]), iterations, rng)
        palette.append(entries)
        labels[rows] = used + own
        used += len(entries)
    return np.concatenate(palette), labels


def _shares(vectors: Array, coarse: Array, cells: Labels, size: int) -> npt.NDArray[np.int64]:
    """Entries for each cell, by what it holds and how far that spreads."""
    errors = ((vectors - coarse[cells]) ** 2).sum(1)
    counts = np.bincount(cells, minlength=len(coarse)).astype(np.float64)
    weights = np.sqrt(np.bincount(cells, errors, len(coarse)) * counts)
    weights /= max(weights.sum(), 1e-30)
    return np.maximum(1, np.floor(weights * (size - len(coarse))).astype(np.int64))


def _k_means(vectors: Array, size: int, iterations: int, rng: np.random.Generator) -> tuple[Array, Labels]:
    entries = vectors[np.sort(rng.choice(len(vectors), size, replace=False))].copy()
    labels = _assign(vectors, entries)
    for _ in range(iterations):
        counts = np.bincount(labels, minlength=size)
        order = np.argsort(labels, kind="stable")
        starts = np.r_[0, np.cumsum(counts)[:-1]]
        alive = np.flatnonzero(counts)
        entries[alive] = np.add.reduceat(vectors[order], starts[alive], axis=0) / counts[alive, None]
        dead = np.flatnonzero(counts == 0)
        entries[dead] = vectors[rng.choice(len(vectors), len(dead))]
        moved = _assign(vectors, entries)
        if np.array_equal(moved, labels):
            break
        labels = moved
    return entries, labels


def _assign(vectors: Array, entries: Array) -> Labels:
    """The nearest entry of each vector."""
    squares = 0.5 * np.einsum("ij,ij->i", entries, entries)
    turned = np.ascontiguousarray(entries.T)
    labels = np.empty(len(vectors), np.intp)
    rows = max(AT_ONCE // len(entries), 1)
    for at in range(0, len(vectors), rows):
        part = slice(at, at + rows)
        products = vectors[part] @ turned
        products -= squares
        labels[part] = products.argmax(1)
    return labels
