"""Symbols under the shipped count tables in independent streams of 2^16, which any number of cores decodes at once.

Version 2 of what the exact mode writes:

    u16 version: 2, u32 CRC-32 of the table file
    for each stream: u32 CRC-32 of its symbols as i32, varint bytes of rANS words, varint bytes of escapes
    for each stream: its words, its escapes as Exp-Golomb bits

Within a stream symbols are coded table by table in ascending number, escapes likewise. A compiled kernel does it where
there is one; else the library `constriction`, to the same bytes.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import constriction
import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, exp_golomb
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.coders.symbol_stream import check_again, guarded
from sw_codecs.entropy.exact_tables import FRACTIONS, Family, exact_tables
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

VERSION = 2
STREAM = 1 << 16
SYMBOL_LIMIT = 1 << 30
STREAM_BYTES = 6
"""Fewest bytes of a stream in the table of streams."""
DAMAGE = {
    1: "coded words are damaged, too few or too many",
    2: "an escape code is damaged, or their number is not that of the escaped symbols",
    3: "a symbol is too large",
}
"""Status of the kernels -> what is wrong."""
CRC_DIFFERS = "the decoded symbols do not match their CRC-32: damaged data or a wrong context"


def share_tables(family: str) -> list[Tensor]:
    """Tables of a family as the kernels take them: shares, first, radius (int32) and bucket (int16, see kernels.h)."""
    return _share_tables(family)[0]


@functools.cache
def _share_tables(family: str) -> tuple[list[Tensor], list[np.ndarray]]:
    """The tensors, and the shares of each table int32 [K + 1]."""
    found: Family = getattr(exact_tables(), family)
    shares = []
    for counts in found.counts:
        before = np.concatenate([[0.0], np.cumsum(counts)])
        # docs/bitstream.md, tables of counts as models: one rounding of the division, one of each product.
        low = np.floor(before * ((float(1 << 24) - len(counts)) / before[-1])).astype(np.int64)
        low[:-1] += np.arange(len(counts))
        low[-1] = 1 << 24
        shares.append(low.astype(np.int32))
    first = np.cumsum([0, *(len(each) for each in shares[:-1])]).astype(np.int32)
    radius = np.repeat(found.radius, FRACTIONS).astype(np.int32)
    starts = np.arange(256, dtype=np.int64) << 16
    bucket = np.stack([np.searchsorted(each, starts, side="right") - 1 for each in shares]).astype(np.int16)
    arrays = [np.concatenate(shares), first, radius, bucket]
    return [torch.from_numpy(np.ascontiguousarray(each)) for each in arrays], shares


@functools.cache
def coding_model(family: str, table: int) -> Any:
    """The library's model of a table; building one takes as long as coding a few hundred symbols."""
    tables: Family = getattr(exact_tables(), family)
    return constriction.stream.model.Categorical(tables.counts[table], perfect=False)


def prefix() -> bytes:
    """Version, and CRC-32 of the table file."""
    return VERSION.to_bytes(2, "little") + exact_tables().crc.to_bytes(4, "little")


def encode(family: str, symbols: np.ndarray, centre: np.ndarray, number: np.ndarray) -> bytes:
    """Bytes of symbols int [n], |s| < 2^30, for integer parts of means [n] and table numbers [n].

    What was written is decoded again and compared.
    """
    symbols = np.ascontiguousarray(symbols, np.int32)
    if not len(symbols):
        return prefix()
    if not EXACT.try_load():
        content, rows = _encoded_in_turn(family, symbols, centre, number)
        with guarded(RuntimeError, "decoding what was encoded"):
            check_again(_decoded_in_turn(family, memoryview(content), rows, centre, number), symbols)
        return _framed(content, rows, symbols)
    at = _tensors(centre, number)
    data, sizes = exact_operations.encode_streams(share_tables(family), torch.from_numpy(symbols), at[0], at[1])
    again, status = exact_operations.decode_streams(share_tables(family), data, sizes, *at)
    check_again(None if status else again.numpy(), symbols)
    return _framed(data.numpy().tobytes(), sizes.numpy(), symbols)


def decode(family: str, data: bytes | memoryview, centre: np.ndarray, number: np.ndarray) -> np.ndarray:
    """int32 [n]: inverse of `encode`, from version and CRC-32 on. Raises BitstreamError."""
    reader = ByteReader(data)
    check_version(reader.integer(2), reader.integer(4))
    count = -(-len(centre) // STREAM)
    sizes = read_sizes(reader, count, crc=True)
    content = reader.take(reader.left)
    if not count:
        return np.empty(0, np.int32)
    if EXACT.try_load():
        payload = torch.from_numpy(np.frombuffer(content, np.uint8).copy())
        at = _tensors(centre, number)
        symbols, status = exact_operations.decode_streams(share_tables(family), payload, torch.from_numpy(sizes), *at)
        refuse_damage(status)
        found: np.ndarray = symbols.numpy()
    else:
        found = _decoded_in_turn(family, content, sizes, centre, number)
    if _checksums(found) != sizes[:, 0].tolist():
        raise BitstreamError(CRC_DIFFERS)
    return found


def check_version(version: int, crc: int) -> None:
    """Raise BitstreamError unless streams of this version and these tables can be read."""
    tables = exact_tables()
    tables.check(tables.version if version == VERSION else version, crc)


def read_sizes(reader: ByteReader, count: int, *, crc: bool) -> np.ndarray:
    """The table of `count` streams, int64 [count, 3]: CRC-32 (0 without `crc`), bytes of words, bytes of escapes.

    Raises BitstreamError unless their bytes are exactly those that follow, before anything is allocated for them.
    """
    if count * (STREAM_BYTES if crc else 2) > reader.left:
        raise BitstreamError(f"{reader.left:,} bytes cannot hold {count:,} streams: the data is truncated")
    sizes = np.zeros((count, 3), np.int64)
    for row in sizes:
        row[0] = reader.integer(4) if crc else 0
        row[1:] = reader.varint(reader.left), reader.varint(reader.left)
    total = int(sizes[:, 1:].sum())
    if total != reader.left or (sizes[:, 1] % 4).any():
        raise BitstreamError(f"the streams are said to have {total:,} bytes in whole words, {reader.left:,} are there")
    return sizes


def write_sizes(sizes: np.ndarray, *, crc: bool) -> bytes:
    """Bytes of the sizes, as `read_sizes` takes them."""
    rows = sizes.tolist()
    return b"".join(
        (row[0].to_bytes(4, "little") if crc else b"") + write_varint(row[1]) + write_varint(row[2]) for row in rows
    )


def refuse_damage(status: int) -> None:
    """Raise BitstreamError for a status of a kernel that is not 0."""
    if status:
        raise BitstreamError(f"{DAMAGE[status]}: damaged data or a wrong context")


def _checksums(symbols: np.ndarray) -> list[int]:
    """CRC-32 of each stream: here and not in the kernel, where a library takes a tenth of the time."""
    coded = np.ascontiguousarray(symbols, "<i4")
    return [checksum.crc32(coded[start : start + STREAM]) for start in range(0, len(coded), STREAM)]


def _framed(content: bytes, sizes: np.ndarray, symbols: np.ndarray) -> bytes:
    sizes[:, 0] = _checksums(symbols)
    return prefix() + write_sizes(sizes, crc=True) + content


def _tensors(centre: np.ndarray, number: np.ndarray) -> tuple[Tensor, Tensor]:
    return (
        torch.from_numpy(np.ascontiguousarray(centre, np.int32)),
        torch.from_numpy(np.ascontiguousarray(number, np.int16)),
    )


def table_bits(family: str, symbols: np.ndarray, centre: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Bits that `encode` spends on each symbol, float64 [n]; framing is not counted."""
    tables: Family = getattr(exact_tables(), family)
    offsets, found = symbols.astype(np.int64) - centre, np.empty(len(symbols))
    for table, rows in groups(number):
        counts, radius = tables.counts[table], int(tables.radius[table // FRACTIONS])
        entry, outside, escaped = entries(offsets[rows], radius)
        found[rows] = np.log2(counts.sum() / counts[entry])
        found[rows[outside]] += 2 * (np.floor(np.log2(np.abs(escaped) - radius)) + 1)
    return found


# Without a compiler


def groups(number: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Each table number that occurs, ascending, with the rows that use it in their order."""
    order = np.argsort(number.astype(np.uint16), kind="stable")  # radix sort
    ends = np.cumsum(np.bincount(number, minlength=1))
    starts = np.concatenate([[0], ends[:-1]])
    return [(int(t), order[starts[t] : ends[t]]) for t in np.flatnonzero(ends > starts)]


def entries(offsets: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Table entries int64, which of them are escapes, and the offsets of those."""
    outside = np.abs(offsets) > radius
    return np.where(outside, 2 * radius + 1, offsets + radius), outside, offsets[outside]


def _encoded_in_turn(
    family: str, symbols: np.ndarray, centre: np.ndarray, number: np.ndarray
) -> tuple[bytes, np.ndarray]:
    """Content and table of streams."""
    parts, rows = [], []
    radii = getattr(exact_tables(), family).radius
    for start in range(0, len(symbols), STREAM):
        part = slice(start, start + STREAM)
        offsets = symbols[part].astype(np.int64) - centre[part]
        coder, puts = constriction.stream.stack.AnsCoder(), []
        signs, magnitudes = [np.empty(0, bool)], [np.empty(0, np.int64)]
        for table, at in groups(number[part]):
            radius = int(radii[table // FRACTIONS])
            entry, _, escaped = entries(offsets[at], radius)
            puts.append((entry.astype(np.int32), coding_model(family, table)))
            signs.append(escaped < 0)
            magnitudes.append(np.abs(escaped) - radius - 1)
        with guarded(ValueError, "entropy coding"):
            for entry, model in reversed(puts):
                coder.encode_reverse(entry, model)
            words = coder.get_compressed().astype("<u4").tobytes()
        escapes = exp_golomb.encode(np.concatenate(signs), np.concatenate(magnitudes))
        parts += [words, escapes]
        rows.append([0, len(words), len(escapes)])
    return b"".join(parts), np.array(rows, np.int64)


def _decoded_in_turn(
    family: str, content: memoryview, sizes: np.ndarray, centre: np.ndarray, number: np.ndarray
) -> np.ndarray:
    reader, found = ByteReader(content), np.empty(len(centre), np.int32)
    radii = getattr(exact_tables(), family).radius
    for stream, (_, words, escapes) in enumerate(sizes.tolist()):
        part = slice(stream * STREAM, (stream + 1) * STREAM)
        symbols = _decoded_stream(family, reader.take(words), reader.take(escapes), number[part], radii)
        symbols += centre[part]
        if np.abs(symbols).max(initial=0) >= SYMBOL_LIMIT:
            refuse_damage(3)
        found[part] = symbols
    return found


def _decoded_stream(
    family: str, words: memoryview, escapes: memoryview, number: np.ndarray, radii: Sequence[int]
) -> np.ndarray:
    """Offsets int64 of one stream."""
    offsets, where, floors = np.empty(len(number), np.int64), [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    with guarded(BitstreamError, "entropy decoding"):
        coder = constriction.stream.stack.AnsCoder(np.frombuffer(words, "<u4").astype(np.uint32))
        for table, rows in groups(number):
            radius = int(radii[table // FRACTIONS])
            entry = np.asarray(coder.decode(coding_model(family, table), len(rows)), np.int64)
            offsets[rows] = entry - radius
            escaped = rows[entry > 2 * radius]
            where.append(escaped)
            floors.append(np.full(len(escaped), radius + 1))
        if not coder.is_empty():
            refuse_damage(1)
    at, floor = np.concatenate(where), np.concatenate(floors)
    negative, magnitude = exp_golomb.decode(escapes, len(at))
    if magnitude.max(initial=0) >= 2 * SYMBOL_LIMIT:
        refuse_damage(3)
    offsets[at] = np.where(negative, -1, 1) * (magnitude + floor)
    return offsets
