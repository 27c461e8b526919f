"""Contents of a file: integers up to the hash point, and the floats that follow from them."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sw_codecs.entropy.exact_tables import exact_tables
from sw_wisp.cube import Cube
from sw_wisp.eight_bits import EightBitLayer
from sw_wisp.nested import UNIT, table_levels
from sw_wisp.numbers import GROUPS, OPACITY, SIZE
from sw_wisp.packets import REFINED, State

SWELL_UNIT = 32
ERFC = np.vectorize(math.erfc, otypes=[np.float64])


@dataclass(frozen=True)
class Decoded:
    """A scene, or the part of it that a prefix of its file holds.

    state       integers, rows in the order of the file
    cube        root of the octree
    base_steps  [22] float64
    strengths   [planes + 1, 5] uint8: how far values are drawn towards the centroid of their cell, 255 being all of
                it, by refinements that are missing and by group
    appearance  layers of the network that turns latents into SH bands
    sh_degree   of those bands
    swell       [N,2] what is added to size and opacity, since splats of other subsets are missing
    """

    state: State
    cube: Cube
    base_steps: np.ndarray
    strengths: np.ndarray
    appearance: tuple[EightBitLayer, ...]
    sh_degree: int
    swell: np.ndarray

    def __len__(self) -> int:
        return len(self.state.cells)

    def digest(self) -> str:
        """SHA-256 of all integers, the same on every machine: level, cell, indices, means, multipliers of each row."""
        state = self.state
        parts = [state.levels[:, None], state.cells.places, state.index, state.mean, state.multiplier]
        return hashlib.sha256(np.concatenate(parts, axis=1).astype("<i4").tobytes()).hexdigest()

    def values(self) -> Tensor:
        """The 22 numbers [N,22] float32 in their own units."""
        every = np.arange(len(self))
        units: np.ndarray = self.state.units(every, slice(None))
        if self.strengths.any():
            pulled = self.strengths[self.state.planes][:, GROUP_OF_COLUMN] / 255.0  # [N,22]
            pulled[:, OPACITY.columns] = self.strengths[0, 0] / 255.0  # opacity and latents are never coarse
            pulled[:, REFINED.stop :] = self.strengths[0, -1] / 255.0
            pulled[~self.state.has_view, REFINED.stop :] = 0
            widths = np.ones(units.shape, np.int64)
            widths[:, REFINED] = 3 ** self.state.planes.astype(np.int64)[:, None]
            units = units + pulled * self.state.multiplier * to_centroid(self.state.index, self.state.scale, widths)
        found = torch.from_numpy(units).double() * torch.from_numpy(self.base_steps / UNIT)  # on all cores
        if self.swell.any():
            found[:, [SIZE.columns.start, OPACITY.columns.start]] += torch.from_numpy(self.swell)
        return found.float()

    def means(self) -> Tensor:
        """Positions [N,3] float32, world units."""
        cells = self.state.cells
        return self.cube.centres(torch.from_numpy(cells.levels), torch.from_numpy(cells.places))


GROUP_OF_COLUMN = np.repeat(np.arange(len(GROUPS)), [group.width for group in GROUPS])


def to_centroid(index: np.ndarray, scale: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Offset, in steps, from the middle of a cell to the mean of a centred Gaussian within it; float64 [...].

    index   middle of the cell, in steps from the mean
    scale   scale level with 12 fractional bits
    width   of the cell, in steps
    """
    cells, place = np.unique(
        np.stack([np.abs(index.astype(np.int64)), table_levels(scale.astype(np.int64)), width]).reshape(3, -1),
        axis=1,
        return_inverse=True,
    )
    middle, sigma, half = cells[0], exact_tables().scales[cells[1]], cells[2] / 2
    low, high = (middle - half) / sigma, (middle + half) / sigma
    density = np.exp(-(low**2) / 2) - np.exp(-(high**2) / 2)
    mass = (ERFC(low / math.sqrt(2)) - ERFC(high / math.sqrt(2))) * math.sqrt(math.pi / 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        centroid = np.where((mass > 1e-280) & (middle > 0), sigma * density / mass, middle - half * (middle > 0))
    return np.sign(index) * (centroid - middle)[place].reshape(index.shape)
