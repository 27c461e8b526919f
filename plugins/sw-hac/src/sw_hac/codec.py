"""The file of HAC. What the decoder needs to predict every distribution stands before what is coded with it.

Sections: `anchors`, `masks` and `networks` (see sw_anchors.sections), `grids` (a bit for every sign, `bernoulli`), and
the integers of `features`, `scalings` and `offsets`, block by block of anchors (`conditional-gaussian`).
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from sw_anchors.anchors import two_layers
from sw_anchors.attribute_sections import AttributeCoder, AttributeDecoder, AttributeEncoder, Block
from sw_anchors.coded_anchors import ENTROPY
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.float_mode import add_machine, read_mode
from sw_anchors.header import read_base_steps, read_integers
from sw_anchors.sections import (
    AnchorGeometry,
    add_geometry,
    add_networks,
    kept_geometry,
    read_geometry,
    read_networks,
    round_networks,
)
from sw_anchors.shape import AnchorShape
from torch import Tensor

from sw_codecs.context.hash_grid import HashGrid, MixedHashGrid
from sw_codecs.entropy.bernoulli import Bernoulli
from sw_hac.model import HACAnchors
from sw_hac.predictors import PREDICTORS, BlockPrediction

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter
    from sw_hac.config import FileSettings

log = logging.getLogger(__name__)

SECTIONS = {"features": "features", "scales": "scalings", "offsets": "offsets"}
"""Group -> section."""
LIMITS = {"feature_dim": 256, "hidden": 256, "grid_hidden": 256, "grid_features": 16}


def encode(model: HACAnchors, writer: ContainerWriter, settings: FileSettings) -> None:
    """Write all sections; the model stays as it is."""
    if model.phase != ENTROPY:
        log.warning(
            "the model was never trained for its rate (phase '%s'): its file will be large and inexact", model.phase
        )
    model = copy.deepcopy(model).to("cpu").eval()
    model.fold_units()
    round_networks(model.networks(), settings.weights)
    geometry, rows = kept_geometry(model)
    add_header(model, writer, settings)
    add_geometry(writer, geometry)
    writer.add("grids", Bernoulli().encode(model.grid.signs().numpy()))
    add_networks(writer, model.networks(), settings.weights)

    writer.require("context model", "integer-mlp")
    attributes = AttributeEncoder(model, rows, list(SECTIONS.values()), settings.mode)
    walk(attributes, PREDICTORS[settings.mode](model.grid, model.mlp_grid, model.shape, model.base_steps), geometry)
    attributes.write(writer)
    writer.allow(len(rows) * model.shape.decoded_bytes, f"a model of {len(rows):,} anchors")


def decode(reader: ContainerReader) -> DecodedAnchors:
    """Raises BitstreamError for damage, and for a file of mode `float` that another machine wrote."""
    feature_dim, hidden, grid_hidden, grid_features = (
        reader.integer(name, low=1, high=high) for name, high in LIMITS.items()
    )
    mode = read_mode(reader)
    base_steps = read_base_steps(reader, low=1e-6, high=1e3)
    shape = AnchorShape(feature_dim, reader.integer("num_offsets", low=1, high=64))
    geometry = read_geometry(reader, bytes_per_anchor=shape.decoded_bytes)
    grid = _read_grid(reader, grid_features)
    model = DecodedAnchors.zeros(geometry, shape, hidden=hidden)
    mlp_grid = two_layers(grid.width, grid_hidden, sum(shape.outputs), torch.Generator())
    read_networks(reader, {**{name: getattr(model, name) for name in model.NETWORKS}, "mlp_grid": mlp_grid})
    with reader.decoding("networks"):
        predict = PREDICTORS[mode](grid, mlp_grid, shape, base_steps)
    attributes = AttributeDecoder(reader, model, list(SECTIONS.values()), mode)
    walk(attributes, predict, geometry)
    attributes.finish()
    return model


def walk(attributes: AttributeCoder, predict: Callable[[Tensor], BlockPrediction], geometry: AnchorGeometry) -> None:
    """Code all groups of each block of anchors, whose distributions their positions give."""
    for rows in attributes.rows:
        predicted = predict(geometry.codes[rows])
        for group, section in SECTIONS.items():
            # Three coordinates of an offset are there or not together.
            present = geometry.masks[rows].repeat_interleave(3, dim=1) if group == "offsets" else None
            attributes.code(Block(section, group, rows), *predicted[group], present)


def add_header(model: HACAnchors, writer: ContainerWriter, settings: FileSettings) -> None:
    """Add the header values that say how the sections are to be read."""
    space, planes = model.grid.grids[0], model.grid.grids[1]
    assert isinstance(space, HashGrid)
    assert isinstance(planes, HashGrid)
    writer.static.update(
        mode=settings.mode,
        base_steps=list(model.base_steps),
        feature_dim=model.shape.features,
        hidden=model.mlp_opacity[0].out_features,
        grid_hidden=model.mlp_grid[0].out_features,
        grid_features=space.features,
        grid_space=[level.resolution for level in space.levels],
        grid_planes=[level.resolution for level in planes.levels],
        grid_log2=[space.log2_size, planes.log2_size],
    )
    add_machine(writer, settings.mode)


def _read_grid(reader: ContainerReader, features: int) -> MixedHashGrid:
    """The hash grid with the signs of the file."""
    space, planes = (read_integers(reader, key, low=3, high=4096, longest=32) for key in ("grid_space", "grid_planes"))
    log2_space, log2_planes = read_integers(reader, "grid_log2", low=3, high=22, shortest=2, longest=2)
    entries = MixedHashGrid.count(space, planes, features=features, log2_space=log2_space, log2_planes=log2_planes)
    reader.allow(4 * entries, f"a hash grid of {entries:,} signs")
    grid = MixedHashGrid(space, planes, features=features, log2_space=log2_space, log2_planes=log2_planes)
    with reader.decoding("grids") as data:
        grid.load_signs(Bernoulli().decode(data, entries))
    return grid
