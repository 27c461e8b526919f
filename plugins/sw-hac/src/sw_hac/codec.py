"""The file of HAC. What the decoder needs to predict every distribution stands before what is coded with it.

Sections: `anchors`, `masks` and `networks` (see sw_anchors.sections), `grids` (a bit for every sign, `bernoulli`), and
the integers of `features`, `scalings` and `offsets`, block by block of anchors (`conditional-gaussian`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_anchors.attribute_sections import AttributeDecoder, AttributeEncoder
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.sections import add_geometry, add_networks, kept_geometry, read_geometry, read_networks

from sw_codecs.context.two_layers import two_layers
from sw_hac.predictors import PREDICTORS
from sw_hac.sections import SECTIONS, add_grid, add_header, read_grid, read_header, settled_copy, walk

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_hac.config import FileSettings
    from sw_hac.model import HACAnchors


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
    walk(attributes, PREDICTORS[settings.mode](model.grid, model.mlp_grid, model.shape, model.base_steps), geometry)
    attributes.write(writer)
    writer.allow(len(rows) * model.shape.decoded_bytes, f"a model of {len(rows):,} anchors")


def decode(reader: ContainerReader, plugins: PluginManager) -> DecodedAnchors:
    """Raises BitstreamError for damage, and for a file of mode `float` that another machine wrote."""
    header = read_header(reader)
    shape = header.shape
    geometry = read_geometry(reader, plugins, bytes_per_anchor=shape.decoded_bytes)
    grid = read_grid(reader, header.grid_features, plugins)
    model = DecodedAnchors.zeros(geometry, shape, hidden=header.hidden)
    mlp_grid = two_layers(grid.width, header.grid_hidden, sum(shape.outputs), torch.Generator())
    read_networks(reader, {**{name: getattr(model, name) for name in model.NETWORKS}, "mlp_grid": mlp_grid})
    with reader.decoding("networks"):
        predict = PREDICTORS[header.mode](grid, mlp_grid, shape, header.base_steps)
    attributes = AttributeDecoder(reader, model, list(SECTIONS.values()), header.mode, plugins)
    walk(attributes, predict, geometry)
    attributes.finish()
    return model
