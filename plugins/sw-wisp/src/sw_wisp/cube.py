"""The root cube of a scene's octree: which cell a place lies in, and where the centre of a cell is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sw_codecs.positions import morton
from sw_wisp.numbers import HIGHEST_LEVEL, LOWEST_LEVEL
from sw_wisp.octree import spread_crowds

MARGIN = 1 + 2.0**-20  # so that the largest coordinate lies within the last cell


@dataclass(frozen=True)
class Cube:
    """Lowest corner and edge, world units; a cell of level l has edge `edge` / 2^l."""

    low: tuple[float, float, float]
    edge: float

    @classmethod
    def around(cls, means: Tensor, *, margin: float = 0.0) -> Cube:
        """The cube that holds places [N,3], N > 0, and `margin` times their extent on every side."""
        places = means.detach().double()
        low, high = places.amin(dim=0), places.amax(dim=0)
        extent = max(float((high - low).max()), 1e-12)
        corner = (low - margin * extent).tolist()
        return cls((corner[0], corner[1], corner[2]), extent * (1 + 2 * margin) * MARGIN)

    def edges(self, levels: Tensor) -> Tensor:
        """Edges [N] float32 of cells of these levels, world units."""
        return torch.ldexp(torch.tensor(self.edge, device=levels.device), -levels).float()

    def levels(self, middle_scales: Tensor, eta: float) -> Tensor:
        """Levels [N] int64 at which cells are no larger than `eta` times the middle of each splat's three scales."""
        wanted = torch.log2(self.edge / (eta * middle_scales.detach().double())).ceil()
        return wanted.clamp(LOWEST_LEVEL, HIGHEST_LEVEL).long()

    def cells(self, means: Tensor, levels: Tensor) -> Tensor:
        """Cells [N,3] int64 of places [N,3] at levels [N]; places outside go to the nearest cell."""
        low = torch.tensor(self.low, dtype=torch.float64, device=means.device)
        count = (2.0 ** levels.double())[:, None]
        places = ((means.detach().double() - low) / self.edge * count).floor()
        return torch.minimum(places.clamp_min(0), count - 1).long()

    def centres(self, levels: Tensor, cells: Tensor) -> Tensor:
        """Centres [N,3] float32 of cells; computed in float64, since cells of level 18 are finer than float32."""
        low = torch.tensor(self.low, dtype=torch.float64, device=cells.device)
        return (low + (cells.double() + 0.5) * (self.edge / 2.0 ** levels.double())[:, None]).float()

    def settled(self, means: Tensor, levels: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        """Levels [N] and cells [N,3] such that no cell holds more than 16: the least opaque go a level deeper.

        Raises ValueError if more splats share one place than its cells have room for.
        """
        deepest = self.cells(means, torch.full_like(levels, HIGHEST_LEVEL))
        codes = morton.encode(deepest.cpu().numpy())
        found = spread_crowds(levels.cpu().numpy(), codes, opacities.detach().cpu().numpy())
        final = torch.from_numpy(found).to(levels.device)
        return final, self.cells(means, final)

    def check(self) -> None:
        """Raise ValueError unless corner and edge are finite and float32 has them."""
        if not all(math.isfinite(x) and abs(x) < 1e30 for x in (*self.low, self.edge)) or not self.edge > 1e-30:
            raise ValueError("the root cube has no finite corner and positive edge")


def splat_cells(levels: Tensor | np.ndarray, places: Tensor | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Levels [N] and cells [N,3] as int64 arrays. Raises ValueError if a cell is none of its level."""
    level, place = (np.asarray(x.cpu() if isinstance(x, Tensor) else x, np.int64) for x in (levels, places))
    if level.shape != place.shape[:1] or place.shape[1:] != (3,):
        raise ValueError(f"levels {list(level.shape)} and cells {list(place.shape)} must be [N] and [N,3]")
    if len(level) and not LOWEST_LEVEL <= level.min() <= level.max() <= HIGHEST_LEVEL:
        raise ValueError(f"levels {level.min()}..{level.max()} leave {LOWEST_LEVEL}..{HIGHEST_LEVEL}")
    if (place < 0).any() or (place >= (1 << level)[:, None]).any():
        raise ValueError("a cell lies outside the root cube")
    return level, place
