"""The file of HAC. What the decoder needs to predict every distribution stands before what is coded with it.

Sections: `anchors`, `masks` and `networks` (see sw_anchors.sections), `grids` (a bit for every sign of the grids,
`bernoulli`), and the integers of `features`, `scalings` and `offsets`, block by block of anchors
(`conditional-gaussian`).
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import torch
from sw_anchors.attribute_sections import AttributeCoder, AttributeDecoder, AttributeEncoder, Block
from sw_anchors.coded_anchors import ENTROPY
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.float_mode import Mode, add_machine, read_mode
from sw_anchors.header import read_base_steps, read_integers
from sw_anchors.sections import (
    AnchorGeometry,
    WeightType,
    add_geometry,
    add_networks,
    kept_geometry,
    read_geometry,
    read_networks,
    round_networks,
)
from sw_anchors.shape import AnchorShape
from torch import Tensor

from sw_codecs.context.hash_grid import HashGrid
from sw_codecs.context.two_layers import two_layers
from sw_hac.mixed_grid import MixedHashGrid
from sw_hac.model import HACAnchors
from sw_hac.rate_model import BlockPrediction, HACRateModel, Predictor

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_hac.config import FileSettings

log = logging.getLogger(__name__)

Model = TypeVar("Model", bound=HACAnchors)

SECTIONS = {"features": "features", "scales": "scalings", "offsets": "offsets"}
"""Section of each group."""
LIMITS = {"feature_dim": 256, "hidden": 256, "grid_hidden": 256, "grid_features": 16}
"""Largest value of a size in the header."""


def encode(model: HACAnchors, writer: ContainerWriter, settings: FileSettings, plugins: PluginManager) -> None:
    """Write all sections; the model stays as it is."""
    model = settled_copy(model, settings.weights)
    geometry, rows = kept_geometry(model)
    add_header(model, writer, settings.mode)
    add_geometry(writer, geometry, plugins)
    add_grid(writer, model.grid, plugins)
    add_networks(writer, model.networks(), settings.weights)

    writer.require("context model", "integer-mlp")
    attributes = AttributeEncoder(model, rows, list(SECTIONS.values()), settings.mode, plugins)
    walk(attributes, model.rate_model.predictor(settings.mode), geometry)
    attributes.write(writer)
    writer.allow(len(rows) * model.shape.decoded_bytes, f"a model of {len(rows):,} anchors")


def decode(reader: ContainerReader, plugins: PluginManager) -> DecodedAnchors:
    """Read all sections. Raises BitstreamError for damage, and in mode `float` for a file from another machine."""
    header = read_header(reader)
    shape = header.shape
    geometry = read_geometry(reader, plugins, bytes_per_anchor=shape.decoded_bytes)
    grid = read_grid(reader, header.grid_features, plugins)
    model = DecodedAnchors.zeros(geometry, shape, hidden=header.hidden)
    mlp_grid = two_layers(grid.width, header.grid_hidden, sum(shape.outputs), torch.Generator())
    read_networks(reader, {**{name: getattr(model, name) for name in model.NETWORKS}, "mlp_grid": mlp_grid})
    with reader.decoding("networks"):
        predictor = HACRateModel.of_file(grid, mlp_grid, shape, header.base_steps).predictor(header.mode)
    attributes = AttributeDecoder(reader, model, list(SECTIONS.values()), header.mode, plugins)
    walk(attributes, predictor, geometry)
    attributes.finish()
    return model


@dataclass(frozen=True)
class HACHeader:
    """Header values of a file: coder mode, base steps, sizes of anchors, networks; `grid_features` bits per vertex."""

    mode: Mode
    base_steps: tuple[float, float, float]
    shape: AnchorShape
    hidden: int
    grid_hidden: int
    grid_features: int


def settled_copy(model: Model, weights: WeightType) -> Model:
    """Return a copy on the CPU whose networks predict in the units of the values, with the weights of the file."""
    if model.phase != ENTROPY:
        log.warning(
            "the model was never trained for its rate (phase '%s'): its file will be large and inexact", model.phase
        )
    model = copy.deepcopy(model).to("cpu").eval()
    model.fold_units()
    base, factors = model.base_steps, model.led.get("steps", (1, 1, 1))
    model.base_steps = base[0] * factors[0], base[1] * factors[1], base[2] * factors[2]
    round_networks(model.networks(), weights)
    return model


def add_header(model: HACAnchors, writer: ContainerWriter, mode: Mode) -> None:
    """Add the header values that say how the sections are to be read."""
    space, planes = model.grid.grids[0], model.grid.grids[1]
    assert isinstance(space, HashGrid)
    assert isinstance(planes, HashGrid)
    writer.static.update(
        mode=mode,
        base_steps=list(model.base_steps),
        feature_dim=model.shape.features,
        hidden=model.mlp_opacity[0].out_features,
        grid_hidden=model.mlp_grid[0].out_features,
        grid_features=space.features,
        grid_space=[level.resolution for level in space.levels],
        grid_planes=[level.resolution for level in planes.levels],
        grid_log2=[space.log2_size, planes.log2_size],
    )
    add_machine(writer, mode)


def read_header(reader: ContainerReader) -> HACHeader:
    """Inverse of `add_header`, without the grid. Raises BitstreamError."""
    feature_dim, hidden, grid_hidden, grid_features = (
        reader.integer(name, low=1, high=high) for name, high in LIMITS.items()
    )
    mode = read_mode(reader)
    base_steps = read_base_steps(reader, low=1e-6, high=1e3)
    shape = AnchorShape(feature_dim, reader.integer("num_offsets", low=1, high=64))
    return HACHeader(mode, base_steps, shape, hidden, grid_hidden, grid_features)


def add_grid(writer: ContainerWriter, grid: MixedHashGrid, plugins: PluginManager) -> None:
    """Add the section `grids`."""
    writer.add("grids", plugins.entropy_models.load("bernoulli")().encode(grid.signs().numpy(), None))


def read_grid(reader: ContainerReader, features: int, plugins: PluginManager) -> MixedHashGrid:
    """Return the hash grid with the signs of the file. Raises BitstreamError."""
    space, planes = (read_integers(reader, key, low=3, high=4096, longest=32) for key in ("grid_space", "grid_planes"))
    log2_space, log2_planes = read_integers(reader, "grid_log2", low=3, high=22, shortest=2, longest=2)
    entries = MixedHashGrid.count(space, planes, features=features, log2_space=log2_space, log2_planes=log2_planes)
    reader.allow(4 * entries, f"a hash grid of {entries:,} signs")
    grid = MixedHashGrid(space, planes, features=features, log2_space=log2_space, log2_planes=log2_planes)
    with reader.decoding("grids") as data:
        grid.load_signs(plugins.entropy_models.load("bernoulli")().decode(data, entries))
    return grid


def walk(
    attributes: AttributeCoder, predictor: Predictor, geometry: AnchorGeometry, sections: Mapping[str, str] = SECTIONS
) -> None:
    """Code all groups of each block of anchors: encoder and decoder go over them in this order.

    predictor   gives distributions and steps from the position codes of a block
    sections    section of each group
    """
    for rows in attributes.rows:
        code_groups(attributes, predictor(geometry.codes[rows]), geometry.masks[rows], rows, sections)


def code_groups(
    attributes: AttributeCoder, predicted: BlockPrediction, masks: Tensor, rows: slice, sections: Mapping[str, str]
) -> None:
    """Code those groups of one block of anchors, with `masks` [n,k] bool, that `sections` names."""
    for group, section in sections.items():
        # Three coordinates of an offset are there or not together.
        present = masks.repeat_interleave(3, dim=1) if group == "offsets" else None
        attributes.code(Block(section, group, rows), *predicted[group], present)
