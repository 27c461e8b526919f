"""Entropy model `wavefront`: integer planes, each value after the twelve neighbours that its distribution hangs on.

Files are written as independent streams (`plane_streams`); those of version 1, one stream for all planes, are read.
Everything is in integers: the symbols depend neither on how rows are batched nor on the number of threads. Source:
CAT-3DGS (arXiv 2503.00357) for the order, the exact mode of the codec library (rules 3 to 6) for the tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_cat_3dgs import plane_streams
from sw_cat_3dgs.plane_fields import Field, PlaneModel, Shape, lattice_of, predicted
from sw_codecs.entropy.exact_streams import table_bits
from sw_codecs.entropy.exact_version_1 import ExactReader

SYMBOL_LIMIT = 1 << 24


@dataclass(frozen=True)
class PlaneContext:
    """Models and sizes of the planes of one scene.

    models      one for each plane orientation, such as `ExactSpatialAr`
    shapes      (C, H, W) per scale: planes are [K, C, H, W], K = len(models)
    """

    models: Sequence[PlaneModel]
    shapes: Sequence[Shape]

    @staticmethod
    def join(planes: Sequence[np.ndarray]) -> np.ndarray:
        """Symbols [n] of planes [K, C, H, W] per scale, one after another."""
        flat = [plane.reshape(-1) for plane in planes]
        return np.concatenate(flat or [np.empty(0, np.int64)])

    def split(self, symbols: np.ndarray) -> list[np.ndarray]:
        """Inverse of `join`."""
        shapes = [(len(self.models), *shape) for shape in self.shapes]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        return [part.reshape(shape) for part, shape in zip(np.split(symbols, ends), shapes, strict=False)]


class PlaneCoder:
    """Codes the symbols [n] of all planes of a scene (`PlaneContext.join`), |value| < 2^24."""

    Context = PlaneContext

    def bits(self, symbols: Tensor, context: PlaneContext) -> Tensor:
        """Bits that `encode` spends on each symbol, float64 [n] on the CPU, from the very tables; no gradient."""
        found = []
        for plane in context.split(_checked(symbols.detach().cpu().numpy())):
            field = Field(len(plane), (plane.shape[1], plane.shape[2], plane.shape[3]))
            field.fill(plane)
            centre, number = predicted(field, context.models)
            found.append(table_bits("laplace", plane.reshape(-1), centre.reshape(-1), number.reshape(-1)))
        return torch.from_numpy(np.concatenate([np.empty(0), *found]))

    def encode(self, symbols: np.ndarray, context: PlaneContext) -> bytes:
        """Bytes of the symbols; decoded again and compared. Raises ValueError for values of 2^24 or more."""
        return plane_streams.encode(context.split(_checked(symbols)), context.models)

    def decode(self, data: bytes, context: PlaneContext) -> np.ndarray:
        """Symbols int32 or int64 [n].

        Memory and time grow with the shapes, which the caller bounds. Raises BitstreamError for damage or other models.
        """
        read = _read_version_1 if data[:2] == b"\x01\x00" else plane_streams.decode
        return context.join(read(data, context.shapes, context.models))


def _read_version_1(data: bytes, shapes: Sequence[Shape], models: Sequence[PlaneModel]) -> list[np.ndarray]:
    fields = [Field(len(models), shape) for shape in shapes]
    reader = ExactReader("laplace", data)
    for step in _steps(fields):
        due = [(field, at) for field in fields if len(at := field.step(step))]
        found = [lattice_of(models, [field.neighbors(k, at) for k in range(len(models))]) for field, at in due]
        symbols = reader.get(*(np.concatenate([each[i] for each in found]) for i in (0, 1)))
        if np.abs(symbols).max(initial=0) >= SYMBOL_LIMIT:
            raise BitstreamError("a value of a plane is beyond 2^24: damaged data or other models")
        start = 0
        for field, at in due:
            count = field.rows * len(at)
            field.put(at, symbols[start : start + count])
            start += count
    reader.finish()
    return [field.planes() for field in fields]


def _steps(fields: Sequence[Field]) -> list[int]:
    """The steps in which some plane has values: narrow planes leave gaps."""
    return [s for s in range(max((f.steps for f in fields), default=0)) if any(len(f.step(s)) for f in fields)]


def _checked(symbols: np.ndarray) -> np.ndarray:
    """Integers [n]. Raises ValueError for something else."""
    if symbols.ndim == 1 and symbols.dtype.kind == "f" and (symbols == np.rint(symbols)).all():
        symbols = symbols.astype(np.int64)
    if symbols.ndim != 1 or not np.issubdtype(symbols.dtype, np.integer):
        raise ValueError(f"values of planes must be integers [n], not {symbols.dtype} {list(symbols.shape)}")
    if symbols.size and np.abs(symbols).max() >= SYMBOL_LIMIT:
        raise ValueError("a value of a plane is beyond 2^24")
    return symbols
