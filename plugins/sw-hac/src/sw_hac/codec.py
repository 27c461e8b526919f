"""The file. What the decoder needs to predict every distribution stands before what is coded with it.

Sections: `anchors`, `masks` and `networks` (see sw_anchors.sections), `grids` (a bit for every
sign, `bernoulli`), and the integers of `features`, `scalings` and `offsets`, block by block of anchors
(`conditional-gaussian`).
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sw_anchors.anchors import two_layers
from sw_anchors.coded_anchors import ENTROPY, rounded_indices
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.float_mode import check_machine, one_thread, this_machine
from sw_anchors.lattice import TOP
from sw_anchors.sections import (
    AnchorPlaces,
    add_networks,
    add_places,
    morton_order,
    read_networks,
    read_places,
    round_networks,
)
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError
from sw_hac.model import HACAnchors, context_of, group_widths, output_widths

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_hac.config import Codec

log = logging.getLogger(__name__)

SECTIONS = ("features", "scalings", "offsets")
LIMITS = {"feature_dim": 256, "hidden": 256, "grid_hidden": 256, "grid_features": 16}
UNIT = 4096


@dataclass(frozen=True)
class Predictor:
    """What both sides predict with: all on the CPU, weights as they stand in the file.

    entropy     the class of `conditional-gaussian`
    mode        "exact" or "float"
    """

    grid: Any
    mlp_grid: nn.Sequential
    feature_dim: int
    num_offsets: int
    base_steps: tuple[float, ...]
    mode: str
    integer_mlp: Any
    entropy: Any

    def contexts(self, codes: Tensor) -> tuple[list[Any], list[np.ndarray]]:
        """For anchors at `codes` [n,3]: for each section a context of the entropy model, and steps [n,1] float64."""
        if self.mode == "exact":
            return self._exact(codes)
        with one_thread():
            outputs = self.mlp_grid(self.grid(codes.to(torch.float32) / TOP))
        found = context_of(outputs, self.feature_dim, self.num_offsets, self.base_steps)
        steps = [step.numpy().astype(np.float64) for step in found.steps]
        triples = zip(found.means, found.scales, steps, strict=True)
        return [self.entropy.Context(m.clamp(-1e6, 1e6), s.clamp(1e-9, 1e6), q) for m, s, q in triples], steps

    def _exact(self, codes: Tensor) -> tuple[list[Any], list[np.ndarray]]:
        outputs = self.integer_mlp(self.grid.integer_features(codes))
        parts = torch.split(outputs, output_widths(self.feature_dim, self.num_offsets), dim=1)
        contexts, steps = [], []
        for group, base in enumerate(self.base_steps):
            multiplier = self.entropy.step_multipliers(parts[6 + group])
            contexts.append(self.entropy.Context(parts[2 * group], parts[2 * group + 1], multiplier))
            steps.append(multiplier * (base / UNIT))
        return contexts, steps


def predictor(
    grid: Any,
    mlp_grid: nn.Sequential,
    feature_dim: int,
    num_offsets: int,
    base_steps: tuple[float, ...],
    mode: str,
    plugins: PluginManager,
) -> Predictor:
    """Raises ValueError if the network cannot be evaluated exactly."""
    units = [1 / base for base in base_steps for _ in range(2)] + [1.0] * 3
    scale = np.repeat(units, output_widths(feature_dim, num_offsets))
    integer_mlp = plugins.context_models.load("integer-mlp")
    return Predictor(
        grid, mlp_grid, feature_dim, num_offsets, base_steps, mode,
        integer_mlp.from_module(mlp_grid, output_scale=scale) if mode == "exact" else None,
        plugins.entropy_models.load("conditional-gaussian"),
    )  # fmt: skip


@dataclass(frozen=True)
class Lattice:
    """What is coded, in the order of the file: places, and the integers [N,C] of each section with their values."""

    places: AnchorPlaces
    symbols: tuple[np.ndarray, ...]
    values: tuple[Tensor, ...]
    bits: float


def encode(model: HACAnchors, writer: ContainerWriter, codec: Codec, plugins: PluginManager) -> Lattice:
    """Write all sections; the bits of the result are what the tables say of the last three (mode `exact`)."""
    if model.phase != ENTROPY:
        log.warning(
            "the model was never trained for its rate (phase '%s'): its file will be large and inexact", model.phase
        )
    model = copy.deepcopy(model).to("cpu").eval()
    model.fold_units()
    round_networks(model.networks(), codec.weights)
    rows = torch.nonzero(model.kept()).squeeze(1)
    rows = rows[morton_order(model.codes()[rows], plugins)]
    masks = model.masks(rows) > 0.5
    places = AnchorPlaces(model.bounds, model.codes()[rows], masks)
    with torch.no_grad():
        values, centres = model.raw(rows), model.centres()

    feature_dim, k = model.features.shape[1], model.num_offsets
    add_header(model, writer, codec, plugins)
    add_places(writer, places, plugins)
    writer.add("grids", plugins.entropy_models.load("bernoulli")().encode(model.grid.signs().numpy()))
    add_networks(writer, model.networks(), codec.weights)

    predicts = predictor(model.grid, model.mlp_grid, feature_dim, k, model.base_steps, codec.mode, plugins)
    coder = predicts.entropy(codec.mode)
    coded: list[list[bytes]] = [[], [], []]
    symbols: list[list[np.ndarray]] = [[], [], []]
    bits = 0.0
    for block in coder.blocks(len(rows), max(group_widths(feature_dim, k))):
        contexts, steps = predicts.contexts(places.codes[block])
        for g, present in enumerate(_present(masks[block])):
            index = rounded_indices(values[g][block].double(), torch.from_numpy(steps[g]), centres[g])
            integers = index.to(torch.int64).numpy() * (1 if present is None else present)
            coded[g].append(coder.encode(integers, contexts[g], present))
            symbols[g].append(integers)
            bits += float(coder.bits(integers, contexts[g], present).sum()) if codec.mode == "exact" else 0.0
    for name, blocks in zip(SECTIONS, coded, strict=True):
        writer.add(name, coder.join(blocks))
    writer.allow(len(rows) * bytes_per_anchor(feature_dim, k), f"a model of {len(rows):,} anchors")
    stacked = tuple(np.concatenate(s) if s else np.zeros((0, w), np.int64)
                    for s, w in zip(symbols, group_widths(feature_dim, k), strict=True))  # fmt: skip
    return Lattice(places, stacked, values, bits)


def add_header(model: HACAnchors, writer: ContainerWriter, codec: Codec, plugins: PluginManager) -> None:
    """Header values that say how the sections are to be read."""
    space, planes = model.grid.grids[0], model.grid.grids[1]
    writer.static.update(
        mode=codec.mode,
        base_steps=list(model.base_steps),
        feature_dim=model.features.shape[1],
        hidden=model.mlp_opacity[0].out_features,
        grid_hidden=model.mlp_grid[0].out_features,
        grid_features=space.features,
        grid_space=[level.resolution for level in space.levels],
        grid_planes=[level.resolution for level in planes.levels],
        grid_log2=[space.log2_size, planes.log2_size],
    )
    if codec.mode == "float":
        writer.static["made_on"] = this_machine()


def decode(reader: ContainerReader, plugins: PluginManager) -> DecodedAnchors:
    """Raises BitstreamError for damage, and for a file of mode `float` that another machine wrote."""
    feature_dim, hidden, grid_hidden, features = (
        reader.integer(name, low=1, high=high) for name, high in LIMITS.items()
    )
    mode = reader.text("mode", choices=("exact", "float"))
    if mode == "float":
        check_machine(reader)
    base_steps = _read_steps(reader)
    k = reader.integer("num_offsets", low=1, high=64)
    places = read_places(reader, plugins, bytes_per_anchor=bytes_per_anchor(feature_dim, k))
    n = len(places.codes)
    grid = _read_grid(reader, features, plugins)

    model = DecodedAnchors(
        places.positions, torch.zeros(n, feature_dim), torch.zeros(n, k, 3), torch.zeros(n, 6), places.masks,
        hidden=hidden,
    )  # fmt: skip
    widths = group_widths(feature_dim, k)
    mlp_grid = two_layers(grid.width, grid_hidden, sum(output_widths(feature_dim, k)), torch.Generator())
    read_networks(reader, {**{name: getattr(model, name) for name in model.NETWORKS}, "mlp_grid": mlp_grid})
    with reader.decoding("networks"):
        predicts = predictor(grid, mlp_grid, feature_dim, k, base_steps, mode, plugins)

    coder = predicts.entropy(mode)
    cut = coder.blocks(n, max(widths))
    found = (model.features, model.scales, model.offsets.view(n, 3 * k))
    sections = [_Blocks(reader, name, coder, len(cut)) for name in SECTIONS]
    for block in cut:
        contexts, steps = predicts.contexts(places.codes[block])
        for g, present in enumerate(_present(places.masks[block])):
            symbols = sections[g].decode(contexts[g], present)
            found[g].data[block] = torch.from_numpy((symbols * steps[g]).astype(np.float32))
    for section in sections:
        section.finish()
    for name, values in zip(SECTIONS, found, strict=True):
        with reader.decoding(name):
            if not bool(torch.isfinite(values).all()):
                raise BitstreamError("a decoded value is not finite")
    return model


class _Blocks:
    """The blocks of one section in turn; errors name the section."""

    def __init__(self, reader: ContainerReader, name: str, coder: Any, count: int) -> None:
        self._reader, self._name, self._coder = reader, name, coder
        self._blocks: Iterator[bytes] = coder.split(reader.section(name), count)

    def decode(self, context: Any, present: Any) -> np.ndarray:
        with self._reader.decoding(self._name):
            found: np.ndarray = self._coder.decode(next(self._blocks), context, present)
        return found

    def finish(self) -> None:
        with self._reader.decoding(self._name):
            next(self._blocks, None)  # raises if bytes follow the last block


def _read_steps(reader: ContainerReader) -> tuple[float, ...]:
    steps = reader.static.get("base_steps")
    fits = isinstance(steps, list) and len(steps) == 3
    if not fits or any(type(q) not in (int, float) or not 1e-6 <= q <= 1e3 for q in steps):
        raise BitstreamError(
            f"{reader.name}: header value 'base_steps' must be three numbers in 1e-6..1e3", section="header"
        )
    return tuple(float(q) for q in steps)


def _read_grid(reader: ContainerReader, features: int, plugins: PluginManager) -> Any:
    """The hash grid with the signs of the file."""
    grid_class = plugins.context_models.load("hash-grid")
    space, planes, log2 = (reader.static.get(name) for name in ("grid_space", "grid_planes", "grid_log2"))
    for name, values, most, low, high in (
        ("grid_space", space, 32, 3, 4096), ("grid_planes", planes, 32, 3, 4096), ("grid_log2", log2, 2, 3, 22),
    ):  # fmt: skip
        fits = isinstance(values, list) and 1 <= len(values) <= most
        if not fits or any(type(v) is not int or not low <= v <= high for v in values):
            raise BitstreamError(
                f"{reader.name}: header value '{name}' must be a list of integers in {low}..{high}", section="header"
            )
    if len(log2) != 2:
        raise BitstreamError(f"{reader.name}: header value 'grid_log2' must be two integers", section="header")
    settings = {"features": features, "log2_space": log2[0], "log2_planes": log2[1]}
    entries = grid_class.count(space, planes, **settings)
    reader.allow(4 * entries, f"a hash grid of {entries:,} signs")
    grid = grid_class(space, planes, **settings)
    with reader.decoding("grids") as data:
        grid.load_signs(plugins.entropy_models.load("bernoulli")().decode(data, entries))
    return grid


def _present(masks: Tensor) -> tuple[None, None, np.ndarray]:
    """Which numbers of each section are there, for masks [n,k]: three of an offset together."""
    return None, None, masks.numpy().repeat(3, axis=1)


def bytes_per_anchor(feature_dim: int, num_offsets: int) -> int:
    """Of the decoded model."""
    return 4 * (3 + sum(group_widths(feature_dim, num_offsets))) + num_offsets
