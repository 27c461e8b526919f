"""Entropy model `conditional-gaussian`: rows of integers whose distributions a context model predicts row by row.

What codes anchor attributes: a block of n rows with C numbers each, mean and scale for every number, one quantiser step
a row; numbers that are not there (of a masked offset) are left out. Mode `exact` takes integers and decodes on any
machine (`gaussian_exact`); mode `float` takes the floats of a network, and decodes only where that network gives the
same floats again: for comparison with published sizes. Source: specification of the codec library, coder modes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.coders.arithmetic import RangeCoder
from sw_codecs.coders.model_spec import K_LIMIT, Gaussian
from sw_codecs.entropy.gaussian_exact import GaussianExact
from sw_codecs.entropy.lattice import lattice
from sw_codecs.entropy.rates import gaussian_bits
from sw_codecs.entropy.rows import Numbers, RowContext, RowLattice
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

BLOCK_SYMBOLS = 1 << 20
FLOAT_LATTICE = 16  # means and deviations in steps are rounded to 1/16
FLOAT_DOMAIN = 1 << 22  # symbols of a block lie within this of one another


class ConditionalGaussian:
    """mode: "exact" or "float"; see the module. One object codes any number of blocks."""

    Context = RowContext
    MODES = ("exact", "float")

    def __init__(self, mode: str = "exact") -> None:
        if mode not in self.MODES:
            raise ValueError(f"mode is '{mode}', must be one of {', '.join(self.MODES)}")
        self.mode = mode
        self._exact, self._range = GaussianExact(), RangeCoder()

    def encode(self, symbols: Numbers, context: RowContext | RowLattice, present: Numbers | None = None) -> bytes:
        """Bytes of one block.

        symbols     [n,C] integers
        present     [n,C] bool: others are not coded; None: all are

        Raises ValueError for parameters that are not finite or out of range.
        """
        values, where = _array(symbols), _where(present)
        if self.mode == "exact":
            coded = values.reshape(-1) if present is None else values[where]
            return self._exact.encode_at(coded, *_on_lattice(context, present))
        coded = values[where].reshape(-1)
        if not len(coded):
            return b""
        low, high = int(coded.min()), int(coded.max())
        head = write_varint(low + K_LIMIT) + write_varint(high - low)
        return head + self._range.encode(coded, _floats(context, where, values.shape, low, high))

    def decode(self, data: bytes, context: RowContext | RowLattice, present: Numbers | None = None) -> np.ndarray:
        """int64 [n,C], 0 where `present` is False. Raises BitstreamError."""
        where = _where(present)
        shape = tuple(np.shape(context.centre if isinstance(context, RowLattice) else context.mean))
        found = np.zeros(shape, np.int64)
        try:
            if self.mode == "exact":
                coded = self._exact.decode_at(data, *_on_lattice(context, present))
            else:
                coded = self._decode_floats(data, context, where, shape)
        except ValueError as error:
            raise BitstreamError(str(error)) from error
        found[where] = coded if where is not Ellipsis else coded.reshape(shape)
        return found

    def decode_into(
        self, values: Tensor, data: bytes, context: RowContext | RowLattice, step: Tensor, present: Tensor | None = None
    ) -> Tensor:
        """As `decode`, a tensor; and write integer * step into `values`.

        values      float32 [n,C] on the CPU, may be a part of a larger tensor
        step        [n,1] float64
        """
        if self.mode == "exact" and values.stride(-1) == 1 and EXACT.try_load():
            there = None if present is None else present.to(torch.bool).contiguous()
            try:
                where = _on_lattice(context, there)
            except ValueError as error:
                raise BitstreamError(str(error)) from error
            symbols = torch.from_numpy(self._exact.decode_at(data, *where))
            found: Tensor = exact_operations.put_values(symbols, there, step.contiguous(), values)
            return found
        found = torch.from_numpy(self.decode(data, context, present))
        values.copy_(found * step)
        return found

    def bits(self, symbols: Numbers, context: RowContext | RowLattice, present: Numbers | None = None) -> Tensor:
        """Bits that `encode` spends on each symbol, float64 [n,C] on the CPU, 0 where `present` is False; no gradient.

        In mode `exact` from the very tables that it uses. Framing is not counted.
        """
        values, where = _array(symbols), _where(present)
        found = np.zeros(values.shape)
        coded = values[where].reshape(-1)
        if self.mode == "exact":
            bits = self._exact.table_bits_at(coded, *_on_lattice(context, present))
        else:
            low, high = int(coded.min(initial=0)), int(coded.max(initial=0))
            spec = _floats(context, where, values.shape, low, high)
            values64, mu, sigma = (
                torch.from_numpy(np.asarray(each, np.float64)) for each in (coded, spec.mu, spec.sigma)
            )
            bits = gaussian_bits(values64, mu, sigma, 1.0).numpy()
        found[where] = bits if where is not Ellipsis else bits.reshape(values.shape)
        return torch.from_numpy(found)

    def _decode_floats(self, data: bytes, context: RowContext, where: Any, shape: tuple[int, ...]) -> np.ndarray:
        count = int(np.count_nonzero(where)) if where is not Ellipsis else int(np.prod(shape))
        reader = ByteReader(data)
        if not count:
            reader.finish()
            return np.empty(0, np.int64)
        low = reader.varint(2 * K_LIMIT) - K_LIMIT
        high = low + reader.varint(FLOAT_DOMAIN)
        spec = _floats(context, where, shape, low, high)
        return self._range.decode(bytes(reader.take(reader.left)), count, spec).astype(np.int64)

    @staticmethod
    def step_multipliers(outputs: Numbers, offset: int = 0) -> np.ndarray:
        """Multipliers for step outputs t (integers, 12 fractional bits): round(4096 (1 + tanh t)), at least 64, plus
        `offset`."""
        return GaussianExact.step_multipliers(_array(outputs)) + offset

    @staticmethod
    def blocks(rows: int, columns: int) -> list[slice]:
        """Slices that cut `rows` rows of at most `columns` numbers into blocks of at most 2^20 numbers."""
        size = max(1, BLOCK_SYMBOLS // max(columns, 1))
        return [slice(start, min(start + size, rows)) for start in range(0, rows, size)]

    @staticmethod
    def join(blocks: Sequence[bytes]) -> bytes:
        """Blocks as one section: varint length and bytes of each."""
        return b"".join(write_varint(len(block)) + block for block in blocks)

    @staticmethod
    def split(data: bytes, count: int) -> Iterator[bytes]:
        """The `count` blocks that `join` put together; to be used up, so that what follows them is noticed.

        Raises BitstreamError.
        """
        reader = ByteReader(data)
        for _ in range(count):
            yield bytes(reader.take(reader.varint(reader.left)))
        reader.finish()


def _array(values: Any) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def _where(present: Any) -> Any:
    return Ellipsis if present is None else _array(present).astype(bool)


def _spread(context: RowContext, where: Any, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Mean, scale and step of each number that is coded, flat."""
    return [
        np.broadcast_to(_array(each), shape)[where].reshape(-1) for each in (context.mean, context.scale, context.step)
    ]


def _on_lattice(context: RowContext | RowLattice, present: Numbers | None) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of each mean and table number of each number that is coded, flat. Raises ValueError."""
    where = None if present is None else _where(present)
    if isinstance(context, RowLattice):
        return context.present(where)
    return lattice(context.mean, context.scale, context.step, where)


def _floats(context: RowContext, where: Any, shape: tuple[int, ...], low: int, high: int) -> Gaussian:
    mean, scale, step = (each.astype(np.float64) for each in _spread(context, where, shape))
    with np.errstate(all="ignore"):  # what is not finite is refused by the model
        mu = np.rint(mean / step * FLOAT_LATTICE) / FLOAT_LATTICE
        sigma = np.maximum(np.rint(scale / step * FLOAT_LATTICE), 1) / FLOAT_LATTICE
    return Gaussian(mu, sigma, low, high)
