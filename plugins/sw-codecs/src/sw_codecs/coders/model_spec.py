"""Probability models that entropy coders take, as plain arrays.

A Gaussian or Laplace model has bins of unit width at the integers: code k = round(x / step) with mean / step and
scale / step. Float models are evaluated in floating point by the coder, so a file that uses them is tied to the
machine kind; what must decode anywhere goes through tables of integer counts (`gaussian_exact`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar, Union

import numpy as np

MAX_DOMAIN = 1 << 24  # the library has 24-bit probabilities, each symbol of the domain gets at least one
K_LIMIT = 1 << 30


def _parameter(value: Any, name: str, *, positive: bool = False) -> np.ndarray:
    array = np.asarray(value, np.float64)
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {list(array.shape)}, must be a number or one per symbol")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds values that are not finite")
    if positive and not (array > 0).all():
        raise ValueError(f"{name} holds values that are not positive")
    return array


def _check_domain(kmin: int, kmax: int) -> None:
    if not (-K_LIMIT <= kmin <= kmax <= K_LIMIT):
        raise ValueError(f"domain {kmin}..{kmax} is empty or out of range")
    if kmax - kmin >= MAX_DOMAIN:
        raise ValueError(f"domain {kmin}..{kmax} is wider than 2^24 symbols")


Spec = TypeVar("Spec")


def unchecked(kind: type[Spec], **fields: Any) -> Spec:
    """A model made of fields that were checked before: looking at ten million parameters again takes its time."""
    made = object.__new__(kind)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


def changed(spec: Spec, **fields: Any) -> Spec:
    """A copy of `spec` with other fields, unchecked."""
    return unchecked(type(spec), **{**vars(spec), **fields})


def _cut(array: np.ndarray | float, start: int, stop: int) -> np.ndarray | float:
    return array if np.ndim(array) == 0 else np.asarray(array)[start:stop]


@dataclass(frozen=True)
class Gaussian:
    """mu, sigma: a number, or one per symbol; in units of the step. Symbols lie in kmin..kmax, tails folded in."""

    mu: np.ndarray | float
    sigma: np.ndarray | float
    kmin: int
    kmax: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "mu", _parameter(self.mu, "mu"))
        object.__setattr__(self, "sigma", _parameter(self.sigma, "sigma", positive=True))
        _check_domain(self.kmin, self.kmax)

    def part(self, start: int, stop: int) -> Gaussian:
        return changed(self, mu=_cut(self.mu, start, stop), sigma=_cut(self.sigma, start, stop))


@dataclass(frozen=True)
class Laplace:
    """mu, b: a number, or one per symbol; density exp(-|x - mu| / b) / 2b. Symbols lie in kmin..kmax."""

    mu: np.ndarray | float
    b: np.ndarray | float
    kmin: int
    kmax: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "mu", _parameter(self.mu, "mu"))
        object.__setattr__(self, "b", _parameter(self.b, "b", positive=True))
        _check_domain(self.kmin, self.kmax)

    def part(self, start: int, stop: int) -> Laplace:
        return changed(self, mu=_cut(self.mu, start, stop), b=_cut(self.b, start, stop))


def _counts(value: Any, ndim: int) -> np.ndarray:
    counts = np.asarray(value)
    if counts.ndim != ndim or counts.shape[-1] < 1 or counts.shape[-1] > MAX_DOMAIN:
        raise ValueError(f"counts have shape {list(counts.shape)}, must have {ndim} axes and 1..2^24 symbols")
    if not np.issubdtype(counts.dtype, np.integer):
        raise ValueError(f"counts must be integers, not {counts.dtype}: they are part of the format")
    totals = counts.sum(-1, dtype=np.float64)
    if counts.size and (counts.min() < 0 or totals.min() <= 0 or totals.max() >= 2.0**53):
        raise ValueError("counts must be non-negative with a positive sum below 2^53")
    return counts.astype(np.float64)  # float64 is part of the format: float32 gives other bitstreams


@dataclass(frozen=True)
class Table:
    """counts [K] integers >= 0: symbol s in 0..K-1 has probability counts[s] / sum. One table for all symbols.

    A symbol with count 0 can be coded, at 24 bits; if only one count is positive no other symbol can.
    """

    counts: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "counts", _counts(self.counts, 1))

    def part(self, start: int, stop: int) -> Table:
        return self


@dataclass(frozen=True)
class Tables:
    """counts [T, K] integers, index [n] in 0..T-1: symbol i is coded with table index[i]."""

    counts: np.ndarray
    index: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "counts", _counts(self.counts, 2))
        index = np.asarray(self.index)
        if index.ndim != 1 or not np.issubdtype(index.dtype, np.integer):
            raise ValueError("the table index must be one integer per symbol")
        if index.size and not (index.min() >= 0 and index.max() < len(self.counts)):
            raise ValueError(f"the table index must lie in 0..{len(self.counts) - 1}")
        object.__setattr__(self, "index", index)

    def part(self, start: int, stop: int) -> Tables:
        return changed(self, index=self.index[start:stop])


@dataclass(frozen=True)
class Bernoulli:
    """p: probability of a 1, a number or one per symbol. Symbols are 0 and 1."""

    p: np.ndarray | float

    def __post_init__(self) -> None:
        p = _parameter(self.p, "p")
        if p.size and not (p.min() >= 0 and p.max() <= 1):
            raise ValueError("p holds values outside 0..1")
        # The library needs both symbols possible; 2^-24 is the smallest probability it has.
        object.__setattr__(self, "p", np.clip(p, 2.0**-24, 1 - 2.0**-24))

    def part(self, start: int, stop: int) -> Bernoulli:
        return changed(self, p=_cut(self.p, start, stop))


@dataclass(frozen=True)
class Uniform:
    """Symbols 0..size-1, all equally likely; 1 <= size < 2^24."""

    size: int

    def __post_init__(self) -> None:
        if not 1 <= self.size < MAX_DOMAIN:
            raise ValueError(f"uniform size {self.size} is not in 1..2^24-1")

    def part(self, start: int, stop: int) -> Uniform:
        return self


ModelSpec = Union[Gaussian, Laplace, Table, Tables, Bernoulli, Uniform]  # noqa: UP007 (used at run time on 3.10)


def domain(spec: ModelSpec) -> tuple[int, int]:
    """The smallest and largest symbol that `spec` can code."""
    if isinstance(spec, (Gaussian, Laplace)):
        return spec.kmin, spec.kmax
    if isinstance(spec, (Table, Tables)):
        return 0, spec.counts.shape[-1] - 1
    if isinstance(spec, Bernoulli):
        return 0, 1
    return 0, spec.size - 1


def as_symbols(symbols: Any) -> np.ndarray:
    """`symbols` as an array [n]. Raises ValueError unless they are a list of integers."""
    symbols = np.asarray(symbols)
    if symbols.ndim != 1 or not np.issubdtype(symbols.dtype, np.integer):
        raise ValueError(f"symbols must be a list of integers, not {symbols.dtype} of shape {list(symbols.shape)}")
    return symbols


def check_length(spec: ModelSpec, n: int) -> None:
    """Raise ValueError if `spec` has per-symbol parameters for another number of symbols than n."""
    for name in ("mu", "sigma", "b", "p", "index"):
        array = getattr(spec, name, None)
        if isinstance(array, np.ndarray) and array.ndim == 1 and len(array) != n:
            raise ValueError(f"{n} symbols, but {name} has {len(array)} values")
