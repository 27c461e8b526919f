"""A decoder for .swz files that was written from docs/bitstream.md and nothing else.

It shares no code with the packages (a test looks), uses Python and numpy, and cares for clarity alone: if it and the
packages disagree, either the page or the packages are wrong. It trusts its input, beyond the checksums.
"""

from __future__ import annotations

import bisect
import heapq
import itertools
import json
import math
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

MASK = (1 << 64) - 1


class PageError(Exception):
    """The file is not what the page describes."""


def check(claim: bool, what: str) -> None:
    if not claim:
        raise PageError(what)


class Bytes:
    """Takes fields off the front."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = bytes(data), 0

    def take(self, count: int) -> bytes:
        check(self.at + count <= len(self.data), "too short")
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, form: str) -> tuple[Any, ...]:
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def one(self, form: str) -> int:
        (value,) = self.unpack(form)
        return int(value)

    def varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    def signed(self) -> int:
        return unzigzag(self.varint())

    def rest(self) -> bytes:
        return self.take(len(self.data) - self.at)

    def bits(self) -> Iterator[str]:
        """The rest, each byte from its least significant bit."""
        return iter(f"{byte >> i & 1}" for byte in self.rest() for i in range(8))

    def done(self) -> None:
        check(self.at == len(self.data), "bytes are left")


# 1 Container


def container(data: bytes) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The header and the sections."""
    file = Bytes(data)
    check(file.take(4) == b"SPWZ" and file.one("H") == 1, "not version 1 of .swz")
    raw = file.take(file.one("I"))
    check(zlib.crc32(raw) == file.one("I"), "header CRC")
    header = json.loads(raw)
    check(
        set(header) | {"requires"} == {"method", "method_version", "requires", "raster", "static", "sections"}, "keys"
    )
    sections, expected = {}, 0
    for name, offset, length, crc in header["sections"]:
        check(offset == expected, "offset")
        sections[name] = file.take(length)
        check(zlib.crc32(sections[name]) == crc, f"CRC of {name}")
        expected += length
    file.done()
    return header, sections


DTYPES = dict(enumerate(["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8", "b1"], 1))


def array(section: bytes) -> np.ndarray:
    data = Bytes(section)
    dtype, axes = data.unpack("BB")
    shape = data.unpack("I" * axes)
    return np.frombuffer(data.rest(), "<" + DTYPES[dtype]).reshape(shape)


# 2 Building blocks


def unzigzag(code: int) -> int:
    return code // 2 if code % 2 == 0 else -(code + 1) // 2


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


Model = list[int]


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


# 3 Entropy coders


def coder_chunks(data: bytes, n: int, payload: Callable[[bytes, int, int, int, int], list[int]]) -> list[int]:
    """All symbols; `payload(bytes, first symbol, count, kmin, kmax)` decodes that of one chunk."""
    file, found = Bytes(data), []
    while len(found) < n:
        count, kmin, kmax, length, crc = file.unpack("IiiII")
        check(count == min(1 << 20, n - len(found)), "chunk size")
        content = file.take(length)
        chunk = [kmin] * count if kmin == kmax else payload(content, len(found), count, kmin, kmax)
        check(crc_i32(chunk) == crc and min(chunk) == kmin and max(chunk) == kmax, "CRC of a chunk")
        found += chunk
    file.done()
    return found


def coder_symbols(coder: str, data: bytes, tables: Sequence[Sequence[int]], numbers: Sequence[int]) -> list[int]:
    """What `range`, `rans` or `huffman` wrote, given the table of each symbol."""

    def payload(content: bytes, first: int, count: int, kmin: int, kmax: int) -> list[int]:
        part = numbers[first : first + count]
        if coder != "huffman":
            words = RangeWords(content) if coder == "range" else RansWords(content)
            return symbols_by_table(words, tables, part)
        trees = [huffman_codes(table) for table in tables]
        bits = iter(f"{word >> i & 1}" for word in struct.unpack(f"<{len(content) // 4}I", content) for i in range(32))
        found = []
        for number in part:
            code = ""
            while code not in trees[number]:
                code += next(bits)
            found.append(trees[number][code])
        return found

    return coder_chunks(data, len(numbers), payload)


# 4 Entropy models


def columns(data: bytes, rows: int, width: int) -> list[list[int]]:
    """The columns of the matrix."""
    file = Bytes(data)
    check(file.unpack("BIH") == (1, rows, width), "head of columns")
    crc = file.one("I")
    plans = []
    for _ in range(width):
        scheme, p = file.unpack("BB")
        offset, length = file.signed(), file.varint()
        first = file.signed() if scheme >= 16 else None
        gaps = [file.varint() for _ in range(length - 1)] if scheme % 16 == 3 else []
        plans.append((scheme % 16, p, offset, length, first, gaps))
    tables = stored_tables(file, [plan[3] for plan in plans if plan[0] != 0])
    chunks = Bytes(file.take(file.varint()))
    classes = coded_classes(chunks, tables, rows)
    chunks.done()
    found = []
    for scheme, p, offset, _, first, gaps in plans:
        if scheme == 0:
            values = [offset] * rows
        else:
            values = column_values(file, next(classes), scheme, p, offset, gaps)
        if first is not None:
            above = first
            for i in range(rows):
                above += values[i]
                values[i] = above
        found.append(values)
    file.done()
    check(crc_i64([v for column in found for v in column]) == crc, "CRC of columns")
    return found


def coded_classes(chunks: Bytes, tables: Sequence[Sequence[int]], rows: int) -> Iterator[list[int]]:
    """The classes of each coded column; a chunk holds up to 2^20 symbols, in pieces of up to 2^20 rows."""
    found: list[list[int]] = []
    chunk: list[int] = []
    words, crc = RangeWords(b""), 0
    for table in tables:
        column: list[int] = []
        for start in range(0, rows, 1 << 20):
            piece = min(1 << 20, rows - start)
            if (not found and not column) or len(chunk) + piece > 1 << 20:
                check(crc_i32(chunk) == crc, "CRC of a chunk of classes")
                length, crc = chunks.unpack("II")
                words, chunk = RangeWords(chunks.take(length)), []
            symbols = symbols_of(words, table, piece)
            chunk += symbols
            column += symbols
        found.append(column)
    check(crc_i32(chunk) == crc, "CRC of a chunk of classes")
    return iter(found)


def column_values(file: Bytes, classes: list[int], scheme: int, p: int, offset: int, gaps: list[int]) -> list[int]:
    if scheme == 3:
        distinct = [offset]
        for gap in gaps:
            distinct.append(distinct[-1] + gap)
        return [distinct[c] for c in classes]
    if scheme == 1:
        return [offset + (c << p) + low for c, low in zip(classes, raw_bits(file, len(classes), p), strict=True)]
    check(scheme == 2, "scheme")
    values = [class_smallest(c, p) for c in classes]
    for e in sorted({class_e(c, p) for c in classes} - {0}):
        rows = [i for i, c in enumerate(classes) if class_e(c, p) == e]
        for i, low in zip(rows, raw_bits(file, len(rows), e), strict=True):
            values[i] += low
    return [unzigzag(value) + offset for value in values]


def categorical(data: bytes, size: int, tables: int, numbers: Sequence[int]) -> list[int]:
    file = Bytes(data)
    check(file.one("B") == 1, "version")
    if not numbers:
        return []
    stored = [table if any(table) else [1] * size for table in stored_tables(file, [size] * tables)]
    return coder_symbols("range", file.rest(), stored, numbers)


def bernoulli(data: bytes, n: int) -> list[int]:
    file = Bytes(data)
    p = min(max(file.varint() / n, 2.0**-24), 1 - 2.0**-24)

    def payload(content: bytes, first: int, count: int, kmin: int, kmax: int) -> list[int]:
        words, model = RangeWords(content), bernoulli_model(p)
        return [words.symbol(model) for _ in range(count)]

    return coder_chunks(file.rest(), n, payload)


class ExactTables:
    """The table file of sw-codecs."""

    def __init__(self, data: bytes) -> None:
        file = Bytes(data)
        check(file.take(4) == b"SPWT", "magic of the tables")
        self.version = file.one("H")
        file.one("I")
        self.multipliers = file.unpack("128H")
        file.take(64 * 4)  # scales: for encoders
        self.thresholds = file.unpack("63I")
        self.radius, self.tables = {}, {}
        for family in ("gaussian", "laplace"):
            self.radius[family] = file.unpack("64H")
            self.tables[family] = [
                [count + 1 for count in file.unpack(f"{2 * radius + 2}H")]
                for radius in self.radius[family]
                for _ in range(8)
            ]
        self.crc = file.one("I")
        file.done()


def escape(bits: Iterator[str]) -> tuple[bool, int]:
    """A sign bit and an Exp-Golomb code."""
    negative, zeros = next(bits) == "1", 0
    while next(bits) == "0":
        zeros += 1
    return negative, int("1" + "".join(next(bits) for _ in range(zeros)), 2) - 1


def density_tables(data: bytes, rows: int, width: int) -> list[list[int]]:
    """`factorised` and `mixture`: the columns of the matrix."""
    file = Bytes(data)
    check(file.unpack("BIH") == (1, rows, width), "head of density tables")
    crc = file.one("I")
    spans = [(file.signed(), file.varint()) for _ in range(width)]
    tables = stored_tables(file, [length + 1 for _, length in spans])
    chunks = Bytes(file.take(file.varint()))
    entries = coded_classes(chunks, tables, rows)
    chunks.done()
    bits, found = file.bits(), []
    for (a, length), column in zip(spans, entries, strict=True):
        values = [a + i for i in column]
        for row in [row for row, i in enumerate(column) if i == length]:
            negative, v = escape(bits)
            values[row] = a - 1 - v if negative else a + length + v
        found.append(values)
    check(crc_i64([v for column in found for v in column]) == crc, "CRC of density tables")
    return found


def exact(
    data: bytes, family: str, tables: ExactTables, mean: Sequence[int], scale: Sequence[int], multiplier: Sequence[int]
) -> list[int]:
    """`gaussian-exact` and `laplace-exact`."""
    file = Bytes(data)
    check(file.unpack("HI") == (tables.version, tables.crc), "other tables")
    centres, numbers = [], []
    for mu, sigma, m in zip(mean, scale, multiplier, strict=True):
        eighths = (8 * mu + m // 2) // m
        centres.append((eighths + 4) // 8)
        level = bisect.bisect_left(tables.thresholds, (max(sigma, 0) << 12) // m)
        numbers.append(8 * level + eighths + 4 - 8 * centres[-1])

    found: list[int] = []
    while len(found) < len(centres):
        count, _, _, length, crc = file.unpack("IiiII")
        start = len(found)
        chunk = Bytes(file.take(length))
        words = RangeWords(chunk.take(chunk.varint()))
        part = numbers[start : start + count]
        entries = symbols_by_table(words, tables.tables[family], part)
        bits = chunk.bits()
        values = [0] * count
        for i in sorted(range(count), key=lambda i: part[i]):  # stable: table by table, in order
            radius = tables.radius[family][part[i] // 8]
            values[i] = entries[i] - radius
            if entries[i] == 2 * radius + 1:
                negative, v = escape(bits)
                values[i] = -(v + radius + 1) if negative else v + radius + 1
        values = [value + centre for value, centre in zip(values, centres[start : start + count], strict=True)]
        check(crc_i32(values) == crc, "CRC of a chunk")
        found += values
    file.done()
    return found


def conditional(
    section: bytes,
    tables: ExactTables,
    c: int,
    mean: np.ndarray,
    scale: np.ndarray,
    steps: np.ndarray,
    there: np.ndarray,
) -> np.ndarray:
    """`conditional-gaussian`: integers like `mean` [n,C]; 0 where not `there`."""
    file, found, rows = Bytes(section), np.zeros(mean.shape, np.int64), max(1, (1 << 20) // c)
    for start in range(0, len(mean), rows):
        part = slice(start, start + rows)
        present = there[part]
        spread = np.broadcast_to(steps[part], mean[part].shape)
        parameters = [each[present].tolist() for each in (mean[part], scale[part], spread)]
        found[part][present] = exact(file.take(file.varint()), "gaussian", tables, *parameters)
    file.done()
    return found


def network(layers: Sequence[tuple[np.ndarray, np.ndarray]], units: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """A network in integers; `units` of the outputs of the last layer."""
    a = np.clip(inputs, -(1 << 20), 1 << 20)
    for i, (weight, bias) in enumerate(layers):
        u = units if i == len(layers) - 1 else np.ones(len(bias))
        w = np.rint(weight.astype(np.float64) * u[:, None] * 2.0**12).astype(np.int64)
        c = np.rint(bias.astype(np.float64) * u * 2.0**24).astype(np.int64)
        a = (a @ w.T + c) >> 12
        if i < len(layers) - 1:
            a = np.clip(a, 0, 1 << 20)
    return a


def hash_grid(bits: Iterator[int], levels: Sequence[int], limit: int, signs: int, codes: np.ndarray) -> np.ndarray:
    """Outputs of a binary hash grid for `codes` [n,d]; takes its signs from `bits`."""
    d, found = codes.shape[1], []
    for r in levels:
        size = -(-min(1 << limit, r**d) // 8) * 8
        table = [[2 * next(bits) - 1 for _ in range(signs)] for _ in range(size)]
        for row, code in enumerate(codes.tolist()):
            places = [v * (r - 2) * 4096 // 65535 + 2048 for v in code]
            total, sums = 0, [0] * signs
            for corner in range(1 << d):
                ends = [(t >> 12) + (corner >> axis & 1) for axis, t in enumerate(places)]
                w = 1
                for axis, (t, p) in enumerate(zip(places, ends, strict=True)):
                    w *= 0 if p in (0, r - 1) else t % 4096 if corner >> axis & 1 else 4096 - t % 4096
                if w == 0:
                    continue
                if r**d <= size:
                    entry = sum(p * r**axis for axis, p in enumerate(ends))
                else:
                    entry = 0
                    for p, prime in zip(ends, (1, 2654435761, 805459861), strict=False):
                        entry ^= p * prime % 2**32
                    entry %= size
                total += w
                sums = [s + w * sign for s, sign in zip(sums, table[entry], strict=True)]
            found.append((row, [4096 * s // total if total else 0 for s in sums]))
    n = len(codes)
    return np.array([[x for _, out in found[row::n] for x in out] for row in range(n)], np.int64).reshape(n, -1)


def places(frame: np.ndarray, bounds: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Where 16-bit codes [n,3] on the lattice `bounds` [2,3] lie in a triplane."""
    mu, v, s, low, high = frame[0], frame[1:4], frame[4], frame[5], frame[6]
    o, d = bounds[0], np.where(bounds[1] > bounds[0], (bounds[1] - bounds[0]) / 65535, 1e-6)
    axes = []
    for i in range(3):
        a = [float(v[j, i] * d[j] / s[i]) for j in range(3)]
        z = float((v[0, i] * (o[0] - mu[0]) + v[1, i] * (o[1] - mu[1]) + v[2, i] * (o[2] - mu[2])) / s[i])
        size = ((abs(a[0]) + abs(a[1]) + abs(a[2])) * 2.0**16 + abs(z)) * 2.0**16
        check(size < 2.0**61, "frame")
        e = next(e for e in (20, 16, 12, 8, 4, 0) if size * 2.0**e < 2.0**61)
        axes.append([*(round(x * 2.0 ** (16 + e)) for x in (*a, z)), e])
    sides = [(round(float(a) * 2**18), round(float(b) * 2**18)) for a, b in zip(low, high, strict=True)]
    found = []
    for code in codes.tolist():
        y = [(a * code[0] + b * code[1] + c * code[2] + z) >> e for a, b, c, z, e in axes]
        y = [min(max(each, -(1 << 26)), 1 << 26) for each in y]
        n = math.isqrt(sum(each * each for each in y))
        if n > 1 << 16:
            y = [(((2 * n - (1 << 16)) << 16) // n) * each // n for each in y]
        u = [((p + (1 << 17) - low_) << 20) // max(high_ - low_, 1) for p, (low_, high_) in zip(y, sides, strict=True)]
        found.append([min(max(each, 0), 1 << 20) for each in u])
    return np.array(found, np.int64).reshape(-1, 3)


PAIRS = ((0, 1), (0, 2), (1, 2))


def triplane(scales: Sequence[np.ndarray], u: np.ndarray) -> np.ndarray:
    """Outputs at places [n,3] of planes [3,C,R,R] a scale."""
    sums, found = 0, []
    for planes in scales:
        r = planes.shape[-1]
        t = u * (r - 1) >> 8
        c = np.minimum(t >> 12, max(r - 2, 0))
        f = t - 4096 * c
        ends, weights = np.stack([c, np.minimum(c + 1, r - 1)]), np.stack([4096 - f, f])
        samples = [
            sum(
                weights[i, :, a] * weights[j, :, b] * plane[:, ends[j, :, b], ends[i, :, a]]
                for i in (0, 1)
                for j in (0, 1)
            )
            for (a, b), plane in zip(PAIRS, planes, strict=True)
        ]
        sums = sums + np.concatenate(samples)
        found.append(sums >> 16)
    return np.concatenate(found).T


NEIGHBORS = [(-2, x) for x in range(-2, 3)] + [(-1, x) for x in range(-2, 3)] + [(0, -2), (0, -1)]


def planes_under_models(
    section: bytes, tables: ExactTables, shapes: Sequence[tuple[int, ...]], models: Sequence[Any]
) -> list[np.ndarray]:
    file = Bytes(section)
    check(file.unpack("HI") == (tables.version, tables.crc), "other tables")
    crc, escapes, length = file.one("I"), file.varint(), file.varint()
    words, bits, coded = RangeWords(file.take(length)), file.bits(), []
    found = [np.zeros(shape, np.int64) for shape in shapes]
    for w in range(max(shape[3] + 3 * (shape[2] - 1) for shape in shapes)):
        due = [
            (scale, k, c, row, w - 3 * row)
            for scale, shape in enumerate(shapes)
            for k, c, row in itertools.product(*(range(length_) for length_ in shape[:3]))
            if 0 <= w - 3 * row < shape[3]
        ]
        centres, numbers = [], []
        for scale, k, c, row, column in due:
            plane = found[scale][k, c]
            around = [(row + y, column + x) for y, x in NEIGHBORS]
            inside = [0 <= y < plane.shape[0] and 0 <= x < plane.shape[1] for y, x in around]
            seen = [int(plane[at]) if ok else 0 for at, ok in zip(around, inside, strict=True)]
            mu, t = network(models[k], np.ones(2), np.array([seen], np.int64) * 4096)[0].tolist()
            level = min(max((7_215_259_165 - 288_539 * t) >> 28, 0), 63)
            eighths = (8 * mu + 2048) // 4096
            centres.append((eighths + 4) // 8)
            numbers.append(8 * level + eighths + 4 - 8 * centres[-1])
        entries = symbols_by_table(words, tables.tables["laplace"], numbers)
        values = [0] * len(due)
        for i in sorted(range(len(due)), key=lambda i: numbers[i]):
            radius = tables.radius["laplace"][numbers[i] // 8]
            values[i] = entries[i] - radius
            if entries[i] == 2 * radius + 1:
                escapes -= 1
                negative, v = escape(bits)
                values[i] = -(v + radius + 1) if negative else v + radius + 1
        for (scale, *at), value, centre in zip(due, values, centres, strict=True):
            found[scale][tuple(at)] = value + centre
            coded.append(value + centre)
    check(escapes == 0 and crc_i32(coded) == crc, "CRC of planes")
    return found


# 5 Positions


def points_of(codes: Sequence[int]) -> np.ndarray:
    """[N,3] from Morton codes."""
    found = [[sum((code >> 3 * i + axis & 1) << i for i in range(21)) for axis in range(3)] for code in codes]
    return np.array(found, np.int64).reshape(-1, 3)


def octree(data: bytes) -> np.ndarray:
    file = Bytes(data)
    version, b = file.unpack("BB")
    check(version == 1, "version of the octree")
    n, distinct = file.varint(), file.varint()
    codes: list[int] = []
    if distinct:
        leaves = octree_leaves(file, b, distinct)
        times = [1] * distinct
        repeated = file.varint()
        if repeated:
            steps, more = columns(file.take(file.varint()), repeated, 2)
            at = 0
            for step, extra in zip(steps, more, strict=True):
                at += step
                times[at] += extra
        codes = [leaf for leaf, count in zip(leaves, times, strict=True) for _ in range(count)]
    check(len(codes) == n and crc_i64(codes) == file.one("I"), "CRC of the points")
    file.done()
    return points_of(codes)


def octree_leaves(file: Bytes, b: int, distinct: int) -> list[int]:
    d = file.one("B")
    actions = [[byte >> 2 * c & 3 for c in range(4)] for byte in file.take(d)]
    stored = iter(stored_tables(file, [255] * sum(level.count(1) for level in actions)))
    words = RangeWords(file.take(file.varint()))
    tables = [[1] * 255 for _ in range(4)]
    nodes, contexts, coded = [0], [0], []
    for level in actions:
        for c in range(4):
            if level[c] == 0:
                tables[c] = [1] * 255
            elif level[c] == 1:
                tables[c] = next(stored)
        symbols = symbols_by_table(words, tables, contexts)
        coded += symbols
        children, below = [], []
        for node, symbol in zip(nodes, symbols, strict=True):
            present = [c for c in range(8) if symbol + 1 >> c & 1]
            children += [(node << 3) + c for c in present]
            below += [min(len(present), 4) - 1] * len(present)
        nodes, contexts = children, below
    check(crc_i32(coded) == file.one("I") and len(nodes) == distinct, "CRC of the octree")
    low = 3 * (b - d)
    return [(node << low) + bits for node, bits in zip(nodes, raw_bits(file, distinct, low), strict=True)]


def plain_positions(data: bytes, *, unzstd: Callable[[bytes], bytes] | None = None) -> np.ndarray:
    """`morton-delta`, or with a decompressor `raw`."""
    file = Bytes(data)
    version, b = file.unpack("BB")
    crc, n = file.one("I"), file.varint()
    check(version == 1, "version of the positions")
    if unzstd is None:
        code, codes = 0, []
        for high, low in zip(*columns(file.rest(), n, 2), strict=True):
            code += (high << 48) + low
            codes.append(code)
        points = points_of(codes)
    else:
        points = np.frombuffer(unzstd(file.rest()), "<u2" if b <= 16 else "<u4").reshape(3, n).T.astype(np.int64)
        codes = [sum((int(p[a]) >> i & 1) << 3 * i + a for i in range(21) for a in range(3)) for p in points]
    check(crc_i64(codes) == crc, "CRC of the points")
    return points


def byte_planes(data: bytes, dtype: str, shape: tuple[int, ...], unzstd: Callable[[bytes], bytes]) -> np.ndarray:
    file = Bytes(data)
    version, form = file.unpack("BB")
    crc, body = file.one("I"), file.rest()
    check(version == 1 and form in (0, 1), "version of the byte planes")
    if form == 1:
        size, rows = np.dtype(dtype).itemsize, shape[0]
        planes, columns_ = unzstd(body), int(np.prod(shape[1:]))
        body = bytes(
            planes[(byte * columns_ + column) * rows + row]
            for row in range(rows)
            for column in range(columns_)
            for byte in range(size)
        )
    check(zlib.crc32(body) == crc, "CRC of the values")
    return np.frombuffer(body, "<" + dtype).reshape(shape)


def float_delta(data: bytes, shape: tuple[int, int], unzstd: Callable[[bytes], bytes]) -> np.ndarray:
    stored, found = byte_planes(data, "u4", shape, unzstd), np.empty(shape, "<u4")
    for column in range(shape[1]):
        r = 0
        for row in range(shape[0]):
            s = int(stored[row, column])
            r = (r + ((s >> 1) ^ (0xFFFFFFFF if s & 1 else 0))) % 2**32
            found[row, column] = r - 2**31 if r >= 2**31 else 2**32 - 1 - r
    return found.view("<f4")


def packed_bits(data: bytes, n: int, w: int) -> list[int]:
    check(len(data) == -(-n * w // 8), "length of the packed bits")
    digits = "".join(f"{byte:08b}" for byte in data)
    check("1" not in digits[n * w :], "padding")
    return [int(digits[i * w : (i + 1) * w], 2) for i in range(n)]


def importance_vq(
    header: bytes,
    mask: bytes,
    indices: bytes,
    codebook: bytes,
    own: bytes,
    n: int,
    d: int,
    unzstd: Callable[[bytes], bytes],
) -> np.ndarray:
    """The vectors, f16 [n,d]."""
    file = Bytes(header)
    version, form, stated, size, k = file.unpack("BBIII")
    file.done()
    check(version == 1 and form in (0, 1) and stated == n, "version of the vectors")
    bits = packed_bits(byte_planes(mask, "u1", (-(-n // 8),), unzstd).tobytes(), n, 1)
    check(sum(bits) == k, "own vectors")
    if form == 0:
        entries = packed_bits(indices, n - k, max((size - 1).bit_length(), 1))
    else:
        entries = categorical(indices, size, 1, [0] * (n - k))
    shared, kept = iter(entries), iter(byte_planes(own, "f2", (k, d), unzstd))
    book = byte_planes(codebook, "f2", (size, d), unzstd)
    return np.array([next(kept) if bit else book[next(shared)] for bit in bits], "<f2").reshape(n, d)


# 6 The files of each method


def decode(data: bytes, unzstd: Callable[[bytes], bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    """The parameters of the model in a file, f32."""
    header, sections = container(data)
    check(header["method_version"] == 1, "layout version")
    static = header["static"]
    if header["method"] == "hac":
        return hac(static, sections, tables)
    if header["method"] == "cat-3dgs":
        return cat(static, sections, tables)
    if header["method"] == "3dgs":
        check(static["mode"] in ("exact", "quantized"), "mode")
        return exact_mode(static, sections) if static["mode"] == "exact" else quantized(static, sections)
    if header["method"] == "chimerags":
        return chimera(static, sections, unzstd)
    check(header["method"] in ("trimming-the-fat", "pup-3dgs", "speedy-splat", "lightgaussian"), "method")
    if static["codec"] == "vectree":
        return vectree(static, sections, unzstd)
    if static["codec"] == "gaussians-ply":
        return ply(static, sections["ply"])
    if static["codec"] == "gaussians-zstd":
        return packed(static, sections, unzstd)
    check(static["codec"] in ("gaussians-exact", "gaussians-quantized"), "codec")
    return exact_mode(static, sections) if static["codec"] == "gaussians-exact" else quantized(static, sections)


def vectree(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    n, bands = static["num_gaussians"], (static["max_sh_degree"] + 1) ** 2
    parts = [sections[name] for name in ("vq", "mask", "index", "codebook", "sh_keep")]
    colors = importance_vq(*parts, n, 3 * bands, unzstd).astype("<f4")
    attributes = byte_planes(sections["attr"], "f2", (n, 8), unzstd).astype("<f4")
    return {
        "means": float_delta(sections["xyz"], (n, 3), unzstd),
        "sh_dc": colors[:, None, :3],
        "sh_rest": colors[:, 3:].reshape(n, 3, bands - 1).transpose(0, 2, 1),
        "opacity_logits": attributes[:, 0],
        "log_scales": attributes[:, 1:4],
        "quats": attributes[:, 4:],
    }


def chimera(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    check(static["max_sh_degree"] == 3 and static["vq"] == "importance-vq", "coder of the vectors")
    groups = []
    for group, n, rest in (("sh2", static["num_gaussians"] - static["num_sh3"], 8), ("sh3", static["num_sh3"], 15)):
        d = 3 + 3 * rest
        means, attributes, colors = np.zeros((0, 3), "<f4"), np.zeros((0, 8), "<f4"), np.zeros((0, d), "<f4")
        if n:
            means = chimera_means(static["xyz"], group, n, sections, unzstd)
            attributes = byte_planes(sections[f"{group}/attributes"], "f2", (n, 8), unzstd).astype("<f4")
            parts = [sections[f"{group}/vq/{name}"] for name in ("header", "mask", "indices", "codebook", "own")]
            colors = importance_vq(*parts, n, d, unzstd).astype("<f4")
        higher = np.zeros((n, 15, 3), "<f4")
        higher[:, :rest] = colors[:, 3:].reshape(n, 3, rest).transpose(0, 2, 1)
        groups.append((means, colors[:, None, :3], higher, attributes[:, 0], attributes[:, 1:4], attributes[:, 4:]))
    names = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")
    return {name: np.concatenate(both) for name, *both in zip(names, *groups, strict=True)}


def chimera_means(
    xyz: str, group: str, n: int, sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> np.ndarray:
    section = sections[f"{group}/xyz"]
    if xyz == "float32":
        return float_delta(section, (n, 3), unzstd)
    if xyz == "float16":
        return byte_planes(section, "f2", (n, 3), unzstd).astype("<f4")
    check(xyz == "uniform16", "positions")
    low, high = array(sections[f"{group}/box"])
    return (low + octree(section) / 65535 * (high - low)).astype("<f4")


def exact_mode(static: dict[str, Any], sections: dict[str, bytes]) -> dict[str, np.ndarray]:
    return {name: array(section) for name, section in sections.items()}


def ply(static: dict[str, Any], section: bytes) -> dict[str, np.ndarray]:
    n, r = static["num_gaussians"], (static["max_sh_degree"] + 1) ** 2 - 1
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(3 * r)),
             "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    lines += [f"property float {name}" for name in names] + ["end_header"]
    file = Bytes(section)
    for line in lines:
        check(file.take(len(line) + 1) == f"{line}\n".encode("ascii"), "header of the .ply")
    table = np.frombuffer(file.rest(), "<f4").reshape(n, len(names))
    return {
        "means": table[:, :3],
        "sh_dc": table[:, None, 6:9],
        "sh_rest": table[:, 9 : 9 + 3 * r].reshape(n, 3, r).transpose(0, 2, 1),
        "opacity_logits": table[:, 9 + 3 * r],
        "log_scales": table[:, 10 + 3 * r : 13 + 3 * r],
        "quats": table[:, 13 + 3 * r :],
    }


def packed(
    static: dict[str, Any], sections: dict[str, bytes], unzstd: Callable[[bytes], bytes]
) -> dict[str, np.ndarray]:
    n, r = static["num_gaussians"], (static["max_sh_degree"] + 1) ** 2 - 1
    tails = {"sh_dc": (1, 3), "sh_rest": (r, 3), "opacity_logits": (), "log_scales": (3,), "quats": (4,)}
    planes = {name: byte_planes(sections[name], "f4", (n, *tail), unzstd) for name, tail in tails.items()}
    return {"means": float_delta(sections["means"], (n, 3), unzstd), **planes}


def quantized(static: dict[str, Any], sections: dict[str, bytes]) -> dict[str, np.ndarray]:
    n, active = static["num_gaussians"], static["active_sh_degree"]
    points = octree(sections["positions"])
    check(len(points) == n, "number of points")
    base = {name: np.array(columns(sections[name], n, width), np.float64).reshape(width, n)
            for name, width in (("color", 3), ("opacity", 1), ("scales", 3), ("quats", 3))}  # fmt: skip
    rest = np.zeros((n, (static["max_sh_degree"] + 1) ** 2 - 1, 3), np.float32)
    activity = [0] * n
    for band in range(1, active + 1):
        matrix = band_columns(sections[f"sh{band}"], n, band, 1 if band == 1 else static["sh_classes"], activity)
        activity = [sum(map(abs, row), done) for row, done in zip(zip(*matrix, strict=True), activity, strict=True)]
        colors = np.array(matrix, np.float64).reshape(2 * band + 1, 3, n) * static["rest_step"]
        for k, (y, u, v) in enumerate(colors):
            rest[:, band**2 - 1 + k] = rgb(y, u, v)
    x, y, z = base["quats"] * static["quat_step"]
    norm = x * x + y * y + z * z
    w, long = np.sqrt(np.maximum(1 - norm, 0)), np.sqrt(np.maximum(norm, 1))
    return {
        "means": np.stack([coordinates(points[:, a], static, a) for a in range(3)], 1),
        "sh_dc": rgb(*(base["color"] * static["dc_step"]))[:, None],
        "sh_rest": rest,
        "opacity_logits": (base["opacity"][0] * static["opacity_step"]).astype(np.float32),
        "log_scales": (base["scales"] * static["scale_step"]).T.astype(np.float32),
        "quats": np.stack([w / long, x / long, y / long, z / long], 1).astype(np.float32),
    }


def coordinates(q: np.ndarray, static: dict[str, Any], axis: int) -> np.ndarray:
    top = float(static["top"][axis])
    v = (q + 0.5) * (2 * top * 2.0 ** -static["position_bits"]) - top
    a = np.abs(v)
    floor = np.floor(a)
    u = np.where(a < 1, a, (1 + (a - floor)) * 2.0 ** (floor - 1))
    u = np.where(v < 0, -u, u)
    return (u * static["width"][axis] + static["center"][axis]).astype(np.float32)


def rgb(y: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    a, b, c, d = 1 / np.sqrt(3.0), 1 / np.sqrt(2.0), 1 / np.sqrt(6.0), -2 / np.sqrt(6.0)
    return np.stack([a * y + b * u + c * v, a * y + 0 * u + d * v, a * y - b * u + c * v], 1).astype(np.float32)


def band_columns(section: bytes, n: int, band: int, classes: int, activity: list[int]) -> list[list[int]]:
    """The columns of one SH band, rows of all classes in place."""
    file, width = Bytes(section), 3 * (2 * band + 1)
    lengths = file.unpack("I" * classes)
    limits = [sorted(activity)[n * i // classes] for i in range(1, classes)] if n else []
    class_of = [bisect.bisect_right(limits, value) for value in activity]
    found = [[0] * n for _ in range(width)]
    for number, length in enumerate(lengths):
        rows = [i for i in range(n) if class_of[i] == number]
        content = file.take(length)
        check(bool(rows) == bool(content), "a class and its rows")
        for column, values in zip(found, columns(content, len(rows), width) if rows else [], strict=False):
            for i, value in zip(rows, values, strict=True):
                column[i] = value
    file.done()
    return found


def hac(static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    check(static["mode"] == "exact", "mode")
    n, k, d, h = (static[name] for name in ("num_anchors", "num_offsets", "feature_dim", "hidden"))
    bounds = np.frombuffer(sections["anchors"][:24], "<f4").astype(np.float64).reshape(2, 3)
    codes = octree(sections["anchors"][24:])
    masks = np.array(bernoulli(sections["masks"], n * k)).reshape(n, k) > 0
    check(len(codes) == n and masks.sum() == static["num_gaussians"], "number of anchors")

    signs, levels, limits = static["grid_features"], (static["grid_space"], static["grid_planes"]), static["grid_log2"]
    grids = [(levels[len(axes) == 2], limits[len(axes) == 2], axes) for axes in ([0, 1, 2], [0, 1], [0, 2], [1, 2])]
    entries = sum(-(-min(1 << limit, r ** len(axes)) // 8) * 8 for shape, limit, axes in grids for r in shape)
    bits = iter(bernoulli(sections["grids"], signs * entries))
    seen = np.concatenate(
        [hash_grid(bits, shape, limit, signs, codes[:, axes]) for shape, limit, axes in grids], axis=1
    )

    weights = Bytes(sections["networks"])
    form = {"float32": "<f4", "float16": "<f2"}[static["weights"]]

    def layers(*widths: int) -> list[tuple[np.ndarray, np.ndarray]]:
        found = []
        for a, b in itertools.pairwise(widths):
            numbers = np.frombuffer(weights.take((a * b + b) * int(form[2])), form).astype(np.float32)
            found.append((numbers[: a * b].reshape(b, a), numbers[a * b :]))
        return found

    drawing = {
        "mlp_opacity": layers(d + 4, h, k),
        "mlp_cov": layers(d + 4, h, 7 * k),
        "mlp_color": layers(d + 4, h, 3 * k),
    }
    groups = (d, 6, 3 * k)
    predicting = layers(seen.shape[1], static["grid_hidden"], 2 * sum(groups) + 3)
    weights.done()

    steps = static["base_steps"]
    units = np.array([1 / q for q, width in zip(steps, groups, strict=True) for _ in range(2 * width)] + [1.0] * 3)
    outputs, at, values = network(predicting, units, seen), 0, []
    for g, (name, width) in enumerate(zip(("features", "scalings", "offsets"), groups, strict=True)):
        numbers = np.clip((outputs[:, [g - 3]] + (1 << 15)) >> 9, 0, 127)
        m = np.array(tables.multipliers, np.int64)[numbers]
        there = np.repeat(masks, 3, axis=1) if name == "offsets" else np.ones((n, width), bool)
        mean, scale = outputs[:, at : at + width], outputs[:, at + width : at + 2 * width]
        i = conditional(sections[name], tables, max(groups), mean, scale, m, there)
        values.append((i * (m * (steps[g] / 4096))).astype(np.float32))
        at += 2 * width
    step = (bounds[1] - bounds[0]) / 65535
    return {
        "anchors": (codes * np.where(step > 0, step, 1e-6) + bounds[0]).astype(np.float32),
        "features": values[0],
        "scales": values[1],
        "offsets": values[2].reshape(n, k, 3),
        **{
            f"{name}.{2 * i}.{part}": array_
            for name, found in drawing.items()
            for i, layer in enumerate(found)
            for part, array_ in zip(("weight", "bias"), layer, strict=True)
        },
    }


def cat(static: dict[str, Any], sections: dict[str, bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    check(static["mode"] == "exact", "mode")
    n, k, d, h = (static[name] for name in ("num_anchors", "num_offsets", "feature_dim", "hidden"))
    bounds = np.frombuffer(sections["anchors"][:24], "<f4").astype(np.float64).reshape(2, 3)
    codes = octree(sections["anchors"][24:])
    masks = np.array(bernoulli(sections["masks"], n * k)).reshape(n, k) > 0
    check(len(codes) == n and masks.sum() == static["num_gaussians"], "number of anchors")
    weights = Bytes(sections["networks"])
    form = {"float32": "<f4", "float16": "<f2"}[static["weights"]]

    def layers(*widths: int) -> list[tuple[np.ndarray, np.ndarray]]:
        found = []
        for a, b in itertools.pairwise(widths):
            numbers = np.frombuffer(weights.take((a * b + b) * int(form[2])), form).astype(np.float32)
            found.append((numbers[: a * b].reshape(b, a), numbers[a * b :]))
        return found

    groups, slices, s = (d, 6, 3 * k), static["slices"], static["slice_hidden"]
    drawing = {name: layers(d + 4, h, w * k) for name, w in (("mlp_opacity", 1), ("mlp_cov", 7), ("mlp_color", 3))}
    outputs = 3 * static["channels"] * len(static["multiples"])
    predicting = layers(outputs, static["context_hidden"], 2 * sum(groups) + 3)
    starts = [sum(slices[:i]) for i in range(len(slices))]
    refining = [layers(start, s, 2 * size) for start, size in zip(starts[1:], slices[1:], strict=True)]
    more = [layers(d, s, 2 * width) for width in groups[1:]] if static["refine"] else []
    spatial = [layers(12, 16, 16, 16, 16, 2) for _ in PAIRS]
    for model in spatial:
        model[1:4] = [(w + np.eye(16, dtype=np.float32), b) for w, b in model[1:4]]
    weights.done()

    steps = static["base_steps"]
    check(steps[0] == 1, "step of features")
    values = [np.zeros((n, width), np.float32) for width in groups]
    if n:
        sizes = [m * static["resolution"] for m in static["multiples"]]
        shapes = [(3, static["channels"], size, size) for size in sizes]
        planes = planes_under_models(sections["triplane"], tables, shapes, spatial)
        frame = array(sections["frame"]).astype(np.float64)
        units = np.array([1 / q for q, width in zip(steps, groups, strict=True) for _ in range(2 * width)] + [1.0] * 3)
        seen = triplane(planes, places(frame, bounds, codes))
        out, at = network(predicting, units, seen), 0
        numbers = np.clip((out[:, -3:] + (1 << 15)) >> 9, 0, 127)
        m = np.array(tables.multipliers, np.int64)[numbers] + 410
        known = np.zeros((n, 0), np.int64)
        for g, width in enumerate(groups):
            mean, scale = out[:, at : at + width].copy(), out[:, at + width : at + 2 * width].copy()
            at += 2 * width
            if g == 0:
                for i, (start, size) in enumerate(zip(starts, slices, strict=True)):
                    part = slice(start, start + size)
                    if i > 0:
                        shift = network(refining[i - 1], np.ones(2 * size), known * m[:, [0]])
                        mean[:, part] += shift[:, :size]
                        scale[:, part] += shift[:, size:]
                    there = np.ones((n, size), bool)
                    coded = conditional(
                        sections[f"features.{i + 1}"],
                        tables,
                        max(groups),
                        mean[:, part],
                        scale[:, part],
                        m[:, [0]],
                        there,
                    )
                    known = np.concatenate([known, coded], axis=1)
                integers = known
            else:
                if more:
                    shift = network(more[g - 1], np.full(2 * width, 1 / steps[g]), known * m[:, [0]])
                    mean, scale = mean + shift[:, :width], scale + shift[:, width:]
                there = np.repeat(masks, 3, axis=1) if g == 2 else np.ones((n, width), bool)
                name = ("scalings", "offsets")[g - 1]
                integers = conditional(sections[name], tables, max(groups), mean, scale, m[:, [g]], there)
            values[g] = (integers * (m[:, [g]] * (steps[g] / 4096))).astype(np.float32)
    step = (bounds[1] - bounds[0]) / 65535
    return {
        "anchors": (codes * np.where(step > 0, step, 1e-6) + bounds[0]).astype(np.float32),
        "features": values[0],
        "scales": values[1],
        "offsets": values[2].reshape(n, k, 3),
        **{
            f"{name}.{2 * i}.{part}": array_
            for name, found in drawing.items()
            for i, layer in enumerate(found)
            for part, array_ in zip(("weight", "bias"), layer, strict=True)
        },
    }
