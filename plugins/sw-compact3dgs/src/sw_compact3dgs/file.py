"""The file of Compact3DGS, rows along a Morton curve (docs/methods/compact3dgs.md):

    positions       float16 [N,3]; with post-processing `byte-planes`, else an array
    opacities       float16 array [N]; with post-processing f32 low, f32 step, then 8-bit indices
    scales/...      parts of the vector coder `residual-vq`: N scales of 3 numbers, linear
    rotations/...   the same of N quaternions
    grid            float16 array; with post-processing f32 scale, i32 zero, then 8-bit indices
    network         float16 array: the weights of the three layers

8-bit indices are coded by `categorical` with the entropy coder that the header names.
"""

from __future__ import annotations

import copy
import logging
import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatwizard_core.api import BitstreamError, SplatwizardError
from sw_codecs.positions.ordering import spatial_order
from sw_compact3dgs.colors import ColorField
from sw_compact3dgs.decoded import DecodedGaussians
from sw_compact3dgs.model import QUANTIZED, SMALLEST_SCALE, CompactGaussians

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager
    from sw_compact3dgs.config import FileSettings

log = logging.getLogger(__name__)

FORMS = ("plain", "post-processed")
HALF_MAX = 65504.0
FIT_ITERATIONS = 10
MAX_GAUSSIANS = (1 << 32) - 1
OPACITY = struct.Struct("<ff")
GRID = struct.Struct("<fi")
SHAPES = {"scales": 3, "rotations": 4}
"""Section prefix -> numbers of a vector."""


def encode(model: CompactGaussians, writer: ContainerWriter, plugins: PluginManager, settings: FileSettings) -> None:
    """Write all sections; the model stays as it is.

    Raises SplatwizardError for values that are not finite and for a model whose masks are all off.
    """
    model = _for_file(model)
    grid = model.color.grid
    n, form = model.num_rows, FORMS[settings.pp]
    writer.raster["sh_degree"] = 0
    writer.static.update(
        num_gaussians=n,
        form=form,
        coder=settings.coder,
        grid_levels=len(grid.levels),
        grid_features=grid.features,
        grid_coarsest=grid.levels[0].resolution,
        grid_growth=model.color.growth,
        grid_log2=grid.log2_size,
        hidden=model.color.hidden,
    )
    means, opacities = model.means.numpy(), model.opacities.numpy()
    table = grid.table.detach()
    if settings.pp:
        writer.add("positions", plugins.array_coders.load("byte-planes")().encode(means.astype(np.float16)))
        writer.add("opacities", _encode_opacities(opacities, plugins, settings.coder))
        writer.add("grid", _encode_grid(table, _levels(model.color), plugins, settings))
    else:
        writer.add_array("positions", means.astype(np.float16))
        writer.add_array("opacities", opacities.astype(np.float16))
        writer.add_array("grid", _halves(table.numpy(), "the colour grid").reshape(-1))
    weights = np.concatenate([weight.detach().numpy().reshape(-1) for weight in model.color.weights])
    writer.add_array("network", _halves(weights, "the colour network"))
    for prefix, values, quantizer in (
        ("scales", model.scales, model.scale_vq), ("rotations", model.unit_quats(), model.quat_vq),
    ):  # fmt: skip
        coder = plugins.vector_coders.load("residual-vq")(
            plugins, size=quantizer.size, stages=quantizer.stages, codebooks=quantizer.codebooks,
            coder=settings.coder if settings.pp else "packed-bits",
        )  # fmt: skip
        for part, data in coder.encode(values.numpy(), np.ones(n)).items():
            writer.add(f"{prefix}/{part}", data)
    writer.allow(_decoded_bytes(n, table.numel(), grid.width), f"a model of {n:,} Gaussians")


@torch.no_grad()
def _for_file(model: CompactGaussians) -> CompactGaussians:
    """A copy on the CPU: masked Gaussians are gone, positions are float16, rows in their order, codebooks are there."""
    model = copy.deepcopy(model).to("cpu").eval().requires_grad_(False)
    bad = model.check_finite()
    if bad:
        raise SplatwizardError(f"{bad:,} Gaussians hold values that are not finite: they cannot be encoded")
    kept = torch.nonzero(model.rate.exact(model.mask_logits)).squeeze(1)
    if not len(kept):
        raise SplatwizardError("the mask turned all Gaussians off: lower mask.weight or mask.factor")
    halves = model.means[kept].clamp(-HALF_MAX, HALF_MAX).half().float()
    rows = kept[spatial_order(halves)]
    for name in model.ROWS:
        setattr(model, name, _like(getattr(model, name), getattr(model, name)[rows]))
    model.means.copy_(model.means.clamp(-HALF_MAX, HALF_MAX).half())
    if model.phase != QUANTIZED:
        log.warning("the model was never trained with its codebooks: they are fitted now, and its file will be inexact")
        model.fit_codebooks(FIT_ITERATIONS)
    return model


def _like(old: Tensor, new: Tensor) -> Tensor:
    return torch.nn.Parameter(new, requires_grad=False) if isinstance(old, torch.nn.Parameter) else new


def _halves(values: NDArray[Any], what: str) -> NDArray[np.float16]:
    with np.errstate(over="ignore"):
        found = values.astype(np.float16)
    if not np.isfinite(found).all():
        raise SplatwizardError(f"{what} holds values that are not finite in float16: it cannot be encoded")
    return found


def _levels(color: ColorField) -> NDArray[np.uint8]:
    """The level of each number of the grid: its table of counts."""
    sizes = [level.size * color.grid.features for level in color.grid.levels]
    return np.repeat(np.arange(len(sizes), dtype=np.uint8), sizes)


def _bytes_model(plugins: PluginManager, coder: str) -> Any:
    return plugins.entropy_models.load("categorical")(plugins.entropy_coders.load(coder)())


def _encode_opacities(opacities: NDArray[Any], plugins: PluginManager, coder: str) -> bytes:
    symbols, side = plugins.quantizers.load("uniform")(8).encode(torch.from_numpy(opacities))
    model = _bytes_model(plugins, coder)
    coded: bytes = model.encode(symbols.numpy(), model.Context(256, n=len(opacities)))
    return OPACITY.pack(float(side["low"][0]), float(side["step"][0])) + coded


def _encode_grid(table: Tensor, levels: NDArray[np.uint8], plugins: PluginManager, settings: FileSettings) -> bytes:
    """Small values become zero, which is a point of the lattice; its ends are those of all values.

    Long steps round more values to few points: for equal bytes the colours change several times less than by zeros.
    """
    quantizer: Any = plugins.quantizers.load("fake-quant")(8)
    values = table.reshape(-1)
    if not bool(torch.isfinite(values).all()):
        raise SplatwizardError("the colour grid holds values that are not finite: it cannot be encoded")
    quantizer.observe(values)
    low, step = values.amin().clamp_max(0), settings.grid_step * settings.grid_factor
    quantizer.observe(torch.stack([low, low + 255 * step]))  # a wider range has longer steps
    largest_zero = settings.grid_threshold * settings.grid_factor
    symbols, side = quantizer.encode(torch.where(values.abs() <= largest_zero, 0.0, values))
    model = _bytes_model(plugins, settings.coder)
    context = model.Context(256, index=levels, tables=int(levels[-1]) + 1)
    coded: bytes = model.encode(symbols.numpy(), context)
    return GRID.pack(float(side["scale"][0, 0]), int(side["zero"][0, 0])) + coded


def decode(reader: ContainerReader, plugins: PluginManager) -> DecodedGaussians:
    """The model of a file. Raises BitstreamError."""
    n = reader.integer("num_gaussians", low=1, high=MAX_GAUSSIANS)
    processed = reader.text("form", choices=FORMS) == FORMS[1]
    coder = reader.text("coder", choices=plugins.entropy_coders.names)
    color = _empty_field(reader, n)
    if processed:
        with reader.decoding("positions") as data:
            halves = plugins.array_coders.load("byte-planes")().decode(data, np.float16, (n, 3))
            if not np.isfinite(halves).all():
                raise BitstreamError("holds values that are not finite")
        with reader.decoding("opacities") as data:
            opacities = _decode_opacities(data, n, plugins, coder)
    else:
        halves = reader.array("positions", dtype="float16", shape=(n, 3), finite=True)
        opacities = _floats(reader.array("opacities", dtype="float16", shape=(n,), finite=True))
    sizes = [weight.numel() for weight in color.weights]
    weights = _floats(reader.array("network", dtype="float16", shape=(sum(sizes),), finite=True))
    for weight, part in zip(color.weights, torch.split(weights, sizes), strict=True):
        weight.data.copy_(part.view_as(weight))
    scales, quats = (_vectors(reader, plugins, prefix, n, width) for prefix, width in SHAPES.items())
    # Last, since it is the largest: a file that is damaged elsewhere was refused before.
    if processed:
        with reader.decoding("grid") as data:
            table = _decode_grid(data, _levels(color), plugins, coder)
    else:
        table = _floats(reader.array("grid", dtype="float16", shape=(color.grid.table.numel(),), finite=True))
    color.grid.table.data = table.view_as(color.grid.table)
    return DecodedGaussians(
        _floats(halves), opacities.clamp(0, 1), scales.clamp_min(SMALLEST_SCALE), quats, color=color
    )  # fmt: skip


def _empty_field(reader: ContainerReader, n: int) -> ColorField:
    """The colour field that the header describes, all zero; its size is held against that of the file first."""
    shape: dict[str, Any] = {
        "levels": reader.integer("grid_levels", low=1, high=32),
        "features": reader.integer("grid_features", low=1, high=8),
        "coarsest": reader.integer("grid_coarsest", low=2, high=1024),
        "growth": reader.number("grid_growth", low=1, high=4),
        "log2_size": reader.integer("grid_log2", low=3, high=24),
    }
    hidden = reader.integer("hidden", low=1, high=256)
    try:
        numbers = ColorField.numbers(**shape)
    except ValueError as error:
        raise BitstreamError(f"{reader.name}: {error}", section="header") from error
    width = shape["levels"] * shape["features"]
    reader.allow(_decoded_bytes(n, numbers, width), f"{n:,} Gaussians and a grid of {numbers:,} numbers")
    return ColorField(**shape, hidden=hidden, generator=None)


def _decoded_bytes(n: int, numbers: int, width: int) -> int:
    """Bytes of the decoded model with the features of each Gaussian, and of its grid."""
    return 4 * (n * (3 + 1 + 3 + 4 + width) + numbers)


def _floats(halves: NDArray[Any]) -> Tensor:
    return torch.from_numpy(halves.astype(np.float32))


def _decode_opacities(data: bytes, n: int, plugins: PluginManager, coder: str) -> Tensor:
    if len(data) < OPACITY.size:
        raise BitstreamError(f"is {len(data)} bytes, too few for its range")
    low, step = (np.array([value], np.float32) for value in OPACITY.unpack(data[: OPACITY.size]))
    lattice = plugins.quantizers.load("uniform")(8).decode(
        torch.arange(256), {"low": low, "step": step, "bits": np.array([8], np.uint8)}
    )
    model = _bytes_model(plugins, coder)
    return torch.from_numpy(lattice.numpy()[model.decode(data[OPACITY.size :], model.Context(256, n=n))])


def _decode_grid(data: bytes, levels: NDArray[np.uint8], plugins: PluginManager, coder: str) -> Tensor:
    if len(data) < GRID.size:
        raise BitstreamError(f"is {len(data)} bytes, too few for its scale")
    scale, zero = GRID.unpack(data[: GRID.size])
    # The 256 points of the lattice, looked up: millions of multiplications less.
    lattice = plugins.quantizers.load("fake-quant")(8).decode(
        torch.arange(256),
        {"scale": np.array([[scale]], np.float32), "zero": np.array([[zero]], np.int32), "bits": np.uint8(8)},
    )
    model = _bytes_model(plugins, coder)
    context = model.Context(256, index=levels, tables=int(levels[-1]) + 1)
    return torch.from_numpy(lattice.numpy()[model.decode(data[GRID.size :], context)])


def _vectors(reader: ContainerReader, plugins: PluginManager, prefix: str, n: int, width: int) -> Tensor:
    parts = {part: reader.section(f"{prefix}/{part}") for part in ("header", "codebooks", "indices")}
    with reader.decoding(f"{prefix}/indices"):
        found = plugins.vector_coders.load("residual-vq")(plugins).decode(parts, n, width)
    return torch.from_numpy(found)
