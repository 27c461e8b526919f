"""The file that fills a size: what the estimate chooses is written, and what was written corrects the estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sw_compress.coders import POSITIONS
from sw_compress.search import Choice, Search, for_size, too_small
from sw_compress.stages import give_back
from sw_compress.targets import LEAST_SHARE

if TYPE_CHECKING:
    from splatwizard_core.api import GaussianModel
    from sw_compress.coders import Levels, Quantized
    from sw_compress.stages import Stages

MOST_ENCODES = 6
"""Two are usual."""
AIM = 0.997
"""Share of a target size that the second encode aims at."""
FAR_OFF = 0.05
"""Relative error of an estimate above which another number of Gaussians may be better."""
SMALL = 300_000
"""Bytes of a file that is in jumps: a level changes more than one part in a hundred."""
STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125)
"""Octaves by which one attribute is made finer, to fill the last bytes of a small file."""


@dataclass(frozen=True)
class Filled:
    """File that was written.

    encodes     how often a file was written on the way
    """

    choice: Choice
    bytes: int
    encodes: int


@dataclass
class _File:
    """The file on the way: what it holds, and how often it was written."""

    coder: Quantized
    path: Path
    stages: Stages
    encodes: int = 0
    bytes: int = 0
    _held: tuple[GaussianModel, dict[str, float]] | None = None

    def write(self, model: GaussianModel, levels: Levels) -> int:
        """Write it, if it does not hold just that; return its bytes."""
        if self._held is None or self._held[0] is not model or self._held[1] != levels:
            give_back()
            with self.stages.timed("encode"):
                self.bytes = self.coder.encode(model, levels, self.path)
            self._held, self.encodes = (model, dict(levels)), self.encodes + 1
        return self.bytes


def fill(
    search: Search, size: int, path: Path, stages: Stages, say: Callable[[str], None],
    chosen: Choice | None = None,
) -> Filled:  # fmt: skip
    """Write the best file of at most `size` bytes.

    chosen  Gaussians that stay, and their precision to begin with; None: what the search finds

    Raises UserInputError that names the smallest file there is.
    """
    file = _File(search.coder, path, stages)

    def choose(budget: float) -> Choice | None:
        with stages.timed("search"):
            return for_size(search, budget)

    choice, best, most = chosen or choose(size), None, 0
    while choice is not None:
        written = file.write(choice.model, choice.allocation.levels)
        if most < written <= size:
            best, most = choice, written
        if _fills(written, size) or file.encodes == MOST_ENCODES or (written <= size and choice.is_finest):
            break
        budget = choice.bytes + AIM * size - written
        far_off = abs(choice.bytes / written - 1) > FAR_OFF
        choice = choose(budget) if far_off and chosen is None else choice.resized(budget)
    if best is None and (coarsest := search.coarsest if chosen is None else chosen.coarsest()) is not None:
        best = coarsest
        most = file.write(best.model, best.allocation.levels)
        if most > size:
            raise too_small(size, f"{most:,}")
    assert best is not None  # a search looks at one part at least
    if not _fills(most, size) and most < SMALL and not best.is_finest:
        best, most = _finer(file, best, most, size)
    if not _fills(most, size):
        what = "the finest settings give {:,} bytes, less than the target of {:,}"
        say((what if best.is_finest else "{:,} bytes are the nearest to {:,} that was found").format(most, size))
    file.write(best.model, best.allocation.levels)
    return Filled(best, most, file.encodes)


def _fills(written: int, size: int) -> bool:
    return LEAST_SHARE * size < written <= size


def _finer(file: _File, choice: Choice, written: int, size: int) -> tuple[Choice, int]:
    """Make one attribute after the other finer while the file stays within `size`, until it is filled."""
    levels = dict(choice.allocation.levels)
    for name in sorted(levels, key=lambda each: (each == POSITIONS, -levels[each])):
        for step in STEPS[:1] if name == POSITIONS else STEPS:
            finer = {**levels, name: max(levels[name] - step, float(file.coder.levels(name)[0]))}
            if _fills(written, size) or finer == levels:
                break
            found = file.write(choice.model, finer)
            if written < found <= size:
                levels, written = finer, found
    return replace(choice, allocation=replace(choice.allocation, levels=levels)), written
