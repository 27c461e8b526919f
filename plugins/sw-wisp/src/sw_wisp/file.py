"""The file of wisp: a header, one section of statistics and networks, and a section a packet.

Section `networks`: probabilities of the octree, context (statistics or networks), strengths of centroids, appearance
network. Sections `packet.01`, ...: the packets in the order of the header, each with one range coder. The file may end
after any of them that is worth it: a prefix of whole packets is a scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_codecs.entropy.exact_tables import exact_tables
from sw_codecs.positions import morton
from sw_wisp import numbers
from sw_wisp.cube import Cube, splat_cells
from sw_wisp.decoded import SWELL_UNIT, Decoded
from sw_wisp.eight_bits import EightBitLayer, pack_layers, unpack_layers
from sw_wisp.fast.streams import reader_of
from sw_wisp.nested import UNIT, Writer
from sw_wisp.numbers import GROUPS, NUMBERS
from sw_wisp.octree import MOST_IN_A_CELL, Cells, file_order, fit_shares
from sw_wisp.octree_contexts import Shares
from sw_wisp.packets import (
    KINDS,
    MOST_PLANES,
    MOST_SUBSETS,
    Context,
    Packet,
    Prediction,
    Walk,
    check_order,
    default_order,
)
from sw_wisp.predicting import PyramidContext
from sw_wisp.static import StaticContext

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter

CONTEXTS: dict[str, Any] = {each.kind: each for each in (StaticContext, PyramidContext)}
BYTES_OF_A_ROW = 4 * NUMBERS * 4 + 5 * 8 + 59 * 4
"""Of memory that a decoded splat takes: its integers, its cell, and the Gaussian."""
MOST_ROWS = 1 << 26
MOST_LAYERS, WIDEST = 16, 4096
MOST_SWELL = 127
Swell = Sequence[Sequence[int]]


@dataclass(frozen=True)
class Scene:
    """Splats and settings to be coded; tensors on any device, rows in any order.

    cube        root of the octree
    levels      [N] int, 3..18, and `cells` [N,3] int at those levels, at most 16 splats in one
    values      [N,22] float, the numbers of `sw_wisp.numbers` in their own units
    appearance  layers of the appearance network
    sh_degree   of the bands that it makes
    base_steps  Q0 of each column
    subsets     [N] int, which subset a splat belongs to; None: all to the only one
    order       (subset, kind) of each packet; None: `default_order`
    planes      refinements of shape, size and colour, 0 to 2
    context     None: statistics of the values by level and column
    in_order    whether splats of one cell keep their order; else the most opaque come first
    strengths   [planes + 1, 5] in 0..1 of the pull towards centroids, by missing refinements and group; None: 0
    psnr        of the training views with the first 1, 2, ... packets, dB; None: not known
    swell       for 1, 2, ... of the subsets, while others are missing: of each of them what is added to size and
                opacity, in 1/32; empty: nothing
    """

    cube: Cube
    levels: Tensor | np.ndarray
    cells: Tensor | np.ndarray
    values: Tensor | np.ndarray
    appearance: tuple[EightBitLayer, ...]
    sh_degree: int = 3
    base_steps: tuple[float, ...] = numbers.BASE_STEPS
    subsets: Tensor | np.ndarray | None = None
    order: tuple[tuple[int, str], ...] | None = None
    planes: int = 0
    context: Context | None = None
    strengths: np.ndarray | None = None
    in_order: bool = False
    psnr: tuple[float, ...] | None = None
    swell: Swell = ()


@dataclass(frozen=True)
class Encoded:
    """rows [N] int64: which splat of the scene each row of the file is; `decoded`: what a decoder gets."""

    rows: np.ndarray
    decoded: Decoded


def encode(scene: Scene, writer: ContainerWriter) -> Encoded:
    """Write all sections and header values of a scene; of each number the nearest index.

    What was written is decoded again and compared. Raises ValueError for values that are not finite, cells that are
    none, or more than 16 splats in one.
    """
    levels, places = splat_cells(scene.levels, scene.cells)
    values = np.asarray(_array(scene.values), np.float64)
    if values.shape != (len(levels), NUMBERS) or not np.isfinite(values).all():
        raise ValueError(f"values must be finite and [{len(levels)},{NUMBERS}], not {list(values.shape)}")
    scene.cube.check()
    labels = np.zeros(len(levels), np.int64) if scene.subsets is None else np.asarray(_array(scene.subsets), np.int64)
    count = int(labels.max(initial=0)) + 1
    order = scene.order or default_order(count, scene.planes)
    ranks = -np.arange(len(levels)) if scene.in_order else values[:, 0]
    rows, subsets = _sorted(levels, places, ranks, labels, [s for s, kind in order if kind == "base"])
    steps = np.asarray(scene.base_steps, np.float64)
    limits = np.array(numbers.LIMITS)
    units = np.clip(values[rows], -limits, limits) * (UNIT / steps)
    context = scene.context or StaticContext.fitted(levels[rows], units)
    shares = fit_shares(subsets)
    strengths = np.zeros((scene.planes + 1, len(GROUPS))) if scene.strengths is None else scene.strengths
    pulled = np.rint(255 * np.clip(strengths, 0, 1)).astype(np.uint8)

    def choose(at: np.ndarray, columns: slice, known: Prediction) -> np.ndarray:
        return np.rint((units[at, columns] - known.mean) / known.multiplier).astype(np.int64)

    sizes = {label: len(part) for label, part in zip([s for s, k in order if k == "base"], subsets, strict=True)}
    packets = [Packet(subset, kind, sizes[subset]) for subset, kind in order]
    walk = Walk(context, shares, scene.planes, subsets, choose)
    sections = [shares.pack() + context.pack() + pulled.tobytes() + pack_layers(scene.appearance)]
    for packet in packets:
        stream = Writer()
        walk.packet(stream, packet)
        sections.append(stream.finish())

    tables = exact_tables()
    writer.static.update(
        tables=[tables.version, tables.crc], planes=scene.planes, context=context.kind, sh_degree=scene.sh_degree,
        order=[[p.subset, p.kind, p.rows] for p in packets], base_steps=steps.tolist(), low=list(scene.cube.low),
        edge=scene.cube.edge, appearance=[list(layer.shape) for layer in scene.appearance],
        **({"swell": [list(row) for row in scene.swell]} if len(scene.swell) else {}),
    )  # fmt: skip
    _write_sections(writer, packets, sections, scene.psnr or (None,) * len(packets))
    decoded = Decoded(
        walk.state, scene.cube, steps, pulled, scene.appearance, scene.sh_degree, np.zeros((len(levels), 2))
    )
    again = _decoded(context, shares, scene.planes, packets, sections[1:])
    if any(not np.array_equal(getattr(again, name), getattr(walk.state, name)) for name in ("index", "mean", "levels")):
        raise RuntimeError("a packet does not decode to what was encoded; please report this")
    return Encoded(rows, decoded)


def _write_sections(
    writer: ContainerWriter, packets: Sequence[Packet], sections: Sequence[bytes], psnr: Sequence[float | None]
) -> None:
    """Add the section `networks` and those of packets, with a cut after each that is not better without the next."""
    writer.add("networks", sections[0])
    rows = 0
    for number, packet in enumerate(packets):
        writer.add(section_name(number), sections[number + 1])
        rows += packet.rows if packet.kind == "base" else 0
        is_last = number == len(packets) - 1
        if is_last or (sections[number + 2] and not (psnr[number] or 0) > (psnr[number + 1] or 0)):
            writer.allow(rows * BYTES_OF_A_ROW, f"a scene of {rows:,} splats")
            writer.cut(psnr[number])


def decode(reader: ContainerReader) -> Decoded:
    """Read the scene that the packets of a file, or of a prefix of it, hold. Raises BitstreamError."""
    header = _Header.read(reader)
    taken = header.packets[: len(reader.sections) - 1]
    reader.allow(sum(p.rows for p in taken if p.kind == "base") * BYTES_OF_A_ROW, "splats")
    with reader.decoding("networks") as data:
        parts = ByteReader(data)
        shares = Shares.unpack(parts)
        context = CONTEXTS[header.context].unpack(parts)
        strengths = np.frombuffer(parts.take((header.planes + 1) * len(GROUPS)), np.uint8).reshape(-1, len(GROUPS))
        appearance = unpack_layers(parts, header.appearance)
        parts.finish()
    walk = Walk(context, shares, header.planes)
    for number, packet in enumerate(taken):
        with reader.decoding(section_name(number)) as data:
            stream = reader_of(data)
            walk.packet(stream, packet)
            stream.finish()
    walk.finish()
    there = [p.rows for p in taken if p.kind == "base"]
    swell = np.zeros((len(there), 2))
    if len(there) <= len(header.swell):
        swell = np.reshape(header.swell[len(there) - 1], (-1, 2)) / SWELL_UNIT
    return Decoded(
        walk.state, header.cube, header.base_steps, strengths, appearance, header.sh_degree,
        np.repeat(swell, there, axis=0),
    )  # fmt: skip


def section_name(number: int) -> str:
    """Section of packet 0, 1, ..."""
    return f"packet.{number + 1:02d}"


@dataclass(frozen=True)
class _Header:
    packets: tuple[Packet, ...]
    planes: int
    context: str
    cube: Cube
    base_steps: np.ndarray
    appearance: tuple[tuple[int, int, int], ...]
    sh_degree: int
    swell: Swell

    @classmethod
    def read(cls, reader: ContainerReader) -> _Header:
        """Header values of a file, checked. Raises BitstreamError."""
        try:
            return cls._read(reader)
        except (TypeError, ValueError) as error:
            raise BitstreamError(f"{reader.name}: the header makes no sense: {error}", section="header") from error
        except BitstreamError as error:
            raise error if error.section else BitstreamError(f"{reader.name}: {error}", section="header") from error

    @classmethod
    def _read(cls, reader: ContainerReader) -> _Header:
        static = reader.static
        version, crc = _integers(static, "tables", 2, high=(1 << 32) - 1)
        exact_tables().check(version, crc)
        planes = reader.integer("planes", low=0, high=MOST_PLANES)
        context = reader.text("context", choices=list(CONTEXTS))
        packets = tuple(_packet(row) for row in _rows(static, "order", MOST_SUBSETS * (MOST_PLANES + 2)))
        check_order(packets, planes)
        if sum(p.rows for p in packets if p.kind == "base") > MOST_ROWS:
            raise BitstreamError(f"more than {MOST_ROWS:,} splats")
        names = ["networks", *map(section_name, range(len(packets)))]
        there = len(reader.sections) if reader.cuts else len(names)  # files of before had no cuts
        last = reader.cuts[-1].sections if reader.cuts else there
        if last != len(names) or there < 2 or list(reader.sections) != names[:there]:
            raise BitstreamError("sections are not those of the order of packets")
        low, steps = _floats(static, "low", 3, 1e30), _floats(static, "base_steps", NUMBERS, 1e30)
        if min(steps) <= 0:
            raise BitstreamError("a base step is not positive")
        cube = Cube((low[0], low[1], low[2]), reader.number("edge", low=1e-30, high=1e30))
        layers = [tuple(_within(row, [WIDEST, WIDEST, 1])) for row in _rows(static, "appearance", MOST_LAYERS)]
        shapes = tuple((rows, columns, bias) for rows, columns, bias in layers)
        degree = reader.integer("sh_degree", low=0, high=3)
        return cls(packets, planes, context, cube, np.array(steps), shapes, degree, _swell(static, packets))


def _swell(static: dict[str, Any], packets: Sequence[Packet]) -> Swell:
    """Rows for 1, 2, ... subsets, but not all, of two numbers for each of them; nothing where the file tells none."""
    if "swell" not in static:
        return ()
    rows, subsets = _rows(static, "swell", MOST_SUBSETS), sum(p.kind == "base" for p in packets)
    if len(rows) != subsets - 1 or any(len(row) != 2 * there for there, row in enumerate(rows, 1)):
        raise BitstreamError("header value 'swell' has not two numbers for each of 1, 2, ... subsets but the last")
    if any(type(n) is not int or abs(n) > MOST_SWELL for row in rows for n in row):
        raise BitstreamError(f"header value 'swell' holds something else than integers up to {MOST_SWELL}")
    return rows


def _rows(static: dict[str, Any], key: str, most: int) -> list[Any]:
    found = static.get(key)
    if not isinstance(found, list) or len(found) > most or not all(isinstance(row, list) for row in found):
        raise BitstreamError(f"header value '{key}' is not a list of at most {most} rows")
    return found


def _within(row: Any, limits: Sequence[int]) -> list[int]:
    if not isinstance(row, list) or len(row) != len(limits) or any(type(n) is not int for n in row):
        raise BitstreamError(f"a row of the header is {row!r:.80}, must be {len(limits)} integers")
    if any(not 0 <= n <= most for n, most in zip(row, limits, strict=True)):
        raise BitstreamError(f"a row of the header is {row!r:.80}, out of range")
    return row


def _packet(row: list[Any]) -> Packet:
    if len(row) != 3 or row[1] not in KINDS:
        raise BitstreamError(f"a packet of the header is {row!r:.80}, must be [subset, kind, rows]")
    subset, rows = _within([row[0], row[2]], [MOST_SUBSETS - 1, MOST_ROWS])
    return Packet(subset, row[1], rows)


def _integers(static: dict[str, Any], key: str, count: int, *, high: int) -> list[int]:
    found = static.get(key)
    if not isinstance(found, list):
        raise BitstreamError(f"header value '{key}' is no list")
    return _within(found, [high] * count)


def _floats(static: dict[str, Any], key: str, count: int, limit: float) -> list[float]:
    found = static.get(key)
    if not isinstance(found, list) or len(found) != count or any(type(x) not in (int, float) for x in found):
        raise BitstreamError(f"header value '{key}' must be {count} numbers")
    if not all(math.isfinite(x) and abs(x) <= limit for x in found):
        raise BitstreamError(f"header value '{key}' is out of range")
    return [float(x) for x in found]


def _sorted(
    levels: np.ndarray, places: np.ndarray, ranks: np.ndarray, labels: np.ndarray, subsets: list[int]
) -> tuple[np.ndarray, list[Cells]]:
    """Rows of the scene in the order of the file, and the cells of each subset in the order of their bases."""
    cells = Cells(levels, morton.encode(places))
    _, crowd = np.unique(np.stack([levels, cells.codes]), axis=1, return_counts=True)
    order = file_order(levels, places, ranks)
    parts = [order[labels[order] == subset] for subset in subsets]
    rows = np.concatenate([np.empty(0, np.int64), *parts])
    if crowd.max(initial=0) > MOST_IN_A_CELL or len(rows) != len(levels):
        raise ValueError(
            f"more than {MOST_IN_A_CELL} splats share a cell (see Cube.settled), or a subset has no packet"
        )
    return rows, [cells.part(part) for part in parts]


def _array(values: Tensor | np.ndarray) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values


def _decoded(context: Context, shares: Shares, planes: int, packets: Sequence[Packet], data: Sequence[bytes]) -> Any:
    walk = Walk(context, shares, planes)
    for packet, section in zip(packets, data, strict=True):
        stream = reader_of(section)
        walk.packet(stream, packet)
        stream.finish()
    return walk.state
