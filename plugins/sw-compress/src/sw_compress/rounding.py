"""A model as its file will decode at any levels, on the device that it is on, and the integers that the file holds.

The arithmetic is that of the codec `gaussians-quantized`, number by number, but the rows stay in the model's order and
one attribute can change alone: a search draws a dozen of such models, and codes none of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from sw_gaussians import heap
from torch import Tensor

from splatwizard_core.api import GaussianModel
from sw_codecs.models import gauge, precision, sh_basis
from sw_codecs.models.attributes import LARGEST_QUAT_STEP, MAX_LOGIT
from sw_codecs.models.luma import COLOR
from sw_codecs.models.position_grid import CORE_SHARE, PositionGrid
from sw_codecs.models.quantized import FAINTEST
from sw_compress.rows import IMPORTANCE, like, select

ROWS_AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 18}
"""Rows that are doubles at a time: those of all would be the largest thing in memory."""
TURNED_ONCE = 1 << 18
"""Gaussians up to which a CPU keeps scales and quaternions as they are rounded, 36 bytes of each."""
NAMES = {"means": "positions", "sh_dc": "dc", "opacity_logits": "opacity", "log_scales": "scale", "quats": "quat",
         "sh_rest": "rest"}  # fmt: skip
"""Parameter -> attribute that has a level."""


@dataclass(frozen=True)
class Steps:
    """Quantiser steps by attribute, and bits of the positions."""

    of: Mapping[str, float]
    bits: int


class Rounding:
    """Rounds the parameters of a model, of which those that can never be drawn are left out.

    power       of the weight of a Gaussian by which its steps fall
    own_basis   whether higher SH coefficients may have a basis of the scene's own
    """

    @torch.no_grad()
    def __init__(self, model: GaussianModel, power: float, own_basis: bool) -> None:
        drawn = model.opacity_logits >= FAINTEST
        self.model = model if bool(drawn.all()) else select(model, drawn)
        self.rows = self.model.num_rows
        self.classes = self._classes_of(power)
        device = model.device
        self._known_factors = torch.from_numpy(precision.FACTORS).to(device)
        self._color = torch.from_numpy(COLOR).to(device)
        self._turned: tuple[Tensor, Tensor] | None = None
        if device.type != "cpu" or self.rows <= TURNED_ONCE:
            self._turned = canonical(self.model.log_scales.detach(), self.model.quats.detach())
        self.basis = self._basis() if own_basis and self.rest.numel() else None

    @property
    def rest(self) -> Tensor:
        """Higher SH coefficients that are in use [N,R,3]."""
        return self.model.sh_rest.detach()[:, : (self.model.active_sh_degree + 1) ** 2 - 1]

    @property
    def factors(self) -> Tensor:
        """Multipliers [N] float64 of the steps of each Gaussian."""
        return self._factors(slice(0, self.rows))

    @cached_property
    def grid(self) -> PositionGrid:
        """Of the positions, with any number of bits."""
        return grid_of(self.model.means.detach())

    def model_at(self, steps: Steps) -> GaussianModel:
        """The model as a file of these steps decodes to."""
        return self._of({parameter: self.parameter(name, steps) for parameter, name in NAMES.items()})

    @torch.no_grad()
    def change(self, whole: GaussianModel, name: str, steps: Steps) -> GaussianModel:
        """Bring one attribute of a model that was rounded to other steps, in place."""
        place: Tensor = next(getattr(whole, parameter) for parameter, each in NAMES.items() if each == name)
        place.copy_(self.parameter(name, steps, place.detach()))  # of itself, but for positions
        return whole

    def overwrite(self, steps: Steps) -> GaussianModel:
        """Bring the model itself to these steps, where there is no memory for two: nothing else can be asked then."""
        for name in ("positions", "dc", "opacity", "quat", "scale", "rest"):  # quaternions are turned by scales
            self.change(self.model, name, steps)
        return self.model

    def _of(self, raw: dict[str, Tensor]) -> GaussianModel:
        return like(self.model, type(self.model)(**raw, active_sh_degree=self.model.active_sh_degree))

    @torch.no_grad()
    def parameter(self, name: str, steps: Steps, out: Tensor | None = None) -> Tensor:
        """Values of an attribute, rounded, float32 in the shape of its parameter.

        out     where they go
        """
        raw: Tensor = next(getattr(self.model, parameter) for parameter, each in NAMES.items() if each == name)
        if name == "positions":
            return on_grid(raw.detach(), replace(self.grid, bits=steps.bits))
        found = torch.zeros_like(raw) if out is None else out
        matrix, width = self._matrix(name, steps), self.rest.shape[1]
        for rows in blocks(self.rows, self.model.device):
            symbols, widths = self._symbols(name, steps, rows, matrix), self._widths(name, steps, rows)[:, None]
            if name == "rest" and matrix is None:
                values = (symbols.reshape(len(symbols), width, 3) * widths[:, :, None]) @ self._color
                found[rows, :width] = values.float()
            elif matrix is not None:
                widths = (steps.of["rest"] / sh_basis.UNIT * self._factors(rows))[:, None]
                found[rows, :width] = ((symbols @ matrix) * widths).reshape(len(symbols), width, 3).float()
            elif name == "dc":
                found[rows] = ((symbols * widths) @ self._color).float()[:, None, :]
            elif name == "quat":
                found[rows] = _complete(symbols * widths).float()
            else:
                found[rows] = (symbols * widths).float().reshape(found[rows].shape)
            if name == "rest":
                heap.let_go()
        return found

    @torch.no_grad()
    def symbols(self, name: str, steps: Steps) -> Tensor:
        """Integers [N,C] int32 that the file holds."""
        matrix = self._matrix(name, steps)
        return torch.cat(
            [self._symbols(name, steps, rows, matrix).int() for rows in blocks(self.rows, self.model.device)]
        )

    def _symbols(self, name: str, steps: Steps, rows: slice, matrix: Tensor | None) -> Tensor:
        """Integers [n,C] of some rows, float64; of higher SH in the basis, or as luma and chroma."""
        if name == "rest":
            part = self.rest[rows].double()
            if matrix is None:
                values = (part @ self._color.T).reshape(len(part), -1)
            else:
                values = (part.reshape(len(part), -1) @ self._inverse).float().double()  # as the codec keeps them
        elif name == "dc":
            values = self.model.sh_dc.detach()[rows, 0].double() @ self._color.T
        elif name == "opacity":
            values = self.model.opacity_logits.detach()[rows, None].double().clamp(-MAX_LOGIT, MAX_LOGIT)
        else:
            values = self._turned_rows(rows)[name == "quat"]
        return (values / self._widths(name, steps, rows)[:, None]).round_()

    def _turned_rows(self, rows: slice) -> tuple[Tensor, Tensor]:
        """Log scales [n,3] and x, y, z [n,3] of some rows, as `canonical` has them."""
        if self._turned is not None:
            return self._turned[0][rows], self._turned[1][rows]
        return _canonical(self.model.log_scales.detach()[rows], self.model.quats.detach()[rows])

    def _widths(self, name: str, steps: Steps, rows: slice) -> Tensor:
        """Step of each row [n]."""
        found = steps.of[name] * self._factors(rows)
        return found.clamp_max(max(steps.of[name], LARGEST_QUAT_STEP)) if name == "quat" else found

    def _classes_of(self, power: float) -> Tensor | None:
        """Classes of precision [N] int8; None: all steps are alike."""
        if power <= 0:
            return None
        known = getattr(self.model, IMPORTANCE, None)
        if known is not None and known.device.type != "cpu":
            return classes_on_device(known.detach().double(), power).to(torch.int8)
        if known is not None:
            weights = known.detach().double().numpy()
        else:
            arrays = (getattr(self.model, name).detach().cpu().numpy() for name in ("opacity_logits", "log_scales"))
            weights = precision.footprints(*arrays)
        return torch.from_numpy(precision.classes_of(weights, power).astype(np.int8)).to(self.model.device)

    def _factors(self, rows: slice) -> Tensor:
        """Multipliers [n] float64 of the steps of some rows."""
        if self.classes is None:
            return self._known_factors[precision.MOST].expand(len(range(self.rows)[rows]))
        return self._known_factors[self.classes[rows].long() + precision.MOST]

    def _basis(self) -> sh_basis.Basis:
        stride, count = sh_basis.stride(self.rows), 0
        covariance = self._known_factors.new_zeros(3 * self.rest.shape[1], 3 * self.rest.shape[1])
        for rows in blocks(-(-self.rows // stride), self.model.device):
            some = slice(rows.start * stride, rows.stop * stride, stride)
            scaled = self.rest[some].flatten(1).double() / self._factors(some)[:, None]
            covariance += scaled.T @ scaled
            count += len(scaled)
        return sh_basis.of_covariance((covariance / max(count, 1)).cpu().numpy())

    def _matrix(self, name: str, steps: Steps) -> Tensor | None:
        """The basis of higher SH coefficients as it is stored, where it pays."""
        if name != "rest" or self.basis is None or not self.basis.pays(self.rows, steps.of["rest"]):
            return None
        return self._stored

    @cached_property
    def _stored(self) -> Tensor:
        """The basis."""
        assert self.basis is not None  # only asked for where it pays
        return torch.from_numpy(self.basis.matrix.astype(np.float64)).to(self.model.device)

    @cached_property
    def _inverse(self) -> Tensor:
        return torch.linalg.inv(self._stored / sh_basis.UNIT)


def blocks(count: int, device: torch.device) -> list[slice]:
    """Rows that are doubles at a time."""
    step = ROWS_AT_ONCE["cpu" if device.type == "cpu" else "cuda"]
    return [slice(start, start + step) for start in range(0, max(count, 1), step)]


def classes_on_device(weights: Tensor, power: float) -> Tensor:
    """As `precision.classes_of`, where the weights [N] are; one on the border of two classes may get the other one."""
    shown = weights[weights > 0].sort().values
    if len(shown):
        weights = weights / ((shown[(len(shown) - 1) // 2] + shown[len(shown) // 2]) / 2)
    found = (2 * power * weights.clamp_min(1e-30).log2()).round()
    return found.clamp(-precision.MOST, precision.MOST).int()


def grid_of(points: Tensor) -> PositionGrid:
    """The grid that `PositionGrid.fit` gives for points [N,3], found where they are."""
    if points.device.type == "cpu" or not len(points):
        return PositionGrid.fit(points.cpu().numpy(), 1)
    return sorted_grid(points)


def sorted_grid(points: Tensor) -> PositionGrid:
    """The same for some points by sorting, which a GPU does faster than it copies them."""
    points, last = points.double(), len(points) - 1
    ordered = points.sort(dim=0).values
    center = (ordered[last // 2] + ordered[(last + 1) // 2]) / 2
    away = (points - center).abs().sort(dim=0).values
    place = int(CORE_SHARE * last)
    share, low, high = CORE_SHARE * last - place, away[place], away[min(place + 1, last)]
    core = low + (high - low) * share if share < 0.5 else high - (high - low) * (1 - share)  # as `numpy.quantile`
    return PositionGrid.around(*(each.cpu().numpy() for each in (center, core, away[-1])), 1)


def cells_of(points: Tensor, grid: PositionGrid) -> Tensor:
    """Cells [N,3] of points [N,3], float64, as `PositionGrid.quantize`."""
    center, width, top = _numbers(grid, points)
    u = (points.double() - center) / width
    away = u.abs()
    mantissa, exponent = torch.frexp(away.clamp_min(1.0))
    v = torch.where(away < 1.0, away, exponent + 2 * mantissa - 1.0).copysign(u)
    return ((v + top) / (2 * top) * 2.0**grid.bits).floor().clamp(0, 2**grid.bits - 1)


def on_grid(points: Tensor, grid: PositionGrid) -> Tensor:
    """Centres [N,3] float32 of the cells of points [N,3]."""
    center, width, top = _numbers(grid, points)
    found = torch.empty_like(points, dtype=torch.float32)
    for rows in blocks(len(points), points.device):
        v = (cells_of(points[rows], grid) + 0.5) * (2 * top * 2.0**-grid.bits) - top
        away = v.abs()
        octave = away.clamp_min(1.0).floor()
        u = torch.where(away < 1.0, away, torch.ldexp(1.0 + (away - octave), octave - 1)).copysign(v)
        found[rows] = (u * width + center).float()
    return found


def _numbers(grid: PositionGrid, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centre, width and top [3] of a grid where the points are."""
    center, width, top = (torch.tensor(each, dtype=torch.float64, device=points.device)
                          for each in (grid.center, grid.width, grid.top))  # fmt: skip
    return center, width, top


_TURNS = torch.zeros(27, 4, dtype=torch.float64)
for _order, _quat in gauge.PERMUTATIONS.items():
    _TURNS[9 * _order[0] + 3 * _order[1] + _order[2]] = torch.tensor(_quat, dtype=torch.float64)
_PLACES = torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = torch.tensor([[1.0, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [-1, 1, -1, 1]], dtype=torch.float64)
"""A quaternion after each of the half turns: its components at these places, with these signs."""


def canonical(log_scales: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
    """Log scales [N,3] in descending order, and x, y, z [N,3] of unit quaternions with w >= 1/2, these float64.

    As `sw_codecs.models.gauge.canonical`.
    """
    sorted_scales, xyz = torch.empty_like(log_scales), torch.empty_like(log_scales, dtype=torch.float64)
    for part in blocks(len(quats), quats.device):
        sorted_scales[part], xyz[part] = _canonical(log_scales[part], quats[part])
    return sorted_scales, xyz


def _canonical(log_scales: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
    q = quats.double()
    norm = q.square().sum(1, keepdim=True).sqrt()
    unit = q.new_tensor([1.0, 0.0, 0.0, 0.0])
    q = torch.where(norm > 1e-12, q / norm.clamp_min(1e-12), unit)
    scales, order = torch.sort(log_scales, dim=1, descending=True, stable=True)
    w, x, y, z = _TURNS.to(q.device)[9 * order[:, 0] + 3 * order[:, 1] + order[:, 2]].unbind(1)
    a, b, c, d = q.unbind(1)
    q = torch.stack([
        a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w,
    ], dim=1)  # fmt: skip
    best = q.abs().argmax(1)
    q = q.gather(1, _PLACES.to(q.device)[best]) * _SIGNS.to(q.device)[best]
    return scales, torch.where(q[:, :1] < 0, -q, q)[:, 1:]


def _complete(xyz: Tensor) -> Tensor:
    """Unit quaternions [N,4] of their x, y, z; longer ones than 1 are shortened, w = 0."""
    squared = xyz[:, 0] ** 2 + xyz[:, 1] ** 2 + xyz[:, 2] ** 2
    quats = torch.cat([(1.0 - squared).clamp_min(0.0).sqrt()[:, None], xyz], dim=1)
    return quats / squared.clamp_min(1.0).sqrt()[:, None]


def entropy_bits(symbols: Tensor, classes: Tensor, count: int, table_bits: float) -> float:
    """Bits of integer columns, each by its own counts in each class, which are stored.

    symbols     [n,C] int32
    classes     [n] 0 .. count - 1
    table_bits  of each distinct value, for its stored count
    """
    if not symbols.numel():
        return 0.0
    n, columns = symbols.shape
    low, high = symbols.aminmax(dim=0)
    spans = [int(b - a) for a, b in zip(*torch.stack([low, high]).tolist(), strict=True)]
    # Where values are many, their low bits go raw; a matrix has few columns, so places fit 32 bits.
    shifts = [max(span.bit_length() - 12, 0) for span in spans]
    width = max(span >> shift for span, shift in zip(spans, shifts, strict=True)) + 1
    places = symbols - low
    if any(shifts):
        places.bitwise_right_shift_(torch.tensor(shifts, dtype=torch.int32, device=symbols.device))
    places += (width * columns * classes.int())[:, None]
    places += width * torch.arange(columns, dtype=torch.int32, device=places.device)
    counts = torch.bincount(places.flatten(), minlength=width * columns * count).reshape(count, columns, width)
    rows = counts.sum(2)
    distinct = (counts > 0).sum(2)
    own = torch.special.entr(counts.double()).sum(2) + torch.special.xlogy(rows.double(), rows.double())
    bits = own / math.log(2) + table_bits * distinct * (distinct > 1)
    return float(bits.sum()) + n * sum(shifts)


def equal_classes(values: Tensor, count: int) -> Tensor:
    """Class 0 .. count - 1 of each of `values` [N], in classes of about equal size, as `band_context.equal_classes`."""
    if count == 1 or not len(values):
        return torch.zeros(len(values), dtype=torch.int64, device=values.device)
    ordered = values.sort().values
    limits = ordered[torch.tensor([len(ordered) * i // count for i in range(1, count)], device=values.device)]
    return torch.searchsorted(limits.contiguous(), values.contiguous(), right=True)
