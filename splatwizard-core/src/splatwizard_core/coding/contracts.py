"""Contracts of what plugins provide for files: quantizers, entropy and context models, coders, codecs of models.

The registries are typed with them. A registered target is a class or function that makes such an object, its settings
by keyword, each with a default: called without arguments (with the plugin manager alone where a contract says so) it
makes one that decodes whatever another of its name has encoded. A context model is the exception: it is built to
measure. Encoding changes no argument, and equal arguments give equal bytes. `encode` raises ValueError for what it
cannot code; `decode` raises BitstreamError for bytes that `encode` did not write, in memory bounded by what it is told
to expect. `sw_codecs.testing` holds a provider to all this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

if TYPE_CHECKING:
    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.gaussians.model import GaussianModel

Points = TypeVar("Points", np.ndarray, Tensor)


@runtime_checkable
class Quantizer(Protocol):
    """Values to integers and back: a differentiable surrogate for training, exact symbols for the file."""

    def forward(self, x: Tensor) -> Tensor:
        """The quantized values in the shape of x, with a gradient to x."""

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Symbols int64 on the device of x, and what `decode` needs besides: JSON values or numpy arrays."""

    def decode(self, symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """Values float32, those of `forward` without noise; needs no state: a new object gives the same ones."""


@runtime_checkable
class EntropyModel(Protocol):
    """Probabilities of symbols: the rate in training, and the bytes in the file, within 2 % of it for 10^5 symbols.

    context     what the distribution depends on besides; each model states its kind. Encoder and decoder must give the
                same; a model whose statistics stand in the file needs the shape alone to decode
    """

    def bits(self, symbols: Tensor, context: Any) -> Tensor:
        """Bits of each symbol in the shape of `symbols`; differentiable where the model is trained."""

    def encode(self, symbols: np.ndarray, context: Any) -> bytes:
        """The bytes of integer symbols."""

    def decode(self, data: bytes, context: Any) -> np.ndarray:
        """The symbols, integers or bool."""


@runtime_checkable
class ContextModel(Protocol):
    """Predicts parameters of entropy models from what is already decoded: a module that trains with its method.

    How it is built and how the decoder evaluates it in integers is its own: a method that has one as a fixed part
    imports it.
    """

    def __call__(self, *inputs: Any, **options: Any) -> Tensor | tuple[Tensor, ...]:
        """Differentiable features or parameters for each row (or place) of the inputs."""


@runtime_checkable
class EntropyCoder(Protocol):
    """Integer symbols under a probability model to bytes and back. Declared `codes="symbols"`.

    specs   holds the classes of models that it takes, such as `specs.Table(counts)`
    """

    @property
    def specs(self) -> Any: ...

    def encode(self, symbols: np.ndarray, model: Any) -> bytes:
        """The bytes of symbols [n] integers within the domain of the model; none for none."""

    def decode(self, data: bytes, n: int, model: Any) -> np.ndarray:
        """The n symbols, int32 [n]."""


@runtime_checkable
class PositionCodec(Protocol):
    """Integer points as a sorted multiset, in Morton order on both sides. Declared `codes="positions"`.

    The setting `max_points` bounds what `decode` accepts.
    """

    def sort(self, points: Points) -> Points:
        """Indices int64 [N] that bring points [N,3] into the order of `encode`; attributes follow them."""

    def encode(self, points: np.ndarray, bits: int) -> bytes:
        """The bytes of points [N,3] integer, 0 <= p < 2^bits, bits 1..21, in order; duplicates are kept."""

    def decode(self, data: bytes) -> np.ndarray:
        """Points int64 [N,3], in order."""


@runtime_checkable
class ArrayCoder(Protocol):
    """Arrays of numbers without loss, row after row; shape and dtype stand elsewhere. Declared `codes="arrays"`."""

    def encode(self, array: np.ndarray) -> bytes:
        """The bytes of an array [N, ...] of a dtype that the coder takes."""

    def decode(self, data: bytes, dtype: npt.DTypeLike, shape: Sequence[int]) -> np.ndarray:
        """The array in native byte order, writable. A shape from a file is held against `reader.allow` first."""


@runtime_checkable
class VectorCoder(Protocol):
    """Float vectors, more loss for less important ones. Declared `codes="vectors"`; made with (plugins, **settings).

    device  where `encode` may compute; bytes are the same for the same device
    """

    device: torch.device | str

    def encode(self, vectors: np.ndarray, importance: np.ndarray, seed: int = 0) -> dict[str, bytes]:
        """Named parts for vectors [n,d] and their importance [n]."""

    def decode(self, parts: Mapping[str, bytes], n: int, d: int) -> np.ndarray:
        """Vectors float32 [n,d]. An n from a file is held against `reader.allow` first."""


@runtime_checkable
class GaussianCodec(Protocol):
    """A GaussianModel as sections of a file. Declared `codes="gaussians"`; made with (plugins, **settings).

    Values that it needs lie in the header's `static`, beside others that it leaves alone: `codec`, its own name, and
    `method`, those of the method that uses it.
    """

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Write everything that `decode` needs; leaves the model as it is."""

    def decode(self, reader: ContainerReader) -> GaussianModel:
        """The model; the settings of the encoder are not needed."""
