"""Header values and sections of a file whose anchors a hash grid predicts: the common part of HAC and HAC++.

Section `grids`: a bit for every sign of the grids, by the entropy model `bernoulli`. The sections `scalings` and
`offsets`, and those of the features, hold integers, block by block of anchors (sw_anchors.attribute_sections).
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from sw_anchors.attribute_sections import AttributeCoder, Block
from sw_anchors.coded_anchors import ENTROPY
from sw_anchors.float_mode import Mode, add_machine, read_mode
from sw_anchors.header import read_base_steps, read_integers
from sw_anchors.sections import AnchorGeometry, WeightType, round_networks
from sw_anchors.shape import AnchorShape
from torch import Tensor

from sw_codecs.context.hash_grid import HashGrid
from sw_hac.mixed_grid import MixedHashGrid
from sw_hac.model import HACAnchors

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_hac.predictors import BlockPrediction

log = logging.getLogger(__name__)

SECTIONS = {"features": "features", "scales": "scalings", "offsets": "offsets"}
"""Group -> section."""
LIMITS = {"feature_dim": 256, "hidden": 256, "grid_hidden": 256, "grid_features": 16}
"""Largest value of a size in the header."""

Model = TypeVar("Model", bound=HACAnchors)


@dataclass(frozen=True)
class HACHeader:
    """Header values of a file: coder mode, base steps, sizes of anchors and networks; `grid_features` bits a vertex."""

    mode: Mode
    base_steps: tuple[float, float, float]
    shape: AnchorShape
    hidden: int
    grid_hidden: int
    grid_features: int


def settled_copy(model: Model, weights: WeightType) -> Model:
    """A copy on the CPU whose networks predict in the units of the values, with the weights that the file has."""
    if model.phase != ENTROPY:
        log.warning(
            "the model was never trained for its rate (phase '%s'): its file will be large and inexact", model.phase
        )
    model = copy.deepcopy(model).to("cpu").eval()
    model.fold_units()
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
    """The hash grid with the signs of the file. Raises BitstreamError."""
    space, planes = (read_integers(reader, key, low=3, high=4096, longest=32) for key in ("grid_space", "grid_planes"))
    log2_space, log2_planes = read_integers(reader, "grid_log2", low=3, high=22, shortest=2, longest=2)
    entries = MixedHashGrid.count(space, planes, features=features, log2_space=log2_space, log2_planes=log2_planes)
    reader.allow(4 * entries, f"a hash grid of {entries:,} signs")
    grid = MixedHashGrid(space, planes, features=features, log2_space=log2_space, log2_planes=log2_planes)
    with reader.decoding("grids") as data:
        grid.load_signs(plugins.entropy_models.load("bernoulli")().decode(data, entries))
    return grid


def walk(
    attributes: AttributeCoder,
    predict: Callable[[Tensor], BlockPrediction],
    geometry: AnchorGeometry,
    sections: Mapping[str, str] = SECTIONS,
) -> None:
    """Code all groups of each block of anchors, whose distributions their positions give."""
    for rows in attributes.rows:
        code_groups(attributes, predict(geometry.codes[rows]), geometry.masks[rows], rows, sections)


def code_groups(
    attributes: AttributeCoder, predicted: BlockPrediction, masks: Tensor, rows: slice, sections: Mapping[str, str]
) -> None:
    """Code the groups that `sections` names of one block of anchors with `masks` [n,k]."""
    for group, section in sections.items():
        # Three coordinates of an offset are there or not together.
        present = masks.repeat_interleave(3, dim=1) if group == "offsets" else None
        attributes.code(Block(section, group, rows), *predicted[group], present)
