"""Chapter 2: Building blocks."""

from __future__ import annotations

import bisect
import heapq
import struct
import zlib
from collections.abc import Sequence

import numpy as np

from bitstream_page.fields import Bytes, check, unzigzag

MASK = (1 << 64) - 1
Model = list[int]


def raw_bits(data: Bytes, count: int, width: int) -> list[int]:
    """`count` integers of `width` bits, from the least significant bit up."""
    stream = int.from_bytes(data.take((count * width + 7) // 8), "little")
    check(stream >> (count * width) == 0, "padding")
    return [(stream >> (i * width)) & ((1 << width) - 1) for i in range(count)]


def class_e(number: int, m: int) -> int:
    """How many low bits values of this class have left over."""
    # Classes from e * 2^m + 2^m to e * 2^m + 2 * 2^m - 1 belong to e, since z >> e has its top bit at 2^m.
    return max((number >> m) - 1, 0)


def class_smallest(number: int, m: int) -> int:
    e = class_e(number, m)
    return (number - (e << m)) << e


def cumulative(counts: Sequence[int]) -> Model:
    """c_0 ... c_K of a table of counts."""
    factor = float((1 << 24) - len(counts)) / float(sum(counts))
    found, below = [], 0
    for i, count in enumerate(counts):
        found.append(int(float(below) * factor) + i)
        below += int(count)
    return [*found, 1 << 24]


def bernoulli_model(p: float) -> Model:
    return [0, int((1.0 - p) * ((1 << 24) - 2)) + 1, 1 << 24]


class RangeWords:
    def __init__(self, data: bytes) -> None:
        self.words = iter(struct.unpack(f"<{len(data) // 4}I", data))
        self.low, self.range = 0, MASK
        self.point = (next(self.words, 0) << 32) + next(self.words, 0)

    def symbol(self, model: Model) -> int:
        scale = self.range >> 24
        q = ((self.point - self.low) & MASK) // scale
        check(q < 1 << 24, "damaged words")
        s = bisect.bisect_right(model, q) - 1
        self.low = (self.low + scale * model[s]) & MASK
        self.range = scale * (model[s + 1] - model[s])
        if self.range < 1 << 32:
            self.low = (self.low << 32) & MASK
            self.range <<= 32
            self.point = ((self.point << 32) & MASK) + next(self.words, 0)
        return s


class RansWords:
    def __init__(self, data: bytes) -> None:
        self.words = list(struct.unpack(f"<{len(data) // 4}I", data))
        self.state = 0
        while self.state < 1 << 32 and self.words:
            self.state = (self.state << 32) + self.words.pop()

    def symbol(self, model: Model) -> int:
        q = self.state % (1 << 24)
        s = bisect.bisect_right(model, q) - 1
        self.state = (self.state >> 24) * (model[s + 1] - model[s]) + q - model[s]
        if self.state < 1 << 32 and self.words:
            self.state = (self.state << 32) + self.words.pop()
        return s


def symbols_of(words: RangeWords | RansWords, counts: Sequence[int], n: int) -> list[int]:
    """n symbols of one table of counts."""
    positive = [s for s, count in enumerate(counts) if count > 0]
    check(len(positive) > 0 or n == 0, "empty table")
    if len(counts) == 1 or len(positive) == 1:
        return positive * n
    model = cumulative(counts) if n else []
    return [words.symbol(model) for _ in range(n)]


def symbols_by_table(
    words: RangeWords | RansWords, tables: Sequence[Sequence[int]], numbers: Sequence[int]
) -> list[int]:
    """A symbol for each entry of `numbers`, coded table by table."""
    found = [0] * len(numbers)
    for table in sorted(set(numbers)):
        rows = [i for i, number in enumerate(numbers) if number == table]
        for i, symbol in zip(rows, symbols_of(words, tables[table], len(rows)), strict=True):
            found[i] = symbol
    return found


def huffman_codes(counts: Sequence[int]) -> dict[str, int]:
    """Symbol of each code."""
    queue = [(np.float32(count), s) for s, count in enumerate(counts)]
    codes = {s: [(s, "")] for s in range(len(counts))}
    heapq.heapify(queue)
    number = len(counts)
    while len(queue) > 1:
        (zero, a), (one, b) = heapq.heappop(queue), heapq.heappop(queue)
        codes[number] = [(s, bit + code) for bit, node in (("0", a), ("1", b)) for s, code in codes.pop(node)]
        heapq.heappush(queue, (zero + one, number))
        number += 1
    return {code: s for s, code in codes[number - 1]}


def crc_i32(symbols: Sequence[int]) -> int:
    return zlib.crc32(np.array(symbols, "<i4").tobytes())


def crc_i64(values: Sequence[int]) -> int:
    return zlib.crc32(np.array(values, "<i8").tobytes())


def stored_tables(data: Bytes, lengths: Sequence[int]) -> list[list[int]]:
    if sum(lengths) == 0:
        return [[] for _ in lengths]
    head = data.varint()
    if head % 2 == 0:
        meta = list(data.take(head // 2))
    else:
        meta = []
        for _ in range(head // 2):
            skipped = data.varint()
            meta += [0] * skipped + [data.take(1)[0]]
    words = RangeWords(data.take(data.varint()))
    symbols = symbols_of(words, [class_smallest(code, 3) for code in meta], sum(lengths))
    check(crc_i32(symbols) == data.one("I"), "CRC of the tables")
    tables, at = [], 0
    for length in lengths:
        code, table = 0, []
        for symbol in symbols[at : at + length]:
            code += unzigzag(symbol)
            table.append(class_smallest(code, 3))
        tables.append(table)
        at += length
    return tables
