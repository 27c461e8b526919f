"""One stream of range- or rANS-coded symbols under several models in turn, with a CRC-32 of the symbols.

The thin layer over `constriction`: it validates what the library would panic on, handles models that leave no
choice without calling it, groups per-symbol tables, and turns whatever goes wrong while decoding into BitstreamError.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import constriction
import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum
from sw_codecs.coders.model_spec import (
    Bernoulli,
    Gaussian,
    Laplace,
    ModelSpec,
    Table,
    Tables,
    Uniform,
    as_symbols,
    check_length,
    domain,
    unchecked,
)

_models = constriction.stream.model


@contextlib.contextmanager
def guarded(error: type[Exception], doing: str) -> Iterator[None]:
    """Turn what the library raises into `error`; its Rust panics derive from BaseException, not Exception."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit, MemoryError, error):
        raise
    except BaseException as cause:
        raise error(f"{doing} failed: {type(cause).__name__}: {cause}") from cause


def check_again(again: np.ndarray | None, symbols: np.ndarray) -> None:
    """Raise RuntimeError unless what was just encoded decodes to the same symbols; None: it does not decode at all."""
    if again is None or not np.array_equal(again, symbols):
        raise RuntimeError("a block does not decode to what was encoded; please report this")


def _only_symbol(counts: np.ndarray) -> int | None:
    """The one symbol with a positive count, or None if there are several."""
    positive = np.flatnonzero(counts)
    return int(positive[0]) if len(positive) == 1 else None


def _model(spec: ModelSpec) -> tuple[Any, tuple[np.ndarray, ...]]:
    """A library model, and the per-symbol parameters to pass with it."""
    if isinstance(spec, (Gaussian, Laplace)):
        family = _models.QuantizedGaussian if isinstance(spec, Gaussian) else _models.QuantizedLaplace
        location, scale = np.asarray(spec.mu), np.asarray(spec.sigma if isinstance(spec, Gaussian) else spec.b)
        if location.ndim == scale.ndim == 0:
            return family(spec.kmin, spec.kmax, float(location), float(scale)), ()
        location, scale = np.broadcast_arrays(location, scale)
        return family(spec.kmin, spec.kmax), (np.ascontiguousarray(location), np.ascontiguousarray(scale))
    if isinstance(spec, Table):
        return _models.Categorical(spec.counts, perfect=False), ()
    if isinstance(spec, Bernoulli):
        p = np.asarray(spec.p)
        if p.ndim == 0:
            return _models.Bernoulli(float(p), perfect=False), ()
        return _models.Bernoulli(perfect=False), (np.ascontiguousarray(p),)
    assert isinstance(spec, Uniform)
    return _models.Uniform(spec.size), ()


def _groups(spec: Tables) -> Iterator[tuple[Table, np.ndarray]]:
    """Each table that is used with the positions it codes, in ascending order: far faster than a table per symbol."""
    key = spec.index.astype(np.uint16 if len(spec.counts) <= 1 << 16 else np.int64)  # uint16 takes the radix sort
    order = np.argsort(key, kind="stable")
    ends = np.cumsum(np.bincount(key, minlength=1))
    starts = np.concatenate([[0], ends[:-1]])
    for table in np.flatnonzero(ends > starts).tolist():
        yield unchecked(Table, counts=spec.counts[table]), order[starts[table] : ends[table]]


def _settled(spec: ModelSpec) -> int | None:
    """The symbol, if the model leaves no choice."""
    low, high = domain(spec)
    if low == high:
        return low
    return _only_symbol(spec.counts) if isinstance(spec, Table) else None


class SymbolWriter:
    """Codes arrays of symbols one after another.

    last_in_first_out   False: range coder; True: rANS, which the library fills from the back
    """

    def __init__(self, *, last_in_first_out: bool = False) -> None:
        self._puts: list[tuple[np.ndarray, Any, tuple[np.ndarray, ...]]] = []
        self._range = None if last_in_first_out else constriction.stream.queue.RangeEncoder()
        self.crc = 0
        self.count = 0

    def put(self, symbols: np.ndarray, spec: ModelSpec) -> None:
        """Append symbols [n], integers within the model's domain. Raises ValueError if one is not."""
        symbols = as_symbols(symbols)
        check_length(spec, len(symbols))
        if len(symbols) == 0:
            return
        low, high = domain(spec)
        if symbols.min() < low or symbols.max() > high:
            raise ValueError(f"symbols {symbols.min()}..{symbols.max()} leave the model's domain {low}..{high}")
        symbols = np.ascontiguousarray(symbols, "<i4")
        self.crc = checksum.crc32(symbols, self.crc)
        self.count += len(symbols)
        self.put_checked(symbols, spec)

    def put_checked(self, symbols: np.ndarray, spec: ModelSpec) -> None:
        """As `put`, without a look at the symbols, int32 [n], n > 0, and without `crc` and `count`."""
        if isinstance(spec, Tables):
            for table, positions in _groups(spec):
                self._code(symbols[positions], table)
        else:
            self._code(symbols, spec)

    def _code(self, symbols: np.ndarray, spec: ModelSpec) -> None:
        settled = _settled(spec)
        if settled is not None:
            if (symbols != settled).any():
                raise ValueError(f"the model allows only symbol {settled}")
            return
        with guarded(ValueError, "entropy coding"):
            model, parameters = _model(spec)
            if self._range is not None:
                self._range.encode(symbols, model, *parameters)
            else:
                self._puts.append((symbols, model, parameters))

    def finish(self) -> bytes:
        """The coded bytes, a multiple of four."""
        with guarded(ValueError, "entropy coding"):
            if self._range is not None:
                words = self._range.get_compressed()
            else:
                stack = constriction.stream.stack.AnsCoder()
                for symbols, model, parameters in reversed(self._puts):
                    stack.encode_reverse(symbols, model, *parameters)
                words = stack.get_compressed()
        return bytes(words.astype("<u4", copy=False).tobytes())


class SymbolReader:
    """Decodes what a SymbolWriter wrote, asked for in the same order with the same models.

    Wrong models or damaged bytes give plausible symbols, never an error: compare `crc` with the writer's.
    """

    def __init__(self, data: bytes | memoryview, *, last_in_first_out: bool = False) -> None:
        if len(data) % 4:
            raise BitstreamError(f"{len(data):,} coded bytes are not whole 32-bit words")
        words = np.frombuffer(data, "<u4").astype(np.uint32, copy=False)
        with guarded(BitstreamError, "entropy decoding"):
            if last_in_first_out:
                self._coder = constriction.stream.stack.AnsCoder(words)
            else:
                self._coder = constriction.stream.queue.RangeDecoder(words)
        self.crc = 0
        self.count = 0

    def get(self, count: int, spec: ModelSpec) -> np.ndarray:
        """The next `count` symbols, int32."""
        check_length(spec, count)
        if count == 0:
            return np.empty(0, np.int32)
        symbols = self.get_unchecked(count, spec)
        self.crc = checksum.crc32(np.ascontiguousarray(symbols, "<i4"), self.crc)
        self.count += count
        return symbols

    def get_unchecked(self, count: int, spec: ModelSpec) -> np.ndarray:
        """As `get` for count > 0, without `crc` and `count`."""
        if not isinstance(spec, Tables):
            return self._decode(count, spec)
        symbols = np.empty(count, np.int32)
        for table, positions in _groups(spec):
            symbols[positions] = self._decode(len(positions), table)
        return symbols

    def _decode(self, count: int, spec: ModelSpec) -> np.ndarray:
        settled = _settled(spec)
        if settled is not None:
            return np.full(count, settled, np.int32)
        with guarded(BitstreamError, "entropy decoding"):
            model, parameters = _model(spec)
            decoded = self._coder.decode(model, *parameters) if parameters else self._coder.decode(model, count)
        return np.asarray(decoded, np.int32)

    def check(self, crc: int) -> None:
        """Raise BitstreamError unless the symbols decoded so far are those that were written."""
        if self.crc != crc:
            raise BitstreamError("the decoded symbols do not match their CRC-32: damaged data or a wrong model")
