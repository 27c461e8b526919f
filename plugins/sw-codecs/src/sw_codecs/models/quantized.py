"""The file in mode `quantized`: positions through the octree codec, all else on a lattice and range coded, or by what
the settings name in their place.

Rows are in Morton order of their grid cell. Gaussians that can never be drawn (opacity below 1/255, or a parameter that
is not finite) are left out. The decoder needs integers and exact arithmetic only. With `prefixes` the rows come in
packets, the most significant Gaussians first, each coded like a file of its own: the file may end after any of them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from sw_gaussians.surfels import SurfelModel, gaussians_of

from splatwizard_core.api import BitstreamError, GaussianModel, Params
from sw_codecs.models.attributes import SCALES_FROM, Steps, Values, base_columns, dequantize, quantize
from sw_codecs.models.band_context import (
    MAX_CLASSES,
    activity_classes,
    decode_band,
    decode_matrix,
    encode_band,
    suitable_classes,
)
from sw_codecs.models.exchangeable import Exchangeable, entropy_model, position_codec
from sw_codecs.models.position_grid import MAX_TOP, PositionGrid

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, EntropyModel, PluginManager, PositionCodec
    from sw_codecs.models.settings import LatticeSettings, QuantizedSettings

log = logging.getLogger(__name__)

FAINTEST = math.log(1 / 255 / (1 - 1 / 255))
"""Rasterizers skip a splat whose alpha is below 1/255, and alpha never exceeds the opacity."""

SECTIONS = ("color", "opacity", "scales", "quats")
"""Sections of the first columns of the attribute matrix; SH bands 1 to 3 follow with one section each."""

SMALLEST_PREFIX = 1 / 16
"""The first of n packets holds this share of the Gaussians to the power 1 - 1/n, the first two to the power 1 - 2/n;
usually."""

ROWS_AT_ONCE = 1 << 12
"""Rows that are dequantised together: intermediate doubles of all rows would outweigh the model several times."""


Packet = tuple[Annotated[int, Field(ge=0, lt=2**32)], Annotated[float, Field(ge=0, le=10)]]
"""Rows of a packet, and what is added to log scales while it is the last one: the Gaussians that are there swell over
the gaps of those that are not."""


class Layout(Params):
    """Header values of a quantised file; all have bounds, since a stranger may have written them."""

    num_gaussians: int = Field(ge=0, lt=2**32)
    max_sh_degree: int = Field(ge=0, le=3)
    active_sh_degree: int = Field(ge=0, le=3)
    position_bits: int = Field(ge=1, le=21)
    center: tuple[float, float, float]
    width: tuple[float, float, float]
    top: tuple[int, int, int]
    dc_step: float = Field(gt=0, le=1e3)
    rest_step: float = Field(gt=0, le=1e3)
    opacity_step: float = Field(gt=0, le=1e3)
    scale_step: float = Field(gt=0, le=1e3)
    quat_step: float = Field(gt=0, le=1e3)
    sh_classes: int = Field(ge=1, le=MAX_CLASSES)
    primitive: Literal["surfel"] | None = None
    packets: list[Packet] | None = Field(None, min_length=1, max_length=64)

    @property
    def scales(self) -> int:
        """Of a Gaussian 3, of a surfel 2."""
        return GaussianModel.NUM_SCALES if self.primitive is None else SurfelModel.NUM_SCALES

    @property
    def decoded_bytes(self) -> int:
        """Of the model in float32: 236 a Gaussian at SH degree 3, 232 per surfel."""
        return 4 * self.num_gaussians * (11 + self.scales + 3 * ((self.max_sh_degree + 1) ** 2 - 1))

    @property
    def base_columns(self) -> int:
        """Columns of the attribute matrix before those of SH bands 1 to 3."""
        return base_columns(self.scales)

    @property
    def sections(self) -> dict[str, tuple[int, int]]:
        """First column and end of each of SECTIONS."""
        quats = SCALES_FROM + self.scales
        limits = (0, 3), (3, SCALES_FROM), (SCALES_FROM, quats), (quats, self.base_columns)
        return dict(zip(SECTIONS, limits, strict=True))

    @property
    def grid(self) -> PositionGrid:
        return PositionGrid(self.center, self.width, self.top, self.position_bits)

    @property
    def steps(self) -> Steps:
        return Steps(self.dc_step, self.rest_step, self.opacity_step, self.scale_step, self.quat_step)


AnyLayout = TypeVar("AnyLayout", bound=Layout)


def encode(model: GaussianModel, writer: ContainerWriter, settings: QuantizedSettings, plugins: PluginManager) -> None:
    """Sections positions, color, opacity, scales, quats, sh1 .. sh<active degree>; of packets 1/positions and so on."""
    positions = plugins.position_codecs.load(settings.positions)()
    layout, cells, symbols = lattice(model, settings, positions.sort)
    packets, swell = significant_first(layout, symbols, settings.prefixes)
    if packets:
        told = list(zip(map(len, packets), swell, strict=True))
        classes = suitable_classes(layout.num_gaussians // len(packets))
        layout = layout.model_copy(update={"packets": told, "sh_classes": classes})
    writer.raster["sh_degree"] = layout.max_sh_degree
    writer.static.update(layout.model_dump(mode="json", exclude_none=True))
    settings.state(writer)
    columns = plugins.entropy_models.load(settings.entropy)()
    if not packets:
        encode_rows(layout, cells, symbols, "", writer, positions, columns)
    for number, rows in enumerate(packets, 1):
        encode_rows(layout, cells[rows], symbols[rows], f"{number}/", writer, positions, columns)
        writer.cut()
    writer.allow(layout.decoded_bytes, f"a model of {layout.num_gaussians:,} Gaussians")


def encode_rows(
    layout: Layout, cells: NDArray[np.int64], symbols: NDArray[np.int32], prefix: str, writer: ContainerWriter,
    positions: PositionCodec, columns: EntropyModel,
) -> None:  # fmt: skip
    """Write the sections of rows of the lattice, which lie in the order of their positions."""
    writer.add(f"{prefix}positions", positions.encode(cells, layout.position_bits))
    for name, (start, stop) in layout.sections.items():
        writer.add(f"{prefix}{name}", columns.encode(symbols[:, start:stop], None))
    for band, start, stop in _bands(layout):
        classes, count = _classes(layout, band, symbols[:, layout.base_columns : start])
        writer.add(f"{prefix}sh{band}", encode_band(columns, symbols[:, start:stop], classes, count))


def significant_first(
    layout: Layout, symbols: NDArray[np.int32], count: int, smallest: float = SMALLEST_PREFIX
) -> tuple[list[NDArray[np.int64]], list[float]]:
    """Return the rows of each of `count` packets, ascending in each, and how much log scales grow after it.

    The most significant come first: a Gaussian counts as much as it covers, opacity times the product of its two
    largest scales. The packets up to a place hold a share of all rows that grows by the same factor each time. Scales
    grow so that what is there covers as much as all will.
    """
    covered = coverage(layout, symbols)
    order = np.argsort(-covered, kind="stable")
    shares = [smallest ** (1 - number / count) for number in range(1, count + 1)]
    ends = [round(share * len(order)) for share in shares]
    packets = [np.sort(order[start:end]) for start, end in zip([0, *ends], ends, strict=False)]
    sums = np.cumsum(covered[order])
    return packets, [round(0.5 * math.log(sums[-1] / sums[end - 1]), 4) if end else 0.0 for end in ends]


def coverage(layout: Layout, symbols: NDArray[np.int32]) -> NDArray[np.float64]:
    """Area that each row covers: opacity times the product of its first two scales, relative to the largest product."""
    opacity = 1 / (1 + np.exp(-layout.opacity_step * symbols[:, 3].astype(np.float64)))
    log_area = layout.scale_step * symbols[:, SCALES_FROM : SCALES_FROM + 2].astype(np.float64).sum(axis=1)
    found: NDArray[np.float64] = opacity * np.exp(log_area - log_area.max(initial=-np.inf))
    return found


def decode(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    """The model on the lattice, of a file that ends at a cut that of its first packets. Raises BitstreamError."""
    layout = parsed(reader, Layout)
    told = layout.packets
    if len(told or ()) != len(reader.cuts) or (told and sum(n for n, _ in told) != layout.num_gaussians):
        raise BitstreamError(f"{reader.name}: cuts, packets and their Gaussians do not fit together", section="header")
    packets = {"": layout.num_gaussians}
    if layout.packets is not None:
        packets = {f"{number}/": rows for number, (rows, _) in enumerate(layout.packets[: reader.packets], 1)}
    n = sum(packets.values())
    layout = layout.model_copy(update={"num_gaussians": n})
    reader.allow(layout.decoded_bytes, f"a model of {n:,} Gaussians")
    cells = np.empty((n, 3), dtype=np.int64)
    symbols = np.empty((n, layout.base_columns + 3 * ((layout.active_sh_degree + 1) ** 2 - 1)), dtype=np.int32)
    end = 0
    for prefix, rows in packets.items():
        start, end = end, end + rows
        decode_rows(layout, cells[start:end], symbols[start:end], prefix, reader, plugins)
    swell = layout.packets[reader.packets - 1][1] if layout.packets is not None else 0.0
    return finite(reconstruct(layout, cells, symbols, swell), reader)


def finite(model: GaussianModel, reader: ContainerReader) -> GaussianModel:
    """The model. Raises BitstreamError if a number of it is not finite."""
    for name, parameter in model.named_parameters():
        if not bool(torch.isfinite(parameter).all()):
            raise BitstreamError(f"{reader.name}: decoded '{name}' is not finite: the file is damaged or hostile")
    return model


def decode_rows(
    layout: Layout, cells: NDArray[np.int64], symbols: NDArray[np.int32], prefix: str, reader: ContainerReader,
    plugins: PluginManager,
) -> None:  # fmt: skip
    """Fill `cells` and `symbols` with the rows of one packet."""
    n = len(cells)
    with reader.decoding(f"{prefix}positions") as data:
        found = position_codec(reader, plugins, n).decode(data)
        if found.shape != (n, 3):
            raise BitstreamError(f"holds {len(found):,} points, header says {n:,}")
        if n and not 0 <= int(found.min()) <= int(found.max()) < 1 << layout.position_bits:
            raise BitstreamError(f"a point leaves the grid of {layout.position_bits} bits")
        cells[:] = found
    columns = entropy_model(reader, plugins)
    for name, (start, stop) in layout.sections.items():
        with reader.decoding(f"{prefix}{name}") as data:
            symbols[:, start:stop] = decode_matrix(columns, data, n, stop - start)
    for band, start, stop in _bands(layout):
        classes, count = _classes(layout, band, symbols[:, layout.base_columns : start])
        with reader.decoding(f"{prefix}sh{band}") as data:
            symbols[:, start:stop] = decode_band(columns, data, classes, count, stop - start)


def lattice(
    model: GaussianModel, settings: LatticeSettings, sort: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    grid: PositionGrid | None = None,
) -> tuple[Layout, NDArray[np.int64], NDArray[np.int32]]:  # fmt: skip
    """Header, grid cells [N,3] in the order of `sort`, and integers of the attributes [N,C] likewise.

    grid    of the positions; None: the one that fits them
    """
    arrays = {name: getattr(model, name).detach().cpu().numpy() for name in model.RAW}
    keep = arrays["opacity_logits"] >= FAINTEST
    for array in arrays.values():
        # +inf is a legitimate logit (opacity 1); everything else must be finite to be drawn.
        finite = ~np.isnan(array) if array is arrays["opacity_logits"] else np.isfinite(array)
        keep &= finite.all(axis=tuple(range(1, finite.ndim)))
    if not keep.all():
        log.info("%d of %d Gaussians can never be drawn and are left out", int((~keep).sum()), len(keep))
    arrays = {name: array[keep] for name, array in arrays.items()}
    grid = PositionGrid.fit(arrays["means"], settings.position_bits) if grid is None else grid
    cells = grid.quantize(arrays["means"])
    order = sort(cells)
    active = (model.active_sh_degree + 1) ** 2 - 1
    values = Values(
        dc=arrays["sh_dc"][order, 0],
        rest=arrays["sh_rest"][order, :active],
        opacity_logits=arrays["opacity_logits"][order],
        log_scales=arrays["log_scales"][order],
        quats=arrays["quats"][order],
    )
    layout = Layout(
        num_gaussians=len(order),
        max_sh_degree=model.max_sh_degree,
        active_sh_degree=model.active_sh_degree,
        position_bits=settings.position_bits,
        center=grid.center,
        width=grid.width,
        top=grid.top,
        dc_step=settings.dc_step,
        rest_step=settings.rest_step,
        opacity_step=settings.opacity_step,
        scale_step=settings.scale_step,
        quat_step=settings.quat_step,
        sh_classes=suitable_classes(len(order)),
        primitive="surfel" if model.NUM_SCALES == SurfelModel.NUM_SCALES else None,
    )
    return layout, cells[order], quantize(values, layout.steps)


def reconstruct(
    layout: Layout, cells: NDArray[np.int64], symbols: NDArray[np.int32], swell: float | NDArray[np.float32] = 0.0
) -> GaussianModel:
    """The model that these integers stand for, with so much on its log scales, of all or [N,1]; for the decoder."""
    n, grid, steps = layout.num_gaussians, layout.grid, layout.steps
    tails = {"means": (3,), "dc": (3,), "rest": ((layout.max_sh_degree + 1) ** 2 - 1, 3), "opacity_logits": (),
             "log_scales": (layout.scales,), "quats": (4,)}  # fmt: skip
    found = {name: np.zeros((n, *tail), dtype=np.float32) for name, tail in tails.items()}
    for start in range(0, n, ROWS_AT_ONCE):
        part = slice(start, start + ROWS_AT_ONCE)
        with np.errstate(over="ignore", invalid="ignore"):  # a hostile header may overflow; the caller looks
            values = dequantize(symbols[part], steps, layout.scales)
            found["means"][part] = grid.dequantize(cells[part])
        found["rest"][part, : values.rest.shape[1]] = values.rest
        for name in ("dc", "opacity_logits", "log_scales", "quats"):
            found[name][part] = getattr(values, name)
    found["log_scales"] += np.asarray(swell, dtype=np.float32)
    found["dc"] = found["dc"][:, None, :]
    return gaussians_of(
        *(torch.from_numpy(array) for array in found.values()), active_sh_degree=layout.active_sh_degree
    )


def _bands(layout: Layout) -> list[tuple[int, int, int]]:
    """(band, first column, end) of the SH bands that are stored."""
    return [
        (band, layout.base_columns + 3 * (band**2 - 1), layout.base_columns + 3 * ((band + 1) ** 2 - 1))
        for band in range(1, layout.active_sh_degree + 1)
    ]


def _classes(layout: Layout, band: int, lower: NDArray[np.int32]) -> tuple[NDArray[np.int64], int]:
    """Class of each row for one band, and how many classes; the first band has nothing to go by."""
    if band == 1:
        return np.zeros(len(lower), dtype=np.int64), 1
    return activity_classes(lower, layout.sh_classes), layout.sh_classes


BESIDE = (*Exchangeable.USUAL, "mode", "codec", "method", "depth_ratio", "lambda_dist", "lambda_normal")
"""Header values that a method keeps beside the codec's own."""


def parsed(reader: ContainerReader, kind: type[AnyLayout]) -> AnyLayout:
    """Header values of a file. Raises BitstreamError for those that make no sense."""
    try:
        layout = kind.model_validate({key: value for key, value in reader.static.items() if key not in BESIDE})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BitstreamError(f"{reader.name}: header value '{key}': {first['msg']}", section="header") from None
    if layout.active_sh_degree > layout.max_sh_degree:
        raise BitstreamError(f"{reader.name}: header activates more SH bands than there are", section="header")
    grid_fits = (
        all(np.isfinite(layout.center))
        and all(0 < w < 1e30 for w in layout.width)
        and all(1 <= t <= MAX_TOP for t in layout.top)
    )
    if not grid_fits:
        raise BitstreamError(f"{reader.name}: header describes no usable position grid", section="header")
    return layout
