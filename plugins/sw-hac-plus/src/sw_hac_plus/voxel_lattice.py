"""Positions of anchors as integer multiples of the voxel size: in training and in the file alike.

x = n e in float64, rounded to float32 once, so that every machine has the same positions from the same integers.
Section `anchors` of such a file: six little-endian float32 (bounds of the hash grid: low x y z, high x y z), float64
voxel size e, three int32 (the smallest n of each axis), then n without it by the position codec `octree`, which fixes
the order of all rows. Source: HAC++ (arXiv 2501.12255); the layout is ours.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from sw_anchors.lattice import position_codes
from sw_anchors.sections import (
    BOUNDS_BYTES,
    AnchorGeometry,
    add_masks,
    morton_order,
    read_bounds,
    read_counts,
    read_masks,
)
from torch import Tensor

from splatwizard_core.api import BitstreamError

if TYPE_CHECKING:
    from sw_anchors.coded_anchors import CodedAnchors

    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager

MOST_BITS = 21
"""Of an axis of the octree."""
LARGEST = 1 << 30
"""Integers of positions stay within this."""
_HEAD = struct.Struct("<d3i")


def voxel_integers(positions: Tensor, voxel_size: float) -> Tensor:
    """[N,3] int64: the nearest multiples of `voxel_size`."""
    return torch.round(positions.detach().to(torch.float64) / voxel_size).to(torch.int64)


def voxel_positions(integers: Tensor, voxel_size: float) -> Tensor:
    """[N,3] float32, world units."""
    return (integers.to(torch.float64) * voxel_size).to(torch.float32)


def check_reach(positions: Tensor, voxel_size: float) -> None:
    """Raise ValueError if anchors at `positions` [N,3] are more voxels from one another, or from 0, than a file has."""
    if not len(positions):
        return
    places = torch.round(positions.detach().to(torch.float64) / voxel_size)
    reach = float((places.amax(dim=0) - places.amin(dim=0)).max())
    if not (reach < 1 << MOST_BITS and float(places.abs().max()) < LARGEST):
        size = f"2^{MOST_BITS} voxels of {voxel_size:g}"
        raise ValueError(f"the anchors reach over more than {size}: train with a larger voxel_size")


def within_reach(candidates: Tensor, anchors: Tensor, voxel_size: float) -> Tensor:
    """[M] bool: those of `candidates` [M,3] with which `check_reach` holds as for `anchors` [N,3] alone; M, N > 0.

    Of those that are too far from one another, on both sides of the anchors, the near ones are taken.
    """
    old, new = (torch.round(each.detach().to(torch.float64) / voxel_size) for each in (anchors, candidates))
    low, high, most = old.amin(dim=0), old.amax(dim=0), (1 << MOST_BITS) - 1
    alone = ((new >= high - most) & (new <= low + most) & (new.abs() < LARGEST)).all(dim=1)  # not a number: False
    taken = torch.where(alone[:, None], new, low)
    together = torch.maximum(high, taken.amax(dim=0)) - torch.minimum(low, taken.amin(dim=0)) <= most  # [3]
    left = most - (high - low)
    near = (new >= low - left / 2) & (new <= high + left / 2)
    return alone & (together | near).all(dim=1)


@dataclass(frozen=True)
class VoxelGeometry(AnchorGeometry):
    """Positions and masks of the anchors of a file, on the CPU; `codes` are those of the hash grid.

    integers    [N,3] int64, in Morton order from the smallest of each axis on
    voxel_size  world units
    """

    integers: Tensor
    voxel_size: float

    @property
    def positions(self) -> Tensor:
        return voxel_positions(self.integers, self.voxel_size)


def kept_voxels(model: CodedAnchors) -> tuple[VoxelGeometry, Tensor]:
    """The anchors of a model that its file has, in the order of the file; and their rows [N] in the model.

    Raises ValueError if two of them share a voxel, or they reach over more than 2^21 voxels.
    """
    rows = torch.nonzero(model.kept()).squeeze(1)
    check_reach(model.anchors[rows], model.voxel_size)
    integers = voxel_integers(model.anchors[rows], model.voxel_size).cpu()
    if len(torch.unique(integers, dim=0)) < len(integers):
        raise ValueError("two anchors share a voxel")
    order = torch.arange(0)
    if len(rows):
        low = integers.amin(dim=0)
        order = morton_order(integers - low)
    integers, rows = integers[order], rows[order.to(rows.device)]
    masks = model.masks(rows).detach().cpu() > 0.5
    bounds = model.bounds.cpu()
    codes = position_codes(voxel_positions(integers, model.voxel_size), bounds)
    return VoxelGeometry(bounds, codes, masks, integers, model.voxel_size), rows


def add_voxels(writer: ContainerWriter, geometry: VoxelGeometry, plugins: PluginManager) -> None:
    """Add the sections `anchors` and `masks`, and the header values num_anchors, num_gaussians and num_offsets."""
    integers, n = geometry.integers.numpy(), len(geometry.integers)
    low = integers.min(axis=0) if n else np.zeros(3, np.int64)
    reach = int((integers - low).max(initial=0))
    head = geometry.bounds.numpy().astype("<f4").tobytes() + _HEAD.pack(geometry.voxel_size, *map(int, low))
    octree = plugins.position_codecs.load("octree")()
    writer.add("anchors", head + octree.encode(integers - low, max(1, reach.bit_length())))
    add_masks(writer, geometry.masks, plugins)


def read_voxels(reader: ContainerReader, plugins: PluginManager, *, bytes_per_anchor: int) -> VoxelGeometry:
    """Inverse of `add_voxels`.

    bytes_per_anchor    of the decoded model, held against the size of the file before anything is allocated

    Raises BitstreamError.
    """
    n, k, gaussians = read_counts(reader, bytes_per_anchor=bytes_per_anchor)
    with reader.decoding("anchors") as data:
        bounds = read_bounds(data)
        head = data[BOUNDS_BYTES : BOUNDS_BYTES + _HEAD.size]
        if len(head) != _HEAD.size:
            raise BitstreamError("ends within the lattice of the positions")
        voxel_size, *low = _HEAD.unpack(head)
        if not math.isfinite(voxel_size) or not 1e-30 < voxel_size < 1e30:
            raise BitstreamError("the voxel size is no positive number")
        points = plugins.position_codecs.load("octree")(max_points=n).decode(data[BOUNDS_BYTES + _HEAD.size :])
        if points.shape != (n, 3):
            raise BitstreamError(f"holds {len(points):,} anchors, header says {n:,}")
        integers = torch.from_numpy(points) + torch.tensor(low, dtype=torch.int64)
        if n and int(integers.abs().max()) >= LARGEST:
            raise BitstreamError("an anchor leaves the lattice")
        positions = voxel_positions(integers, voxel_size)
        if not bool(torch.isfinite(positions).all()):
            raise BitstreamError("the voxel size puts an anchor beyond all finite positions")
        codes = position_codes(positions, bounds)
    masks = read_masks(reader, plugins, n, k, gaussians)
    return VoxelGeometry(bounds, codes, masks, integers, voxel_size)
