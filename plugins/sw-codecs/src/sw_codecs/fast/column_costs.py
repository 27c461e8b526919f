"""Estimated bits of several plans of a column together: numbers so few take longer to call than to work on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sw_codecs.coders.count_tables import code_counts, count_codes, step_bits


def costs(plans: Sequence[Any], distinct: np.ndarray, counts: np.ndarray) -> list[tuple[Any, float]]:
    """Plans with their table sizes filled in, and their estimated bits.

    plans               each a ColumnPlan, none a constant
    distinct, counts    values of the column, and how often each occurs
    """
    parts = [plan.split(distinct) for plan in plans]
    ends = np.cumsum([int(classes.max()) + 1 for classes, *_ in parts]).tolist()
    starts = [0, *ends[:-1]]  # of their tables, one after the other
    places = np.concatenate([classes + start for (classes, *_), start in zip(parts, starts, strict=True)])
    occurs = np.bincount(places, np.tile(counts, len(plans))).astype(np.int64)
    codes = count_codes(occurs)
    stored = code_counts(codes)
    used = np.flatnonzero(occurs)
    lasts = np.searchsorted(used, ends).tolist()
    totals = [int(stored[start:end].sum()) for start, end in zip(starts, ends, strict=True)]
    symbols = occurs[used] * np.log2(np.repeat(totals, np.diff(lasts, prepend=0)) / stored[used])
    steps = np.diff(codes, prepend=0)
    steps[starts] = codes[starts]
    tables = step_bits(np.abs(steps))
    found, first = [], 0
    for plan, (_, _, extra), start, end, last in zip(plans, parts, starts, ends, lasts, strict=True):
        bits = float(symbols[first:last].sum()) + float(tables[start:end].sum())
        bits += 8.0 * len(plan.pack()) if plan.gaps else 0.0  # a dictionary's
        bits += float(counts.sum() * plan.parameter if extra is None else (counts * extra).sum())
        found.append((replace(plan, size=end - start), bits))
        first = last
    return found


def least_bits(counts: np.ndarray) -> float:
    """Bits of values that occur so often, by their own shares: no plan takes fewer, but for rounding."""
    return (1 - 1e-9) * float((counts * np.log2(counts.sum() / counts)).sum())


def histogram(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct values in ascending order and how often each occurs."""
    low, high = int(values.min()), int(values.max())
    if high - low < max(1 << 16, 4 * len(values)):  # counting beats sorting
        counts = np.bincount(values - low, minlength=1)
        present = np.flatnonzero(counts)
        return present + low, counts[present]
    return np.unique(values, return_counts=True)
