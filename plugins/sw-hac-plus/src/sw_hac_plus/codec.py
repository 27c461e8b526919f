"""The file of HAC++. What the decoder needs to predict every distribution stands before what is coded with it.

Sections: `anchors` (sw_hac_plus.voxel_lattice), `masks`, `networks` (sw_anchors.sections), `grids` (a bit for every
sign), the integers of `features.1`, ... (a section a slice, `conditional-mixture`), `scalings` and `offsets`
(`conditional-gaussian`), block by block of anchors. Without a channel context the features are one section, as in HAC.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_anchors.attribute_sections import AttributeCoder, AttributeDecoder, AttributeEncoder, Block, Coders
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.float_mode import Mode
from sw_anchors.header import read_integers
from sw_anchors.sections import add_networks, read_networks

from splatwizard_core.api import BitstreamError
from sw_codecs.context.two_layers import two_layers
from sw_codecs.entropy.rows import RowMixture
from sw_hac import codec as hac_codec
from sw_hac_plus.channel_mixture import PARTS, ChannelMixture
from sw_hac_plus.rate_model import ExactMixtures, FloatMixtures, HACPlusRateModel, Predictor
from sw_hac_plus.voxel_lattice import VoxelGeometry, add_voxels, kept_voxels, read_voxels

if TYPE_CHECKING:
    from torch import nn

    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_hac.config import FileSettings
    from sw_hac_plus.model import HACPlusAnchors

KINDS = ("full", "tiny", "none")
AFTER_FEATURES = {"scales": "scalings", "offsets": "offsets"}
"""Section of each group that is coded after the features, under one Gaussian."""


def encode(model: HACPlusAnchors, writer: ContainerWriter, settings: FileSettings, plugins: PluginManager) -> None:
    """Write all sections; the model stays as it is."""
    model = hac_codec.settled_copy(model, settings.weights)
    geometry, rows = kept_voxels(model)
    hac_codec.add_header(model, writer, settings.mode)
    _add_channel(writer, model.channel)
    add_voxels(writer, geometry, plugins)
    hac_codec.add_grid(writer, model.grid, plugins)
    add_networks(writer, model.networks(), settings.weights)

    writer.require("context model", "integer-mlp")
    further = mixtures(model.channel, settings.mode, plugins)
    attributes = AttributeEncoder(model, rows, sections(model.channel), settings.mode, plugins, further)
    walk(attributes, model.rate_model.predictor(settings.mode), model.channel, geometry)
    attributes.write(writer)
    writer.allow(len(rows) * model.shape.decoded_bytes, f"a model of {len(rows):,} anchors")


def decode(reader: ContainerReader, plugins: PluginManager) -> DecodedAnchors:
    """Read all sections. Raises BitstreamError for damage, and in mode `float` for a file from another machine."""
    header = hac_codec.read_header(reader)
    shape = header.shape
    channel = _read_channel(reader, shape.features)
    geometry = read_voxels(reader, plugins, bytes_per_anchor=shape.decoded_bytes)
    grid = hac_codec.read_grid(reader, header.grid_features, plugins)
    model = DecodedAnchors.zeros(geometry, shape, hidden=header.hidden)
    outputs = sum(shape.outputs) + (0 if channel is None else shape.features)
    mlp_grid = two_layers(grid.width, header.grid_hidden, outputs, torch.Generator())
    networks: dict[str, nn.Module] = {name: getattr(model, name) for name in model.NETWORKS}
    read_networks(reader, networks | {"mlp_grid": mlp_grid} | ({} if channel is None else {"channel": channel}))
    base = torch.tensor(header.base_steps)
    rate_model = HACPlusRateModel(grid, mlp_grid, shape, header.base_steps, base, channel=channel)
    with reader.decoding("networks"):
        predictor = rate_model.predictor(header.mode)
    further = mixtures(channel, header.mode, plugins)
    attributes = AttributeDecoder(reader, model, sections(channel), header.mode, plugins, further)
    walk(attributes, predictor, channel, geometry)
    attributes.finish()
    return model


def walk(
    attributes: AttributeCoder, predictor: Predictor, channel: ChannelMixture | None, geometry: VoxelGeometry
) -> None:
    """Code all groups of each block: features slice by slice, then scales, then the offsets that masks keep."""
    if channel is None or not isinstance(predictor, (ExactMixtures, FloatMixtures)):
        hac_codec.walk(attributes, predictor, geometry)
        return
    for rows in attributes.rows:
        first = predictor.first(geometry.codes[rows])
        _, steps = first.groups["features"]
        known = first.channel_inputs.new_empty(len(first.channel_inputs), sum(channel.slices))
        for i in range(len(channel.slices)):
            columns = channel.part(i)
            mixture = predictor.mixture(i, columns, first, known[:, : columns.start])
            symbols = attributes.code(Block(f"features.{i + 1}", "features", rows, columns), mixture, steps)
            known[:, columns] = predictor.known(symbols, first)
        hac_codec.code_groups(attributes, first.groups, geometry.masks[rows], rows, AFTER_FEATURES)


def mixtures(channel: ChannelMixture | None, mode: Mode, plugins: PluginManager) -> Coders:
    """Return the entropy model of mixtures by the type that it takes; none without a channel context."""
    return {} if channel is None else {RowMixture: plugins.entropy_models.load("conditional-mixture")(mode)}


def sections(channel: ChannelMixture | None) -> list[str]:
    """Names of the sections of attributes, in file order."""
    if channel is None:
        return list(hac_codec.SECTIONS.values())
    return [*(f"features.{i + 1}" for i in range(len(channel.slices))), *AFTER_FEATURES.values()]


def _add_channel(writer: ContainerWriter, channel: ChannelMixture | None) -> None:
    """Add the header values `channel`, `slices` and `channel_hidden`, as far as there are any."""
    if channel is None:
        writer.static["channel"] = "none"
        return
    writer.static.update(channel="full" if channel.context else "tiny", slices=list(channel.slices))
    if channel.hidden is not None:
        writer.static["channel_hidden"] = channel.hidden
    writer.require("context model", "channel-mixture")
    writer.require("entropy model", "conditional-mixture")


def _read_channel(reader: ContainerReader, features: int) -> ChannelMixture | None:
    """Return the channel context that the header describes, without its weights. Raises BitstreamError."""
    kind = reader.text("channel", choices=KINDS)
    if kind == "none":
        return None
    slices = read_integers(reader, "slices", low=1, high=256, longest=64)
    if sum(slices) != features:
        raise BitstreamError(f"{reader.name}: the slices of the header do not sum to its features", section="header")
    full = kind == "full"
    context = PARTS * features if full else 0
    hidden = reader.integer("channel_hidden", low=1, high=512) if full else None
    numbers = ChannelMixture.count(slices, context=context, hidden=hidden)
    if 2 * numbers > reader.sections.get("networks", 0):  # float16 at least; before they are made
        raise BitstreamError(
            f"{reader.name}: channel networks of {numbers:,} numbers are not there", section="networks"
        )
    return ChannelMixture(slices, context=context, hidden=hidden, generator=torch.Generator())
