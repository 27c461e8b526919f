"""Files of any method to a size: settings between its rate points, then as many rows of the model as the size holds."""

from __future__ import annotations

import copy
import logging
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.render_options import options_of
from sw_gaussians.sized import LEAST_FILLED
from torch import Tensor, nn

from splatwizard_core.api import CapabilityError, UserInputError, parse_size
from splatwizard_core.tooling import NegotiatedRasterizer, filled_writer
from sw_compress.pruning import Pruning
from sw_compress.rate_ladder import RateLadder
from sw_compress.views import training_views

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerWriter, Method, OptimizationParams, SplatModel

log = logging.getLogger(__name__)

FILLED, GOAL = 0.99, 0.996
"""Share of the size that is good enough, and that is aimed at."""
SLACK = 64
"""Bytes by which a header may grow when the file is closed: names of what was tried."""
LOWEST = -3
"""Place on the ladder below the smallest rate point, 0, down to which settings go where rows would be halved."""
FEWEST = 0.5
"""Share of the rows below which coarser settings are better, or a file that leaves a part of the size."""
TRIES = 8
"""Settings and numbers of rows that are tried, each."""


@torch.no_grad()
def with_rows(model: SplatModel, rows: Tensor) -> SplatModel:
    """Return a copy in eval mode with the rows [M] of its `ROWS` alone, in that order."""
    part = copy.deepcopy(model)
    for name in part.ROWS:
        value = getattr(part, name)
        kept = value.detach()[rows].contiguous()
        setattr(part, name, nn.Parameter(kept, requires_grad=False) if isinstance(value, nn.Parameter) else kept)
    if hasattr(part, "after_cut"):
        part.after_cut()
    return part.eval()


def in_file(model: SplatModel) -> SplatModel:
    """Return the rows of a model that its file holds."""
    return with_rows(model, model.rows_in_file()) if hasattr(model, "rows_in_file") else model


@dataclass(frozen=True)
class Tried:
    """A file that was not written: its config, its rows (None: all), its bytes."""

    config: OptimizationParams
    rows: int | None
    writer: ContainerWriter
    bytes: int


class SizeFilling:
    """The search for the file of a method that fills a size.

    method      with a `size` in its config
    writer      of the file, as it is before anything is written
    """

    def __init__(self, method: Method, model: SplatModel, writer: ContainerWriter) -> None:
        self.method, self.model, self.raster = method, in_file(model), dict(writer.raster)
        self.asked = str(method.config.size)
        self.size = parse_size(self.asked) - SLACK
        self.plain = self._with(method.config.model_copy(update={"size": ""}))
        self.ladder = RateLadder(self.plain)
        self.least = sys.maxsize
        self._whole: dict[float, Tried] = {}  # by place on the ladder
        self._order: Callable[[int], Tensor] | None = None

    def found(self) -> ContainerWriter:
        """Return the writer of the file. Raises UserInputError if the size is too small."""
        low, high = self._by_settings(float(self.ladder.own))
        if low is not None and self._fills(low):
            return low.writer
        found = None if high is None else self._by_rows(high)
        if low is not None and not self._is_enough(found):
            return self._told(low)
        place = 0.0
        while not self._is_enough(found) and place > LOWEST and self.ladder.at(place - 1) is not None:
            place -= 1
            low, high = self._by_settings(place)
            if low is not None and self._fills(low):
                return low.writer
            found = (None if high is None else self._by_rows(high)) or found
        if found is None:
            raise UserInputError(
                f"--size {self.asked}: no file of this training is as small, the smallest that was found has "
                f"{self.least:,} bytes: ask for more, or take a lower --rate"
            )
        return self._told(found if low is None else max(found, low, key=lambda each: each.bytes))

    def _told(self, found: Tried) -> ContainerWriter:
        if found.bytes < LEAST_FILLED * self.size:
            log.warning(
                "--size %s: the largest file that was found has %s bytes: a higher --rate, or more Gaussians, make "
                "larger ones", self.asked, f"{found.bytes:,}",
            )  # fmt: skip
        return found.writer

    def _is_enough(self, found: Tried | None) -> bool:
        return found is not None and (found.rows is None or found.rows >= FEWEST * self.model.num_rows)

    def _fills(self, tried: Tried) -> bool:
        return FILLED * self.size <= tried.bytes <= self.size

    def _with(self, config: OptimizationParams) -> Method:
        found = copy.copy(self.method)
        found.__init__(self.method.plugins, config)  # type: ignore[misc]
        found.scene = self.method.scene
        return found

    def _try(self, config: OptimizationParams, model: SplatModel, rows: int | None = None) -> Tried:
        origin = (0.0, 0.0, 0.0) if self.method.scene is None else self.method.scene.origin
        writer, _ = filled_writer(self._with(config), model, self.raster, origin)
        size = len(writer.to_bytes())
        log.info("%s rows: %s bytes", "all" if rows is None else f"{rows:,}", f"{size:,}")
        return Tried(config, rows, writer, size)

    def _by_settings(self, place: float) -> tuple[Tried | None, Tried | None]:
        """Return the largest file that fits and the smallest that does not, of the whole model; None: there is none.

        place   on the ladder from which on it looks
        """
        ladder, found = self.ladder, self._whole
        self._at(place)
        while found[place].bytes > self.size and place > 0:
            place = self._at(place - 1)
        while found[place].bytes <= FILLED * self.size and place + 1 not in found and place < ladder.last:
            if ladder.at(place + 1) is None:
                break
            place = self._at(place + 1)
        for _ in range(TRIES):
            fitting = [at for at in found if found[at].bytes <= self.size]
            low = max(fitting, default=None)
            high = min((at for at in found if found[at].bytes > self.size and (low is None or at > low)), default=None)
            if low is None or high is None or self._fills(found[low]):
                break
            a, b = math.log(found[low].bytes), math.log(found[high].bytes)
            share = min(max((math.log(GOAL * self.size) - a) / (b - a), 0.05), 0.95)
            config = ladder.at(low + share * (high - low))
            if config is None or config in [each.config for each in found.values()]:
                break
            self._at(low + share * (high - low))
        return (None if low is None else found[low]), (None if high is None else found[high])

    def _at(self, place: float) -> float:
        """Try the settings of a place with the whole model; return the place."""
        config = self.ladder.at(place)
        assert config is not None
        if place not in self._whole:
            self._whole[place] = self._try(config, self.model)
        return place

    def _by_rows(self, whole: Tried) -> Tried | None:
        """Return a file with fewer rows; None if one row is too much.

        Where a number of rows more does not fit, since settings follow that number, settings between the rate points
        fill what is left.
        """
        order, tried = self._rows_by_worth(), dict[int, Tried]()

        def written(rows: int) -> int:
            tried[rows] = self._try(whole.config, with_rows(self.model, order(rows)), rows)
            self.least = min(self.least, tried[rows].bytes)
            return tried[rows].bytes

        found = tried.get(rows_that_fit(self.model.num_rows, whole.bytes, self.size, written))
        if found is None or self._fills(found):
            return found
        rows = min((rows for rows, each in tried.items() if each.bytes > self.size), default=self.model.num_rows)
        return max([found, *self._by_grades(rows)], key=lambda each: each.bytes)

    def _by_grades(self, rows: int) -> list[Tried]:
        """Files that fit, with so many rows and settings from those of the first rate point to those of the last."""
        model, low, high = with_rows(self.model, self._rows_by_worth()(rows)), 0.0, 1.0
        found = list[Tried]()
        for _ in range(TRIES):
            middle = (low * high) ** 0.5 if low else high / 8  # palettes and the like double, and double again
            if (config := self.ladder.graded(middle)) is None:
                break
            each = self._try(config, model, rows)
            if each.bytes > self.size:
                high = middle
                continue
            low, found = middle, [*found, each]
            if self._fills(each):
                break
        return found

    def _rows_by_worth(self) -> Callable[[int], Tensor]:
        if self._order is None:
            self._order = rows_by_worth(self.method, self.model, self.raster)
        return self._order


def rows_that_fit(count: int, whole: int, size: int, written: Callable[[int], int]) -> int:
    """Return how many of `count` rows fill a size; 0: one is too much.

    whole       bytes with all of them, more than the size
    written     number of rows -> bytes with these
    """
    over, under = (count, whole), (0, 0)
    fixed = 0.0  # bytes without any row
    wanted = count * GOAL * size / whole
    for _ in range(2 * TRIES):
        rows = min(max(round(wanted), under[0] + 1), over[0] - 1)
        if not under[0] < rows < over[0]:
            break
        found = rows, written(rows)
        if found[1] > size:
            if not under[0]:
                fixed = max(found[1] - rows * (over[1] - found[1]) / (over[0] - rows), 0.0)
            over = found
        else:
            under = found
            if found[1] >= FILLED * size:
                break
        if under[0] and (over[0] - under[0]) * under[1] / under[0] < min((1 - FILLED) * size, FILLED * size - under[1]):
            break  # sizes jump there: no number between fills it, or is much nearer
        start = under if under[0] else (0, fixed)
        slope = (over[1] - start[1]) / (over[0] - start[0])
        wanted = start[0] + (GOAL * size - start[1]) / max(slope, 1e-9)
    return under[0]


def rows_by_worth(method: Method, model: SplatModel, raster: Mapping[str, Any]) -> Callable[[int], Tensor]:
    """Return what gives the rows [M] that stay where so many shall: those that the training views miss most.

    raster      what the file asks of a renderer

    By opacity where there is no scene, and where no rasterizer tells what a removal changes.
    """
    model = with_rows(model, torch.arange(model.num_rows, device=model.device))
    if method.scene is not None:
        rasterizer = NegotiatedRasterizer(method.plugins, device=model.device, options=options_of(raster))
        seen = training_views(model, method.scene)
        pruning = Pruning(model, [*seen.fit, *seen.judge], rasterizer, keeps_unseen=False, select=with_rows)
        try:
            pruning.rows(model.num_rows - 1)
        except CapabilityError as error:
            log.info("rows go by their opacity: %s", error)
        else:
            return pruning.rows
    opacities = getattr(model, "opacities", None)
    if not isinstance(opacities, Tensor):
        opacities = torch.sigmoid(getattr(model, "opacity_logits"))  # noqa: B009
    ranks = torch.sort(opacities.detach(), descending=True, stable=True).indices
    return lambda count: ranks[:count].sort().values
