"""Entropy model `gaussian-exact`: integer parameters, shipped count tables, any machine.

Mean and scale reach the coder as integers with 12 fractional bits (from an integer network, see `integer_mlp`), are
put on a lattice with integer arithmetic alone, and select one of 512 shipped tables. Symbols are coded table by table,
which is also several times faster than a model per symbol. Source: specification of the codec library, exact mode,
rules 3 to 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, exp_golomb
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.coders.arithmetic import CHUNK, HEADER
from sw_codecs.coders.model_spec import as_symbols
from sw_codecs.coders.symbol_stream import SymbolReader, SymbolWriter
from sw_codecs.entropy.exact_tables import FRACTIONS, Family, exact_tables
from sw_codecs.entropy.rates import CODER_FLOOR, gaussian_bits

UNIT = 4096  # 12 fractional bits
SYMBOL_LIMIT = 1 << 30
PARAMETER_LIMIT = 1 << 48  # shifts and products below stay within 63 bits


@dataclass(frozen=True)
class FloatContext:
    """Context of `bits`: mean, scale, step as float tensors that broadcast with the values, in the same unit.

    smallest_probability    floor of the probability of a value; the default is the coder's, HAC trains with 1e-6
    grad_below_bound        whether what lies below the floor is still pulled (`sw_codecs.entropy.rates.lower_bound`)
    """

    mean: Tensor | float
    scale: Tensor | float
    step: Tensor | float = 1.0
    smallest_probability: float = CODER_FLOOR
    grad_below_bound: bool = True

    @property
    def bound(self) -> dict[str, Any]:
        return {"p_min": self.smallest_probability, "grad_below_bound": self.grad_below_bound}


@dataclass(frozen=True)
class IntegerContext:
    """Context of `encode` and `decode`: integers [n] in units of the base step with 12 fractional bits.

    mean, scale     int64 [n], |value| < 2^48; a scale below the smallest level (0.05 steps) counts as that level
    multiplier      64..16384 [n] or one number: the step is base step * multiplier / 4096 (`step_multipliers`)

    They must be computed exactly, or the decoder falls out of step: floats rounded to integers are not exact.
    """

    mean: np.ndarray
    scale: np.ndarray
    multiplier: np.ndarray | int = UNIT


def step_multipliers(outputs: np.ndarray) -> np.ndarray:
    """Step multipliers 64..8192 (int64) for network outputs t with 12 fractional bits: round(4096 (1 + tanh t)).

    Raises ValueError for floats: they would be cut off, and are not exact.
    """
    if not np.issubdtype(np.asarray(outputs).dtype, np.integer):
        raise ValueError(f"step outputs must be integers, not {np.asarray(outputs).dtype}")
    j = np.clip((np.asarray(outputs, np.int64) + (1 << 15)) >> 9, 0, 127)
    return exact_tables().multipliers[j]


Floats = FloatContext
Integers = IntegerContext


class GaussianExact:
    """Codes integer symbols [n], |k| < 2^30, in units of the step: a Gaussian with mean and standard deviation each.

    What a caller builds is reached through the class, so that whoever got it from the registry needs no import:
    `model.FloatContext(...)`, `model.IntegerContext(...)`, `model.step_multipliers(outputs)`.
    """

    FloatContext = Floats
    IntegerContext = Integers
    step_multipliers = staticmethod(step_multipliers)

    def bits(self, symbols: Tensor, context: Floats) -> Tensor:
        """Bits of each value (its unit is the context's; rounded or with noise added); differentiable."""
        return gaussian_bits(symbols, context.mean, context.scale, context.step, **context.bound)

    def table_bits(self, symbols: np.ndarray, context: Integers) -> np.ndarray:
        """Bits that `encode` spends on each symbol, float64 [n], from the very tables it uses; no gradient."""
        tables = exact_tables().gaussian
        symbols = _check_symbols(symbols)
        centre, number = _lattice(context, len(symbols))
        found = np.empty(len(symbols))
        for table, rows in _groups(number):
            counts, radius = np.asarray(tables.tables[table].counts), int(tables.radius[table // FRACTIONS])
            entry, outside, _ = _entries(symbols[rows] - centre[rows], radius)
            found[rows] = np.log2(counts.sum() / counts[entry])
            over = np.abs(symbols[rows] - centre[rows])[outside] - radius  # magnitude + 1 of the escape code
            found[rows[outside]] += 2 * (np.floor(np.log2(over)) + 1)
        return found

    def encode(self, symbols: np.ndarray, context: Integers) -> bytes:
        """u16 table version, u32 table CRC-32, then chunks; each is decoded again and compared.

        Raises ValueError for symbols or parameters out of range.
        """
        symbols = _check_symbols(symbols)
        centre, number = _lattice(context, len(symbols))
        tables = exact_tables()
        family = tables.gaussian
        parts = [tables.version.to_bytes(2, "little") + tables.crc.to_bytes(4, "little")]
        for start in range(0, len(symbols), CHUNK):
            part = slice(start, start + CHUNK)
            chunk = np.ascontiguousarray(symbols[part], "<i4")
            payload = _encode_chunk(symbols[part] - centre[part], number[part], family)
            if not np.array_equal(_decode_chunk(payload, number[part], family) + centre[part], symbols[part]):
                raise RuntimeError("a chunk does not decode to what was encoded; please report this")
            parts.append(HEADER.pack(len(chunk), chunk.min(), chunk.max(), len(payload), checksum.crc32(chunk)))
            parts.append(payload)
        return b"".join(parts)

    def decode(self, data: bytes, context: Integers) -> np.ndarray:
        """int32 [n], n as in the context. Raises BitstreamError for damage, a wrong context or other tables."""
        try:
            centre, number = _lattice(context, len(np.asarray(context.mean)))
        except ValueError as error:
            raise BitstreamError(str(error)) from error
        tables, reader = exact_tables(), ByteReader(data)
        tables.check(reader.integer(2), reader.integer(4))
        found = np.empty(len(centre), np.int32)
        for start in range(0, len(found), CHUNK):
            part = slice(start, start + CHUNK)
            count, kmin, kmax, length, crc = HEADER.unpack(reader.take(HEADER.size))
            if count != len(found[part]):
                raise BitstreamError(f"a chunk has {count:,} symbols, expected {len(found[part]):,}")
            chunk = _decode_chunk(reader.take(length), number[part], tables.gaussian) + centre[part]
            if chunk.min() != kmin or chunk.max() != kmax or checksum.crc32(chunk.astype("<i4")) != crc:
                raise BitstreamError("the decoded symbols do not match their CRC-32: damaged data or a wrong context")
            found[part] = chunk
        reader.finish()
        return found


def _check_symbols(symbols: Any) -> np.ndarray:
    symbols = as_symbols(symbols)
    if symbols.size and (symbols.min() <= -SYMBOL_LIMIT or symbols.max() >= SYMBOL_LIMIT):
        raise ValueError("a symbol is beyond 2^30")
    return symbols.astype(np.int64)


def _lattice(context: IntegerContext, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of each mean int64 [n] (in steps), and table numbers uint16 [n]; integer arithmetic alone."""
    mean, scale, multiplier = (np.asarray(each) for each in (context.mean, context.scale, context.multiplier))
    for name, array in (("mean", mean), ("scale", scale), ("multiplier", multiplier)):
        if not np.issubdtype(array.dtype, np.integer) or array.shape not in ((n,), ()):
            raise ValueError(f"{name} must be {n} integers, not {array.dtype} of shape {list(array.shape)}")
        if array.size and (array.min() <= -PARAMETER_LIMIT or array.max() >= PARAMETER_LIMIT):
            raise ValueError(f"{name} is beyond 2^48")
    if multiplier.size and (multiplier.min() < 64 or multiplier.max() > 4 * UNIT):
        raise ValueError("multiplier leaves 64..16384")
    mean, scale, m = (each.astype(np.int64) for each in np.broadcast_arrays(mean, scale, multiplier))
    eighths = (8 * mean + m // 2) // m
    centre = (eighths + 4) // 8
    if centre.size and (centre.min() <= -SYMBOL_LIMIT or centre.max() >= SYMBOL_LIMIT):
        raise ValueError("a mean is beyond 2^30 steps")
    level = np.searchsorted(exact_tables().thresholds, (np.maximum(scale, 0) << 12) // m, side="left")
    return centre, (level * FRACTIONS + (eighths + 4 - 8 * centre)).astype(np.uint16)


def _groups(number: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Each table number that occurs, ascending, with the rows that use it in their order."""
    order = np.argsort(number, kind="stable")  # radix sort on uint16
    ends = np.cumsum(np.bincount(number, minlength=1))
    starts = np.concatenate([[0], ends[:-1]])
    return [(int(t), order[starts[t] : ends[t]]) for t in np.flatnonzero(ends > starts)]


def _entries(offsets: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Table entries int64, which of them are escapes, and the offsets of those."""
    outside = np.abs(offsets) > radius
    return np.where(outside, 2 * radius + 1, offsets + radius), outside, offsets[outside]


def _encode_chunk(offsets: np.ndarray, number: np.ndarray, family: Family) -> bytes:
    """varint length, range-coded words, then the escapes as Exp-Golomb bits, both in the order of the tables."""
    writer, signs, magnitudes = SymbolWriter(), [np.empty(0, bool)], [np.empty(0, np.int64)]
    for table, rows in _groups(number):
        radius = int(family.radius[table // FRACTIONS])
        entry, _, escaped = _entries(offsets[rows], radius)
        writer.put_checked(entry.astype(np.int32), family.tables[table])
        signs.append(escaped < 0)
        magnitudes.append(np.abs(escaped) - radius - 1)
    words = writer.finish()
    return write_varint(len(words)) + words + exp_golomb.encode(np.concatenate(signs), np.concatenate(magnitudes))


def _decode_chunk(payload: bytes | memoryview, number: np.ndarray, family: Family) -> np.ndarray:
    """Offsets from the integer part of the mean, int64 [n]."""
    reader = ByteReader(payload)
    coded = SymbolReader(reader.take(reader.varint(reader.left)))
    offsets, escapes, floors = np.empty(len(number), np.int64), [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for table, rows in _groups(number):
        radius = int(family.radius[table // FRACTIONS])
        entry = coded.get_unchecked(len(rows), family.tables[table]).astype(np.int64)
        offsets[rows] = entry - radius
        escaped = rows[entry == 2 * radius + 1]
        escapes.append(escaped)
        floors.append(np.full(len(escaped), radius + 1))
    where, floor = np.concatenate(escapes), np.concatenate(floors)
    negative, magnitude = exp_golomb.decode(reader.take(reader.left), len(where))
    if len(where) and (magnitude.max() >= 2 * SYMBOL_LIMIT):
        raise BitstreamError("an escaped symbol is beyond 2^30")
    offsets[where] = np.where(negative, -1, 1) * (magnitude + floor)
    return offsets
