"""`gsc-quant`: the scalar quantiser of the MPEG GSC exploration (2025), and a lossless coder of ours behind it.

It is an anchor that anybody can run, after the exploration's, not its own: that codes the same integers with G-PCC.
Source: specification of the protocols, anchors (read of N00677, repeated in N01292).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from sw_gaussians.surfels import refuse_surfels

from splatwizard_core.api import BitstreamError, GaussianModel, Params, UserInputError

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SPAN = 256.0  # world units: the range of a position along each axis, from its smallest value on
RANGES = {"sh": (-4.0, 4.0), "opacity": (-7.0, 18.0), "scale": (-26.0, 4.0), "quaternion": (-1.0, 1.0)}
"""Range of each attribute as a .ply stores it: coefficients, logit, logarithm, components of the unit quaternion."""
POSITIONS, COLUMNS = "octree", "columns"
"""Coders of the integers: `position codec` of the cells, `entropy model` of all else."""
ON_LATTICE = 1e-6  # distance from which on components of a quaternion are taken for no values of this lattice
SECTIONS = ("position", "sh0", "sh1", "sh2", "sh3", "opacity", "scaling", "rotation")


class GscQuantSettings(Params):
    """Settings of the quantiser."""

    position_bits: int = Field(18, ge=4, le=21, description="bits of a position along each axis")
    bits: int = Field(12, ge=2, le=20, description="bits of every other value")
    range: Literal["auto", "fixed"] = Field(
        "auto", description="an attribute that its range would clip: takes that of this file's values, or is refused"
    )


class Range(NamedTuple):
    """Smallest and largest value, each one number or one for each of three axes."""

    low: Floats
    high: Floats

    def quantize(self, values: Floats, bits: int) -> Integers:
        """Codes 0 .. 2^bits - 1 of values [N,C]."""
        top = 2**bits - 1
        return np.clip(np.rint((values - self.low) / (self.high - self.low) * top), 0, top).astype(np.int64)

    def dequantize(self, codes: Integers, bits: int) -> Floats:
        """Values of codes; low and high come back exactly."""
        top = 2**bits - 1
        found: Floats = np.where(codes == top, self.high, self.low + codes * ((self.high - self.low) / top))
        return found


class GscQuantCodec:
    """Every attribute to integers over a range, positions by an octree, the rest by columns; nothing is trained.

    Gaussians come back in Morton order of their cells. What was decoded gives the same bytes again.
    """

    Settings: ClassVar[type[Params]] = GscQuantSettings

    def __init__(self, plugins: PluginManager, **settings: Any) -> None:
        self.settings = GscQuantSettings(**settings)
        self.plugins = plugins

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Write a section per attribute. Raises UserInputError for surfels, values that are not finite, and clipping
        with `range=fixed`."""
        refuse_surfels(model, "codec gsc-quant")
        values = stored_values(model)
        ranges, auto = ranges_of(values, self.settings.range)
        bits, degree = self.settings.bits, model.active_sh_degree
        writer.raster["sh_degree"] = degree
        writer.static.update(
            num_gaussians=model.num_rows, sh_degree=degree, position_bits=self.settings.position_bits, bits=bits,
            range_auto=auto, ranges={name: [each.low.tolist(), each.high.tolist()] for name, each in ranges.items()},
        )  # fmt: skip
        if not model.num_rows:
            return
        octree = self.plugins.position_codecs.load(POSITIONS)()
        columns = self.plugins.entropy_models.load(COLUMNS)()
        cells = ranges["position"].quantize(values["position"], self.settings.position_bits)
        order = octree.sort(cells)
        writer.add("position", octree.encode(cells[order], self.settings.position_bits))
        for name, attribute in attributes_of(degree).items():
            found = values[name][order]
            spread = ranges[attribute]
            codes = spread.quantize(found if name != "rotation" else unit_quaternions(found, spread, bits), bits)
            writer.add(name, columns.encode(codes, None))
        writer.allow(decoded_bytes(model.num_rows, degree), f"a model of {model.num_rows:,} Gaussians")

    def decode(self, reader: ContainerReader) -> GaussianModel:
        """Return the model. Raises BitstreamError."""
        count = reader.integer("num_gaussians", low=0, high=2**32 - 1)
        degree = reader.integer("sh_degree", low=0, high=3)
        position_bits = reader.integer("position_bits", low=4, high=21)
        bits = reader.integer("bits", low=2, high=20)
        reader.allow(decoded_bytes(count, degree), f"{count:,} Gaussians")
        if count == 0:
            return model_of({"position": np.zeros((0, 3))}, degree)
        ranges = stated_ranges(reader)
        with reader.decoding("position") as data:
            cells = self.plugins.position_codecs.load(POSITIONS)(max_points=count).decode(data)
            if cells.shape != (count, 3) or not 0 <= int(cells.min()) <= int(cells.max()) < 1 << position_bits:
                raise BitstreamError(f"holds {len(cells):,} points on another grid, the header says {count:,}")
        columns = self.plugins.entropy_models.load(COLUMNS)()
        found = {"position": ranges["position"].dequantize(cells, position_bits)}
        for name, attribute in attributes_of(degree).items():
            with reader.decoding(name) as data:
                codes = columns.decode(data, (count, section_width(name)))
                if not 0 <= int(codes.min()) <= int(codes.max()) < 1 << bits:
                    raise BitstreamError(f"a code has more than {bits} bits")
                found[name] = ranges[attribute].dequantize(codes, bits)
        return model_of(found, degree)


def model_of(values: dict[str, Floats], degree: int) -> GaussianModel:
    """The Gaussians of values [N,C] by section, which may lack sections where N is 0."""
    n = len(values["position"])
    found = {name: values.get(name, np.zeros((n, section_width(name)))) for name in attributes_of(degree)}
    bands = [found[f"sh{band}"].reshape(n, 2 * band + 1, 3) for band in range(1, degree + 1)]
    parts = (
        values["position"], found["sh0"][:, None, :], np.concatenate([np.zeros((n, 0, 3)), *bands], axis=1),
        found["opacity"][:, 0], found["scaling"], found["rotation"],
    )  # fmt: skip
    return GaussianModel.from_tensors(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def ranges_of(values: dict[str, Floats], kind: str) -> tuple[dict[str, Range], list[str]]:
    """Range of each attribute, and which were taken from the values because the table's would clip them.

    Positions get one step for all axes. Raises UserInputError for a clipped attribute where `kind` is "fixed".
    """
    ranges, clipped = {}, []
    points = values["position"] if len(values["position"]) else np.zeros((1, 3))
    low, high, width = points.min(axis=0), points.max(axis=0), SPAN
    if (high - low).max() > SPAN:
        clipped.append("position")
        width = float((high - low).max())
    ranges["position"] = Range(low, low + width)
    for name, (least, most) in RANGES.items():
        found = _all_of(values, name)
        lowest, highest = (float(found.min()), float(found.max())) if found.size else (least, most)
        if name != "quaternion" and (lowest < least or highest > most):
            clipped.append(name)
            least, most = lowest, highest
        ranges[name] = Range(np.array(least), np.array(most))
    if clipped and kind == "fixed":
        raise UserInputError(
            f"gsc-quant: its ranges would clip {', '.join(clipped)} of this model; codec.settings.range=auto takes the "
            "range of the values for these"
        )
    return ranges, clipped


def clipped_attributes(model: GaussianModel) -> list[str]:
    """Attributes of a model that the table's ranges would clip, in the order of the table."""
    return ranges_of(stored_values(model), "auto")[1]


def _all_of(values: dict[str, Floats], attribute: str) -> Floats:
    parts = [values[name].ravel() for name, of in attributes_of(3).items() if of == attribute and name in values]
    return np.concatenate(parts) if parts else np.zeros(0)


def stored_values(model: GaussianModel) -> dict[str, Floats]:
    """Values as the .ply of 3DGS stores them, [N,C] float64 by section. Raises UserInputError if one is not finite."""
    raw = {name: getattr(model, name).detach().cpu().double().numpy() for name in model.RAW}
    rest = raw["sh_rest"]
    found = {
        "position": raw["means"], "sh0": raw["sh_dc"][:, 0], "opacity": raw["opacity_logits"][:, None],
        "scaling": raw["log_scales"], "rotation": raw["quats"],
        **{f"sh{band}": rest[:, band**2 - 1 : (band + 1) ** 2 - 1].reshape(-1, section_width(f"sh{band}"))
           for band in range(1, model.active_sh_degree + 1)},
    }  # fmt: skip
    for name, values in found.items():
        if not np.isfinite(values).all():
            raise UserInputError(f"gsc-quant: {name} has values that are not finite")
    return found


def attributes_of(degree: int) -> dict[str, str]:
    """Section -> attribute of the table, without the positions."""
    bands = {f"sh{band}": "sh" for band in range(degree + 1)}
    return {**bands, "opacity": "opacity", "scaling": "scale", "rotation": "quaternion"}


def section_width(section: str) -> int:
    """Columns of a section."""
    if section.startswith("sh"):
        return 3 * (2 * int(section[2:]) + 1)
    return {"opacity": 1, "scaling": 3, "rotation": 4}[section]


def unit_quaternions(quats: Floats, spread: Range, bits: int) -> Floats:
    """Unit quaternions [N,4]; decoded values of this lattice stay as they are, so that coding twice changes nothing."""
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    step = float(spread.high - spread.low) / (2**bits - 1)
    again = spread.dequantize(spread.quantize(quats, bits), bits)
    decoded = (np.abs(again - quats).max(axis=1, keepdims=True) < ON_LATTICE) & (np.abs(length - 1) < 2 * step)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    return np.where(decoded, quats, np.where(length > 0, quats / np.where(length > 0, length, 1.0), identity))


def stated_ranges(reader: ContainerReader) -> dict[str, Range]:
    """Ranges of the header. Raises BitstreamError unless each is two finite numbers, or of positions two of three."""
    stated = reader.static.get("ranges")
    found = {}
    for name in ("position", *RANGES):
        try:
            low, high = (np.array(each, dtype=np.float64) for each in stated[name])  # type: ignore[index]
            shape = (3,) if name == "position" else ()
            if not low.shape == high.shape == shape or not (np.abs([low, high]) < 1e12).all() or (low >= high).any():
                raise ValueError
        except (TypeError, ValueError, KeyError):
            raise BitstreamError(f"{reader.name}: the header has no range of {name}", section="header") from None
        found[name] = Range(low, high)
    return found


def decoded_bytes(count: int, degree: int) -> int:
    """Bytes of a decoded model."""
    return 4 * count * (14 + 3 * ((degree + 1) ** 2 - 1))
