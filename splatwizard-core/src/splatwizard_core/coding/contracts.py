"""The contracts of what plugins provide for files: quantizers, entropy and context models, coders, codecs of models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from torch import Tensor

if TYPE_CHECKING:
    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.gaussians.model import GaussianModel


class Quantizer(Protocol):
    """Two faces of one object: a differentiable surrogate for training, exact lattice indices for the file."""

    def forward(self, x: Tensor) -> Tensor:
        """The surrogate; same shape, differentiable."""
        ...

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Integer symbols, and what `decode` needs besides (JSON-able values or numpy arrays)."""
        ...

    def decode(self, symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """Values; `encode` of the result gives the same symbols."""
        ...


class EntropyModel(Protocol):
    """Rate estimate for training and the real thing for the file; the two agree within 2 % on 10^5 symbols."""

    def bits(self, symbols: Tensor, context: Any) -> Tensor:
        """Bits per element, shape of `symbols`, differentiable."""
        ...

    def encode(self, symbols: np.ndarray, context: Any) -> bytes: ...

    def decode(self, data: bytes, context: Any) -> np.ndarray: ...


class EntropyCoder(Protocol):
    """Symbols under a ModelSpec to bytes and back, with chunking, CRC and range checks.

    The class has the models that it takes as attributes of `specs`: `coder.specs.Table(counts)`.
    """

    specs: Any

    def encode(self, symbols: np.ndarray, model: Any) -> bytes: ...

    def decode(self, data: bytes, n: int, model: Any) -> np.ndarray: ...


class PositionCodec(Protocol):
    """Integer points as a sorted multiset: both sides sort by Morton code, attributes follow that order."""

    def encode(self, points: np.ndarray, bits: int) -> bytes:
        """points [N,3] integer, 0 <= p < 2^bits, already in Morton order (duplicates allowed)."""
        ...

    def decode(self, data: bytes) -> np.ndarray:
        """[N,3] int64, in Morton order. Raises BitstreamError."""
        ...


class ContextModel(Protocol):
    """Predicts parameters of entropy models from what is already decoded: a module that trains with its method."""

    def __call__(self, *inputs: Any) -> Tensor:
        """Differentiable features or parameters, one row for each row of the inputs."""
        ...


class ArrayCoder(Protocol):
    """Arrays of numbers without loss, shape and dtype included."""

    def encode(self, array: np.ndarray) -> bytes: ...

    def decode(self, data: bytes) -> np.ndarray: ...


class GaussianCodec(Protocol):
    """Turns a GaussianModel into sections of a file and back. The class takes (plugins, **settings)."""

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Write everything that `decode` needs; leaves the model as it is."""
        ...

    def decode(self, reader: ContainerReader) -> GaussianModel:
        """The inverse. Raises BitstreamError."""
        ...
