"""Ties: what the numbers of a block that are known say of those behind them.

A block is predicted at once and coded part by part (`numbers.PARTS`). Where luma is off from its mean, chroma is too,
and a splat whose first latents are far from their means has all of them far. So a part's means move by a linear
function of the residuals before it in the block, and its scale levels by one of their sizes: |k| over the deviation of
its table, at most 4.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_codecs.entropy.exact_tables import exact_tables
from sw_wisp.eight_bits import EXACT_EXPONENT, HIGHEST_EXPONENT, LARGEST_WEIGHT, EightBitLayer
from sw_wisp.fast.ties import moved as fast_moved
from sw_wisp.nested import UNIT, table_levels
from sw_wisp.numbers import BLOCKS, PARTS
from sw_wisp.packets import VALUE_LIMIT, State, even

LARGEST_SIZE = 4
ROUNDING = 1 / 12
"""Variance, in squared steps, that rounding adds to a number."""


def tied_parts() -> list[tuple[slice, slice]]:
    """Parts that follow others in their block, each with the columns before it there."""
    return [
        (part, slice(block.start, part.start)) for block, parts in zip(BLOCKS, PARTS, strict=True) for part in parts[1:]
    ]


def tie_shapes() -> list[tuple[int, int]]:
    """Outputs and inputs of each tie: what is added to the means of a part, then to its scale levels."""
    return [(2 * (part.stop - part.start), before.stop - before.start) for part, before in tied_parts()]


def moved(tie: EightBitLayer, before: slice, rows: np.ndarray, state: State) -> np.ndarray:
    """Additions to the means, then the scale levels, of a part of splats `rows`, int64 [2,n,c], 12 fractional bits.

    before  columns in its block that are known
    """
    at = even(rows)
    found = fast_moved(tie, before, at, (state.index, state.scale, state.multiplier), sizes_of_a_step())
    if found is not None:
        return found
    index = state.index[at, before].astype(np.int64)
    residuals = np.clip(index * state.multiplier[at, before], -VALUE_LIMIT, VALUE_LIMIT)
    tables = table_levels(state.scale[at, before])
    sizes = np.minimum(np.abs(index) * sizes_of_a_step()[tables], LARGEST_SIZE * UNIT)
    weights = np.ldexp(tie.weights.astype(np.float64), tie.exponents[:, None].astype(np.int64))
    half = len(weights) // 2
    parts = (residuals @ weights[:half].T, sizes @ weights[half:].T)  # multiples of 2^-12 below 2^53: exact
    return np.floor(np.stack(parts)).astype(np.int64)


def pack_ties(ties: Sequence[EightBitLayer]) -> bytes:
    """Of each tie the exponents of its rows and its weights, plain: tables would be longer than what they save."""
    return b"".join(tie.exponents.tobytes() + tie.weights.tobytes() for tie in ties)


def unpack_ties(reader: ByteReader) -> tuple[EightBitLayer, ...]:
    """Inverse of `pack_ties`. Raises BitstreamError."""
    found = []
    for rows, columns in tie_shapes():
        exponents = np.frombuffer(reader.take(rows), np.int8)
        weights = np.frombuffer(reader.take(rows * columns), np.int8).reshape(rows, columns)
        if exponents.min() < EXACT_EXPONENT or exponents.max() > HIGHEST_EXPONENT:
            raise BitstreamError("an exponent of a tie is out of range")
        if (weights == -LARGEST_WEIGHT - 1).any():
            raise BitstreamError("a weight of a tie is out of range")
        found.append(EightBitLayer(weights, exponents, np.zeros(0, np.int16), 0))
    return tuple(found)


@functools.cache
def sizes_of_a_step() -> np.ndarray:
    """Steps int64 [64] over the deviation of each table, 12 fractional bits."""
    return np.rint(UNIT / np.sqrt(exact_tables().scales ** 2 + ROUNDING)).astype(np.int64)
