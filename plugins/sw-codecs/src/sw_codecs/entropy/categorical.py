"""Entropy model `categorical`: symbols 0..K-1 under stored counts, one table or one for each value of a context."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError, EntropyCoder
from sw_codecs.bits.packing import ByteReader
from sw_codecs.coders.arithmetic import RangeCoder
from sw_codecs.coders.count_tables import pack_tables, rounded_counts, unpack_tables
from sw_codecs.coders.model_spec import Tables, as_symbols

VERSION = 1
MAX_ENTRIES = 1 << 24
TOTAL = 1 << 20


@dataclass(frozen=True)
class CategoricalContext:
    """size: how many symbols there are. index [n]: which table codes each symbol, in 0..tables-1; decoded before.

    logits [tables, size], or [size]: trained weights whose softmax takes the place of the symbols' own statistics in
    `bits`, then differentiable, and in `encode`. `decode` needs n, from the index or given, and no logits: the file has
    the counts.
    """

    size: int
    n: int | None = None
    index: np.ndarray | None = None
    tables: int = 1
    logits: Tensor | None = None

    def __post_init__(self) -> None:
        if self.logits is not None and self.logits.numel() != self.size * self.tables:
            raise ValueError(f"logits of shape {list(self.logits.shape)}, must be [{self.tables}, {self.size}]")
        if self.size < 1 or self.tables < 1 or self.size * self.tables > MAX_ENTRIES:
            raise ValueError(f"{self.tables} tables of {self.size} symbols are none or too many")

    def rows(self, n: int) -> np.ndarray:
        """The table of each of n symbols."""
        index = np.zeros(n, np.int64) if self.index is None else np.asarray(self.index)
        if index.shape != (n,) or (n and not 0 <= index.min() <= index.max() < self.tables):
            raise ValueError(f"the context must be {n} integers in 0..{self.tables - 1}")
        return index


class Categorical:
    """Counts are stored: of the symbols, or from logits that were trained. Its context is a `Categorical.Context`.

    coder   an entropy coder for tables of counts (`huffman`, ...), the same for encoding and decoding: the bytes do not
            name it. None: `range`, for which `bits` is the size
    """

    Context = CategoricalContext

    def __init__(self, coder: EntropyCoder | None = None) -> None:
        self.coder: EntropyCoder = RangeCoder() if coder is None else coder

    def bits(self, symbols: Tensor, context: CategoricalContext) -> Tensor:
        """Bits per symbol, shape of `symbols`: under the logits, differentiable in them; or else under the counts of
        `symbols` itself, float64, no gradient.
        """
        if context.logits is not None:
            logits = context.logits.reshape(context.tables, context.size)
            rows = torch.from_numpy(context.rows(symbols.numel()).astype(np.int64)).to(logits.device)
            shares = torch.log_softmax(logits, 1)  # of each table once, not of each symbol's
            return -(shares[rows, symbols.reshape(-1).long()] / math.log(2)).reshape(symbols.shape)
        flat = as_symbols(symbols.detach().cpu().numpy().reshape(-1))
        index, tables = _histograms(flat, context)
        stored = np.stack([rounded_counts(t) for t in tables])
        found = np.log2(np.maximum(stored.sum(1), 1)[index] / stored[index, flat])
        return torch.from_numpy(found.reshape(symbols.shape)).to(symbols.device)

    def encode(self, symbols: np.ndarray, context: CategoricalContext) -> bytes:
        """u8 version, the count tables, chunks of the coder. Raises ValueError for symbols out of range."""
        symbols = as_symbols(symbols)
        index, tables = _histograms(symbols, context)
        head = bytes([VERSION])
        if len(symbols) == 0:
            return head
        return head + pack_tables(list(tables)) + self.coder.encode(symbols, _spec(list(tables), index))

    def decode(self, data: bytes, context: CategoricalContext) -> np.ndarray:
        """int32 [n]. Raises BitstreamError for damage or another context."""
        n = context.n if context.n is not None else len(np.asarray(context.index if context.index is not None else ()))
        reader = ByteReader(data)
        version = reader.integer(1)
        if version != VERSION:
            raise BitstreamError(f"categorical data of version {version} is not known: upgrade sw-codecs")
        if n == 0:
            reader.finish()
            return np.empty(0, np.int32)
        tables = unpack_tables(reader, [context.size] * context.tables)
        if sum(int(t.sum()) for t in tables) == 0:
            raise BitstreamError("the count tables are empty")
        return self.coder.decode(bytes(reader.take(reader.left)), n, _spec(tables, context.rows(n), stored=True))


def _histograms(symbols: np.ndarray, context: CategoricalContext) -> tuple[np.ndarray, np.ndarray]:
    """The table of each symbol, and the counts [tables, size]: how often each occurs, or shares of 2^20."""
    if symbols.size and not 0 <= symbols.min() <= symbols.max() < context.size:
        raise ValueError(f"symbols {symbols.min()}..{symbols.max()} leave 0..{context.size - 1}")
    index = context.rows(len(symbols))
    if context.logits is not None:
        logits = context.logits.detach().cpu().double().reshape(context.tables, context.size)
        if bool(torch.isnan(logits.softmax(1)).any()):
            raise ValueError("logits hold values that are not finite")
        return index, np.maximum(np.rint(TOTAL * logits.softmax(1).numpy()), 1).astype(np.int64)
    counts = np.bincount(index.astype(np.int64) * context.size + symbols, minlength=context.tables * context.size)
    return index, counts.reshape(context.tables, context.size)


def _spec(tables: list[np.ndarray], index: np.ndarray, *, stored: bool = False) -> Tables:
    """Tables that never occur get equal counts, so that every table is a distribution."""
    counts = np.stack(tables if stored else [rounded_counts(t) for t in tables])
    counts[counts.sum(1) == 0] = 1
    return Tables(counts, index)
