"""Files of more Gaussians than are held in memory at once, in two passes.

The first pass reads what is drawn without higher spherical harmonics of all Gaussians, makes up cameras, and ranks them
by what they change in pictures of the whole scene. How many stay, and how precise they are, is searched for on a sample
of runs from everywhere, drawn among coarse stand-ins of all others: its errors and bytes are a share of those of the
whole. The second pass reduces and writes tile by tile.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.render_options import antialias_of, raster_of
from sw_gaussians.simplifying import merged_by
from torch import Tensor

from splatwizard_core.api import ContainerReader, GaussianModel, RasterOptions, UserInputError, track
from splatwizard_core.tooling import NegotiatedRasterizer
from sw_codecs.models.quantized import FAINTEST
from sw_compress import coders
from sw_compress.allocation import at_price, of_error, within
from sw_compress.among import Among, coarse, sample_rows, without
from sw_compress.calibrating import calibrate, rounded_error, sizes_of
from sw_compress.coders import FIXED_BYTES, Levels, Quantized
from sw_compress.filling import AIM, MOST_ENCODES
from sw_compress.large_scene import LargeScene, read_scene
from sw_compress.measuring import Errors
from sw_compress.ply_blocks import PlyBlocks, blocks_of
from sw_compress.pruning import Pruning
from sw_compress.quality import Pictures, decibels
from sw_compress.reducing import Reduction
from sw_compress.rows import IMPORTANCE, like, select, with_degree
from sw_compress.search import (
    COARSEST_PRICE,
    Choice,
    Search,
    for_quality,
    for_size,
    least_bytes,
    too_small,
    within_bytes,
)
from sw_compress.shelf import Shelf
from sw_compress.stages import Stages, give_back
from sw_compress.targets import LEAST_SHARE, QUALITY_MARGIN, Target
from sw_compress.tiled_file import TiledFile, tiles_of
from sw_compress.views import Views, made_up_views
from sw_compress.whole import Whole

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core.api import PluginManager, Rasterizer
    from sw_codecs.models.sh_basis import Basis

LARGE = {"cpu": 4_000_000, "cuda": 16_000_000}
"""Gaussians above which a file is made small in two passes, by kind of device."""
LEAST_ROW = 56
"""Bytes of a Gaussian in a .ply, at least."""
SAMPLE, RUN = 1 << 18, 1 << 12
"""Gaussians that are searched with, and how many of them lie side by side."""
QUALITY_TRIES = 6
"""Files that are written for a quality; each is decoded and drawn."""
MOST_BY_REST = 4.0
"""Times that an error may be larger with higher SH than without."""
MOST_LOST = 0.6
"""Share of the error of a quality that may be of Gaussians that are gone."""


def large_file(path: Path, device: torch.device) -> PlyBlocks | None:
    """The rows of a .ply that is to be made small in two passes; None for any other file."""
    name, most = path.name.lower(), LARGE[device.type]
    if not name.endswith(".ply") or name.endswith(".compressed.ply") or not path.is_file():
        return None
    if path.stat().st_size < LEAST_ROW * most:  # not even its header is looked at
        return None
    found = blocks_of(path)
    return found if found is not None and found.count > most else None


@dataclass(frozen=True)
class WrittenLarge:
    """A file that was written, as `compressing` goes on with it."""

    facts: dict[str, Any]
    judge: Pictures
    held_out: Pictures
    seen: Views
    plugins: PluginManager
    device: torch.device
    stages: Stages

    def opened(self, path: Path, _: object) -> tuple[LargeScene, dict[str, Any]]:
        """Decode the file; return that, and the bytes of its sections, those of all tiles together."""
        with self.stages.timed("decode"):
            scene, reader = decoded(path, self.plugins, self.device)
        sections: dict[str, int] = {"header": reader.header_bytes}
        for name, size in reader.sections.items():
            name = name.rpartition("/")[2]
            sections[name] = sections.get(name, 0) + size
        facts: dict[str, Any] = {"sections": sections}
        if "foreseen" in self.facts:
            with self.stages.timed("check"):
                facts["found"] = round(decibels(self.judge.error(scene)), 2)
        return scene, facts


def decoded(path: Path, plugins: PluginManager, device: torch.device) -> tuple[LargeScene, ContainerReader]:
    """The Gaussians of a file in tiles. Raises BitstreamError, OSError."""
    reader = ContainerReader.open(path)
    return LargeScene.of_tiles(tiles_of(reader, plugins, device), Shelf(path.parent)), reader


@dataclass(frozen=True)
class Asked:
    """Target and bounds of one file."""

    target: Target
    given: Views | None
    views: int | None
    gaussians: int | None
    sh_degree: int | None
    drop_unseen: bool
    device: torch.device
    plugins: PluginManager
    stages: Stages
    say: Callable[[str], None]


def write_large(blocks: PlyBlocks, asked: Asked, path: Path) -> WrittenLarge:
    """Write the file. Raises UserInputError for a target out of reach, SceneError, BitstreamError, OSError."""
    with contextlib.ExitStack() as shelves:
        work = _Work(blocks, asked, path, shelves)
        facts = work.for_size() if asked.target.size is not None else work.for_quality()
    return WrittenLarge(facts, work.judge, work.held_out, work.seen, asked.plugins, asked.device, asked.stages)


class _Sample:
    """Runs of a scene from everywhere, drawn among stand-ins of all else, and the search on them.

    share   of the whole scene
    """

    def __init__(self, scene: LargeScene, seen: Views, rasterizer: Rasterizer, coder: Quantized, asked: Asked) -> None:
        light = scene.light
        rows = sample_rows(light.num_rows, SAMPLE, RUN).to(light.device)
        self.share = len(rows) / light.num_rows
        with asked.stages.timed("sample"):
            among = Among(rasterizer, coarse(light, without(light.num_rows, rows)))
            model = scene.part(rows)
            options = RasterOptions(alpha=True)
            self.judge = Pictures(model, seen.judge, among, options)
            model = model if asked.sh_degree is None else with_degree(model, asked.sh_degree)
            count = None if asked.gaussians is None else max(1, round(self.share * asked.gaussians))
            if (size := asked.target.size) is not None and (
                least := self.whole_bytes(least_bytes(coder, model, count))
            ) > 2 * size:
                raise too_small(size, f"about {least:,.0f}")
            pruning = Pruning(model, seen.fit, among, keeps_unseen=keeps_unseen(asked))
            setattr(model, IMPORTANCE, pruning.importance)
        with asked.stages.timed("sensitivities"):
            errors = Errors(coder, model, self.judge)
        self.reduction = Reduction(model, pruning, self.judge)
        self.search = Search(coder, model, self.reduction, self.judge, errors, count)
        self._plain = Pictures(with_degree(model, 0), seen.judge, among, options)
        self.whole: dict[int, float] = {}  # Gaussians of the sample -> error of all pictures of the whole

    def bytes_of(self, size: float) -> float:
        """The sample's part of a file of `size` bytes: what is fixed has each of them."""
        return FIXED_BYTES + self.share * (size - FIXED_BYTES)

    def whole_bytes(self, size: float) -> float:
        """The file whose part has `size` bytes."""
        return FIXED_BYTES + (size - FIXED_BYTES) / self.share

    def more(self, choice: Choice) -> int | None:
        """The next larger number to try; None: there is none."""
        parts = self.search.parts()
        place = min(range(len(parts)), key=lambda i: abs(parts[i] - choice.model.num_rows))
        return parts[place - 1] if place else None

    @torch.no_grad()
    def foreseen(self, choice: Choice, lost: float) -> float:
        """Error of the pictures of the whole.

        lost    by fewer Gaussians, drawn without higher SH

        Errors of rounding are the sample's, as many times larger: they have no common sign. What is known of the
        whole corrects them.
        """
        part, coder = choice.model, self.search.coder
        reduced, plain = self.judge.error(part), self._plain.error(with_degree(part, 0))
        both = self.judge.error(coder.rounded(part, choice.allocation.levels))
        coder.forget()
        rest = min(max(reduced / plain, 1.0), MOST_BY_REST) if plain > 0 else 1.0
        known = self.search.errors.correction(choice.allocation.levels)
        found = rest * lost + known * max(both - reduced, 0.0) / self.share
        self.whole[part.num_rows] = found
        return found

    def tried(self) -> list[dict[str, Any]]:
        """Numbers that were looked at, as figures of the whole; the dB of those that it was not drawn for are the
        sample's, which does not see all."""
        return [
            {"gaussians": round(n / self.share), "bytes": round(self.whole_bytes(b)),
             "psnr": round(decibels(self.whole[n]) if n in self.whole else q + 10 * math.log10(self.share), 2)}
            for n, b, q in self.search.tried
        ]  # fmt: skip


class _Unrounded:
    """Quality of a part: its errors are too small for colours of 8 bits."""

    def __init__(self, pictures: Pictures) -> None:
        self._pictures = pictures

    def quality(self, model: GaussianModel) -> _Unrounded:
        self.psnr = decibels(self._pictures.error(model))
        return self


class _Work:
    """The scene, its pictures, and the file on the way.

    shelves     closes what lies beside the file
    """

    def __init__(self, blocks: PlyBlocks, asked: Asked, path: Path, shelves: contextlib.ExitStack) -> None:
        self.asked, self.path, self.shelves, self.encodes = asked, path, shelves, 0
        with asked.stages.timed("read"):
            scene, read = read_scene(blocks, self._shelf(), asked.device, blocks.path.name)
        if read < blocks.count:
            asked.say(f"{blocks.path.name}: {blocks.count - read:,} Gaussians mean nothing and were left out")
        light = scene.light
        self.coder = Quantized(asked.plugins, raster_of(light), precise=True)
        self._rasterizer = rasterizer = NegotiatedRasterizer(
            asked.plugins, device=asked.device, options=raster_of(light)
        )
        with asked.stages.timed("cameras"), torch.no_grad():
            self.seen = made_up_views(light, rasterizer, asked.views) if asked.given is None else asked.given
            self.held_out = Pictures(scene, self.seen.held_out, rasterizer, RasterOptions(alpha=True))
        self.sample = _Sample(scene, self.seen, rasterizer, self.coder, asked)
        with asked.stages.timed("score"):
            pruning = Pruning(light, self.seen.fit, rasterizer, keeps_unseen=keeps_unseen(asked))
            unseen = int(pruning.unseen.sum())
            self._whole: Whole | None = Whole(scene, pruning, self.seen.judge, rasterizer)
        with asked.stages.timed("sensitivities"):
            search = self.sample.search
            self.judge = calibrate(
                search.errors, search.model, scene, pruning.importance, self.coder, self._compared(), self.seen.judge,
                rasterizer,
            )  # fmt: skip
        self.facts: dict[str, Any] = {
            "source": {"file": blocks.path.name, "bytes": blocks.path.stat().st_size, "gaussians": read},
            "target": {"bytes": asked.target.size, "psnr": asked.target.quality},
            "left_out": read - scene.num_rows, "unseen": unseen, "antialiased": antialias_of(light),
            "tiles": len(scene.tiles), "refined": None,
        }  # fmt: skip

    def _shelf(self) -> Shelf:
        shelf = Shelf(self.path.parent)
        self.shelves.callback(shelf.close)
        return shelf

    def _compared(self) -> Levels:
        """Levels about as a choice will have, at which the sample is compared with the whole."""
        search, target = self.sample.search, self.asked.target
        curves, count = search.errors.curves(self.coder, search.model), search.model.num_rows
        if target.size is None:
            assert target.quality is not None  # it is asked for
            return of_error(curves, 10 ** (-target.quality / 10) * self.sample.share).levels
        budget = self.sample.bytes_of(target.size) * count / min(search.count or count, count)
        return (within(curves, budget) or at_price(curves, COARSEST_PRICE)).levels

    def for_size(self) -> dict[str, Any]:
        """Write the best file of the size."""
        size, sample = self.asked.target.size, self.sample
        assert size is not None  # it is asked for
        with self.asked.stages.timed("search"):
            choice = for_size(sample.search, sample.bytes_of(size))
        choice = sample.search.coarsest if choice is None else self._enough(choice, sample.bytes_of(size))
        assert choice is not None  # a search looks at one part at least
        file = self._reduced(choice)
        choice, basis = self._measured(choice, file)
        choice = choice.within(sample.bytes_of(size)) or choice.coarsest()
        with self.asked.stages.timed("search"):
            error = rounded_error(
                file.scene, file.importance, self.coder, choice.allocation.levels, basis, self.judge, self._rasterizer
            )
        self.facts["foreseen"] = round(decibels(error), 2)
        best, most, held = choice, 0, None
        before: tuple[float, float] | None = None  # bytes by the tables, and of the file
        for _ in range(MOST_ENCODES):
            written, held = self._write(file, choice), choice
            if most < written <= size:
                best, most = choice, written
            if LEAST_SHARE * size < written <= size or (written <= size and choice.is_finest):
                break
            power = 1.0  # of the bytes of the file with which those of the tables grow
            if before is not None and written != before[1]:
                power = math.log(choice.bytes / before[0]) / math.log(written / before[1])
            before = choice.bytes, written
            wanted = choice.bytes * (AIM * size / written) ** min(max(power, 0.5), 2.0)
            resized = choice.resized(wanted)
            if resized is None or resized.allocation.levels == choice.allocation.levels:
                resized = choice.coarsest() if written > size else None
            if resized is None or resized.allocation.levels == choice.allocation.levels:
                break
            choice = resized
        if not most:
            raise too_small(size, f"{written:,}")
        if held is not best:
            self._write(file, best)
        if most <= LEAST_SHARE * size:
            what = "the finest settings give {:,} bytes, less than the target of {:,}"
            told = what if best.is_finest else "{:,} bytes are the nearest to {:,} that was found"
            self.asked.say(told.format(most, size))
        return self._facts(best, most)

    def for_quality(self) -> dict[str, Any]:
        """Write the smallest file of the quality that a few tries find."""
        quality, sample = self.asked.target.quality, self.sample
        assert quality is not None  # it is asked for
        with self.asked.stages.timed("search"):
            exact: Any = _Unrounded(sample.judge)
            choice = for_quality(sample.search, quality - 10 * math.log10(sample.share), exact)
        choice = self._good(choice, 10 ** (-quality / 10))
        file = self._reduced(choice)
        choice, _ = self._measured(choice, file)
        best: tuple[int, Choice] | None = None
        good: tuple[float, float] | None = None  # decibels by the tables, and in pictures
        bad: tuple[float, float] | None = None
        curves, haste, aim = choice.curves, 1.0, quality + QUALITY_MARGIN / 2
        for _ in range(QUALITY_TRIES):
            written = self._write(file, choice)
            with self.asked.stages.timed("check"):
                scene, _ = decoded(self.path, self.asked.plugins, self.asked.device)
                reached = self.held_out.quality(scene).psnr
                scene.shelf.close()
            here = decibels(choice.allocation.error), reached
            if reached >= quality:
                best, good = (written, choice) if best is None or written < best[0] else best, here
            else:
                bad = here
            if quality <= reached <= quality + QUALITY_MARGIN or (reached < quality and choice.is_finest):
                break
            if best is not None and curves is choice.curves:  # a bit of the positions is a jump: go on from it
                curves, bad, haste = best[1].placed(), None, 1.0
            if good is not None and bad is not None:
                share = min(max((aim - bad[1]) / max(good[1] - bad[1], 1e-6), 0.1), 0.9)
                wanted = bad[0] + share * (good[0] - bad[0])
            else:  # part of the error may be of what is gone, which no precision mends
                wanted, haste = here[0] + haste * (aim - reached), 2 * haste
            choice = replace(choice, allocation=of_error(curves, 10 ** (-wanted / 10)))
        if best is None:
            raise UserInputError(
                f"the finest settings that were tried reach {reached:.1f} dB against the source, which is less than "
                f"{quality:g} dB"
            )
        if best[1] is not choice:
            self._write(file, best[1])
        return self._facts(best[1], best[0])

    def _facts(self, choice: Choice, written: int) -> dict[str, Any]:
        levels = choice.allocation.levels
        return {
            **self.facts, "bytes": written, "encodes": self.encodes, "tried": self.sample.tried(),
            "precision": self.coder.settings(levels).model_dump(exclude={"positions", "entropy"}),
        }  # fmt: skip

    def _write(self, file: TiledFile, choice: Choice) -> int:
        self.encodes += 1
        with self.asked.stages.timed("encode"):
            return file.write(choice.allocation.levels, self.path)

    def _lost(self, choice: Choice) -> float:
        """Error of the whole with as small a share of its Gaussians as a choice has of the sample's."""
        assert self._whole is not None  # not reduced yet
        with self.asked.stages.timed("score"):
            return self._whole.lost(*self._share_of(choice))

    def _share_of(self, choice: Choice) -> tuple[int, float]:
        """Number of Gaussians of the whole, and the power of removals among those that go."""
        assert self._whole is not None  # not reduced yet
        whole, rows = self._whole.scene.num_rows, choice.model.num_rows
        count = max(1, round(whole * rows / self.sample.search.model.num_rows))
        if self.asked.gaussians is not None:
            count = min(self.asked.gaussians, whole)
        return count, self.sample.reduction.power(rows)

    def _enough(self, choice: Choice, budget: float) -> Choice:
        """The choice, or one of more Gaussians for the same bytes while that is better for the whole."""
        sample = self.sample
        error = sample.foreseen(choice, self._lost(choice))
        while (count := sample.more(choice)) is not None:
            with self.asked.stages.timed("search"):
                other = within_bytes(sample.search, count, budget)
            if other is None or (found := sample.foreseen(other, self._lost(other))) >= error:
                break
            choice, error = other, found
        return choice

    def _measured(self, choice: Choice, file: TiledFile) -> tuple[Choice, Basis | None]:
        """The choice with bytes as of what is written, and a basis of its higher SH coefficients."""
        with self.asked.stages.timed("search"):
            sizes, basis = sizes_of(file.scene, file.importance, self.coder, file.scene.degree)
        return choice.sized(sizes, self.sample.share), basis

    def _good(self, choice: Choice, error: float) -> Choice:
        """The choice, or one of so many Gaussians that what is gone leaves enough of an error to rounding."""
        sample = self.sample
        while (lost := self._lost(choice)) > MOST_LOST * error and (count := sample.more(choice)) is not None:
            with self.asked.stages.timed("search"):
                part, curves = sample.search.part(count)
            choice = Choice(part, curves, choice.allocation)
        rounding = max(error - lost, (1 - MOST_LOST) * error) * sample.share
        return replace(choice, allocation=of_error(choice.curves, rounding))

    def _reduced(self, choice: Choice) -> TiledFile:
        """The whole scene with as small a share of its Gaussians as a choice has of the sample's; lets the scene go."""
        count, power = self._share_of(choice)
        whole, self._whole = self._whole, None
        assert whole is not None  # it is done once
        scene, rows = whole.scene, whole.rows(count, power)
        with self.asked.stages.timed("reduce"):
            importance = list[Tensor]()
            tiles = _reduced(whole, rows, whole.counts(count, power), importance, self.asked)
            found = LargeScene.of_tiles(tiles, self._shelf())
            self.facts |= {"pruned": scene.num_rows - len(rows), "merged": len(rows) - found.num_rows}
            scene.shelf.close()
            del scene, whole, tiles
            return TiledFile(found, torch.cat(importance), self.coder, coders.OWN_BASIS)


def keeps_unseen(asked: Asked) -> bool:
    """Whether what no camera shows stays."""
    return not asked.drop_unseen and asked.given is None and asked.gaussians is None


def _reduced(
    whole: Whole, rows: Tensor, counts: list[int], importance: list[Tensor], asked: Asked
) -> Iterator[GaussianModel]:
    """Tiles of the rows that stay, in which neighbours merge until `counts` are left; fills `importance`."""
    scene, weights, known = whole.scene, whole.weights, whole.importance  # of what none shows, the median, and nothing
    with track("reduce", total=len(scene.tiles), unit="tiles") as bar:
        for tile in scene.tiles:
            part = scene.rows(tile)
            own = rows[(rows >= part.start) & (rows < part.stop)]
            if not len(own):
                continue
            model = scene.tile(tile, own - part.start)
            model = model if asked.sh_degree is None else with_degree(model, asked.sh_degree)
            count, of = max(1, counts[tile]), known[own]
            if count < len(own):
                all_of = torch.arange(len(own), device=own.device)
                merged, of = merged_by(model, all_of, count, weights[own], summed=of)
                model = like(model, merged)
                drawn = model.opacity_logits >= FAINTEST
                if not bool(drawn.all()):
                    model, of = select(model, drawn), of[drawn]
            importance.append(of)
            yield model
            bar.advance()
            give_back()
