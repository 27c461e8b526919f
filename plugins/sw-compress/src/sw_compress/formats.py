"""Files of other programs to a size or a quality: Gaussians go, then spherical harmonics get coarse.

Their precision is the format's, so every candidate is written and read again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel, UserInputError
from sw_compress.quality import Pictures
from sw_compress.rows import like, with_degree
from sw_compress.targets import LEAST_SHARE, QUALITY_MARGIN, Target

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from sw_compress.reducing import Reduction

Settings = Mapping[str, Any]

FORMATS: Mapping[str, tuple[Settings, ...]] = {
    "spz": tuple({"sh1_bits": a, "sh_bits": b} for a, b in ((8, 8), (6, 5), (5, 4), (4, 3))),
    "sog": tuple({"palette": palette} for palette in (None, 16_384, 4_096, 1_024)),
}
"""Settings of the codec of each format, the most precise first."""
DECODED = "file"
"""Section of a codec's file that holds the other program's."""
PATIENCE = 2
STEPS = 6
"""Numbers of Gaussians tried with settings that were chosen."""
AIM = 0.996
FEWEST = 0.01
"""Least share of the Gaussians that stays."""


@dataclass(frozen=True)
class FormatFile:
    """A file of another program.

    model       as it decodes
    tried       what was written on the way
    """

    data: bytes
    model: GaussianModel
    settings: dict[str, Any]
    sections: dict[str, int]
    encodes: int
    tried: list[dict[str, Any]]


@dataclass
class _Writer:
    """Writes parts of a model, and remembers what it wrote."""

    name: str
    model: GaussianModel
    reduction: Reduction
    plugins: PluginManager
    antialiased: bool
    tried: list[dict[str, Any]] = field(default_factory=list)

    def file(self, count: int, settings: Settings, degree: int) -> FormatFile:
        """Write as many Gaussians as `count`, or as few as may stay."""
        part = with_degree(self.reduction.part(count), degree)
        codec = self.plugins.gaussian_codecs.load(self.name)(self.plugins, **settings)
        writer = ContainerWriter(self.name, 1, raster={"antialias": True} if self.antialiased else {})
        with torch.no_grad():
            codec.encode(part, writer)
        whole = writer.to_bytes()
        data = ContainerReader(whole).section(DECODED)
        model = like(part, codec.decode(ContainerReader(whole)).to(part.device))
        self.tried.append({"gaussians": part.num_rows, "bytes": len(data), **settings, "sh_degree": degree})
        return FormatFile(bytes(data), model, {**settings}, {DECODED: len(data)}, len(self.tried), self.tried)

    def candidates(self) -> Iterator[tuple[Settings, int]]:
        """Settings and SH degree, the most precise first."""
        degree = self.model.active_sh_degree
        if degree:
            yield from ((settings, degree) for settings in FORMATS[self.name])
        yield from ((FORMATS[self.name][-1], each) for each in range(degree - 1, -1, -1))
        if not degree:
            yield FORMATS[self.name][-1], 0


def format_file(
    name: str, model: GaussianModel, reduction: Reduction, judge: Pictures, held_out: Pictures, target: Target,
    count: int | None, plugins: PluginManager, *, antialiased: bool, say: Callable[[str], None],
) -> FormatFile:  # fmt: skip
    """The best file of a size, or the smallest of a quality. Raises UserInputError for a target out of reach."""
    writer = _Writer(name, model, reduction, plugins, antialiased)
    whole = model.num_rows if count is None else min(count, model.num_rows)
    if target.size is not None:
        return _of_size(writer, whole, target.size, judge, say, fixed=count is not None)
    assert target.quality is not None  # one of the two is given
    return _of_quality(writer, whole, target.quality, held_out, fixed=count is not None)


def _of_size(
    writer: _Writer, whole: int, size: int, judge: Pictures, say: Callable[[str], None], *, fixed: bool
) -> FormatFile:
    best: tuple[float, FormatFile] | None = None
    smallest, worse = math.inf, 0
    for settings, degree in writer.candidates():
        found, least = _filled(writer, whole, size, settings, degree, fixed=fixed)
        smallest = min(smallest, least)
        if found is None:
            continue
        error = judge.error(found.model)
        if best is None or error < best[0]:
            best, worse = (error, found), 0
        else:
            worse += 1
        if worse == PATIENCE:
            break
    if best is None:
        raise UserInputError(
            f"no .{writer.name} of {size:,} bytes was found: the smallest has {smallest:,} bytes (what no camera shows "
            "stays, unless --drop-unseen)"
        )
    if len(best[1].data) <= LEAST_SHARE * size:
        say(f"the best .{writer.name} that was found has {len(best[1].data):,} bytes; the target is {size:,}")
    return best[1]


def _filled(
    writer: _Writer, whole: int, size: int, settings: Settings, degree: int, *, fixed: bool
) -> tuple[FormatFile | None, int]:
    """The file of most Gaussians in `size` bytes, None where none was found; and the bytes of the smallest."""
    found = writer.file(whole, settings, degree)
    if len(found.data) <= size or fixed:
        return (found if len(found.data) <= size else None), len(found.data)
    known = [(0.0, 0.0), (found.model.num_rows, len(found.data))]  # bytes are nearly a constant, and some for each
    kept: FormatFile | None = None
    least = len(found.data)
    for _ in range(STEPS):
        (n0, b0), (n1, b1) = known
        slope = (b1 - b0) / (n1 - n0)
        count = min(whole, int(n1 + (AIM * size - b1) / slope)) if slope > 0 else 0
        if count < max(1, FEWEST * whole) or count in (n0, n1):
            break
        found = writer.file(count, settings, degree)
        least = min(least, len(found.data))
        if len(found.data) <= size and (kept is None or len(found.data) > len(kept.data)):
            kept = found
        if LEAST_SHARE * size < len(found.data) <= size or found.model.num_rows > 1.02 * count:
            break
        known = [known[1], (count, len(found.data))]
    return kept, least


def _of_quality(writer: _Writer, whole: int, quality: float, held_out: Pictures, *, fixed: bool) -> FormatFile:
    best: FormatFile | None = None
    reached = -math.inf
    for settings, degree in writer.candidates():
        found = writer.file(whole, settings, degree)
        psnr = held_out.quality(found.model).psnr
        reached = max(reached, psnr)
        if psnr < quality:
            break  # whatever comes is coarser
        low, high = 0.0, 1.0  # shares that are too few, and enough
        for _ in range(0 if fixed else STEPS):
            if psnr <= quality + QUALITY_MARGIN:
                break
            share = (low + high) / 2
            fewer = writer.file(max(1, round(share * whole)), settings, degree)
            psnr_fewer = held_out.quality(fewer.model).psnr
            if psnr_fewer >= quality:
                high, found, psnr = share, fewer, psnr_fewer
            else:
                low = share
        if best is None or len(found.data) < len(best.data):
            best = found
    if best is None:
        raise UserInputError(
            f"the most precise .{writer.name} reaches {reached:.1f} dB against the source, less than {quality:g} dB"
        )
    return best
