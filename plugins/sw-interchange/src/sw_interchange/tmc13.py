"""`tmc13`: the integers of `gsc-quant` by MPEG's own program for G-PCC, as the GSC exploration (2025) codes them.

Positions by its octree without loss; each column of attributes by its RAHT as a reflectance, with the exploration's
QPs; SH as luma and chroma. The program is the user's (`sw_interchange.tmc3`). It codes one attribute at a time, and the
points with each: where a stream's units of geometry are those of the positions' stream, the file has them once.
Source: specification of the protocols, anchors. Not told there: QPs of r2 and r4 (here halfway, the finer of two), and
of opacity, scales and rotations (here band 0's of luma).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field
from sw_gaussians.sized import Sized, fill
from sw_gaussians.surfels import refuse_surfels

from splatwizard_core.api import BitstreamError, GaussianModel, Method, SplatModel, Stage
from sw_interchange import gsc_quant, tmc3
from sw_interchange.gsc_quant import Floats, Integers
from sw_interchange.methods import TrainedScene

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter

SHARED = 0x80 | tmc3.GEOMETRY
"""Type of an empty unit in the file that stands for the next geometry unit of the positions' stream."""
RED, GREEN, BLUE = 0.2126, 0.7152, 0.0722  # luma of BT.709
TO_BLUE, TO_RED = 1.8556, 1.5748  # of its chroma


class Tmc13Config(Sized):
    """Everything that can be set for tmc13. Defaults are those of r5."""

    ENCODING: ClassVar[tuple[str, ...]] = (
        "size", "position_bits", "bits", "range", "qp_dc", "qp_sh_luma", "qp_sh_chroma", "qp_shape",
    )  # fmt: skip

    iterations: int = Field(0, ge=0, description="without effect: nothing is trained after the scene of 3dgs")
    position_bits: int = Field(18, ge=4, le=21, description="bits of a position along each axis")
    bits: int = Field(12, ge=2, le=16, description="bits of every other value")
    range: Literal["auto", "fixed"] = Field(
        "auto", description="an attribute that its range would clip: takes that of this file's values, or is refused"
    )
    qp_dc: list[int] = Field(
        [4, 6, 6], min_length=3, max_length=3, description="QPs of SH band 0: luma, blue chroma, red chroma"
    )
    qp_sh_luma: list[int] = Field([6, 14, 18], min_length=3, max_length=3, description="QPs of SH bands 1 to 3, luma")
    qp_sh_chroma: list[int] = Field(
        [14, 20, 22], min_length=3, max_length=3, description="QPs of SH bands 1 to 3, chroma"
    )
    qp_shape: int = Field(4, ge=4, le=75, description="QP of opacity, scales and rotations")


class Tmc13(Method):
    """Gaussians through the user's `tmc3`; `SPLATWIZARD_TMC3` names it, for encoding and for decoding."""

    name: ClassVar[str] = "tmc13"
    version: ClassVar[int] = 1
    Config = Tmc13Config
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        f"r{i}": {"qp_dc": dc, "qp_sh_luma": luma, "qp_sh_chroma": chroma, "qp_shape": dc[0]}
        for i, (dc, luma, chroma) in enumerate(
            (
                ([26, 30, 30], [38, 46, 49], [42, 50, 53]),
                ([18, 22, 22], [30, 38, 41], [34, 42, 45]),
                ([10, 14, 14], [22, 30, 33], [26, 34, 37]),
                ([7, 10, 10], [14, 22, 25], [20, 27, 29]),
                ([4, 6, 6], [6, 14, 18], [14, 20, 22]),
            ),
            1,
        )
    }
    DEFAULT_RATE: ClassVar[str] = "r5"

    def stages(self) -> Sequence[Stage]:
        return [TrainedScene(self.config)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write a section per attribute.

        Raises CapabilityError without the program, UserInputError for surfels, values that are not finite, and clipping
        with `range=fixed`.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"{self.name} encodes a GaussianModel, not a {type(model).__name__}")
        refuse_surfels(model, "tmc13")
        if self.config.size:
            fill(self, model, writer)
            return
        opt, degree = self.config, model.active_sh_degree
        values = {name: luma_chroma(each) if name.startswith("sh") else each
                  for name, each in gsc_quant.stored_values(model).items()}  # fmt: skip
        ranges, auto = gsc_quant.ranges_of(values, opt.range)
        writer.raster["sh_degree"] = degree
        writer.static.update(
            num_gaussians=model.num_rows, sh_degree=degree, position_bits=opt.position_bits, bits=opt.bits,
            range_auto=auto, ranges={name: [each.low.tolist(), each.high.tolist()] for name, each in ranges.items()},
        )  # fmt: skip
        if not model.num_rows:
            return
        cells = ranges["position"].quantize(values["position"], opt.position_bits)
        stream = tmc3.encode(cells, None, bits=opt.bits, qp=0)
        geometry = [each for each in tmc3.units_of(stream) if each.kind == tmc3.GEOMETRY]
        writer.add("position", stream)
        for name, attribute in gsc_quant.attributes_of(degree).items():
            spread = ranges[attribute]
            found = values[name] if name != "rotation" else gsc_quant.unit_quaternions(values[name], spread, opt.bits)
            codes = spread.quantize(found, opt.bits)
            columns = []
            for i, qp in enumerate(self._qps(name)):
                units = tmc3.units_of(tmc3.encode(cells, codes[:, i], bits=opt.bits, qp=qp))
                content = tmc3.stream_of(without_geometry(units, geometry))
                columns.append(struct.pack("<I", len(content)) + content)
            writer.add(name, b"".join(columns))
        writer.allow(gsc_quant.decoded_bytes(model.num_rows, degree), f"a model of {model.num_rows:,} Gaussians")

    def decode(self, reader: ContainerReader) -> SplatModel:
        """Return the model. Raises BitstreamError, CapabilityError without the program."""
        self.check_version(reader)
        count = reader.integer("num_gaussians", low=0, high=2**32 - 1)
        degree = reader.integer("sh_degree", low=0, high=3)
        position_bits = reader.integer("position_bits", low=4, high=21)
        bits = reader.integer("bits", low=2, high=16)
        reader.allow(gsc_quant.decoded_bytes(count, degree), f"{count:,} Gaussians")
        if count == 0:
            return gsc_quant.model_of({"position": np.zeros((0, 3))}, degree)
        ranges = gsc_quant.stated_ranges(reader)
        with reader.decoding("position") as data:
            cells, _ = tmc3.decode(data)
            geometry = [each for each in tmc3.units_of(data) if each.kind == tmc3.GEOMETRY]
            if len(cells) != count or not 0 <= int(cells.min()) <= int(cells.max()) < 1 << position_bits:
                raise BitstreamError(f"holds {len(cells):,} points or another grid, the header says {count:,}")
        values = {"position": ranges["position"].dequantize(cells, position_bits)}
        for name, attribute in gsc_quant.attributes_of(degree).items():
            with reader.decoding(name) as data:
                columns = [decoded_column(each, geometry, cells) for each in parts_of(data)]
                if len(columns) != gsc_quant.section_width(name):
                    raise BitstreamError(f"has {len(columns)} columns, not {gsc_quant.section_width(name)}")
                codes = np.clip(np.stack(columns, axis=1), 0, 2**bits - 1)  # the program's loss may lead out of them
                found = ranges[attribute].dequantize(codes, bits)
                values[name] = colors(found) if name.startswith("sh") else found
        return gsc_quant.model_of(values, degree)

    def _qps(self, section: str) -> list[int]:
        """QP of each column of a section."""
        if not section.startswith("sh"):
            return [self.config.qp_shape] * gsc_quant.section_width(section)
        band = int(section[2:])
        if band == 0:
            return list(self.config.qp_dc)
        luma, chroma = self.config.qp_sh_luma[band - 1], self.config.qp_sh_chroma[band - 1]
        return [luma, chroma, chroma] * (2 * band + 1)


def luma_chroma(values: Floats) -> Floats:
    """Luma, blue and red chroma of columns [N,3 k] red, green, blue; in [-a, a] where these are."""
    red, green, blue = np.moveaxis(values.reshape(len(values), values.shape[1] // 3, 3), 2, 0)
    luma = RED * red + GREEN * green + BLUE * blue
    return np.stack([luma, (blue - luma) / TO_BLUE, (red - luma) / TO_RED], axis=2).reshape(values.shape)


def colors(values: Floats) -> Floats:
    """Red, green and blue of columns [N,3 k] luma, blue and red chroma."""
    luma, to_blue, to_red = np.moveaxis(values.reshape(len(values), values.shape[1] // 3, 3), 2, 0)
    red, blue = luma + TO_RED * to_red, luma + TO_BLUE * to_blue
    return np.stack([red, (luma - RED * red - BLUE * blue) / GREEN, blue], axis=2).reshape(values.shape)


def without_geometry(units: Sequence[tmc3.Unit], geometry: Sequence[tmc3.Unit]) -> list[tmc3.Unit]:
    """Put an empty unit for each geometry unit, if they are the ones given; else all units as they are."""
    if [each for each in units if each.kind == tmc3.GEOMETRY] != list(geometry):
        return list(units)
    return [tmc3.Unit(SHARED, b"") if each.kind == tmc3.GEOMETRY else each for each in units]


def decoded_column(content: bytes, geometry: Sequence[tmc3.Unit], cells: Integers) -> Integers:
    """The values of one column. Raises BitstreamError unless they belong to the points `cells`, in their order."""
    shared = iter(geometry)
    units = [next(shared, each) if each.kind == SHARED else each for each in tmc3.units_of(content)]
    points, values = tmc3.decode(tmc3.stream_of(units))
    if values is None or not np.array_equal(points, cells):
        raise BitstreamError("a column's points are not those of the positions")
    return values


def parts_of(data: bytes) -> Iterator[bytes]:
    """Contents of a section, each behind its length (u32). Raises BitstreamError."""
    at = 0
    while at < len(data):
        length = struct.unpack_from("<I", data, at)[0] if at + 4 <= len(data) else len(data)
        if at + 4 + length > len(data):
            raise BitstreamError("ends within a column")
        yield data[at + 4 : at + 4 + length]
        at += 4 + length
