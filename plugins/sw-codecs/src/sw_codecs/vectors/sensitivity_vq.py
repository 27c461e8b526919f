"""Coder `sensitivity-vq`: vectors of low sensitivity share a codebook, each other one has an entry of its own; 8 bits.

Source: "Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis" (C3DGS, arXiv 2401.02436).

Parts (docs/bitstream.md):

    header      u8 version, u32 vectors n, u32 entries k
    index       entry of each vector, u16 (u32 for more than 2^16 entries) [n], `byte-planes`
    lattice     f32 [d] steps, then i32 [d] zero points
    entries     u8 [k, d], `byte-planes`
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from splatwizard_core.api import BitstreamError, Params
from sw_codecs.codebooks.sharing import Training, share_vectors
from sw_codecs.quantizers.fake_quant import FakeQuantAffine

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager

VERSION = 1
HEADER = struct.Struct("<BII")
BITS = 8
FLOAT_MAX = 1e30  # beyond it the steps of a lattice, and distances, leave float32


def index_dtype(entries: int) -> np.dtype[Any]:
    """The integers in which a file holds indices into so many entries."""
    return np.dtype(np.uint16 if entries <= 1 << 16 else np.uint32)


class SensitivityVQSettings(Params):
    """Settings of `sensitivity-vq`."""

    threshold: float = Field(0.6e-6, ge=0, description="more sensitive vectors keep their own entry; as the scores")
    size: int = Field(4096, ge=1, le=1 << 20, description="entries that the others share")
    training: Training = Field("batch-mean", description="the published loop; ema: ours; kmeans: passes over all")
    iterations: int = Field(100, ge=0, description="batches, or passes")
    batch: int = Field(1 << 18, ge=1, description="vectors of each batch, at most all; drawn with replacement")
    decay: float = Field(0.8, ge=0, lt=1, description="how much of the codebook each batch leaves")


class SensitivityVQ:
    """Float vectors to four byte strings and back.

    threshold   vectors of higher sensitivity keep their own entry, in the unit of the scores (published for colours:
                0.6e-6, the change of the mean pixel for a change of the colour)
    size        entries that the others share
    training, iterations, batch, decay
                of the shared entries, see `share_vectors`
    device      where they are trained: "cpu", where equal arguments give equal bytes, or "cuda"
    """

    Settings = SensitivityVQSettings

    def __init__(
        self,
        plugins: PluginManager,
        *,
        threshold: float = 0.6e-6,
        size: int = 4096,
        training: Training = "batch-mean",
        iterations: int = 100,
        batch: int = 1 << 18,
        decay: float = 0.8,
        device: torch.device | str = "cpu",
    ) -> None:
        self.plugins, self.threshold, self.size, self.device = plugins, threshold, size, device
        self.training, self.iterations, self.batch, self.decay = training, iterations, batch, decay

    def encode(self, vectors: NDArray[Any], importance: NDArray[Any], seed: int = 0) -> dict[str, bytes]:
        """The parts for `vectors` [n, d], each number within +-1e30.

        importance  [n], their sensitivity: such as the pruner `sensitivity` finds, -inf for what no view shows
        seed        of the codebook's training

        Raises ValueError for a NaN and for shapes that do not fit.
        """
        x = torch.as_tensor(np.asarray(vectors, np.float32))
        if not bool((x.abs() <= FLOAT_MAX).all()):
            raise ValueError(f"a vector holds values that are not numbers within +-{FLOAT_MAX:g}")
        shared = share_vectors(
            x.to(self.device), torch.as_tensor(np.asarray(importance, np.float64)).to(self.device),
            threshold=self.threshold, size=self.size, training=self.training, iterations=self.iterations,
            batch=self.batch, decay=self.decay, generator=torch.Generator().manual_seed(seed),
        )  # fmt: skip
        entries = shared.entries.cpu()
        symbols, side = FakeQuantAffine(BITS, channels=entries.shape[1], zero=False).encode(entries)
        planes = self.plugins.coders.load("byte-planes")()
        return {
            "header": HEADER.pack(VERSION, len(x), len(entries)),
            "index": planes.encode(shared.index.cpu().numpy().astype(index_dtype(len(entries)))),
            "lattice": side["scale"].astype("<f4").tobytes() + side["zero"].astype("<i4").tobytes(),
            "entries": planes.encode(symbols.numpy().astype(np.uint8)),
        }

    def decode(self, parts: Mapping[str, bytes], n: int, d: int) -> NDArray[np.float32]:
        """The vectors, [n, d]. Raises BitstreamError.

        It takes a few times the memory of the result: an n that comes from a file must be held against
        `reader.allow` first.
        """
        for name in ("header", "index", "lattice", "entries"):
            if name not in parts:
                raise BitstreamError(f"part '{name}' is missing")
        if len(parts["header"]) != HEADER.size or len(parts["lattice"]) != 8 * d:
            raise BitstreamError(f"part 'header' must have {HEADER.size} bytes, part 'lattice' {8 * d}")
        version, stated, size = HEADER.unpack(parts["header"])
        if version != VERSION:
            raise BitstreamError(f"part 'header': vectors of version {version} are not known: upgrade sw-codecs")
        if stated != n or size > n or (n and not size):
            raise BitstreamError(f"part 'header': {stated:,} vectors of {size:,} entries, expected {n:,} vectors")
        planes = self.plugins.coders.load("byte-planes")()
        index = planes.decode(parts["index"], index_dtype(size), (n,)).astype(np.int64)
        if len(index) and int(index.max()) >= size:
            raise BitstreamError(f"part 'index': an index is outside the codebook of {size:,} entries")
        symbols = torch.from_numpy(planes.decode(parts["entries"], np.uint8, (size, d)))
        side = {
            "scale": np.frombuffer(parts["lattice"], "<f4", d).reshape(1, d),
            "zero": np.frombuffer(parts["lattice"], "<i4", d, 4 * d).reshape(1, d),
            "bits": np.uint8(BITS),
        }
        found: NDArray[np.float32] = FakeQuantAffine.decode(symbols, side).numpy()[index]
        return found
