"""Entropy model `gaussian-exact`: integer parameters, shipped count tables, any machine.

Mean and scale reach the coder as integers with 12 fractional bits (from an integer network, see `integer_mlp`), are
put on a lattice with integer arithmetic alone, and select one of 512 shipped tables. Symbols are coded table by table,
which is also several times faster than a model per symbol. Source: specification of the codec library, exact mode,
rules 3 to 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_codecs.coders.model_spec import as_symbols
from sw_codecs.entropy import exact_streams, exact_version_1
from sw_codecs.entropy.exact_streams import SYMBOL_LIMIT
from sw_codecs.entropy.exact_tables import exact_tables, step_multipliers
from sw_codecs.entropy.lattice import UNIT, lattice
from sw_codecs.entropy.rates import CODER_FLOOR, gaussian_bits

Numbers = np.ndarray | Tensor


@dataclass(frozen=True)
class FloatContext:
    """Context of `bits`: mean, scale, step as float tensors that broadcast with the values, in the same unit.

    smallest_probability    floor of the probability of a value; the default is the coder's, HAC trains with 1e-6
    grad_below_bound        whether what lies below the floor is still pulled (`sw_codecs.entropy.rates.lower_bound`)
    """

    mean: Tensor | float
    scale: Tensor | float
    step: Tensor | float = 1.0
    smallest_probability: float = CODER_FLOOR
    grad_below_bound: bool = True

    @property
    def bound(self) -> dict[str, Any]:
        return {"p_min": self.smallest_probability, "grad_below_bound": self.grad_below_bound}


@dataclass(frozen=True)
class IntegerContext:
    """Context of `encode` and `decode`: integers [n] in units of the base step with 12 fractional bits.

    mean, scale     int64 [n], |value| < 2^48; a scale below the smallest level (0.05 steps) counts as that level
    multiplier      64..16384 [n] or one number: the step is base step * multiplier / 4096 (`step_multipliers`)

    They must be computed exactly, or the decoder falls out of step: floats rounded to integers are not exact.
    """

    mean: np.ndarray
    scale: np.ndarray
    multiplier: np.ndarray | int = UNIT


Floats = FloatContext
Integers = IntegerContext


class GaussianExact:
    """Codes integer symbols [n], |k| < 2^30, in units of the step: a Gaussian with mean and standard deviation each.

    What a caller builds is reached through the class, so that whoever got it from the registry needs no import:
    `model.FloatContext(...)`, `model.IntegerContext(...)`, `model.step_multipliers(outputs)`.
    """

    FloatContext = Floats
    IntegerContext = Integers
    step_multipliers = staticmethod(step_multipliers)

    def bits(self, symbols: Tensor, context: Floats) -> Tensor:
        """Bits of each value (its unit is the context's; rounded or with noise added); differentiable."""
        return gaussian_bits(symbols, context.mean, context.scale, context.step, **context.bound)

    def table_bits(self, symbols: np.ndarray, context: Integers) -> np.ndarray:
        """Bits that `encode` spends on each symbol, float64 [n], from the very tables it uses; no gradient."""
        symbols = _check_symbols(symbols)
        return exact_streams.table_bits("gaussian", symbols, *_flat_lattice(context, len(symbols)))

    def encode(self, symbols: np.ndarray, context: Integers) -> bytes:
        """Bytes of independent streams (`exact_streams`), decoded again and compared.

        Raises ValueError for symbols or parameters out of range.
        """
        symbols = _check_symbols(symbols)
        return exact_streams.encode("gaussian", symbols, *_flat_lattice(context, len(symbols)))

    def decode(self, data: bytes, context: Integers) -> np.ndarray:
        """int32 [n], n as in the context. Raises BitstreamError for damage, a wrong context or other tables."""
        try:
            centre, number = _flat_lattice(context, len(np.asarray(context.mean)))
        except ValueError as error:
            raise BitstreamError(str(error)) from error
        return self.decode_at(data, centre, number)

    @staticmethod
    def encode_at(symbols: np.ndarray, centre: np.ndarray, number: np.ndarray) -> bytes:
        """As `encode`, for what `lattice.lattice` gave."""
        return exact_streams.encode("gaussian", _check_symbols(symbols), centre, number)

    @staticmethod
    def table_bits_at(symbols: np.ndarray, centre: np.ndarray, number: np.ndarray) -> np.ndarray:
        """As `table_bits`, for what `lattice.lattice` gave."""
        return exact_streams.table_bits("gaussian", _check_symbols(symbols), centre, number)

    @staticmethod
    def decode_at(data: bytes, centre: np.ndarray, number: np.ndarray) -> np.ndarray:
        """As `decode`, for what `lattice.lattice` gave. Raises BitstreamError."""
        if data[:2] == b"\x01\x00":
            reader = ByteReader(data)
            exact_tables().check(reader.integer(2), reader.integer(4))
            return exact_version_1.decode_chunks(reader, centre, number)
        return exact_streams.decode("gaussian", data, centre, number)


def _check_symbols(symbols: Any) -> np.ndarray:
    symbols = as_symbols(symbols)
    if symbols.size and (symbols.min() <= -SYMBOL_LIMIT or symbols.max() >= SYMBOL_LIMIT):
        raise ValueError("a symbol is beyond 2^30")
    return symbols


def _flat_lattice(context: IntegerContext, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of each mean, in steps, and table numbers, [n] each."""
    fields = {name: np.asarray(getattr(context, name)) for name in ("mean", "scale", "multiplier")}
    for name, array in fields.items():
        if not np.issubdtype(array.dtype, np.integer) or array.shape not in ((n,), ()):
            raise ValueError(f"{name} must be {n} integers, not {array.dtype} of shape {list(array.shape)}")
    return lattice(*(np.broadcast_to(each, (n,)).reshape(n, 1) for each in fields.values()))
