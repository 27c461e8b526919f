"""Codec `gaussians-indexed` for whole Gaussian models: codebooks of colours and shapes in 8 bits, half positions.

Source: C3DGS (arXiv 2401.02436). Sections (docs/bitstream.md), each array by the coder that the header names, rows of
Gaussians along a Morton curve, entries of codebooks by their first use:

    xyz                         f16 [N,3]
    opacity, factor             u8 [N]
    color_index, shape_index    u16 [N], or u32 for more than 2^16 entries
    dc, rest                    u8 [Kc,1,3] and [Kc,K-1,3]
    shape, quat                 u8 [Kg,3] and [Kg,4]
    steps, zeros                array sections f32 [6] and i32 [6]: lattices of opacity, factor, dc, rest, shape, quat
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from splatwizard_core.api import BitstreamError, GaussianModel, Params, SplatwizardError
from sw_c3dgs.coded import QUANTIZED, CodedGaussians
from sw_c3dgs.indexed import IndexedGaussians
from sw_c3dgs.model import SharedGaussians
from sw_codecs.models.exchangeable import codes_arrays, hold_part
from sw_codecs.positions.ordering import box_cells, spatial_order
from sw_codecs.vectors.sensitivity_vq import index_dtype

if TYPE_CHECKING:
    from splatwizard_core.api import ArrayCoder, ContainerReader, ContainerWriter, PluginManager

TRIED = ("deflate", "byte-planes")
MAX_ZERO = 1 << 20  # of the quantizer
MAX_LOG_FACTOR = 80.0  # exp stays within float32


class Settings(Params):
    """Settings of the codec."""

    arrays: str = Field(
        "deflate", description="coder of every array: as published; byte-planes is shorter for most, others do too"
    )


class IndexedCodec:
    """Writes Gaussians with shared colours and shapes; those of any other model keep one of each, in 8 bits."""

    Settings = Settings

    def __init__(self, plugins: PluginManager, **settings: Any) -> None:
        self.plugins, self.settings = plugins, Settings(**settings)
        if self.settings.arrays not in TRIED:
            hold_part(plugins.array_coders, self.settings.arrays, "codec.settings.arrays", codes_arrays)

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Write the sections. Raises SplatwizardError for values that are not finite or far too large."""
        try:
            coded = model.coded() if isinstance(model, IndexedGaussians) else SharedGaussians.of(model).coded()
        except ValueError as error:
            raise SplatwizardError(f"the Gaussians cannot be encoded: {error}") from error
        if np.abs(coded.values("factor")).max(initial=0) > MAX_LOG_FACTOR:
            raise SplatwizardError(f"a log scale is beyond +-{MAX_LOG_FACTOR:g}: the Gaussians cannot be encoded")
        coded = coded.in_order(spatial_order(box_cells(coded.means)))
        n, colors, shapes = len(coded.means), len(coded.symbols["dc"]), len(coded.symbols["shape"])
        bands = 1 + coded.symbols["rest"].shape[1]
        degree = math.isqrt(bands) - 1
        writer.raster["sh_degree"] = degree
        writer.static.update(
            num_gaussians=n, num_colors=colors, num_shapes=shapes, max_sh_degree=degree, arrays=self.settings.arrays
        )
        coder = self.plugins.array_coders.load(self.settings.arrays)()
        writer.add("xyz", coder.encode(coded.means))
        writer.add("color_index", coder.encode(coded.color_index.astype(index_dtype(colors))))
        writer.add("shape_index", coder.encode(coded.shape_index.astype(index_dtype(shapes))))
        for name in QUANTIZED:
            writer.add(name, coder.encode(coded.symbols[name]))
        writer.add_array("steps", coded.steps)
        writer.add_array("zeros", coded.zeros)
        writer.allow(_decoded_bytes(n, colors, shapes, bands), f"a model of {n:,} Gaussians")

    def decode(self, reader: ContainerReader) -> IndexedGaussians:
        """The model. Raises BitstreamError."""
        n = reader.integer("num_gaussians", low=0, high=2**32 - 1)
        colors = reader.integer("num_colors", low=min(n, 1), high=n)
        shapes = reader.integer("num_shapes", low=min(n, 1), high=n)
        bands = (reader.integer("max_sh_degree", low=0, high=3) + 1) ** 2
        coder = self.plugins.array_coders.load(reader.text("arrays", choices=self.plugins.array_coders.names))()
        reader.allow(_decoded_bytes(n, colors, shapes, bands), f"a model of {n:,} Gaussians")
        with reader.decoding("xyz") as data:
            means = coder.decode(data, np.float16, (n, 3))
            if not np.isfinite(means).all():
                raise BitstreamError("holds values that are not finite")
        steps = reader.array("steps", dtype="float32", shape=(len(QUANTIZED),), finite=True)
        if not (steps > 0).all():
            raise BitstreamError(f"{reader.name}: section 'steps': not all are above 0", section="steps")
        zeros = reader.array("zeros", dtype="int32", shape=(len(QUANTIZED),))
        if np.abs(zeros.astype(np.int64)).max() > MAX_ZERO:
            raise BitstreamError(f"{reader.name}: section 'zeros': beyond +-2^20", section="zeros")
        sizes = {
            "opacity": (n,), "factor": (n,), "dc": (colors, 1, 3), "rest": (colors, bands - 1, 3),
            "shape": (shapes, 3), "quat": (shapes, 4),
        }  # fmt: skip
        symbols: dict[str, NDArray[np.uint8]] = {}
        for name, size in sizes.items():
            with reader.decoding(name) as data:
                symbols[name] = coder.decode(data, np.uint8, size)
        coded = CodedGaussians(
            means, symbols, steps, zeros,
            _index("color_index", colors, n, reader, coder), _index("shape_index", shapes, n, reader, coder),
        )  # fmt: skip
        self._check(coded, reader)
        return IndexedGaussians(coded)

    def _check(self, coded: CodedGaussians, reader: ContainerReader) -> None:
        """Raise BitstreamError for values that no encoder writes and no renderer can use."""
        with np.errstate(over="ignore"):
            for name in QUANTIZED:
                values = coded.values(name)
                with reader.decoding(name):
                    if not np.isfinite(values).all():
                        raise BitstreamError("holds values that are not finite in float32")
                    if name == "factor" and np.abs(values).max(initial=0) > MAX_LOG_FACTOR:
                        raise BitstreamError(f"a log factor is beyond +-{MAX_LOG_FACTOR:g}")
                    if name == "shape" and values.min(initial=0) < 0:
                        raise BitstreamError("a shape has a negative scale")


def _index(name: str, size: int, n: int, reader: ContainerReader, coder: ArrayCoder) -> NDArray[np.int64]:
    with reader.decoding(name) as data:
        found = coder.decode(data, index_dtype(size), (n,)).astype(np.int64)
        if len(found) and int(found.max()) >= size:
            raise BitstreamError(f"an index is outside the codebook of {size:,} entries")
    return found


def _decoded_bytes(n: int, colors: int, shapes: int, bands: int) -> int:
    """Of the model in float32, and of what is gathered from it to draw or to export it."""
    return 4 * (n * (9 + 11 + 3 * bands) + 3 * bands * colors + 7 * shapes)
