"""Entropy model `conditional-mixture`: rows of integers, each under a mixture of two Gaussians that a context predicts.

As `conditional-gaussian`, with a second mean and scale for every number and the logarithm of how much likelier the
first Gaussian is. Mode `exact` takes integers: each Gaussian selects a shipped count table, and a number is coded under
the sum of both tables with weights of 8 bits, so that a file decodes on any machine. Mode `float` takes floats, and
decodes only where they come out the same again. Source: specification of HAC++, exact decode of the mixture.

Layout of a block: u16 version of the tables, u32 CRC-32 of the table file, u32 CRC-32 of the coded integers as i32,
varint length and range-coded words, then the escapes as Exp-Golomb bits. No coded number, no bytes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import constriction
import numpy as np
import torch

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, exp_golomb
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.coders.symbol_stream import check_again, guarded
from sw_codecs.entropy.conditional import _array, _where
from sw_codecs.entropy.exact_tables import FRACTIONS, exact_tables
from sw_codecs.entropy.gaussian_exact import SYMBOL_LIMIT, IntegerContext, _flat_lattice
from sw_codecs.entropy.lattice import _tensor
from sw_codecs.entropy.rates import gaussian_mass
from sw_codecs.entropy.rows import Numbers, RowMixture
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

WIDTHS = np.array([4, 6, 8, 12, 16, 24, 32, 48, 64, 128, 256])
"""Half-widths of the windows that are coded without an escape."""
PAD = 2 * int(WIDTHS[-1]) + 1
FAR = 1 << 16
"""No table reaches as far from its middle."""
AT_ONCE = 1 << 18
"""Counts that are held together."""
WEIGHT_BITS = 8
FLOAT_TOTAL = 1 << 23


@dataclass(frozen=True)
class _Rows:
    """Mixtures of n coded numbers: centre int64 [n] and half-width [n] of their windows, and what makes their counts.

    counts  (rows, half-width W) -> float64 [rows, 2 W + 2], all positive: the window, then the escape
    order   [n] rows in the order of coding: by ascending width, those of one width in their order
    exact   what the compiled kernel takes of each number: shifts of the window [n,2] int32, tables [n,2] int16, weight
            of the first [n] int32; None: it has no such form
    """

    centre: np.ndarray
    width: np.ndarray
    counts: Callable[[np.ndarray, int], np.ndarray]
    order: np.ndarray
    exact: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def encode(self, entries: np.ndarray) -> bytes:
        """Range-coded words of entries [n]: 0 .. 2 W, or the escape."""
        kernel = self._kernel()
        if kernel is not None:
            words = exact_operations.encode_mixtures(*kernel, torch.from_numpy(entries.astype(np.int32)))
            return bytes(words.numpy().tobytes())
        coder = constriction.stream.queue.RangeEncoder()
        with guarded(ValueError, "entropy coding"):
            for rows, width in self._batches():
                coder.encode(entries[rows].astype(np.int32), _categorical(), self.counts(rows, width))
        return bytes(coder.get_compressed().astype("<u4", copy=False).tobytes())

    def decode(self, words: memoryview) -> np.ndarray:
        """Inverse of `encode`, int64 [n]. Raises BitstreamError for damage that is noticed."""
        kernel = self._kernel()
        if kernel is not None:
            data = torch.from_numpy(np.frombuffer(words, np.uint8).copy())
            entries, status = exact_operations.decode_mixtures(*kernel, data)
            if status:
                raise BitstreamError("coded words are damaged")
            return entries.numpy().astype(np.int64)
        found = np.empty(len(self.centre), np.int64)
        with guarded(BitstreamError, "entropy decoding"):
            coder = constriction.stream.queue.RangeDecoder(np.frombuffer(words, "<u4").astype(np.uint32, copy=False))
            for rows, width in self._batches():
                found[rows] = coder.decode(_categorical(), self.counts(rows, width))
        return found

    def bits(self, entries: np.ndarray) -> np.ndarray:
        """Bits of entries [n], float64."""
        found = np.empty(len(entries))
        for rows, width in self._batches():
            counts = self.counts(rows, width)
            found[rows] = np.log2(counts.sum(axis=1) / counts[np.arange(len(rows)), entries[rows]])
        return found

    def _kernel(self) -> tuple[list[torch.Tensor], list[torch.Tensor]] | None:
        """Arguments of the compiled kernel, if there is one."""
        if self.exact is None or not EXACT.try_load():
            return None
        rows = (self.order.astype(np.int32, copy=False), self.width.astype(np.int32, copy=False), *self.exact)
        return _summed_tables(), [torch.from_numpy(each) for each in rows]

    def _batches(self) -> Iterator[tuple[np.ndarray, int]]:
        """Rows of one width at a time, in the order of coding; so many that their counts stay within AT_ONCE."""
        for width in WIDTHS.tolist():
            rows = np.flatnonzero(self.width == width)
            size = max(1, AT_ONCE // (2 * width + 2))
            for start in range(0, len(rows), size):
                yield rows[start : start + size], width


class ConditionalMixture:
    """mode: "exact" or "float"; see the module. One object codes any number of blocks."""

    Context = RowMixture
    MODES = ("exact", "float")

    def __init__(self, mode: str = "exact") -> None:
        if mode not in self.MODES:
            raise ValueError(f"mode is '{mode}', must be one of {', '.join(self.MODES)}")
        self.mode = mode

    def encode(self, symbols: Numbers, context: RowMixture, present: Numbers | None = None) -> bytes:
        """Bytes of one block.

        symbols     [n,C] integers
        present     [n,C] bool: others are not coded; None: all are

        The words are decoded again and compared. Raises ValueError for parameters that are not finite or out of range.
        """
        values, where = _array(symbols), _where(present)
        coded = values[where].reshape(-1).astype(np.int64)
        if not len(coded):
            return b""
        if np.abs(coded).max() >= SYMBOL_LIMIT:
            raise ValueError("a symbol is beyond 2^30")
        mixtures = self._rows(context, where, values.shape)
        offsets, width = coded - mixtures.centre, mixtures.width
        outside = np.abs(offsets) > width
        entries = np.where(outside, 2 * width + 1, offsets + width)
        words = mixtures.encode(entries)
        with guarded(RuntimeError, "decoding what was encoded"):
            check_again(mixtures.decode(memoryview(words)), entries)
        escaped = mixtures.order[outside[mixtures.order]]
        tables = exact_tables()
        return b"".join([
            tables.version.to_bytes(2, "little"), tables.crc.to_bytes(4, "little"), _crc(coded).to_bytes(4, "little"),
            write_varint(len(words)), words,
            exp_golomb.encode(offsets[escaped] < 0, np.abs(offsets[escaped]) - width[escaped] - 1),
        ])  # fmt: skip

    def decode(self, data: bytes, context: RowMixture, present: Numbers | None = None) -> np.ndarray:
        """int64 [n,C], 0 where `present` is False. Raises BitstreamError."""
        shape, where = np.shape(_array(context.mean)), _where(present)
        found = np.zeros(shape, np.int64)
        try:
            mixtures = self._rows(context, where, shape)
        except ValueError as error:
            raise BitstreamError(str(error)) from error
        reader = ByteReader(data)
        if not len(mixtures.centre):
            reader.finish()
            return found
        exact_tables().check(reader.integer(2), reader.integer(4))
        crc = reader.integer(4)
        words = reader.take(reader.varint(reader.left))
        if len(words) % 4:
            raise BitstreamError(f"{len(words):,} coded bytes are not whole 32-bit words")
        coded = mixtures.decode(words)
        escaped = mixtures.order[(coded > 2 * mixtures.width)[mixtures.order]]
        coded -= mixtures.width
        negative, magnitudes = exp_golomb.decode(reader.take(reader.left), len(escaped))
        if len(escaped) and magnitudes.max() >= 2 * SYMBOL_LIMIT:
            raise BitstreamError("an escaped symbol is beyond 2^30")
        coded[escaped] = np.where(negative, -1, 1) * (magnitudes + mixtures.width[escaped] + 1)
        coded += mixtures.centre
        if np.abs(coded).max() >= SYMBOL_LIMIT:
            raise BitstreamError("a symbol is beyond 2^30: damaged data or a wrong context")
        if _crc(coded) != crc:
            raise BitstreamError("the decoded symbols do not match their CRC-32: damaged data or a wrong context")
        found[where] = coded if where is not Ellipsis else coded.reshape(shape)
        return found

    def bits(self, symbols: Numbers, context: RowMixture, present: Numbers | None = None) -> torch.Tensor:
        """Bits that `encode` spends on each symbol, float64 [n,C], 0 where `present` is False; no gradient."""
        values, where = _array(symbols), _where(present)
        coded = values[where].reshape(-1).astype(np.int64)
        mixtures = self._rows(context, where, values.shape)
        offsets = coded - mixtures.centre
        over = np.maximum(np.abs(offsets) - mixtures.width, 0)
        bits = mixtures.bits(np.where(over > 0, 2 * mixtures.width + 1, offsets + mixtures.width))
        bits += np.where(over > 0, 2 * (np.floor(np.log2(np.maximum(over, 1))) + 1), 0)
        found = np.zeros(values.shape)
        found[where] = bits if where is not Ellipsis else bits.reshape(values.shape)
        return torch.from_numpy(found)

    def _rows(self, context: RowMixture, where: Any, shape: tuple[int, ...]) -> _Rows:
        given = [
            _array(each)
            for each in (context.mean, context.scale, context.second_mean, context.second_scale, context.logit,
                         context.step)
        ]  # fmt: skip
        if self.mode == "exact" and where is Ellipsis and len(shape) == 2:
            found = _kernel_rows(given, shape)
            if found is not None:
                return found
        parts = [np.broadcast_to(each, shape)[where].reshape(-1) for each in given]
        return _exact_rows(*parts) if self.mode == "exact" else _float_rows(*parts)


@functools.cache
def _categorical() -> Any:
    """The library's model of integer counts, one table a symbol."""
    return constriction.stream.model.Categorical(perfect=False)


def _crc(symbols: np.ndarray) -> int:
    return checksum.crc32(np.ascontiguousarray(symbols, "<i4"))


def _widths(reach: np.ndarray) -> np.ndarray:
    """The smallest half-width that covers each reach, or the largest there is."""
    return WIDTHS[np.minimum(np.searchsorted(WIDTHS, reach), len(WIDTHS) - 1)]


def _by_width(width: np.ndarray) -> np.ndarray:
    return np.argsort(width.astype(np.uint16), kind="stable")


@functools.cache
def _padded_tables() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(counts of all tables with PAD zeros at each end, index of each table's middle, radius, escape count)."""
    family = exact_tables().gaussian
    radius = np.repeat(family.radius, FRACTIONS)
    zeros = np.zeros(PAD)
    flat = np.concatenate([part for counts in family.counts for part in (zeros, counts[:-1], zeros)])
    sizes = 2 * (radius + PAD) + 1
    escapes = np.array([counts[-1] for counts in family.counts])
    return flat, np.cumsum(sizes) - sizes + PAD + radius, radius, escapes


@functools.cache
def _summed_tables() -> list[torch.Tensor]:
    """The tables as the kernel takes them, see exact_kernels/mixtures.h."""
    family = exact_tables().gaussian
    sums = [np.concatenate([[0.0], np.cumsum(counts[:-1])]) for counts in family.counts]
    first = np.cumsum([0, *(len(each) for each in sums[:-1])])
    escapes = np.array([counts[-1] for counts in family.counts])
    radius = np.repeat(family.radius, FRACTIONS)
    arrays = (np.concatenate(sums), escapes.astype(np.float64), first.astype(np.int32), radius.astype(np.int32))
    return [torch.from_numpy(each) for each in arrays]


def _exact_rows(
    mean: np.ndarray, scale: np.ndarray, second_mean: np.ndarray, second_scale: np.ndarray, logit: np.ndarray,
    step: np.ndarray,
) -> _Rows:  # fmt: skip
    """Rules 3 to 5 of the exact mixture, integer arithmetic alone."""
    n = len(mean)
    if not np.issubdtype(logit.dtype, np.integer):
        raise ValueError(f"the logits must be integers, not {logit.dtype}")
    both = [_flat_lattice(IntegerContext(*each, step), n) for each in ((mean, scale), (second_mean, second_scale))]
    # sigmoid(d) = (1 + tanh(d / 2)) / 2: the table of step multipliers has it.
    j = np.clip(((logit.astype(np.int64) >> 1) + (1 << 15)) >> 9, 0, 127)
    top = 1 << WEIGHT_BITS
    weight = np.clip((exact_tables().multipliers[j] + 16) >> 5, 2, top - 2)
    centre = np.where(weight >= top // 2, both[0][0], both[1][0])
    reach, radius = np.zeros(n, np.int64), _padded_tables()[2]
    for middles, number in both:
        reach = np.maximum(reach, radius[number] + np.abs(middles - centre))
    shifts = np.stack([np.clip(centre - middles, -FAR, FAR) for middles, _ in both], axis=1).astype(np.int32)
    numbers = np.stack([number for _, number in both], axis=1).astype(np.int16)
    width = _widths(reach)
    return _with_counts(centre, width, _by_width(width), (shifts, numbers, weight.astype(np.int32)))


def _kernel_rows(parts: list[np.ndarray], shape: tuple[int, ...]) -> _Rows | None:
    """`_exact_rows` of parts as of RowMixture by the kernel; None: there is none, or it refuses them."""
    if not EXACT.try_load() or not shape[0] * shape[1]:
        return None
    if not all(np.issubdtype(each.dtype, np.integer) for each in parts):
        return None
    if [each.shape for each in parts] != [shape] * 5 + [(shape[0], 1)]:
        return None
    tables = exact_tables()
    *rows, status = exact_operations.mixture_rows(
        [_tensor(each) for each in parts], torch.from_numpy(tables.multipliers), torch.from_numpy(tables.thresholds),
        _summed_tables()[3], torch.from_numpy(WIDTHS),
    )  # fmt: skip
    if status:
        return None
    centre, width, order, shifts, numbers, weight = (each.numpy() for each in rows)
    return _with_counts(centre.astype(np.int64), width.astype(np.int64), order, (shifts, numbers, weight))


def _with_counts(
    centre: np.ndarray, width: np.ndarray, order: np.ndarray, exact: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> _Rows:
    def counts(rows: np.ndarray, width: int) -> np.ndarray:
        # A window of a table is copied whole, several times faster than number by number.
        flat, middle, radius, escapes = _padded_tables()
        windows = np.lib.stride_tricks.sliding_window_view(flat, 2 * width + 1)
        found = np.ones((len(rows), 2 * width + 2))
        first = exact[2][rows].astype(np.float64)
        for c, share in enumerate((first, (1 << WEIGHT_BITS) - first)):
            table = exact[1][rows, c]
            most = radius[table] + width + 1  # from there on the window lies outside of the table
            part = windows[middle[table] - width + np.clip(exact[0][rows, c], -most, most)]
            part *= share[:, None]
            found[:, :-1] += part
            found[:, -1] += share * escapes[table]
        return found

    return _Rows(centre, width, counts, order, exact)


def _float_rows(
    mean: np.ndarray, scale: np.ndarray, second_mean: np.ndarray, second_scale: np.ndarray, logit: np.ndarray,
    step: np.ndarray,
) -> _Rows:  # fmt: skip
    """Counts of 2^23 times the mixture's probabilities, in float64."""
    step = step.astype(np.float64)
    with np.errstate(all="ignore"):
        means = [each.astype(np.float64) / step for each in (mean, second_mean)]
        scales = [np.maximum(each.astype(np.float64) / step, 0.05) for each in (scale, second_scale)]
        share = 1 / (1 + np.exp(-logit.astype(np.float64)))
    if not all(np.isfinite(each).all() and np.abs(each).max(initial=0) < SYMBOL_LIMIT for each in (*means, *scales)):
        raise ValueError("a mean or a scale is not finite, or beyond 2^30 steps")
    if not np.isfinite(share).all():
        raise ValueError("a logit is not a number")
    heavy = np.where(share >= 0.5, means[0], means[1])
    centre = np.rint(heavy).astype(np.int64)
    reach = np.max([np.abs(m - centre) + 5 * s for m, s in zip(means, scales, strict=True)], axis=0)

    def counts(rows: np.ndarray, width: int) -> np.ndarray:
        x = torch.from_numpy((centre[rows][:, None] + np.arange(-width, width + 1)).astype(np.float64))
        mass = torch.zeros(1, dtype=torch.float64)
        for m, s, w in zip(means, scales, (share, 1 - share), strict=True):
            mu, sigma, part = (torch.from_numpy(each[rows])[:, None] for each in (m, s, w))
            mass = mass + part * gaussian_mass(x, mu, sigma)
        found = np.ones((len(rows), 2 * width + 2))
        found[:, :-1] += np.floor(mass.numpy() * FLOAT_TOTAL)
        return found

    width = _widths(reach)
    return _Rows(centre, width, counts, _by_width(width))
