"""Chapter 3: Entropy coders."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from bitstream_page.building_blocks import RangeWords, RansWords, crc_i32, huffman_codes, symbols_by_table
from bitstream_page.fields import Bytes, check


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
