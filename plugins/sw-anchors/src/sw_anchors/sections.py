"""File sections of an anchor model's geometry (positions, offset masks) and network weights.

Section `anchors`: six little-endian float32 (bounds: low x y z, high x y z), then the 16-bit position codes, coded by
`octree`; they fix the order of all rows. Section `masks`: one symbol per offset,
anchor by anchor, by the entropy model `bernoulli`. Section `networks`: every weight and bias in the order of
`named_parameters`, float32 or float16.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from sw_gaussians.morton import interleave
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError
from sw_anchors.lattice import BITS, TOP, coded_positions

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_anchors.coded_anchors import CodedAnchors

WeightType = Literal["float32", "float16"]
WEIGHT_TYPES: tuple[WeightType, ...] = ("float32", "float16")
BOUNDS_BYTES = 24


@dataclass(frozen=True)
class AnchorGeometry:
    """Positions and masks of the anchors of a file: its sections `anchors` and `masks`, on the CPU.

    bounds      [2,3] float32
    codes       [N,3] int64, in Morton order
    masks       [N,k] bool; a row has at least one
    """

    bounds: Tensor
    codes: Tensor
    masks: Tensor

    @property
    def positions(self) -> Tensor:
        """[N,3] float32, world units."""
        return coded_positions(self.codes, self.bounds)


def morton_order(codes: Tensor) -> Tensor:
    """Return the row order of the file, [N] int64, for position codes [N,3]."""
    return torch.argsort(interleave(codes.cpu()), stable=True)


def kept_geometry(model: CodedAnchors) -> tuple[AnchorGeometry, Tensor]:
    """Return the geometry of the kept anchors in file order, and their rows [N] in the model."""
    kept = torch.nonzero(model.kept()).squeeze(1)
    rows = kept[morton_order(model.codes()[kept]).to(kept.device)]
    geometry = AnchorGeometry(model.bounds.cpu(), model.codes()[rows].cpu(), model.masks(rows).detach().cpu() > 0.5)
    return geometry, rows


def add_geometry(writer: ContainerWriter, geometry: AnchorGeometry, plugins: PluginManager) -> None:
    """Add the sections `anchors` and `masks`, and the header values num_anchors, num_gaussians and num_offsets."""
    bounds = geometry.bounds.numpy().astype("<f4").tobytes()
    writer.add("anchors", bounds + plugins.position_codecs.load("octree")().encode(geometry.codes.numpy(), BITS))
    add_masks(writer, geometry.masks, plugins)


def add_masks(writer: ContainerWriter, masks: Tensor, plugins: PluginManager) -> None:
    """Add the section `masks` and the header values num_anchors, num_gaussians and num_offsets; masks [N,k] bool."""
    writer.static["num_anchors"], writer.static["num_offsets"] = map(int, masks.shape)
    writer.static["num_gaussians"] = int(masks.sum())
    writer.add("masks", plugins.entropy_models.load("bernoulli")().encode(masks.numpy().reshape(-1), None))


def read_geometry(reader: ContainerReader, plugins: PluginManager, *, bytes_per_anchor: int) -> AnchorGeometry:
    """Inverse of `add_geometry`.

    bytes_per_anchor    of the decoded model, held against the size of the file before anything is allocated

    Raises BitstreamError.
    """
    n, k, gaussians = read_counts(reader, bytes_per_anchor=bytes_per_anchor)
    with reader.decoding("anchors") as data:
        bounds = read_bounds(data)
        codes = torch.from_numpy(plugins.position_codecs.load("octree")(max_points=n).decode(data[BOUNDS_BYTES:]))
        if codes.shape != (n, 3):
            raise BitstreamError(f"holds {len(codes):,} anchors, header says {n:,}")
        if n and not 0 <= int(codes.min()) <= int(codes.max()) <= TOP:
            raise BitstreamError(f"an anchor leaves the lattice of {BITS} bits")
    return AnchorGeometry(bounds, codes, read_masks(reader, plugins, n, k, gaussians))


def read_counts(reader: ContainerReader, *, bytes_per_anchor: int) -> tuple[int, int, int]:
    """Read the header values num_anchors, num_offsets and num_gaussians. Raises BitstreamError."""
    n = reader.integer("num_anchors", low=0, high=(1 << 32) - 1)
    k = reader.integer("num_offsets", low=1, high=64)
    gaussians = reader.integer("num_gaussians", low=n, high=n * k)
    reader.allow(n * bytes_per_anchor, f"a model of {n:,} anchors")
    return n, k, gaussians


def read_bounds(data: bytes | memoryview) -> Tensor:
    """Read bounds [2,3] float32 from the start of a section. Raises BitstreamError unless finite and in order."""
    if len(data) < BOUNDS_BYTES:
        raise BitstreamError("ends within the bounds of the anchors")
    bounds = torch.from_numpy(np.frombuffer(data[:BOUNDS_BYTES], "<f4").astype(np.float32).reshape(2, 3))
    if not bool(torch.isfinite(bounds).all() and (bounds[0] <= bounds[1]).all()):
        raise BitstreamError("the bounds of the anchors are not finite or end before they start")
    return bounds


def read_masks(reader: ContainerReader, plugins: PluginManager, n: int, k: int, gaussians: int) -> Tensor:
    """Read masks [n,k] bool, `gaussians` of them True, at least one per row. Raises BitstreamError."""
    with reader.decoding("masks") as data:
        symbols = plugins.entropy_models.load("bernoulli")().decode(data, n * k)
        masks = torch.from_numpy(symbols.reshape(n, k) > 0)
        if int(masks.sum()) != gaussians:
            raise BitstreamError(f"keeps {int(masks.sum()):,} Gaussians, header says {gaussians:,}")
        if not bool(masks.any(dim=1).all()):
            raise BitstreamError("an anchor has no Gaussian")
    return masks


def add_networks(writer: ContainerWriter, networks: Mapping[str, nn.Module], weights: WeightType) -> None:
    """Add the section `networks` and the header value `weights`. Raises ValueError if a weight does not fit."""
    writer.static["weights"] = weights
    arrays = [p.detach().cpu().numpy().astype(weights) for _, p in _parameters(networks)]
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError(f"a weight of a network is not finite, or does not fit {weights}: use float32")
    writer.add("networks", b"".join(array.astype(array.dtype.newbyteorder("<")).tobytes() for array in arrays))


@torch.no_grad()
def round_networks(networks: Mapping[str, nn.Module], weights: WeightType) -> None:
    """Round every weight, in place, to its value in the file."""
    for _, parameter in _parameters(networks):
        parameter.copy_(parameter.to(getattr(torch, weights)))


@torch.no_grad()
def read_networks(reader: ContainerReader, networks: Mapping[str, nn.Module]) -> None:
    """Load the weights of the section into networks of matching shapes, in place. Raises BitstreamError."""
    dtype = np.dtype(reader.text("weights", choices=WEIGHT_TYPES)).newbyteorder("<")
    with reader.decoding("networks") as data:
        expected = sum(p.numel() for _, p in _parameters(networks)) * dtype.itemsize
        if len(data) != expected:
            raise BitstreamError(f"is {len(data):,} bytes, the networks need {expected:,}")
        values = torch.from_numpy(np.frombuffer(data, dtype).astype(np.float32))
        if not bool(torch.isfinite(values).all()):
            raise BitstreamError("a weight is not finite")
        start = 0
        for _, parameter in _parameters(networks):
            part = values[start : start + parameter.numel()]
            parameter.copy_(part.view_as(parameter))
            start += parameter.numel()


def _parameters(networks: Mapping[str, nn.Module]) -> list[tuple[str, nn.Parameter]]:
    return [(f"{key}.{name}", p) for key, module in networks.items() for name, p in module.named_parameters()]
