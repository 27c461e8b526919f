"""The file in mode `quantized`: positions through the octree codec, all else on a lattice and range coded, or by what
the settings name in their place.

Rows are in Morton order of their grid cell. Gaussians that can never be drawn (opacity below 1/255, or a parameter that
is not finite) are left out. The decoder needs integers and exact arithmetic only. With `prefixes` the rows come in
packets, the most significant Gaussians first, each coded like a file of its own: the file may end after any of them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from sw_gaussians import heap
from sw_gaussians.surfels import SurfelModel, gaussians_of

from splatwizard_core.api import BitstreamError, GaussianModel, Params
from sw_codecs.fast.threads import each_of
from sw_codecs.models import precision, sh_basis
from sw_codecs.models.attributes import SCALES_FROM, Ready, Steps, Values, base_columns, dequantize, quantize, ready
from sw_codecs.models.band_context import (
    MAX_CLASSES,
    activity_classes,
    decode_band,
    decode_matrix,
    encode_band,
    equal_classes,
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

BASIS, PRECISION = "basis", "precision"
"""Sections of some files, before those whose meaning depends on them."""

SMALLEST_PREFIX = 1 / 16
"""The first of n packets holds this share of the Gaussians to the power 1 - 1/n, the first two to the power 1 - 2/n,
if nothing else is said."""

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
    precision: Literal[True] | None = None
    sh_basis: Literal[True] | None = None
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
    def rest_columns(self) -> int:
        """Columns of SH bands 1 to 3."""
        return 3 * ((self.active_sh_degree + 1) ** 2 - 1)

    @property
    def grid(self) -> PositionGrid:
        return PositionGrid(self.center, self.width, self.top, self.position_bits)

    @property
    def steps(self) -> Steps:
        return Steps(self.dc_step, self.rest_step, self.opacity_step, self.scale_step, self.quat_step)


AnyLayout = TypeVar("AnyLayout", bound=Layout)


@dataclass(frozen=True)
class Lattice:
    """A model in integers.

    cells       of the grid [N,3], in the order of the position codec
    symbols     of the attributes [N,C] likewise
    basis       of SH bands 1 to 3 [K,K]; None: the usual one
    classes     of precision [N]; None: all rows have the same steps
    """

    layout: Layout
    cells: NDArray[np.int64]
    symbols: NDArray[Any]
    basis: NDArray[np.int8] | None = None
    classes: NDArray[np.int32] | None = None

    def part(self, rows: NDArray[np.int64] | slice) -> Lattice:
        """Some rows."""
        classes = None if self.classes is None else self.classes[rows]
        return replace(self, cells=self.cells[rows], symbols=self.symbols[rows], classes=classes)


def encode(model: GaussianModel, writer: ContainerWriter, settings: QuantizedSettings, plugins: PluginManager) -> None:
    """Sections positions, color, opacity, scales, quats, sh1 .. sh<active degree>; of packets 1/positions and so on.

    Before them `basis` of the file and `precision` of its rows, if there are such. A model whose attribute `importance`
    [N] says what its Gaussians weigh (`precision.classes_of`) has steps by that, if settings ask for it.
    """
    positions = plugins.position_codecs.load(settings.positions)()
    found = lattice(model, settings, positions.sort)
    layout = found.layout
    packets, swell = significant_first(found, settings.prefixes) if settings.prefixes else ([], [])
    if packets:
        told = list(zip(map(len, packets), swell, strict=True))
        classes = suitable_classes(layout.num_gaussians // len(packets))
        layout = layout.model_copy(update={"packets": told, "sh_classes": classes})
        found = replace(found, layout=layout)
    writer.raster["sh_degree"] = layout.max_sh_degree
    writer.static.update(layout.model_dump(mode="json", exclude_none=True))
    settings.state(writer)
    columns = plugins.entropy_models.load(settings.entropy)()
    if found.basis is not None:
        writer.add(BASIS, found.basis.tobytes())
    if not packets:
        encode_rows(found, "", writer, positions, columns)
    for number, rows in enumerate(packets, 1):
        encode_rows(found.part(rows), f"{number}/", writer, positions, columns)
        writer.cut()
    writer.allow(layout.decoded_bytes, f"a model of {layout.num_gaussians:,} Gaussians")


def encode_rows(
    found: Lattice, prefix: str, writer: ContainerWriter, positions: PositionCodec, columns: EntropyModel
) -> None:
    """Write the sections of rows of the lattice, which lie in the order of their positions."""
    writer.add(f"{prefix}positions", positions.encode(found.cells, found.layout.position_bits))
    for name, part in _parts(found):
        heap.trim()
        if isinstance(part, list):
            writer.add(f"{prefix}{name}", encode_band(columns, part))
        else:
            writer.add(f"{prefix}{name}", columns.encode(part, None))


def matrices(found: Lattice) -> Iterator[tuple[str, NDArray[np.int32]]]:
    """Section and integers of each matrix that has statistics of its own."""
    for name, parts in _parts(found):
        for part in parts if isinstance(parts, list) else [parts]:
            yield name, part


def _parts(found: Lattice) -> Iterator[tuple[str, NDArray[np.int32] | list[NDArray[np.int32]]]]:
    """Each section after the positions: its integers, or those of each class."""
    layout, symbols = found.layout, found.symbols
    first = _first_classes(layout, found.classes)
    if found.classes is not None:
        yield PRECISION, found.classes[:, None]
    for name, (start, stop) in layout.sections.items():
        part = symbols[:, start:stop]
        yield name, part if first is None else _by_class(part, first, layout.sh_classes)
    for band, start, stop in _bands(layout):
        classes, count = _classes(layout, band, symbols[:, layout.base_columns : start], first)
        yield f"sh{band}", _by_class(symbols[:, start:stop], classes, count)


def _by_class(symbols: NDArray[np.int32], classes: NDArray[np.int64], count: int) -> list[NDArray[np.int32]]:
    order = np.argsort(classes.astype(np.uint8), kind="stable")  # one gather instead of one for each class
    return np.split(symbols[order], np.bincount(classes, minlength=count).cumsum()[:-1])


def significant_first(found: Lattice, count: int) -> tuple[list[NDArray[np.int64]], list[float]]:
    """Return the rows of each of `count` packets, ascending in each, and how much log scales grow after it.

    The most significant come first: a Gaussian counts as much as it covers, opacity times the product of its two
    largest scales. The packets up to a place hold a share of all rows that grows by the same factor each time. Scales
    grow so that what is there covers as much as all will.
    """
    covered = _coverage(found)
    order = np.argsort(-covered, kind="stable")
    shares = [SMALLEST_PREFIX ** (1 - number / count) for number in range(1, count + 1)]
    ends = [round(share * len(order)) for share in shares]
    packets = [np.sort(order[start:end]) for start, end in zip([0, *ends], ends, strict=False)]
    sums = np.cumsum(covered[order])
    return packets, [round(0.5 * math.log(sums[-1] / sums[end - 1]), 4) if end else 0.0 for end in ends]


def _coverage(found: Lattice) -> NDArray[np.float64]:
    """Area that each row covers: opacity times the product of its first two scales, relative to the largest product."""
    layout, symbols = found.layout, found.symbols[:, : SCALES_FROM + 2].astype(np.float64)
    factors = np.ones(len(symbols)) if found.classes is None else precision.factors(found.classes)
    opacity = 1 / (1 + np.exp(-layout.opacity_step * factors * symbols[:, 3]))
    log_area = layout.scale_step * factors * symbols[:, SCALES_FROM : SCALES_FROM + 2].sum(axis=1)
    covered: NDArray[np.float64] = opacity * np.exp(log_area - log_area.max(initial=-np.inf))
    return covered


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
    found = Lattice(
        layout,
        np.empty((n, 3), np.int64),
        np.empty((n, layout.base_columns + layout.rest_columns), np.int32),
        classes=np.empty(n, np.int32) if layout.precision else None,
    )
    if layout.sh_basis:
        with reader.decoding(BASIS) as data:
            found = replace(found, basis=sh_basis.unpack(bytes(data), layout.rest_columns))
    end = 0
    for prefix, rows in packets.items():
        start, end = end, end + rows
        decode_rows(found.part(slice(start, end)), prefix, reader, plugins)
    swell = layout.packets[reader.packets - 1][1] if layout.packets is not None else 0.0
    return finite(reconstruct(found, swell), reader)


def finite(model: GaussianModel, reader: ContainerReader) -> GaussianModel:
    """The model. Raises BitstreamError if a number of it is not finite."""
    for name, parameter in model.named_parameters():
        if not all(bool(torch.isfinite(part).all()) for part in parameter.detach().split(ROWS_AT_ONCE)):
            raise BitstreamError(f"{reader.name}: decoded '{name}' is not finite: the file is damaged or hostile")
    return model


def decode_rows(found: Lattice, prefix: str, reader: ContainerReader, plugins: PluginManager) -> None:
    """Fill the arrays of `found` with the rows of one packet."""
    layout, symbols, n = found.layout, found.symbols, len(found.cells)
    with reader.decoding(f"{prefix}positions") as data:
        cells = position_codec(reader, plugins, n).decode(data)
        if cells.shape != (n, 3):
            raise BitstreamError(f"holds {len(cells):,} points, header says {n:,}")
        if n and not 0 <= int(cells.min()) <= int(cells.max()) < 1 << layout.position_bits:
            raise BitstreamError(f"a point leaves the grid of {layout.position_bits} bits")
        found.cells[:] = cells
    columns = entropy_model(reader, plugins)
    if found.classes is not None:
        with reader.decoding(f"{prefix}{PRECISION}") as data:
            found.classes[:] = precision.checked(decode_matrix(columns, data, n, 1))
    first = _first_classes(layout, found.classes)
    for name, (start, stop) in layout.sections.items():
        with reader.decoding(f"{prefix}{name}") as data:
            if first is None:
                symbols[:, start:stop] = decode_matrix(columns, data, n, stop - start)
            else:
                symbols[:, start:stop] = decode_band(columns, data, first, layout.sh_classes, stop - start)
    for band, start, stop in _bands(layout):
        classes, count = _classes(layout, band, symbols[:, layout.base_columns : start], first)
        with reader.decoding(f"{prefix}sh{band}") as data:
            symbols[:, start:stop] = decode_band(columns, data, classes, count, stop - start)


@dataclass(frozen=True)
class Unrounded:
    """A model before it is rounded: rows that can be drawn, in the order of the model.

    means       [N,3]
    grid        of the positions, of any number of bits
    classes     of precision [N]; None: all rows have the same steps
    primitive   of the header
    """

    max_sh_degree: int
    active_sh_degree: int
    primitive: Literal["surfel"] | None
    means: NDArray[np.float32]
    grid: PositionGrid
    values: Ready
    classes: NDArray[np.int32] | None


def unrounded(model: GaussianModel, precision_power: float, own_basis: bool) -> Unrounded:
    """Do once what does not depend on grid and steps. Arguments as in the settings."""
    arrays = {name: getattr(model, name).detach().cpu().numpy() for name in model.RAW}
    keep = arrays["opacity_logits"] >= FAINTEST
    for array in arrays.values():
        for start in range(0, len(keep), ROWS_AT_ONCE):
            part = array[start : start + ROWS_AT_ONCE]
            # +inf is a legitimate logit (opacity 1); everything else must be finite to be drawn.
            finite = ~np.isnan(part) if array is arrays["opacity_logits"] else np.isfinite(part)
            keep[start : start + ROWS_AT_ONCE] &= finite.all(axis=tuple(range(1, finite.ndim)))
    if not keep.all():
        log.info("%d of %d Gaussians can never be drawn and are left out", int((~keep).sum()), len(keep))
        arrays = {name: array[keep] for name, array in arrays.items()}
    values = Values(
        dc=arrays["sh_dc"][:, 0],
        rest=arrays["sh_rest"][:, : (model.active_sh_degree + 1) ** 2 - 1],
        opacity_logits=arrays["opacity_logits"],
        log_scales=arrays["log_scales"],
        quats=arrays["quats"],
    )
    classes = None
    if precision_power > 0:
        known = getattr(model, "importance", None)
        weights = (
            precision.footprints(values.opacity_logits, values.log_scales)
            if known is None
            else known.detach().cpu().double().numpy()[keep]
        )
        classes = precision.classes_of(weights, precision_power)
    return Unrounded(
        model.max_sh_degree,
        model.active_sh_degree,
        "surfel" if model.NUM_SCALES == SurfelModel.NUM_SCALES else None,
        arrays["means"],
        PositionGrid.fit(arrays["means"], 1),
        ready(values, None if classes is None else precision.factors(classes), own_basis),
        classes,
    )


def rounded(
    given: Unrounded, settings: LatticeSettings, sort: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    grid: PositionGrid | None = None,
) -> Lattice:  # fmt: skip
    """Round; rows in the order of `sort`.

    grid    of the positions; None: the one that fits them
    """
    grid = replace(given.grid, bits=settings.position_bits) if grid is None else grid
    cells = grid.quantize(given.means)
    order = sort(cells)
    layout = Layout(
        num_gaussians=len(order),
        max_sh_degree=given.max_sh_degree,
        active_sh_degree=given.active_sh_degree,
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
        precision=None if given.classes is None else True,
        primitive=given.primitive,
    )
    cells = cells[order]
    heap.trim()
    symbols, basis = quantize(given.values, layout.steps, order)
    if basis is not None:
        layout = layout.model_copy(update={"sh_basis": True})
    classes = None if given.classes is None else given.classes[order]
    heap.trim()
    return Lattice(layout, cells, symbols, basis, classes)


def lattice(
    model: GaussianModel, settings: QuantizedSettings, sort: Callable[[NDArray[np.int64]], NDArray[np.int64]]
) -> Lattice:
    """Round a model; rows in the order of `sort`."""
    return rounded(unrounded(model, settings.precision_power, settings.sh_basis), settings, sort)


def reconstruct(found: Lattice, swell: float | NDArray[np.float32] = 0.0) -> GaussianModel:
    """The model that these integers stand for, with so much on its log scales, of all or [N,1]; for the decoder."""
    layout, cells, symbols = found.layout, found.cells, found.symbols
    n, grid, steps = layout.num_gaussians, layout.grid, layout.steps
    tails = {"means": (3,), "dc": (3,), "rest": ((layout.max_sh_degree + 1) ** 2 - 1, 3), "opacity_logits": (),
             "log_scales": (layout.scales,), "quats": (4,)}  # fmt: skip
    arrays = {name: np.zeros((n, *tail), dtype=np.float32) for name, tail in tails.items()}

    def fill(start: int) -> None:
        part = slice(start, start + ROWS_AT_ONCE)
        with np.errstate(over="ignore", invalid="ignore"):  # a hostile header may overflow; the caller looks
            factors = None if found.classes is None else precision.factors(found.classes[part])
            values = dequantize(symbols[part], steps, layout.scales, factors, found.basis)
            arrays["means"][part] = grid.dequantize(cells[part])
        arrays["rest"][part, : values.rest.shape[1]] = values.rest
        for name in ("dc", "opacity_logits", "log_scales", "quats"):
            arrays[name][part] = getattr(values, name)

    each_of(fill, range(0, n, ROWS_AT_ONCE), rows=n)
    arrays["log_scales"] += np.asarray(swell, dtype=np.float32)
    arrays["dc"] = arrays["dc"][:, None, :]
    return gaussians_of(
        *(torch.from_numpy(array) for array in arrays.values()), active_sh_degree=layout.active_sh_degree
    )


def _bands(layout: Layout) -> list[tuple[int, int, int]]:
    """(band, first column, end) of the SH bands that are stored."""
    return [
        (band, layout.base_columns + 3 * (band**2 - 1), layout.base_columns + 3 * ((band + 1) ** 2 - 1))
        for band in range(1, layout.active_sh_degree + 1)
    ]


def _first_classes(layout: Layout, classes: NDArray[np.int32] | None) -> NDArray[np.int64] | None:
    """Class of statistics of each row for what does not follow lower bands: by its precision, or there are none."""
    return None if classes is None else equal_classes(classes.astype(np.int64), layout.sh_classes)


def _classes(
    layout: Layout, band: int, lower: NDArray[np.int32], first: NDArray[np.int64] | None
) -> tuple[NDArray[np.int64], int]:
    """Class of each row for one band, and how many classes; the first band has but precision to go by."""
    if band > 1:
        return activity_classes(lower, layout.sh_classes), layout.sh_classes
    return (np.zeros(len(lower), dtype=np.int64), 1) if first is None else (first, layout.sh_classes)


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
