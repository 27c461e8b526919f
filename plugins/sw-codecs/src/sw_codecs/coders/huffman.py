"""Entropy coder `huffman`: codes of whole bits from tables of counts; simple, up to 1 bit per symbol above the rest."""

from __future__ import annotations

from itertools import repeat

import constriction
import numpy as np
import torch

from splatwizard_core.api import BitstreamError
from splatwizard_native import NativeBuildError
from sw_codecs.coders.arithmetic import ChunkedCoder
from sw_codecs.coders.model_spec import Gaussian, Laplace, ModelSpec, Table, Tables
from sw_codecs.coders.symbol_stream import guarded
from sw_codecs.native import CODECS

MAX_TABLES = 4096  # distinct parameter pairs that may be turned into tables
MAX_ENTRIES = 1 << 24
TOTAL = 1 << 16


class HuffmanCoder(ChunkedCoder):
    """Takes Table and Tables. Gaussian and Laplace models are turned into tables first, one for each distinct pair of
    parameters (at most 4096), computed in floating point: such a file is tied to the machine kind.
    """

    def _encode_chunk(self, symbols: np.ndarray, spec: ModelSpec) -> bytes:
        tables, index, low = _as_tables(spec, len(symbols))
        entry = index.astype(np.int64) * tables.shape[1] + (symbols - low)
        with guarded(ValueError, "Huffman coding"):
            return _written(tables, entry)

    def _decode_chunk(self, payload: memoryview, count: int, spec: ModelSpec) -> np.ndarray:
        if len(payload) % 4:
            raise BitstreamError(f"{len(payload):,} coded bytes are not whole 32-bit words")
        tables, index, low = _as_tables(spec, count)
        if 2 <= tables.shape[1] <= tables.size <= MAX_ENTRIES and np.isfinite(tables).all() and _has_kernel():
            # Copies: what torch wraps must be writable.
            copied = np.array(payload, np.uint8), np.array(tables, np.float32), np.array(index, np.int64)
            decoded = torch.ops.sw_codecs.huffman_decode(*map(torch.from_numpy, copied))
            if len(decoded) < count:
                raise BitstreamError(f"the codes end before {count:,} symbols: truncated data or a wrong model")
            return np.asarray(decoded.numpy() + np.int32(low), np.int32)
        with guarded(BitstreamError, "Huffman decoding"):
            trees = [constriction.symbol.huffman.DecoderHuffmanTree(table) for table in tables]
            decode = constriction.symbol.QueueDecoder(np.frombuffer(payload, "<u4").astype(np.uint32)).decode_symbol
            which = repeat(trees[0], count) if len(trees) == 1 else map(trees.__getitem__, index.tolist())
            symbols = list(map(decode, which))
        return np.array(symbols, np.int32) + np.int32(low)


def _has_kernel() -> bool:
    """Whether there is a compiled decoder. Compiling one takes longer than a file does without."""
    try:
        return CODECS.load_built()
    except NativeBuildError:
        return False


def _written(tables: np.ndarray, entry: np.ndarray) -> bytes:
    """The codes of entries (table * alphabet + symbol) one after another, bits filling u32 words from the lowest."""
    trees = [constriction.symbol.huffman.EncoderHuffmanTree(table) for table in tables]
    is_used = np.bincount(entry) > 0
    used = np.flatnonzero(is_used)
    code, length = np.zeros(len(used), np.uint64), np.zeros(len(used), np.int64)
    for i, (table, symbol) in enumerate(
        zip(*(part.tolist() for part in np.divmod(used, tables.shape[1])), strict=True)
    ):
        alone = constriction.symbol.QueueEncoder()
        alone.encode_symbol(symbol, trees[table])
        words, length[i] = alone.get_compressed_and_bitrate()
        code[i] = int.from_bytes(words[:2].astype("<u4").tobytes(), "little")
    if length.max() > 64:  # counts that grow like Fibonacci numbers: rare enough to take the slow way
        together = constriction.symbol.QueueEncoder()
        for table, symbol in zip(*(part.tolist() for part in np.divmod(entry, tables.shape[1])), strict=True):
            together.encode_symbol(symbol, trees[table])
        return bytes(together.get_compressed_and_bitrate()[0].astype("<u4").tobytes())
    which = (np.cumsum(is_used) - 1)[entry]
    ends = np.cumsum(length[which])
    starts = ends - length[which]
    word, shift = starts >> 6, (starts & 63).astype(np.uint64)
    out = np.zeros((int(ends[-1]) >> 6) + 1, np.uint64)
    # At least one code starts in every word, for none is longer; at most one runs on from a word into the next.
    firsts = np.flatnonzero(np.diff(word, prepend=-1))
    out[word[firsts]] = np.bitwise_or.reduceat(code[which] << shift, firsts)
    across = np.flatnonzero((ends - 1) >> 6 != word)
    out[word[across] + 1] |= code[which[across]] >> (np.uint64(64) - shift[across])
    return out.astype("<u8").tobytes()[: (int(ends[-1]) + 31) // 32 * 4]


def _as_tables(spec: ModelSpec, n: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Counts [T, K] float32 (part of the format), the table of each symbol [n], and the symbol of entry 0."""
    if isinstance(spec, Table):
        return np.asarray(spec.counts, np.float32)[None], np.zeros(n, np.int64), 0
    if isinstance(spec, Tables):
        return np.asarray(spec.counts, np.float32), spec.index, 0
    if not isinstance(spec, (Gaussian, Laplace)):
        raise ValueError(f"Huffman coding takes tables, not {type(spec).__name__}")
    location, scale = np.asarray(spec.mu), np.asarray(spec.sigma if isinstance(spec, Gaussian) else spec.b)
    pairs = np.stack([np.broadcast_to(location, n), np.broadcast_to(scale, n)], 1)
    distinct, index = np.unique(pairs, axis=0, return_inverse=True)
    width = spec.kmax - spec.kmin + 1
    if len(distinct) > MAX_TABLES or len(distinct) * width > MAX_ENTRIES:
        raise ValueError(f"{len(distinct):,} distinct models of {width:,} symbols are too many for Huffman tables")
    with np.errstate(over="ignore"):  # infinitely many scales away is far enough
        edges = (np.arange(spec.kmin, spec.kmax + 2) - 0.5 - distinct[:, :1]) / distinct[:, 1:]  # [T, K + 1]
    edges[:, 0], edges[:, -1] = -np.inf, np.inf  # the tails are folded in
    if isinstance(spec, Gaussian):
        cdf = torch.special.ndtr(torch.from_numpy(edges)).numpy()
    else:
        cdf = 0.5 - 0.5 * np.sign(edges) * np.expm1(-np.abs(edges))
    return np.maximum(np.rint(np.diff(cdf, axis=1) * TOTAL), 1).astype(np.float32), index.ravel(), spec.kmin
