"""The file: places of the anchors, networks, planes, then the attributes under what all of those predict.

Sections: `anchors`, `masks` and `networks` (see sw_anchors.sections), `frame` and `triplane`, and
the integers of `features.1`, ... (a section a slice), `scalings` and `offsets`, block by block of anchors.
Encoder and decoder walk over the rows in the same way (`walk`); only what happens to a block of symbols differs.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sw_anchors.coded_anchors import GROUPS, MASK_THRESHOLD, rounded_indices
from sw_anchors.decoded_anchors import DecodedAnchors
from sw_anchors.float_mode import check_machine, one_thread, this_machine
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
from sw_cat_3dgs.context import PLANES, CatContext, ContextShape
from sw_cat_3dgs.model import CatAnchors
from sw_cat_3dgs.predictors import PREDICTORS
from sw_cat_3dgs.stage import base_resolution

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_cat_3dgs.config import CatConfig

LIMITS = {
    "feature_dim": 256, "hidden": 256, "channels": 512, "context_hidden": 512, "slice_hidden": 512,
    "resolution": 1 << 14,
}  # fmt: skip

Code = Callable[[str, str, slice, slice, Any, Any], Tensor]
"""(section, group, rows, columns of the group, distribution, which are there) -> symbols int64 [n,C]."""


def encode(model: CatAnchors, writer: ContainerWriter, config: CatConfig, plugins: PluginManager) -> None:
    """All sections. The model stays as it is."""
    kept = torch.nonzero(model.kept()).squeeze(1)
    rows = kept[morton_order(model.codes()[kept], plugins).to(kept.device)]
    masks = (model.soft_masks()[rows] > MASK_THRESHOLD).cpu()
    places = AnchorPlaces(model.bounds.cpu(), model.codes()[rows].cpu(), masks)
    values = dict(zip(GROUPS, (v.detach().cpu() for v in model.raw(rows)), strict=True))
    centres = dict(zip(GROUPS, (c.cpu() for c in model.centres()), strict=True))

    context = _settled_context(model, places, config)
    networks = {name: copy.deepcopy(getattr(model, name)).cpu() for name in model.NETWORKS} | _networks(context)
    round_networks(networks, config.codec.weights)
    _write_shape(writer, context.shape, config, context.resolution)
    add_places(writer, places, plugins)
    add_networks(writer, networks, config.codec.weights)
    writer.add_array("frame", context.frame.numpy().astype("<f4"))
    planes = [plane.numpy() for plane in context.triplane.integers()]
    spatial = plugins.context_models.load("spatial-ar")
    writer.add("triplane", spatial.encode(planes, [arm.exact(arm.state()) for arm in context.arms]))
    _use_integers(context, planes)

    conditional = plugins.entropy_models.load("conditional-gaussian")
    coder = conditional(config.codec.mode)
    predictor: Any = PREDICTORS[config.codec.mode](context, plugins)
    blocks: dict[str, list[bytes]] = {name: [] for name in sections(context.shape)}

    def code(section: str, group: str, part: slice, columns: slice, distribution: Any, there: Any) -> Tensor:
        step = predictor.quantum(group, distribution.step)
        symbols = rounded_indices(values[group][part, columns].double(), step, centres[group]).to(torch.int64)
        blocks[section].append(coder.encode(symbols.numpy(), distribution, there))
        return symbols

    if len(rows):
        with one_thread():
            walk(predictor, context.places(places.codes, places.bounds), masks, conditional, code)
    for name, found in blocks.items():
        writer.add(name, conditional.join(found))
    writer.allow(decoded_bytes(len(rows), context.shape, context.resolution), f"a model of {len(rows):,} anchors")


def decode(reader: ContainerReader, plugins: PluginManager) -> DecodedAnchors:
    """The model that the file holds. Raises BitstreamError for damage, and for a `float` file of another machine."""
    mode = reader.text("mode", choices=tuple(PREDICTORS))
    if mode == "float":
        check_machine(reader)
    shape, hidden, resolution = _read_shape(reader)
    n = reader.integer("num_anchors", low=0, high=(1 << 32) - 1)
    reader.allow(decoded_bytes(n, shape, resolution), f"a model of {n:,} anchors and planes of base {resolution}")
    if (n > 0) != (resolution > 0):
        raise BitstreamError(f"{reader.name}: header gives {n:,} anchors planes of {resolution}", section="header")
    places = read_places(reader, plugins, bytes_per_anchor=_row_bytes(shape))
    found = {name: torch.zeros(n, width) for name, width in zip(GROUPS, shape.widths, strict=True)}
    model = DecodedAnchors(
        places.positions, found["features"], found["offsets"].view(n, shape.offsets, 3), found["scales"], places.masks,
        hidden=hidden,
    )  # fmt: skip
    context = CatContext(plugins, shape, torch.Generator())
    read_networks(reader, {name: getattr(model, name) for name in model.NETWORKS} | _networks(context))
    context.frame = torch.from_numpy(reader.array("frame", dtype="<f4", shape=(7, 3), finite=True))
    with reader.decoding("networks"):
        arms = [arm.exact(arm.state()) for arm in context.arms]
    with reader.decoding("triplane") as data:
        shapes = [(shape.channels, m * resolution, m * resolution) for m in shape.multiples]
        _use_integers(context, plugins.context_models.load("spatial-ar").decode(data, shapes, arms))
    with reader.decoding("networks"):
        predictor: Any = PREDICTORS[mode](context, plugins)

    conditional = plugins.entropy_models.load("conditional-gaussian")
    coder = conditional(mode)
    count = len(row_blocks(n, shape, conditional))
    stored = {name: _blocks(reader, name, conditional, count) for name in sections(shape)}

    def code(section: str, group: str, part: slice, columns: slice, distribution: Any, there: Any) -> Tensor:
        block = next(stored[section])
        with reader.decoding(section):
            symbols = torch.from_numpy(coder.decode(block, distribution, there))
        found[group][part, columns] = (symbols * predictor.quantum(group, distribution.step)).to(torch.float32)
        return symbols

    if n:
        with reader.decoding("frame"):
            spots = context.places(places.codes, places.bounds)
        with one_thread():
            walk(predictor, spots, places.masks, conditional, code)
    for blocks in stored.values():
        next(blocks, None)  # what follows the last block is noticed
    for name, value in found.items():
        if not bool(torch.isfinite(value).all()):
            raise BitstreamError(f"{reader.name}: decoded {name} are not finite: the file is damaged or hostile")
    return model


def walk(predictor: Any, places: Tensor, masks: Tensor, conditional: Any, code: Code) -> None:
    """Call `code` for each block of rows: features slice by slice, then scales, then the offsets that masks keep."""
    shape: ContextShape = predictor.context.shape
    for part in row_blocks(len(places), shape, conditional):
        first = predictor.first(places[part])
        mean, scale, step = first["features"]
        known = predictor.known(torch.zeros(len(mean), 0, dtype=torch.int64), step)
        for i in range(len(shape.slices)):
            columns = predictor.context.slices.part(i)
            found = [mean[:, columns], scale[:, columns]]
            if i > 0:
                found = [a + b for a, b in zip(found, predictor.shift(f"slice{i}", known), strict=True)]
            symbols = code(f"features.{i + 1}", "features", part, columns, conditional.Context(*found, step), None)
            known = torch.cat([known, predictor.known(symbols, step)], dim=1)
        for group, section in (("scales", "scalings"), ("offsets", "offsets")):
            mean, scale, step = first[group]
            if shape.refine:
                shift, widening = predictor.shift(group, known)
                mean, scale = mean + shift, scale + widening
            there = masks[part].repeat_interleave(3, dim=1) if group == "offsets" else None
            code(section, group, part, slice(None), conditional.Context(mean, scale, step), there)


def row_blocks(rows: int, shape: ContextShape, conditional: Any) -> list[slice]:
    """The blocks in which rows are predicted and coded."""
    found: list[slice] = conditional.blocks(rows, max(shape.widths))
    return found


def sections(shape: ContextShape) -> list[str]:
    """Names of the sections of attributes, in file order."""
    return [*(f"features.{i}" for i in range(1, len(shape.slices) + 1)), "scalings", "offsets"]


def decoded_bytes(anchors: int, shape: ContextShape, resolution: int) -> int:
    """Of the model in float32, with the planes that its decoder holds meanwhile."""
    latents = sum(PLANES * shape.channels * (m * resolution) ** 2 for m in shape.multiples)
    return anchors * _row_bytes(shape) + 4 * latents


def _row_bytes(shape: ContextShape) -> int:
    return 4 * (3 + sum(shape.widths)) + shape.offsets


def _networks(context: CatContext) -> dict[str, nn.Module]:
    return {"context": context.network, "slices": context.slices, "arms": context.arms}


def _settled_context(model: CatAnchors, places: AnchorPlaces, config: CatConfig) -> CatContext:
    """A copy of the model's context on the CPU; of a training that ended before there was one, a plain one."""
    context = copy.deepcopy(model.context).cpu()
    if not len(places.codes):
        _use_integers(context, [plane.numpy() for plane in context.triplane.initial(0, None)])
    elif context.resolution == 0:
        settings = config.context
        context.fit_frame(places.positions, neighbors=settings.neighbors, contamination=settings.contamination)
        features, scales, offsets = (v.cpu() for v in model.raw(torch.nonzero(model.kept()).squeeze(1)))
        context.start_at((features, scales, offsets))
        resolution = base_resolution(len(places.codes), settings.anchors_per_cell)
        shapes = [plane.shape for plane in context.triplane.initial(resolution, torch.Generator())]
        _use_integers(context, [np.zeros(each, np.int64) for each in shapes])
    context.fold_units()
    return context


def _use_integers(context: CatContext, planes: list[np.ndarray]) -> None:
    """Give the triplane the values of the file."""
    for i, plane in enumerate(planes):
        values = torch.from_numpy(plane.astype(np.float32)) / 16
        setattr(context.triplane.planes, str(i), nn.Parameter(values, requires_grad=False))
    context.rounded = True


def _write_shape(writer: ContainerWriter, shape: ContextShape, config: CatConfig, resolution: int) -> None:
    writer.static.update(
        mode=config.codec.mode, feature_dim=shape.features, hidden=config.hidden, channels=shape.channels,
        multiples=list(shape.multiples), resolution=resolution, context_hidden=shape.hidden, slices=list(shape.slices),
        slice_hidden=shape.slice_hidden, refine=int(shape.refine),
        base_steps=list(shape.base_steps),
    )  # fmt: skip
    if config.codec.mode == "float":
        writer.static["made_on"] = this_machine()


def _read_shape(reader: ContainerReader) -> tuple[ContextShape, int, int]:
    """(shape, hidden, resolution) from the header."""
    sizes = {
        name: reader.integer(name, low=0 if name == "resolution" else 1, high=high) for name, high in LIMITS.items()
    }
    slices = _sizes(reader, "slices", longest=64, high=LIMITS["feature_dim"])
    if sum(slices) != sizes["feature_dim"]:
        raise BitstreamError(f"{reader.name}: the slices of the header do not sum to its features", section="header")
    shape = ContextShape(
        features=sizes["feature_dim"], offsets=reader.integer("num_offsets", low=1, high=64),
        channels=sizes["channels"], multiples=_sizes(reader, "multiples", longest=4, high=16),
        hidden=sizes["context_hidden"], slices=slices, slice_hidden=sizes["slice_hidden"],
        refine=bool(reader.integer("refine", low=0, high=1)), base_steps=_read_steps(reader),
    )  # fmt: skip
    return shape, sizes["hidden"], sizes["resolution"]


def _read_steps(reader: ContainerReader) -> tuple[float, float, float]:
    steps: Any = reader.static.get("base_steps")
    usable = isinstance(steps, list) and len(steps) == 3 and all(type(q) in (int, float) for q in steps)
    if not usable or steps[0] != 1 or not all(1e-9 <= q <= 1e9 for q in steps):
        raise BitstreamError(
            f"{reader.name}: header value 'base_steps' must be 1 and two numbers in 1e-9..1e9", section="header"
        )
    return 1.0, float(steps[1]), float(steps[2])


def _sizes(reader: ContainerReader, name: str, *, longest: int, high: int) -> tuple[int, ...]:
    """A list of the header."""
    value: Any = reader.static.get(name)
    fits = isinstance(value, list) and 1 <= len(value) <= longest
    if not fits or any(type(v) is not int or not 1 <= v <= high for v in value):
        raise BitstreamError(
            f"{reader.name}: header value '{name}' must be 1..{longest} integers in 1..{high}", section="header"
        )
    return tuple(value)


def _blocks(reader: ContainerReader, name: str, conditional: Any, count: int) -> Iterator[bytes]:
    """The blocks of a section one by one; what is wrong with their framing is blamed on it."""
    with reader.decoding(name) as data:
        yield from conditional.split(data, count)
