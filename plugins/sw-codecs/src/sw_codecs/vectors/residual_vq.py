"""Coder `residual-vq`: each vector as a sum of codebook entries, one of each stage; indices entropy coded or packed.

Parts (docs/bitstream.md):

    header      u8 version, u8 1 if codebooks are float16, u8 stages S, u16 entries K of a stage, u32 vectors n, then
                the name of the coder of the indices in ASCII
    codebooks   [S, K, d], float32 or float16
    indices     [n, S], stage by stage within a vector: `packed-bits`; else `categorical` with that entropy coder and a
                table of K symbols for each stage

Source: Compact 3D Gaussian Representation (arXiv 2311.13681), 6 stages of 64 entries, packed or Huffman coded.
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
from sw_codecs.arrays.packed_bits import PackedBits
from sw_codecs.entropy.categorical import Categorical, CategoricalContext
from sw_codecs.quantizers.residual_quantizer import ResidualVectorQuantizer

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager

VERSION = 1
HEADER = struct.Struct("<BBBHI")
PACKED = "packed-bits"
MAX_SIZE = 1 << 15
MAX_STAGES = 16


class ResidualVQSettings(Params):
    """Settings of the coder `residual-vq`."""

    size: int = Field(64, ge=1, le=MAX_SIZE, description="entries of a stage")
    stages: int = Field(6, ge=1, le=MAX_STAGES, description="stages: entries whose sum is a vector")
    iterations: int = Field(10, ge=0, description="passes of k-means over the vectors for each stage")
    coder: str = Field("huffman", description="of the indices: packed-bits, or an entropy coder that takes tables")
    half: bool = Field(False, description="codebooks in float16")


class ResidualVQ:
    """Float vectors to three byte strings and back.

    size        entries K of a stage, 1..2^15
    stages      S, 1..16
    iterations  passes of k-means over the vectors for each stage
    coder       of the indices: `packed-bits`, or an entropy coder that takes tables, by name
    half        float16 codebooks
    device      where codebooks are fitted and searched; equal arguments give equal bytes on a CPU
    codebooks   [S, K, d] that were trained elsewhere; None: k-means fits them to the vectors
    """

    Settings = ResidualVQSettings

    def __init__(
        self,
        plugins: PluginManager,
        *,
        size: int = 64,
        stages: int = 6,
        iterations: int = 10,
        coder: str = "huffman",
        half: bool = False,
        device: torch.device | str = "cpu",
        codebooks: torch.Tensor | None = None,
    ) -> None:
        if not 1 <= size <= MAX_SIZE or not 1 <= stages <= MAX_STAGES or iterations < 0:
            raise ValueError(
                f"size {size}, stages {stages}, iterations {iterations}: must be in 1..{MAX_SIZE:,}, 1..{MAX_STAGES}, "
                "and >= 0"
            )
        self.plugins, self.size, self.stages, self.iterations = plugins, size, stages, iterations
        self.coder, self.half, self.device, self.codebooks = coder, half, device, codebooks

    def encode(self, vectors: NDArray[Any], importance: NDArray[Any], seed: int = 0) -> dict[str, bytes]:
        """The parts of `vectors` [n, d].

        importance  [n], weights of k-means, those below 0 count as 0; all equal to each other: no matter
        seed        of k-means

        Raises ValueError for values that are not finite and for codebooks of another shape.
        """
        x = torch.from_numpy(np.array(vectors, np.float32)).to(self.device)  # a copy: what is given may be read-only
        n, d = x.shape
        head = HEADER.pack(VERSION, self.half, self.stages, self.size, n) + self.coder.encode("ascii")
        if n == 0:
            return {"header": head, "codebooks": b"", "indices": b""}
        quantizer = ResidualVectorQuantizer(self.size, self.stages, dim=d, half=self.half).to(x.device)
        assert quantizer.codebooks is not None
        if self.codebooks is None:
            weights = torch.from_numpy(np.clip(np.asarray(importance, np.float64), 0, None)).to(x.device)
            generator = torch.Generator().manual_seed(seed)
            quantizer.fit(
                x, weights=weights if float(weights.sum()) > 0 else None,
                iterations=self.iterations, generator=generator,
            )  # fmt: skip
        elif self.codebooks.shape != quantizer.codebooks.shape:
            raise ValueError(f"codebooks {list(self.codebooks.shape)}, must be {list(quantizer.codebooks.shape)}")
        else:
            quantizer.codebooks.data = self.codebooks.detach().to(x)
        symbols, side = quantizer.encode(x)
        books = side["codebooks"]
        return {
            "header": head,
            "codebooks": books.astype(books.dtype.newbyteorder("<")).tobytes(),
            "indices": self._pack(symbols.cpu().numpy()),
        }

    def decode(self, parts: Mapping[str, bytes], n: int, d: int) -> NDArray[np.float32]:
        """The vectors, [n, d] float32. Raises BitstreamError.

        It takes about 8 S bytes a vector besides the result: an n that comes from a file must be held against
        `reader.allow` first.
        """
        for name in ("header", "codebooks", "indices"):
            if name not in parts:
                raise BitstreamError(f"part '{name}' is missing")
        half, stages, size, coder = self._header(parts["header"], n)
        if n == 0:
            if parts["codebooks"] or parts["indices"]:
                raise BitstreamError("parts of no vectors are not empty")
            return np.zeros((0, d), np.float32)
        dtype = np.dtype("<f2" if half else "<f4")
        if len(parts["codebooks"]) != stages * size * d * dtype.itemsize:
            raise BitstreamError(
                f"part 'codebooks' is {len(parts['codebooks']):,} bytes, {stages} of {size:,} entries of {d} numbers "
                f"are {stages * size * d * dtype.itemsize:,}"
            )
        books = np.frombuffer(parts["codebooks"], dtype).reshape(stages, size, d)
        symbols = self._unpack(parts["indices"], n, stages, size, coder)
        return ResidualVectorQuantizer.decode(torch.from_numpy(symbols), {"codebooks": books}).numpy()

    def _header(self, data: bytes, n: int) -> tuple[bool, int, int, str]:
        """Whether codebooks are float16, stages, entries, the coder of the indices."""
        if len(data) < HEADER.size:
            raise BitstreamError(f"part 'header' is {len(data)} bytes, must be {HEADER.size} and a name")
        version, half, stages, size, stated = HEADER.unpack(data[: HEADER.size])
        if version != VERSION or half > 1:
            raise BitstreamError(f"residual-vq data of version {version}, form {half} is not known: upgrade sw-codecs")
        if stated != n or not 1 <= stages <= MAX_STAGES or not 1 <= size <= MAX_SIZE:
            raise BitstreamError(f"{stated:,} vectors of {stages} stages of {size:,} entries, expected {n:,} vectors")
        coder = data[HEADER.size :].decode("ascii", "replace")
        if coder != PACKED and coder not in self.plugins.entropy_coders.names:
            raise BitstreamError(f"the coder of the indices is {coder!r:.80}, which is not installed")
        return bool(half), stages, size, coder

    def _pack(self, symbols: NDArray[np.int64]) -> bytes:
        if self.coder == PACKED:
            return PackedBits(self.size).encode(symbols.reshape(-1))
        model = Categorical(self.plugins.entropy_coders.load(self.coder)())
        return model.encode(symbols.reshape(-1), _context(len(symbols), self.stages, self.size))

    def _unpack(self, data: bytes, n: int, stages: int, size: int, coder: str) -> NDArray[np.int64]:
        if coder == PACKED:
            found = PackedBits(size).decode(data, np.int64, (n * stages,))
        else:
            model = Categorical(self.plugins.entropy_coders.load(coder)())
            found = model.decode(data, _context(n, stages, size))
        return found.astype(np.int64).reshape(n, stages)


def _context(n: int, stages: int, size: int) -> CategoricalContext:
    return CategoricalContext(size, index=np.tile(np.arange(stages, dtype=np.uint8), n), tables=stages)
