"""The file of CAT-3DGS: geometry, networks, planes, then the attributes under what all of those predict.

Sections: `anchors`, `masks` and `networks` (see sw_anchors.sections), `frame` and `triplane`, and the integers of
`features.1`, ... (a section a slice), `scalings` and `offsets`, block by block of anchors. Encoder and decoder walk
over the rows in the same way (`walk`); only what happens to a block of symbols differs.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from sw_anchors.attribute_sections import AttributeCoder, AttributeDecoder, AttributeEncoder, Block
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.float_mode import add_machine, one_thread, read_mode
from sw_anchors.header import read_base_steps, read_integers
from sw_anchors.rate_model import triple
from sw_anchors.sections import (
    AnchorGeometry,
    add_geometry,
    add_networks,
    kept_geometry,
    read_geometry,
    read_networks,
    round_networks,
)
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError, UserInputError
from sw_cat_3dgs.context import PLANES, CatContext, ContextShape
from sw_cat_3dgs.model import CatAnchors
from sw_cat_3dgs.rate_model import CatRateModel, Predictor
from sw_cat_3dgs.stage import base_resolution
from sw_cat_3dgs.triplane import GAIN
from sw_codecs.entropy.rows import RowContext

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_cat_3dgs.config import CatConfig

LIMITS = {
    "feature_dim": 256, "hidden": 256, "channels": 512, "context_hidden": 512, "slice_hidden": 512,
    "resolution": 1 << 14,
}  # fmt: skip

PLANES_FREE, PLANES_PER_ANCHOR = 1 << 20, 1024
"""Integers of the planes that a file may have, and those for each of its anchors besides: they cost hardly any bytes,
so that a small file could keep its reader busy for long."""


def encode(model: CatAnchors, writer: ContainerWriter, config: CatConfig, plugins: PluginManager) -> None:
    """Write all sections; the model stays as it is."""
    geometry, rows = kept_geometry(model)
    mode = config.codec.settings.mode
    context = _settled_context(model, geometry, config)
    networks = {name: copy.deepcopy(getattr(model, name)).cpu() for name in model.NETWORKS} | _networks(context)
    round_networks(networks, config.codec.settings.weights)
    if not _planes_fit(len(geometry.codes), context.shape, context.resolution):
        raise UserInputError(
            f"context.anchors_per_cell={config.context.anchors_per_cell}: planes of base {context.resolution} are too "
            f"large for {len(geometry.codes):,} anchors; give a larger value"
        )
    _write_shape(writer, context.shape, config, context.resolution)
    add_geometry(writer, geometry, plugins)
    add_networks(writer, networks, config.codec.settings.weights)
    writer.add_array("frame", context.frame.numpy().astype("<f4"))
    planes = [plane.numpy() for plane in context.triplane.integers()]
    writer.require("context model", "spatial-ar")
    coder = plugins.entropy_models.load("wavefront")()
    expected = coder.Context(context.exact_arms(), context.shape.planes(context.resolution))
    writer.add("triplane", coder.encode(expected.join(planes), expected))
    _use_integers(context, planes)

    attributes = AttributeEncoder(model, rows, sections(context.shape), mode, plugins)
    predictor = CatRateModel.of_file(context).predictor(mode)
    if len(rows):
        with one_thread() if mode == "float" else torch.no_grad():
            walk(attributes, predictor, context.places(geometry.codes, geometry.bounds), geometry.masks)
    attributes.write(writer)
    if mode == "exact":
        writer.require("context model", "integer-mlp")
    writer.allow(decoded_bytes(len(rows), context.shape, context.resolution), f"a model of {len(rows):,} anchors")


def decode(reader: ContainerReader, plugins: PluginManager) -> DecodedAnchors:
    """Raises BitstreamError for damage, and for a file of mode `float` that another machine wrote."""
    mode = read_mode(reader)
    shape, hidden, resolution = _read_shape(reader)
    n = reader.integer("num_anchors", low=0, high=(1 << 32) - 1)
    reader.allow(decoded_bytes(n, shape, resolution), f"a model of {n:,} anchors and planes of base {resolution}")
    if (n > 0) != (resolution > 0):
        raise BitstreamError(f"{reader.name}: header gives {n:,} anchors planes of {resolution}", section="header")
    if not _planes_fit(n, shape, resolution):
        raise BitstreamError(
            f"{reader.name}: planes of base {resolution} are too large for {n:,} anchors", section="header"
        )
    geometry = read_geometry(reader, plugins, bytes_per_anchor=shape.decoded_bytes)
    model = DecodedAnchors.zeros(geometry, shape, hidden=hidden)
    context = CatContext(shape, torch.Generator())
    read_networks(reader, {name: getattr(model, name) for name in model.NETWORKS} | _networks(context))
    context.frame = torch.from_numpy(reader.array("frame", dtype="<f4", shape=(7, 3), finite=True))
    with reader.decoding("networks"):
        arms = context.exact_arms()
    with reader.decoding("triplane") as data:
        coder = plugins.entropy_models.load("wavefront")()
        expected = coder.Context(arms, shape.planes(resolution))
        _use_integers(context, expected.split(coder.decode(data, expected)))
    with reader.decoding("networks"):
        predictor = CatRateModel.of_file(context).predictor(mode)

    attributes = AttributeDecoder(reader, model, sections(shape), mode, plugins)
    if n:
        with reader.decoding("frame"):
            places = context.places(geometry.codes, geometry.bounds)
        with one_thread() if mode == "float" else torch.no_grad():
            walk(attributes, predictor, places, geometry.masks)
    attributes.finish()
    return model


def walk(attributes: AttributeCoder, predictor: Predictor, places: Tensor, masks: Tensor) -> None:
    """Code each block of rows: features slice by slice, then scales, then the offsets that masks keep."""
    slices, refine = predictor.context.slices, predictor.context.shape.refine
    for rows in attributes.rows:
        first = predictor.first(places[rows])
        alone = first["features"]
        steps = predictor.steps("features", alone)
        known = predictor.known(torch.zeros(len(steps), 0, dtype=torch.int64), alone)
        for i in range(len(slices.slices)):
            columns = slices.part(i)
            mean, scale = alone.mean[:, columns], alone.scale[:, columns]
            if i > 0:
                shift, widening = predictor.shift(f"slice{i}", known)
                mean, scale = mean + shift, scale + widening
            context = RowContext(mean, scale, alone.step)
            symbols = attributes.code(Block(f"features.{i + 1}", "features", rows, columns), context, steps)
            known = torch.cat([known, predictor.known(symbols, alone)], dim=1)
        for group, section in (("scales", "scalings"), ("offsets", "offsets")):
            context = first[group]
            steps = predictor.steps(group, context)
            if refine:
                shift, widening = predictor.shift(group, known)
                context = RowContext(context.mean + shift, context.scale + widening, context.step)
            present = masks[rows].repeat_interleave(3, dim=1) if group == "offsets" else None
            attributes.code(Block(section, group, rows), context, steps, present)


def sections(shape: ContextShape) -> list[str]:
    """Names of the sections of attributes, in file order."""
    return [*(f"features.{i}" for i in range(1, len(shape.slices) + 1)), "scalings", "offsets"]


def decoded_bytes(anchors: int, shape: ContextShape, resolution: int) -> int:
    """Bytes of the model in float32, with the planes that its decoder holds meanwhile."""
    return anchors * shape.decoded_bytes + 4 * _integers(shape, resolution)


def _integers(shape: ContextShape, resolution: int) -> int:
    return sum(PLANES * c * h * w for c, h, w in shape.planes(resolution))


def _planes_fit(anchors: int, shape: ContextShape, resolution: int) -> bool:
    return _integers(shape, resolution) <= PLANES_FREE + PLANES_PER_ANCHOR * anchors


def _networks(context: CatContext) -> dict[str, nn.Module]:
    return {"context": context.network, "slices": context.slices, "arms": context.arms}


def _settled_context(model: CatAnchors, geometry: AnchorGeometry, config: CatConfig) -> CatContext:
    """A copy of the model's context on the CPU; of a training that ended before there was one, a plain one."""
    context = copy.deepcopy(model.context).cpu()
    if not len(geometry.codes):
        _use_integers(context, [plane.numpy() for plane in context.triplane.initial(0, None)])
    elif context.resolution == 0:
        settings = config.context
        context.fit_frame(geometry.positions, neighbors=settings.neighbors, contamination=settings.contamination)
        context.start_at(triple(v.cpu() for v in model.raw(torch.nonzero(model.kept()).squeeze(1))))
        resolution = base_resolution(len(geometry.codes), settings.anchors_per_cell)
        shapes = [plane.shape for plane in context.triplane.initial(resolution, torch.Generator())]
        _use_integers(context, [np.zeros(each, np.int64) for each in shapes])
    context.fold_units()
    factors = model.led.get("steps", (1, 1, 1))
    _, scales, offsets = (base * factor for base, factor in zip(context.shape.base_steps, factors, strict=True))
    context.shape = replace(context.shape, base_steps=(1.0, scales, offsets))
    return context


def _use_integers(context: CatContext, planes: list[np.ndarray]) -> None:
    """Give the triplane the values of the file."""
    for i, plane in enumerate(planes):
        values = torch.from_numpy(plane.astype(np.float32)) / GAIN
        setattr(context.triplane.planes, str(i), nn.Parameter(values, requires_grad=False))
    context.rounded = True


def _write_shape(writer: ContainerWriter, shape: ContextShape, config: CatConfig, resolution: int) -> None:
    writer.static.update(
        mode=config.codec.settings.mode, feature_dim=shape.features, hidden=config.hidden, channels=shape.channels,
        multiples=list(shape.multiples), resolution=resolution, context_hidden=shape.hidden, slices=list(shape.slices),
        slice_hidden=shape.slice_hidden, refine=int(shape.refine),
        base_steps=list(shape.base_steps),
    )  # fmt: skip
    add_machine(writer, config.codec.settings.mode)


def _read_shape(reader: ContainerReader) -> tuple[ContextShape, int, int]:
    """(shape, hidden, resolution) from the header."""
    sizes = {
        name: reader.integer(name, low=0 if name == "resolution" else 1, high=high) for name, high in LIMITS.items()
    }
    slices = read_integers(reader, "slices", low=1, high=LIMITS["feature_dim"], longest=64)
    if sum(slices) != sizes["feature_dim"]:
        raise BitstreamError(f"{reader.name}: the slices of the header do not sum to its features", section="header")
    base_steps = read_base_steps(reader, low=1e-9, high=1e9)
    if base_steps[0] != 1:
        raise BitstreamError(f"{reader.name}: the base step of the features must be 1", section="header")
    shape = ContextShape(
        features=sizes["feature_dim"], offsets=reader.integer("num_offsets", low=1, high=64),
        channels=sizes["channels"], multiples=read_integers(reader, "multiples", low=1, high=16, longest=4),
        hidden=sizes["context_hidden"], slices=slices, slice_hidden=sizes["slice_hidden"],
        refine=bool(reader.integer("refine", low=0, high=1)), base_steps=base_steps,
    )  # fmt: skip
    return shape, sizes["hidden"], sizes["resolution"]
