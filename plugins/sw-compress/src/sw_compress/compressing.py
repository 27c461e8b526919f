"""A splat file made small: cameras, what may go, how precise the rest is, and the file."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from splatwizard_core.api import Camera, GaussianModel, PluginManager, RasterOptions, UserInputError, replacing
from splatwizard_core.tooling import OUTPUT_FILE, NegotiatedRasterizer, choose_device, load_plugins, open_model
from sw_compress.coders import PRECISE_FROM, Quantized
from sw_compress.filling import Filled, fill
from sw_compress.formats import FORMATS, FormatFile, format_file
from sw_compress.large import Asked, WrittenLarge, large_file, write_large
from sw_compress.large_scene import LargeScene
from sw_compress.measuring import Errors
from sw_compress.pruning import Pruning
from sw_compress.quality import PHOTOGRAPHS, Pictures, loss_against_photographs, told_loss
from sw_compress.reducing import Reduction
from sw_compress.refining import Refined, refine
from sw_compress.rows import IMPORTANCE, with_degree
from sw_compress.search import Choice, Search, check_in_reach, for_quality, measured_again
from sw_compress.source import Source, lay_aside, open_source
from sw_compress.stages import Stages, peak_bytes
from sw_compress.targets import Target
from sw_compress.views import Views, made_up_views, views_of_file

SWZ = "swz"
LONGEST = 86_400
"""Seconds that a refinement may take."""


@dataclass(frozen=True)
class Compressed:
    """Outcome.

    out     the file; None where its bytes were asked for
    data    the bytes; None where a file was asked for
    model   as the file decodes; of a large one what is drawn of it, its higher harmonics in a file
    record  bytes by section, counts, precision, quality, cameras, seconds: JSON values
    """

    out: Path | None
    data: bytes | None
    model: GaussianModel | LargeScene
    record: dict[str, Any]


def compress(
    scene: str | os.PathLike[str] | GaussianModel,
    *,
    size: str | int | None = None,
    quality: str | float | None = None,
    ratio: str | float | None = None,
    out: str | os.PathLike[str] | None = None,
    format: str = SWZ,
    cameras: str | os.PathLike[str] | None = None,
    views: int | None = None,
    gaussians: int | None = None,
    sh_degree: int | None = None,
    drop_unseen: bool = False,
    refine: float = 0.0,
    device: str = "auto",
    plugins: PluginManager | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Compressed:
    """Make a scene small without its photographs.

    scene       a file of explicit Gaussians of any known format, or a model
    size        bytes of the result at most: 8_000_000 or "8MB"; it has more than 99 % of them
    quality     dB against the source's own pictures at cameras that were held out; 40 where nothing is asked for
    ratio       of the source file's bytes to those of the result
    out         path of the result; None: its bytes are returned
    format      "swz", "sog" or "spz"
    cameras     JSON of cameras in place of those made up
    views       number of cameras that are made up; None: 18 to 60 on a CPU, 48 to 120 on a GPU, more where there is
                less to draw
    gaussians   number that stays, the most significant ones; None: what gives the best picture
    sh_degree   highest degree of the spherical harmonics; None: the source's
    drop_unseen whether what no camera shows may go; it does where `gaussians` is given
    refine      seconds of training on pictures of the source, for a .swz; 0: none
    say         takes lines for the user

    Equal files, options and kind of device give equal bytes, but for what `refine` makes in its time. Raises
    UserInputError for a target out of reach, SceneError and BitstreamError for a source that cannot be used.
    """
    # What is wrong with what is asked for is told before a large file is read.
    if format not in (SWZ, *FORMATS):
        raise UserInputError(f"format '{format}' is none of {', '.join((SWZ, *FORMATS))}")
    Target.of(size, quality, ratio, 0)
    if gaussians is not None and gaussians < 1:
        raise UserInputError(f"{gaussians} Gaussians: at least 1 must stay")
    if not 0 <= refine <= LONGEST:
        raise UserInputError(f"refine {refine:g}: must be a number of seconds in 0 .. {LONGEST:,}")
    if refine and format != SWZ:
        raise UserInputError(f"only .swz files are refined, not .{format}: leave out one of the two")
    if out is not None:
        OUTPUT_FILE.check(os.fspath(out))
    given = None if cameras is None else views_of_file(Path(cameras))
    stages, plugins = Stages(), load_plugins() if plugins is None else plugins
    asked = _Asked(
        size, quality, ratio, format, given, views, gaussians, sh_degree, drop_unseen, refine,
        choose_device(device, plugins), plugins, stages, say,
    )  # fmt: skip
    with contextlib.ExitStack() as beside:
        if out is not None:
            place = Path(beside.enter_context(replacing(out)))
        else:
            place = Path(beside.enter_context(tempfile.TemporaryDirectory(prefix="sw-compress-"))) / f"scene.{format}"
        written = _written_in_two_passes(scene, asked, place) or _written(scene, asked, place)
        # Only now, when neither source nor search are in memory.
        made: GaussianModel | LargeScene
        made, facts = written.opened(place, asked)
        data = place.read_bytes() if out is None else None
    with stages.timed("check"):
        found = written.held_out.quality(made)
    record = {
        "file": None if out is None else str(Path(out)),
        "format": format,
        **written.facts,
        **facts,
        "gaussians": made.num_rows,
        "sh_degree": made.active_sh_degree,
        "quality": found.as_dict(),
        "loss_of_photographs": {
            f"{each:g}": round(loss_against_photographs(found.psnr, each), 3) for each in PHOTOGRAPHS
        },
        "told": told_loss(found.psnr),
        "cameras": written.seen.as_dict(),
        "seconds": stages.rounded(),
        "peak_bytes": peak_bytes(asked.device),
        "device": str(asked.device),
    }
    return Compressed(None if out is None else Path(out), data, made, record)


@dataclass(frozen=True)
class _Asked:
    """Arguments of `compress`, checked."""

    size: str | int | None
    quality: str | float | None
    ratio: str | float | None
    format: str
    given: Views | None
    views: int | None
    gaussians: int | None
    sh_degree: int | None
    drop_unseen: bool
    refine: float
    device: torch.device
    plugins: PluginManager
    stages: Stages
    say: Callable[[str], None]


@dataclass(frozen=True)
class _Written:
    """A file that was written.

    model       as it decodes, where that is known
    facts       for the record
    held_out    pictures of the source that only measure
    """

    model: GaussianModel | None
    facts: dict[str, Any]
    held_out: Pictures
    seen: Views

    def opened(self, path: Path, asked: _Asked) -> tuple[GaussianModel, dict[str, Any]]:
        """The model of the file, and the bytes of its sections where they are not among the facts."""
        if self.model is not None:
            return self.model, {}
        with asked.stages.timed("decode"):
            model, reader = open_model(path, asked.plugins, asked.device)
        assert isinstance(model, GaussianModel)  # of a method of explicit Gaussians
        return model, {"sections": {"header": reader.header_bytes, **reader.sections}}


def _written_in_two_passes(
    scene: str | os.PathLike[str] | GaussianModel, asked: _Asked, path: Path
) -> WrittenLarge | None:
    """Write the file of a source that is too large for memory; None for any other source, or kind of result."""
    if isinstance(scene, GaussianModel) or asked.format != SWZ or asked.refine:
        return None
    given = Path(scene)
    blocks = large_file(given, asked.device)
    if blocks is None:
        return None
    target = Target.of(asked.size, asked.quality, asked.ratio, given.stat().st_size)
    how = Asked(
        target, asked.given, asked.views, asked.gaussians, asked.sh_degree, asked.drop_unseen, asked.device,
        asked.plugins, asked.stages, asked.say,
    )  # fmt: skip
    return write_large(blocks, how, path)


def _written(scene: str | os.PathLike[str] | GaussianModel, asked: _Asked, path: Path) -> _Written:
    """Write the file."""
    stages = asked.stages
    with stages.timed("read"):
        source = open_source(scene, asked.plugins, asked.device)
    if not isinstance(scene, GaussianModel):  # that one is somebody else's
        lay_aside(source.model, path.parent)
    target = Target.of(asked.size, asked.quality, asked.ratio, source.file_bytes)
    model = source.model if asked.sh_degree is None else with_degree(source.model, asked.sh_degree)
    coder = Quantized(asked.plugins, source.raster, precise=model.num_rows >= PRECISE_FROM)
    if target.size is not None and asked.format == SWZ:
        with stages.timed("read"):
            check_in_reach(coder, model, asked.gaussians, target.size)
    rasterizer = NegotiatedRasterizer(asked.plugins, device=asked.device, options=source.raster)
    with stages.timed("cameras"), torch.no_grad():
        seen = made_up_views(source.model, rasterizer, asked.views) if asked.given is None else asked.given
        options = RasterOptions(alpha=True)
        judge = Pictures(source.model, seen.judge, rasterizer, options)
        held_out = Pictures(source.model, seen.held_out, rasterizer, options)
    keeps_unseen = not asked.drop_unseen and asked.given is None and asked.gaussians is None
    pruning = Pruning(model, seen.fit, rasterizer, keeps_unseen=keeps_unseen)
    reduction = Reduction(model, pruning, judge)
    work = _Work(source, model, coder, judge, held_out, reduction, seen.fit, rasterizer, target, asked)
    made, count, facts = (_make_swz if asked.format == SWZ else _make_other)(work, path)
    pruned = reduction.pruned(count)
    facts = {
        "source": {"file": source.name, "bytes": source.file_bytes, "gaussians": source.read},
        "target": {"bytes": target.size, "psnr": target.quality},
        **facts,
        "left_out": source.read - source.model.num_rows,
        "pruned": pruned,
        "merged": source.model.num_rows - count - pruned,
        "unseen": int(pruning.unseen.sum()),
        "antialiased": source.antialiased,
    }
    return _Written(made, facts, held_out, seen)


@dataclass
class _Work:
    """Inputs of the making of a file."""

    source: Source
    model: GaussianModel
    coder: Quantized
    judge: Pictures
    held_out: Pictures
    reduction: Reduction
    fit: list[Camera]
    rasterizer: NegotiatedRasterizer
    target: Target
    asked: _Asked


def _make_swz(work: _Work, path: Path) -> tuple[GaussianModel | None, int, dict[str, Any]]:
    """Write the file; return None for its model, the number of its Gaussians, and facts."""
    asked, stages, coder = work.asked, work.asked.stages, work.coder
    with stages.timed("score"):
        setattr(work.model, IMPORTANCE, work.reduction.pruning.importance)
    with stages.timed("sensitivities"):
        errors = Errors(coder, work.model, work.judge)
    search = Search(coder, work.model, work.reduction, work.judge, errors, asked.gaussians)
    refined: Refined | None = None

    def better(choice: Choice) -> Choice:
        nonlocal refined
        levels = choice.allocation.levels
        with stages.timed("refine"):
            refined = refine(choice.model, work.model, work.fit, work.rasterizer, coder, levels, seconds=asked.refine)
        return Choice(refined.model, errors.curves(coder, refined.model), choice.allocation)

    if work.target.size is not None:
        filled = fill(search, work.target.size, path, stages, asked.say)
        if asked.refine:
            filled = fill(search, work.target.size, path, stages, asked.say, better(filled.choice))
    else:
        assert work.target.quality is not None  # one of the two is given
        with stages.timed("search"):
            choice = for_quality(search, work.target.quality, work.held_out)
        if asked.refine:
            choice = measured_again(search, better(choice), work.target.quality, work.held_out)
        with stages.timed("encode"):
            filled = Filled(choice, coder.encode(choice.model, choice.allocation.levels, path), 1)
    facts = {
        "bytes": filled.bytes,
        "precision": coder.settings(filled.choice.allocation.levels).model_dump(exclude={"positions", "entropy"}),
        "encodes": filled.encodes,
        "refined": None if refined is None else refined.as_dict(),
        "tried": [{"gaussians": n, "bytes": round(b), "psnr": round(q, 2)} for n, b, q in search.tried],
    }
    return None, filled.choice.model.num_rows, facts


def _make_other(work: _Work, path: Path) -> tuple[GaussianModel | None, int, dict[str, Any]]:
    """Write a file of another program; return its model, the number of its Gaussians, and facts."""
    asked = work.asked
    with asked.stages.timed("search"):
        found: FormatFile = format_file(
            asked.format, work.model, work.reduction, work.judge, work.held_out, work.target, asked.gaussians,
            asked.plugins, antialiased=work.source.antialiased, say=asked.say,
        )  # fmt: skip
    path.write_bytes(found.data)
    facts = {
        "bytes": len(found.data), "sections": found.sections, "precision": found.settings,
        "encodes": found.encodes, "tried": found.tried,
    }  # fmt: skip
    return found.model, found.model.num_rows, facts
