"""Signed Exp-Golomb codes of order 0 as a raw bit stream: for the rare symbols that a table has no room for."""

from __future__ import annotations

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import bit_length

MAX_PREFIX = 40


def encode(negative: np.ndarray, magnitudes: np.ndarray) -> bytes:
    """Sign bits and magnitudes v >= 0 as bits that fill bytes from the least significant one; zero-padded.

    Each value: a sign bit (1: negative), as many zeros as v + 1 has bits after its leading one, then v + 1 from its
    leading one down.
    """
    if len(magnitudes) == 0:
        return b""
    shifted = np.asarray(magnitudes, np.int64) + 1
    length = bit_length(shifted)
    if length.max() > MAX_PREFIX:
        raise ValueError(f"a magnitude has {length.max()} bits, at most {MAX_PREFIX} can be coded")
    size = 2 * length  # sign, length - 1 zeros, length digits
    start = np.cumsum(size) - size
    bits = np.zeros(int(size.sum()), np.uint8)
    bits[start] = negative
    for digit in range(int(length.max())):  # digit 0 is the leading one
        rows = np.flatnonzero(length > digit)
        bits[start[rows] + length[rows] + digit] = (shifted[rows] >> (length[rows] - 1 - digit)) & 1
    return np.packbits(bits, bitorder="little").tobytes()


def decode(data: bytes | memoryview, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(negative bool [count], magnitudes int64 [count]). Raises BitstreamError unless `data` is `count` codes."""
    if count > 4 * len(data):  # the shortest code has two bits
        raise BitstreamError(f"{len(data):,} bytes cannot hold {count:,} escape codes: the data is truncated")
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").tobytes()
    negative, magnitudes = np.empty(count, bool), np.empty(count, np.int64)
    position = 0
    for i in range(count):
        one = bits.find(b"\x01", position + 1, position + 1 + MAX_PREFIX)
        length = one - position
        if one < 0 or one + length > len(bits):
            raise BitstreamError("an escape code is damaged or truncated")
        value = 0
        for bit in bits[one : one + length]:
            value = value << 1 | bit
        negative[i], magnitudes[i] = bits[position], value - 1
        position = one + length
    if len(bits) - position >= 8 or any(bits[position:]):
        raise BitstreamError("unknown bits follow the escape codes")
    return negative, magnitudes
