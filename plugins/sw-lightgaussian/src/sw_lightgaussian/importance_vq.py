"""Coder `importance-vq`: vectors of little importance share a codebook, the others keep their own in float16.

Source: LightGaussian (arXiv 2311.17245), section on vector quantisation.

Parts (docs/bitstream.md):

    header      u8 version, u8 form of the indices (0 packed bits, 1 range coded), u32 vectors n, u32 entries K of the
                codebook, u32 own vectors k; of version 2, which names parts of others: names in UTF-8 of the entropy
                model of the indices and of the array coder, a zero byte between them
    mask        a bit a vector, 1 where it keeps its own; `packed-bits`, these through `byte-planes`
    indices     of the other vectors, in order: `packed-bits`, or `categorical` where that is shorter
    codebook    float16 [K, d], `byte-planes`
    own         float16 [k, d], `byte-planes`

Settings name another array coder than `byte-planes`, and an entropy model of integers that codes the indices (form 2).
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from splatwizard_core.api import BitstreamError
from sw_codecs.models.exchangeable import NamedParts, codes_arrays, codes_matrices, decoded_matrix, hold_part

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager

VERSION, NAMED = 1, 2
PACKED, RANGE_CODED, BY_NAME = 0, 1, 2
HEADER = struct.Struct("<BBIII")
HALF_MAX = 65504.0
MAX_CODES = 1 << 16

Training = Literal["ema", "official", "kmeans"]


class VQSettings(NamedParts):
    """Settings of `importance-vq`, and of the codec `vectree`."""

    USUAL: ClassVar[dict[str, str]] = {"entropy": "", "arrays": "byte-planes"}

    entropy: str = Field(
        "", description="entropy model of the indices: any that codes integers; empty: `packed-bits` or `categorical`"
    )
    arrays: str = Field("byte-planes", description="coder of arrays of float16 and bytes: any that codes those")

    ratio: float = Field(0.6, ge=0, le=1, description="share of the vectors that share a codebook, the least important")
    size: int = Field(8192, ge=2, le=1 << 16, description="codebook entries at most")
    rows_per_code: float = Field(4, ge=1, description="and no more than one for so many such vectors, a power of two")
    iterations: int = Field(1000, ge=0, description="updates of the codebook")
    batch: int = Field(80_000, ge=1, description="vectors of each update")
    decay: float = Field(0.8, ge=0, lt=1, description="how much of the codebook's averages each update keeps")
    reseed: int = Field(10, ge=0, description="entries that may start afresh after an update")
    training: Training = Field("ema", description="official: the rule of the authors' code; kmeans: passes over all")


class PartError(BitstreamError):
    """A part is damaged: `part` is its name, `reason` what is wrong with it."""

    def __init__(self, part: str, reason: str) -> None:
        super().__init__(f"part '{part}': {reason}")
        self.part, self.reason = part, reason


@dataclass(frozen=True)
class CodedVectors:
    """The form in which a file holds n vectors of d numbers.

    codes       [n] int64: entry of the codebook, -1 for a vector that keeps its own
    codebook    [K, d] float16
    own         [k, d] float16, of the vectors with code -1 in their order
    """

    codes: NDArray[np.int64]
    codebook: NDArray[np.float16]
    own: NDArray[np.float16]

    def vectors(self) -> NDArray[np.float32]:
        """[n, d] float32."""
        found = np.empty((len(self.codes), self.own.shape[1]), np.float32)
        keeps = self.codes < 0
        found[keeps] = self.own
        found[~keeps] = self.codebook[self.codes[~keeps]]
        return found


class ImportanceVQ:
    """Float vectors to five byte strings and back.

    ratio           share of the vectors that is vector-quantised, 0..1: the least important ones
    size            codebook entries at most, up to 2^16
    rows_per_code   and no more than the largest power of two with so many vectors for each entry
    iterations      updates of the codebook while it is trained
    training        by the quantizer `vq`: "ema" or "official" (the authors' rule), weighted batches of `batch` rows
                    with `decay` and up to `reseed` entries that start afresh each time; "kmeans", passes over all rows
    entropy, arrays names of parts, as in `VQSettings`. Raises ConfigError for one that cannot serve
    device          where it is trained: "cpu", where equal arguments give equal bytes, or "cuda"
    """

    Settings = VQSettings

    def __init__(
        self,
        plugins: PluginManager,
        *,
        ratio: float = 0.6,
        size: int = 8192,
        rows_per_code: float = 4,
        iterations: int = 1000,
        batch: int = 80_000,
        decay: float = 0.8,
        reseed: int = 10,
        training: Training = "ema",
        entropy: str = "",
        arrays: str = "byte-planes",
        device: torch.device | str = "cpu",
    ) -> None:
        if not 0 <= ratio <= 1 or not 1 <= size <= MAX_CODES:
            raise ValueError(f"ratio {ratio} and size {size} must be in 0..1 and 1..{MAX_CODES:,}")
        self.plugins, self.ratio, self.size, self.rows_per_code = plugins, ratio, size, rows_per_code
        self.iterations, self.batch, self.decay, self.reseed = iterations, batch, decay, reseed
        self.training, self.device = training, device
        self.entropy, self.arrays = entropy, arrays
        if entropy:
            hold_part(plugins.entropy_models, entropy, "codec.settings.entropy", codes_matrices)
        if arrays != "byte-planes":
            tried = partial(codes_arrays, dtypes=(np.float16, np.uint8))
            hold_part(plugins.array_coders, arrays, "codec.settings.arrays", tried)

    def encode(self, vectors: NDArray[Any], importance: NDArray[Any], seed: int = 0) -> dict[str, bytes]:
        """The parts for `vectors` [n, d], clamped to the range of float16; equal arguments give equal bytes.

        importance  [n], any finite numbers and -inf; of equal ones the first vectors count as more important
        seed        of the codebook's training

        Raises ValueError for a NaN.
        """
        return self.pack(self.quantize(vectors, importance, seed))

    def decode(self, parts: Mapping[str, bytes], n: int, d: int) -> NDArray[np.float32]:
        """The vectors, [n, d]. Raises BitstreamError.

        It takes a few times the memory of the result: an n that comes from a file must be held against
        `reader.allow` first.
        """
        return self.unpack(parts, n, d).vectors()

    def quantize(self, vectors: NDArray[Any], importance: NDArray[Any], seed: int = 0) -> CodedVectors:
        """Choose the vectors that keep their own, and train a codebook whose entries stand for the others."""
        x = np.clip(np.asarray(vectors, np.float32), -HALF_MAX, HALF_MAX)
        importance = np.asarray(importance, np.float64)
        if x.ndim != 2 or importance.shape != x.shape[:1]:
            raise ValueError(f"vectors [n, d] and importance [n], not {list(x.shape)} and {list(importance.shape)}")
        if np.isnan(x).any() or np.isnan(importance).any():
            raise ValueError("a vector or its importance is not a number")
        # Half a billionth more, since 1 - 0.9 is not 0.1.
        keep = math.floor((1 - self.ratio) * len(x) + 1e-9)
        keeps = np.zeros(len(x), bool)
        keeps[np.argsort(-importance, kind="stable")[:keep]] = True
        codes, codebook = np.full(len(x), -1), np.empty((0, x.shape[1]), np.float16)
        if keep < len(x):
            codes[~keeps], codebook = self._codebook(x[~keeps], np.maximum(importance[~keeps], 0), seed)
        return CodedVectors(codes, codebook, x[keeps].astype(np.float16))

    def codebook_size(self, n: int) -> int:
        """Entries that are trained for n vectors."""
        return min(self.size, 1 << int(math.log2(max(2.0, n / self.rows_per_code))))

    def _codebook(
        self, x: NDArray[np.float32], importance: NDArray[np.float64], seed: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float16]]:
        """Codes [n] and the codebook, of which only entries stay that a vector uses."""
        quantizer = self.plugins.quantizers.load("vq")(self.codebook_size(len(x)), decay=self.decay, half=True)
        rows, weights = torch.from_numpy(x).to(self.device), None
        if importance.any():
            weights = torch.from_numpy(importance / importance.max()).to(self.device)
        generator = torch.Generator().manual_seed(seed)
        if self.training == "kmeans":
            quantizer.fit(rows, weights=weights, iterations=self.iterations, generator=generator)
        else:
            quantizer.train(
                rows, weights, self.iterations, self.batch,
                generator=generator, rule=self.training, reseed=self.reseed,
            )  # fmt: skip
        index, side = quantizer.encode(rows)
        used, codes = np.unique(index.cpu().numpy(), return_inverse=True)
        return codes.astype(np.int64), side["codebook"][used]

    def pack(self, coded: CodedVectors) -> dict[str, bytes]:
        """The parts; the inverse of `unpack`, byte for byte."""
        load = self.plugins.coders.load
        planes, packed = load(self.arrays)(), load("packed-bits")
        keeps = coded.codes < 0
        codes, size = coded.codes[~keeps], len(coded.codebook)
        if self.entropy:
            form, indices = BY_NAME, self.plugins.entropy_models.load(self.entropy)().encode(codes, None)
        else:
            form, indices = PACKED, packed(max(size, 1)).encode(codes)
            ranged = self._range(size, len(codes))
            if len(codes) and len(shorter := ranged[0].encode(codes.astype(np.int32), ranged[1])) < len(indices):
                form, indices = RANGE_CODED, shorter
        named = bool(self.entropy) or self.arrays != "byte-planes"
        names = f"{self.entropy}\0{self.arrays}".encode() if named else b""
        mask = np.frombuffer(packed(2).encode(keeps.astype(np.uint8)), np.uint8)
        return {
            "header": HEADER.pack(NAMED if named else VERSION, form, len(coded.codes), size, len(coded.own)) + names,
            "mask": planes.encode(mask),
            "indices": indices,
            "codebook": planes.encode(coded.codebook),
            "own": planes.encode(coded.own),
        }

    def unpack(self, parts: Mapping[str, bytes], n: int, d: int) -> CodedVectors:
        """Read the parts and check what they hold. Raises PartError, a BitstreamError."""
        with _part(parts, "header") as data:
            form, size, own, entropy, arrays = _header(data, n)
            known = {"entropy model": self.plugins.entropy_models.names, "array coder": self.plugins.array_coders.names}
            for kind, name in (("entropy model", entropy), ("array coder", arrays)):
                if name and name not in known[kind]:
                    raise BitstreamError(f"the {kind} {name!r:.80} is not installed")
        load = self.plugins.coders.load
        planes, packed = load(arrays)(), load("packed-bits")
        with _part(parts, "mask") as data:
            mask = planes.decode(data, np.uint8, ((n + 7) // 8,))
            keeps = packed(2).decode(mask.tobytes(), np.uint8, (n,)).astype(bool)
            if int(keeps.sum()) != own:
                raise BitstreamError(f"keeps {int(keeps.sum()):,} vectors, the header says {own:,}")
        codes = np.full(n, -1, np.int64)
        with _part(parts, "indices") as data:
            if form == PACKED:
                found = packed(max(size, 1)).decode(data, np.int64, (n - own,))
            elif form == BY_NAME:
                found = decoded_matrix(self.plugins.entropy_models.load(entropy)(), data, n - own)
            else:
                model, context = self._range(size, n - own)
                found = model.decode(data, context)
            if len(found) and not 0 <= int(found.min()) <= int(found.max()) < size:
                raise BitstreamError(f"an index is outside the codebook of {size:,} entries")
            codes[~keeps] = found
        halves = {}
        for name, count in (("codebook", size), ("own", own)):
            with _part(parts, name) as data:
                halves[name] = planes.decode(data, np.float16, (count, d))
                if not np.isfinite(halves[name]).all():
                    raise BitstreamError("holds values that are not finite")
        return CodedVectors(codes, halves["codebook"], halves["own"])

    def _range(self, size: int, n: int) -> tuple[Any, Any]:
        """The entropy model for n indices into `size` entries, and its context."""
        model = self.plugins.entropy_models.load("categorical")
        return model(), model.Context(max(size, 1), n)


def _header(data: bytes, n: int) -> tuple[int, int, int, str, str]:
    """Form of the indices, entries of the codebook, own vectors, names of the entropy model and the array coder."""
    names = data[HEADER.size :].decode().split("\0")
    if len(data) < HEADER.size or len(names) != (2 if data[0] == NAMED else 1) or (data[0] == VERSION and names[0]):
        raise BitstreamError(f"{len(data)} bytes, must be {HEADER.size}")
    version, form, stated, size, own = HEADER.unpack(data[: HEADER.size])
    entropy, arrays = names if version == NAMED else ("", "byte-planes")
    forms = {VERSION: (PACKED, RANGE_CODED), NAMED: (BY_NAME,) if entropy else (PACKED, RANGE_CODED)}
    if form not in forms.get(version, ()) or not arrays:
        raise BitstreamError(f"vectors of version {version}, form {form} are not known: upgrade sw-lightgaussian")
    if stated != n:
        raise BitstreamError(f"there are {stated:,} vectors, expected {n:,}")
    coded = n - own
    if coded < 0 or size > min(coded, MAX_CODES) or (coded > 0 and size == 0):
        raise BitstreamError(f"{size:,} codebook entries and {own:,} own vectors cannot be of {n:,} vectors")
    return form, size, own, entropy, arrays


@contextlib.contextmanager
def _part(parts: Mapping[str, bytes], name: str) -> Iterator[bytes]:
    """The bytes of a part for a block that decodes them; what goes wrong in it is blamed on the part."""
    if name not in parts:
        raise PartError(name, "is missing")
    try:
        yield parts[name]
    except (BitstreamError, ValueError, LookupError, ArithmeticError) as error:
        raise PartError(name, str(error)) from error
