"""Writer of `.swz`: the octree and the quantised columns of `gaussians-quantized`, and sizes before it writes.

A level is the step of an attribute in octaves of the step here; bits of the positions fall by one with each level.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.choices import CodecChoice
from sw_gaussians.morton import interleave
from torch import Tensor

from splatwizard_core.api import GaussianModel, create_method
from splatwizard_core.tooling import encode as encode_model
from sw_codecs.models.band_context import suitable_classes
from sw_codecs.models.settings import QuantizedSettings
from sw_compress.rounding import Rounding, Steps, blocks, cells_of, entropy_bits, equal_classes, grid_of
from sw_compress.rows import IMPORTANCE, select
from sw_compress.stages import give_back

if TYPE_CHECKING:
    from splatwizard_core.api import Method, PluginManager

Levels = Mapping[str, float]

POSITIONS = "positions"
STEPS = {"opacity": 0.25, "scale": 0.1, "quat": 0.022, "dc": 0.07, "rest": 0.055}
"""Quantiser steps at level 0, as of rate point r3 of 3dgs."""
POSITION_BITS = 15
"""Bits per axis at level 0."""
FINEST, COARSEST = -4.0, 5.0
LEVELS = np.arange(FINEST, COARSEST + 0.25, 0.5)
POSITION_LEVELS = np.arange(POSITION_BITS - 20, POSITION_BITS - 7, dtype=np.float64)
LARGEST_QUAT_STEP = 0.5
PRECISION_POWER = 0.4
"""Of what a Gaussian weighs in pictures by which its steps fall."""
PRECISE_FROM = 1000
"""Gaussians from which on they have classes of precision: a smaller file is in jumps as it is."""
OWN_BASIS = True
"""Whether higher SH coefficients may have a basis of the scene's own."""
SAMPLE = 1 << 17
"""Gaussians that tables are made from."""
TABLE_BITS = 3.0
"""Of each distinct value of a column, for its stored count."""
FIXED_BYTES = 1100
"""Of the header and of what stands before each section."""


@dataclass(frozen=True)
class Quantized:
    """Writes `.swz` files.

    raster      what the file asks of a renderer
    method      that the file is of: one of explicit Gaussians
    origin      of the model in the world; None: its own
    precise     whether steps follow what Gaussians weigh
    """

    plugins: PluginManager
    raster: Mapping[str, Any]
    method: str = "3dgs"
    origin: tuple[float, float, float] | None = None
    precise: bool = True
    _last: list[tuple[GaussianModel, list[float], Rounding]] = field(default_factory=list, compare=False, repr=False)

    @property
    def power(self) -> float:
        """Of the weight of a Gaussian by which its steps fall."""
        return PRECISION_POWER if self.precise else 0.0

    def attributes(self, model: GaussianModel) -> tuple[str, ...]:
        """Names of what has a level."""
        return (POSITIONS, *(name for name in STEPS if name != "rest" or model.active_sh_degree))

    def levels(self, name: str) -> NDArray[np.float64]:
        """Levels that an attribute may have."""
        if name == POSITIONS:
            return POSITION_LEVELS
        return LEVELS[STEPS[name] * 2.0**LEVELS <= LARGEST_QUAT_STEP] if name == "quat" else LEVELS

    def settings(self, levels: Levels) -> QuantizedSettings:
        """Settings of the codec."""
        steps = {f"{name}_step": step for name, step in self.steps(levels).items()}
        bits = int(POSITION_BITS - levels[POSITIONS])
        return QuantizedSettings(position_bits=bits, precision_power=self.power, sh_basis=OWN_BASIS, **steps)

    def steps(self, levels: Levels) -> dict[str, float]:
        """Quantiser steps by attribute, of all but the positions."""
        return {name: step * 2.0 ** levels.get(name, 0.0) for name, step in STEPS.items()}

    def factors(self, model: GaussianModel) -> Tensor:
        """Multipliers of the steps of each Gaussian [N]; 1 where nothing says what it weighs."""
        if getattr(model, IMPORTANCE, None) is None or not self.power:
            return torch.ones(model.num_rows, device=model.device)
        return self.rounding(model).factors.float()

    def finest(self, model: GaussianModel) -> dict[str, float]:
        """Levels at which nothing is lost that could be seen."""
        return {name: float(self.levels(name)[0]) for name in self.attributes(model)}

    def rounding(self, model: GaussianModel) -> Rounding:
        """The rounding of a model; that of the last one is kept while it is as it was."""
        state = [self.power, *(getattr(model, name)._version for name in model.RAW)]
        if not self._last or self._last[0][0] is not model or self._last[0][1] != state:
            self.forget()  # it holds a model, and so does the next
            self._last.append((model, state, Rounding(model, self.power, OWN_BASIS)))
        return self._last[0][2]

    def forget(self) -> None:
        """Let the model go whose rounding is known."""
        self._last.clear()

    def rounded(self, model: GaussianModel, levels: Levels) -> GaussianModel:
        """Return the Gaussians that a file of these levels decodes to, in the order of the model."""
        return self.rounding(model).model_at(self.whole_steps(levels))

    def whole_steps(self, levels: Levels) -> Steps:
        """Steps and bits of the positions."""
        return Steps(self.steps(levels), int(POSITION_BITS - levels[POSITIONS]))

    @torch.no_grad()
    def sizes(self, model: GaussianModel, *, coarsest: bool = False) -> dict[str, NDArray[np.float64]]:
        """Bytes of each attribute at each of its levels, or the `coarsest`, from entropies; nothing is coded."""
        count = model.num_rows
        part, some = model, slice(-1 if coarsest else None, None)
        found = {POSITIONS: position_sizes(model, POSITION_LEVELS[some])}
        if count > SAMPLE:
            give_back()
            chosen = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:SAMPLE].sort().values
            part = select(model, chosen.to(model.device))
        return found | self.column_sizes(part, count, some=some)

    @torch.no_grad()
    def column_sizes(
        self, part: GaussianModel, count: int, tiles: int = 1, some: slice = slice(None)
    ) -> dict[str, NDArray[np.float64]]:
        """The same of all but the positions, of a model that a part stands for.

        count   Gaussians of the model
        tiles   that it is written in, each with tables of its own
        some    of the levels
        """
        rounding = Rounding(part, self.power, OWN_BASIS)
        scale, found = count / max(part.num_rows, 1), {}
        sections = _Sections(rounding, suitable_classes(count // tiles), TABLE_BITS * tiles / scale)
        for name in self.attributes(part):
            if name != POSITIONS:
                steps = [Steps({name: STEPS[name] * 2.0**level}, POSITION_BITS) for level in self.levels(name)[some]]
                found[name] = np.array([sections.bits(name, each) for each in steps]) * scale / 8
        found["dc"] += sections.precision_bits() * scale / 8
        return found

    def encode(self, model: GaussianModel, levels: Levels, path: Path) -> int:
        """Write the file; return its bytes."""
        origin = self.origin or model.world_origin or (0.0, 0.0, 0.0)
        return encode_model(self.method_of(levels), model, dict(self.raster), path, origin).bytes

    def method_of(self, levels: Levels) -> Method:
        """The method that the file is of."""
        codec = self.choice(levels)
        values = {"codec.name": codec.name, **{f"codec.settings.{key}": value for key, value in codec.settings.items()}}
        return create_method(self.plugins, self.method, values)

    def choice(self, levels: Levels) -> CodecChoice:
        """The codec that writes the file, with its settings."""
        settings = self.settings(levels).model_dump()
        numbers = {key: value for key, value in settings.items() if not isinstance(value, str)}
        return CodecChoice(name="gaussians-quantized", settings=numbers)


def position_sizes(
    model: GaussianModel, levels: NDArray[np.float64] = POSITION_LEVELS, limits: Sequence[int] = ()
) -> NDArray[np.float64]:
    """Bytes of the positions at ascending levels.

    limits  first row of each tile, then N, where each is coded for itself
    """
    finest, means = int(POSITION_BITS - levels[0]), model.means.detach()
    grid, parts = replace(grid_of(means), bits=finest), blocks(len(means), means.device)
    if len(means) > SAMPLE:
        give_back()  # the grid took doubles of all
    codes = torch.cat([interleave(cells_of(means[rows], grid).long()) for rows in parts])
    tiles = [codes] if not limits else codes.split([end - start for start, end in itertools.pairwise(limits)])
    bits = np.sum([octree_bits(tile.sort().values, finest) for tile in tiles], axis=0)
    return np.array([bits[int(POSITION_BITS - level)] / 8 for level in levels])


class _Sections:
    """Sections of a file that is not written: rows by class, as its codec parts them."""

    def __init__(self, rounding: Rounding, count: int, table_bits: float) -> None:
        self._rounding, self._count, self._table_bits = rounding, count, table_bits
        if rounding.classes is None:
            self._first = torch.zeros(rounding.rows, dtype=torch.int64, device=rounding.model.device)
            self._first_count = 1
        else:
            self._first, self._first_count = equal_classes(rounding.classes.long(), count), count

    def precision_bits(self) -> float:
        """Bits of the classes themselves."""
        if self._rounding.classes is None:
            return 0.0
        return columns_bits(self._rounding.classes[:, None].int())

    def bits(self, name: str, steps: Steps) -> float:
        """Bits of the columns of an attribute."""
        symbols = self._rounding.symbols(name, steps)
        if name != "rest":
            return entropy_bits(symbols, self._first, self._first_count, self._table_bits)
        total, activity = 0.0, torch.zeros_like(self._first)
        classes, count = self._first, self._first_count
        for degree in range(1, round((symbols.shape[1] // 3 + 1) ** 0.5)):
            band = symbols[:, 3 * (degree**2 - 1) : 3 * ((degree + 1) ** 2 - 1)]
            if degree > 1:
                classes, count = equal_classes(activity, self._count), self._count
            total += entropy_bits(band, classes, count, self._table_bits)
            activity += band.abs().sum(1)
        return total


def columns_bits(symbols: Tensor) -> float:
    """Bits of integer columns [n,c] int32, each by its own counts, which are stored."""
    alone = torch.zeros(len(symbols), dtype=torch.int32, device=symbols.device)
    return entropy_bits(symbols, alone, 1, TABLE_BITS)


def octree_bits(codes: Tensor, bits: int) -> list[float]:
    """Bits of an octree over sorted Morton codes [n] of `bits` bits an axis, cut at each depth 0 .. `bits`."""
    total, found = 0.0, [0.0]
    parents = torch.ones(1, dtype=torch.int64, device=codes.device)  # children of each node's parent
    for depth in range(1, bits + 1):
        children, several = torch.unique_consecutive(codes >> (3 * (bits - depth)), return_counts=True)
        _, parent, number = torch.unique_consecutive(children >> 3, return_inverse=True, return_counts=True)
        occupancy = torch.zeros_like(number).scatter_add_(0, parent, 1 << (children & 7))
        places = 256 * parents.clamp_max(4) + occupancy
        for counts in torch.bincount(places, minlength=5 * 256).cpu().numpy().reshape(5, 256)[1:]:
            counts = counts[counts > 0]
            total += float((counts * np.log2(counts.sum() / counts)).sum()) + TABLE_BITS * len(counts)
        parents = number[parent]
        found.append(total + (columns_bits(several[:, None].int()) if len(children) < len(codes) else 0.0))
    return found
