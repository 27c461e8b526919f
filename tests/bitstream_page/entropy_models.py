"""Chapter 4: Entropy models, but for the networks and grids that predict their parameters (integer_networks.py)."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Sequence

import numpy as np

from bitstream_page.building_blocks import (
    RangeWords,
    RansWords,
    bernoulli_model,
    class_e,
    class_smallest,
    crc_i32,
    crc_i64,
    raw_bits,
    stored_tables,
    symbols_by_table,
    symbols_of,
)
from bitstream_page.entropy_coders import coder_chunks, coder_symbols
from bitstream_page.fields import Bytes, check, unzigzag


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


def categorical(data: bytes, size: int, tables: int, numbers: Sequence[int], coder: str = "range") -> list[int]:
    file = Bytes(data)
    check(file.one("B") == 1, "version")
    if not numbers:
        return []
    stored = [table if any(table) else [1] * size for table in stored_tables(file, [size] * tables)]
    return coder_symbols(coder, file.rest(), stored, numbers)


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
        self.deviations = [scale / 2**20 for scale in file.unpack("64I")]
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


def centre_and_table(mean: int, level: int, m: int) -> tuple[int, int]:
    """I and the number of the table."""
    eighths = (8 * mean + m // 2) // m
    centre = (eighths + 4) // 8
    return centre, 8 * level + eighths + 4 - 8 * centre


def coded_values(
    words: RangeWords | RansWords, bits: Iterator[str], tables: ExactTables, family: str, numbers: Sequence[int]
) -> list[int]:
    """s for each entry of `numbers`, the tables."""
    entries = symbols_by_table(words, tables.tables[family], numbers)
    values = [0] * len(numbers)
    for i in sorted(range(len(numbers)), key=lambda i: numbers[i]):  # stable: table by table, in order
        radius = tables.radius[family][numbers[i] // 8]
        values[i] = entries[i] - radius
        if entries[i] == 2 * radius + 1:
            negative, v = escape(bits)
            values[i] = -(v + radius + 1) if negative else v + radius + 1
    return values


def stream_values(
    words: RansWords, bits: Iterator[str], tables: ExactTables, numbers: Sequence[int], centres: Sequence[int]
) -> list[int]:
    """Symbols of a whole stream."""
    coded = coded_values(words, bits, tables, "gaussian", numbers)
    check(words.state == 0 and not words.words and not any(bit == "1" for bit in bits), "end of a stream")
    return [value + centre for value, centre in zip(coded, centres, strict=True)]


def exact(
    data: bytes, tables: ExactTables, mean: Sequence[int], scale: Sequence[int], multiplier: Sequence[int]
) -> list[int]:
    """`gaussian-exact`."""
    file = Bytes(data)
    version, crc = file.unpack("HI")
    check(version in (1, 2) and crc == tables.crc, "other tables")
    centres, numbers = [], []
    for mu, sigma, m in zip(mean, scale, multiplier, strict=True):
        level = bisect.bisect_left(tables.thresholds, (max(sigma, 0) << 12) // m)
        centre, number = centre_and_table(mu, level, m)
        centres.append(centre)
        numbers.append(number)

    found: list[int] = []
    if version == 2:
        starts = range(0, len(centres), 1 << 16)
        sizes = [(file.one("I"), file.varint(), file.varint()) for _ in starts]
        for start, (crc, length, escapes) in zip(starts, sizes, strict=True):
            part = slice(start, start + (1 << 16))
            words, bits = RansWords(file.take(length)), Bytes(file.take(escapes)).bits()
            values = stream_values(words, bits, tables, numbers[part], centres[part])
            check(crc_i32(values) == crc, "CRC of a stream")
            found += values
    while len(found) < len(centres):
        count, _, _, length, crc = file.unpack("IiiII")
        start = len(found)
        chunk = Bytes(file.take(length))
        words = RangeWords(chunk.take(chunk.varint()))
        coded = coded_values(words, chunk.bits(), tables, "gaussian", numbers[start : start + count])
        values = [value + centre for value, centre in zip(coded, centres[start : start + count], strict=True)]
        check(crc_i32(values) == crc, "CRC of a chunk")
        found += values
    file.done()
    return found


WIDTHS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 128, 256)


def mixture_block(data: bytes, tables: ExactTables, numbers: Sequence[Sequence[int]]) -> list[int]:
    """A block of `conditional-mixture`: two means, two scales, d and m of each number."""
    if not numbers:
        check(not data, "bytes of no numbers")
        return []
    file = Bytes(data)
    check(file.unpack("HI") == (tables.version, tables.crc), "other tables")
    crc = file.one("I")
    words, bits = RangeWords(file.take(file.varint())), file.bits()
    windows = []
    for mu_1, mu_2, sigma_1, sigma_2, d, m in numbers:
        j = min(max(((d >> 1) + (1 << 15)) >> 9, 0), 127)
        w = min(max((tables.multipliers[j] + 16) >> 5, 2), 254)
        parts = []
        for mu, sigma, share in ((mu_1, sigma_1, w), (mu_2, sigma_2, 256 - w)):
            level = bisect.bisect_left(tables.thresholds, (max(sigma, 0) << 12) // m)
            middle, number = centre_and_table(mu, level, m)
            parts.append((middle, tables.radius["gaussian"][level], tables.tables["gaussian"][number], share))
        centre = parts[0 if w >= 128 else 1][0]
        reach = max(radius + abs(middle - centre) for middle, radius, _, _ in parts)
        width = next((width for width in WIDTHS if width >= reach), WIDTHS[-1])
        counts = [1] * (2 * width + 2)
        for middle, radius, table, share in parts:
            for s in range(-width, width + 1):
                if abs(centre + s - middle) <= radius:
                    counts[s + width] += share * table[centre + s - middle + radius]
            counts[-1] += share * table[-1]
        windows.append((width, centre, counts))
    found = [0] * len(windows)
    order = sorted(range(len(windows)), key=lambda i: windows[i][0])
    entries = {i: symbols_of(words, windows[i][2], 1)[0] for i in order}
    for i in order:
        width, centre, _ = windows[i]
        s = entries[i] - width
        if entries[i] == 2 * width + 1:
            negative, v = escape(bits)
            s = -(v + width + 1) if negative else v + width + 1
        found[i] = centre + s
    check(crc_i32(found) == crc, "CRC of a block")
    return found


def conditional_mixture(
    section: bytes, tables: ExactTables, c: int, parameters: Sequence[np.ndarray], steps: np.ndarray
) -> np.ndarray:
    """`conditional-mixture`: integers [n,C]; `parameters` are the means, the scales and d, [n,C] each."""
    shape = parameters[0].shape
    file, found, rows = Bytes(section), np.zeros(shape, np.int64), max(1, (1 << 20) // c)
    spread = np.stack([*parameters, np.broadcast_to(steps, shape)], axis=-1)
    for start in range(0, len(found), rows):
        part = spread[start : start + rows].reshape(-1, 6).tolist()
        found[start : start + rows] = np.reshape(mixture_block(file.take(file.varint()), tables, part), (-1, shape[1]))
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
        found[part][present] = exact(file.take(file.varint()), tables, *parameters)
    file.done()
    return found
