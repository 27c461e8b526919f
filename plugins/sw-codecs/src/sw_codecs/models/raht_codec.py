"""Codec `raht` of whole Gaussian models: octree, RAHT coefficients and log scales in blocks, a codebook for SH bands.

Source: MesonGS (arXiv 2409.09756). Sections (docs/bitstream.md), rows in Morton order:

    box         float64 [2,3]: corners of the voxel grid
    positions   `octree` of the voxels
    mean        float32 [7]: the first coefficient, sum / sqrt(N), of each channel
    detail      `columns` of integers [N-1,7]: the other coefficients, less the zero of their block
    scales      `columns` of integers [N,3]: log scales, likewise
    steps       `byte-planes` of float32 [B,10]: quantiser steps of each block, 7 channels, then 3 scales
    zeros       `columns` of integers [B,10]: the integer that stands for 0
    index       `columns` of integers [N]: codebook entry of each Gaussian
    codebook    `byte-planes` of float16 [K,D]

`octree` and `columns` are the usual ones; settings name others, and then so does the header.

The decoder computes in float64 with +, -, *, / and square roots alone: it gives the same floats on every machine.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatwizard_core.api import BitstreamError, GaussianModel, SplatwizardError
from sw_codecs.models.exchangeable import Exchangeable, decoded_matrix, entropy_model, position_codec
from sw_codecs.models.raht_gaussians import CHANNELS, RahtGaussians, settled_copy
from sw_codecs.models.raht_settings import RahtSettings
from sw_codecs.models.voxels import Anchor, VoxelGrid
from sw_codecs.positions import morton
from sw_codecs.quantizers.fake_quant import FakeQuantAffine, block_of_rows
from sw_codecs.transforms.euler import exact_quats_of
from sw_codecs.transforms.raht import RahtPlan

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager

COLUMNS = CHANNELS + 3
"""Quantised numbers of a Gaussian."""

HALF_MAX = 65504.0
MAX_BLOCKS = 4096


class Raht:
    """Settings: `RahtSettings`. A settled `RahtGaussians` has its own, and is written with the ranges that it has."""

    Settings = RahtSettings

    def __init__(self, plugins: PluginManager, *, seed: int = 0, **settings: Any) -> None:
        """seed     of the codebook's training."""
        self.plugins, self.seed, self.settings = plugins, seed, RahtSettings(**settings)
        self.settings.check(plugins)

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Write the sections. Gaussians that are not finite are left out.

        Raises SplatwizardError for a settled model that holds such values.
        """
        if not isinstance(model, RahtGaussians) or model.grid is None:
            model = settled_copy(model, self.settings, seed=self.seed)
        _check_finite(model)
        _write(copy.deepcopy(model).cpu(), writer, self.plugins, self.settings)

    def decode(self, reader: ContainerReader) -> GaussianModel:
        """Return the model. Raises BitstreamError."""
        return _read(reader, self.plugins)


def _check_finite(model: RahtGaussians) -> None:
    for name, parameter in model.named_parameters():
        rows = parameter.detach().reshape(len(parameter), math.prod(parameter.shape[1:]))
        bad = ~torch.isfinite(rows).all(1)
        if bool(bad.any()):
            raise SplatwizardError(f"'{name}' is not finite in {int(bad.sum()):,} rows: they cannot be encoded")


@torch.no_grad()
def _write(model: RahtGaussians, writer: ContainerWriter, plugins: PluginManager, parts: Exchangeable) -> None:
    """Write a settled model that is on the CPU and nobody else's: its codebook entries are renumbered."""
    assert model.grid is not None
    n, degree, grid = model.num_rows, model.max_sh_degree, model.grid
    octree, columns = plugins.position_codecs.load(parts.positions)(), plugins.entropy_models.load(parts.entropy)()
    planes = plugins.array_coders.load("byte-planes")()
    used, index = torch.unique(model.code, return_inverse=True)
    codebook = model.codebook[used].flatten(1).numpy().clip(-HALF_MAX, HALF_MAX).astype(np.float16)
    coefficients = model.plan().forward(model.attributes(torch.float64))
    detail, detail_side = model.detail.encode(coefficients[1:])
    scales, scale_side = model.scale_lattice.encode(model.log_scales)
    writer.raster["sh_degree"] = degree
    writer.static.update(
        num_gaussians=n, max_sh_degree=degree, active_sh_degree=model.active_sh_degree, depth=grid.depth,
        anchor=grid.anchor, bits=model.detail.bits, blocks=model.detail.blocks, codebook_size=len(codebook),
    )  # fmt: skip
    parts.state(writer)
    writer.add_array("box", np.array([grid.low, grid.high], np.float64))
    writer.add("positions", octree.encode(model.cells.numpy(), grid.depth))
    writer.add_array("mean", coefficients[:1].sum(0).float().numpy())
    # Blocks differ in where their zero is; about it, one table of counts fits all of them (a tenth fewer bytes).
    writer.add("detail", columns.encode(detail.numpy() - _of_rows(detail_side["zero"], len(detail)), None))
    writer.add("scales", columns.encode(scales.numpy() - _of_rows(scale_side["zero"], len(scales)), None))
    writer.add("steps", planes.encode(np.concatenate([detail_side["scale"], scale_side["scale"]], 1)))
    writer.add("zeros", columns.encode(np.concatenate([detail_side["zero"], scale_side["zero"]], 1), None))
    if degree:
        writer.add("index", columns.encode(index.numpy(), None))
        writer.add("codebook", planes.encode(codebook))
    writer.allow(_decoded_bytes(n, degree), f"a model of {n:,} Gaussians")


def _read(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    n = reader.integer("num_gaussians", low=0, high=2**31 - 1)
    degree = reader.integer("max_sh_degree", low=0, high=3)
    active = reader.integer("active_sh_degree", low=0, high=degree)
    depth = reader.integer("depth", low=1, high=morton.MAX_BITS)
    bits = reader.integer("bits", low=1, high=16)
    blocks = reader.integer("blocks", low=1, high=MAX_BLOCKS)
    size = reader.integer("codebook_size", low=0, high=1 << 16)
    anchor = reader.text("anchor", choices=get_args(Anchor))
    reader.allow(_decoded_bytes(n, degree), f"a model of {n:,} Gaussians")
    columns, planes = entropy_model(reader, plugins), plugins.array_coders.load("byte-planes")()
    low, high = reader.array("box", dtype="float64", shape=(2, 3), finite=True).tolist()
    with reader.decoding("positions") as data:
        cells = position_codec(reader, plugins, n).decode(data)
        codes = morton.encode(cells)
        if len(cells) != n or (codes[1:] == codes[:-1]).any():
            raise BitstreamError(f"holds {len(np.unique(codes)):,} voxels, header says {n:,}")
        if n and cells.max() >= 1 << depth:
            raise BitstreamError(f"a voxel leaves the grid of {depth} levels")
        with np.errstate(over="ignore", invalid="ignore"):
            means = VoxelGrid(tuple(low), tuple(high), depth, cast("Anchor", anchor)).points(cells)
    with reader.decoding("steps") as data:
        steps = planes.decode(data, np.float32, (blocks, COLUMNS))
    with reader.decoding("zeros") as data:
        zeros = decoded_matrix(columns, data, blocks, COLUMNS)
        if not 0 <= int(zeros.min()) <= int(zeros.max()) < 1 << bits:
            raise BitstreamError(f"a zero is no integer of {bits} bits")
    mean = reader.array("mean", dtype="float32", shape=(CHANNELS,), finite=True)

    def lattice(section: str, rows: int, start: int, stop: int) -> Tensor:
        with reader.decoding(section) as data:
            symbols = decoded_matrix(columns, data, rows, stop - start) + _of_rows(zeros[:, start:stop], rows)
            side = {"scale": steps[:, start:stop], "zero": zeros[:, start:stop], "bits": np.uint8(bits)}
            return FakeQuantAffine.decode(torch.from_numpy(symbols), side)

    log_scales = lattice("scales", n, CHANNELS, COLUMNS)
    detail = lattice("detail", max(n - 1, 0), 0, CHANNELS).double()
    coefficients = torch.cat([torch.from_numpy(mean).double()[None], detail])[:n]
    attributes = RahtPlan(codes).inverse(coefficients)
    rest = np.zeros((n, 0, 3), np.float32)
    if degree:
        bands = (degree + 1) ** 2 - 1
        with reader.decoding("index") as data:
            index = decoded_matrix(columns, data, n)
            if n and not 0 <= int(index.min()) <= int(index.max()) < size:
                raise BitstreamError(f"an index leaves the codebook of {size:,} entries")
        with reader.decoding("codebook") as data:
            rest = planes.decode(data, np.float16, (size, 3 * bands)).astype(np.float32)[index].reshape(n, bands, 3)
    values = {
        "means": torch.from_numpy(means), "sh_dc": attributes[:, None, 4:], "sh_rest": torch.from_numpy(rest),
        "opacity_logits": attributes[:, 0], "log_scales": log_scales,
        "quats": torch.from_numpy(exact_quats_of(attributes[:, 1:4].numpy())),
    }  # fmt: skip
    tensors = {name: values[name].float().contiguous() for name in GaussianModel.RAW}
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise BitstreamError(f"{reader.name}: decoded '{name}' is not finite: the file is damaged or hostile")
    return GaussianModel(**tensors, active_sh_degree=active)


def _of_rows(values: NDArray[Any], rows: int) -> NDArray[np.int64]:
    """Values [B,C] of each block for each of `rows`, [rows,C]."""
    found: NDArray[np.int64] = values[block_of_rows(rows, len(values), torch.device("cpu")).numpy()].astype(np.int64)
    return found


def _decoded_bytes(n: int, degree: int) -> int:
    """Of the model in float32: 236 a Gaussian at SH degree 3."""
    return 4 * n * (11 + 3 * (degree + 1) ** 2)
