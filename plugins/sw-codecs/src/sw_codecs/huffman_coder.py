"""Entropy coder `huffman`: codes of whole bits from tables of counts; simple, up to 1 bit a symbol above the rest."""

from __future__ import annotations

import constriction
import numpy as np
import torch

from splatwizard_core.errors import BitstreamError
from sw_codecs.coders import ChunkedCoder
from sw_codecs.model_spec import Gaussian, Laplace, ModelSpec, Table, Tables
from sw_codecs.symbol_stream import guarded

MAX_TABLES = 4096  # distinct parameter pairs that may be turned into tables
MAX_ENTRIES = 1 << 24
TOTAL = 1 << 16


class HuffmanCoder(ChunkedCoder):
    """Takes Table and Tables. Gaussian and Laplace models are turned into tables first, one for each distinct pair of
    parameters (at most 4096), computed in floating point: such a file is tied to the machine kind.
    """

    def _encode_chunk(self, symbols: np.ndarray, spec: ModelSpec) -> bytes:
        tables, index, low = _as_tables(spec, len(symbols))
        encoder = constriction.symbol.QueueEncoder()
        with guarded(ValueError, "Huffman coding"):
            trees = [constriction.symbol.huffman.EncoderHuffmanTree(table) for table in tables]
            for symbol, table in zip((symbols - low).tolist(), index.tolist(), strict=True):
                encoder.encode_symbol(symbol, trees[table])
            words, _ = encoder.get_compressed_and_bitrate()
        return words.astype("<u4").tobytes()

    def _decode_chunk(self, payload: memoryview, count: int, spec: ModelSpec) -> np.ndarray:
        if len(payload) % 4:
            raise BitstreamError(f"{len(payload):,} coded bytes are not whole 32-bit words")
        tables, index, low = _as_tables(spec, count)
        with guarded(BitstreamError, "Huffman decoding"):
            trees = [constriction.symbol.huffman.DecoderHuffmanTree(table) for table in tables]
            decoder = constriction.symbol.QueueDecoder(np.frombuffer(payload, "<u4").astype(np.uint32))
            symbols = [decoder.decode_symbol(trees[table]) for table in index.tolist()]
        return np.array(symbols, np.int32) + np.int32(low)


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
    edges = (np.arange(spec.kmin, spec.kmax + 2) - 0.5 - distinct[:, :1]) / distinct[:, 1:]  # [T, K + 1]
    edges[:, 0], edges[:, -1] = -np.inf, np.inf  # the tails are folded in
    if isinstance(spec, Gaussian):
        cdf = torch.special.ndtr(torch.from_numpy(edges)).numpy()
    else:
        cdf = 0.5 - 0.5 * np.sign(edges) * np.expm1(-np.abs(edges))
    return np.maximum(np.rint(np.diff(cdf, axis=1) * TOTAL), 1).astype(np.float32), index.ravel(), spec.kmin
