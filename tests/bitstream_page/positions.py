"""Chapter 5: Positions and plain numbers."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np

from bitstream_page.building_blocks import RangeWords, crc_i32, crc_i64, raw_bits, stored_tables, symbols_by_table
from bitstream_page.entropy_models import categorical, columns
from bitstream_page.fields import Bytes, check


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


def deflate(data: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    check(data[0] == 1, "version of the DEFLATE array")
    return np.frombuffer(zlib.decompress(data[1:]), "<" + dtype).reshape(shape)


def packed_bits(data: bytes, n: int, w: int) -> list[int]:
    check(len(data) == -(-n * w // 8), "length of the packed bits")
    digits = "".join(f"{byte:08b}" for byte in data)
    check("1" not in digits[n * w :], "padding")
    return [int(digits[i * w : (i + 1) * w], 2) for i in range(n)]


def sensitivity_vq(
    header: bytes, index: bytes, lattice: bytes, entries: bytes, n: int, d: int, unzstd: Callable[[bytes], bytes]
) -> np.ndarray:
    """The vectors, f32 [n,d]."""
    file = Bytes(header)
    version, stated, k = file.unpack("BII")
    file.done()
    check(version == 1 and stated == n, "version of the vectors")
    steps, zeros = np.frombuffer(lattice, "<f4", d), np.frombuffer(lattice, "<i4", d, 4 * d)
    symbols = byte_planes(entries, "u1", (k, d), unzstd).astype(np.int32)
    return ((symbols - zeros).astype("<f4") * steps)[byte_planes(index, "u2" if k <= 2**16 else "u4", (n,), unzstd)]


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


def residual_vq(header: bytes, codebooks: bytes, indices: bytes, n: int, d: int) -> np.ndarray:
    file = Bytes(header)
    version, half, stages, size, stated = file.unpack("BBBHI")
    coder = file.rest().decode("ascii")
    check(version == 1 and half in (0, 1) and stated == n, "head of residual-vq")
    books = np.frombuffer(codebooks, "<f2" if half else "<f4").astype(np.float32).reshape(stages, size, d)
    if coder == "packed-bits":
        flat = packed_bits(indices, n * stages, max((size - 1).bit_length(), 1))
    else:
        flat = categorical(indices, size, stages, [i % stages for i in range(n * stages)], coder)
    entries = np.array(flat, np.int64).reshape(n, stages)
    found = books[0][entries[:, 0]]
    for stage in range(1, stages):
        found = found + books[stage][entries[:, stage]]
    return found
