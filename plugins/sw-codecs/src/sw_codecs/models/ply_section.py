"""A file that holds the .ply of 3DGS as it is: what most pruning papers count as their size, 248 bytes per Gaussian.

Bit for bit what `sw export` writes and viewers read; 12 bytes per Gaussian are normals that are always zero. That of
surfels lacks a scale: 244 bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_gaussians.ply import from_ply, to_ply
from sw_gaussians.surfels import gaussians_of, state_surfels, stated_scales

from splatwizard_core.api import BitstreamError

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel


def encode(model: GaussianModel, writer: ContainerWriter) -> None:
    """Section `ply`. A .ply knows no inactive SH bands: they are written as zeros, which draws the same."""
    writer.raster["sh_degree"] = model.max_sh_degree
    writer.static["num_gaussians"] = model.num_rows
    writer.static["max_sh_degree"] = model.max_sh_degree
    state_surfels(model, writer)
    active = (model.active_sh_degree + 1) ** 2 - 1
    if active < model.sh_rest.shape[1]:
        rest = model.sh_rest.detach().clone()
        rest[:, active:] = 0
        raw = (model.means, model.sh_dc, rest, model.opacity_logits, model.log_scales, model.quats)
        model = gaussians_of(*(tensor.detach() for tensor in raw))
    writer.add("ply", to_ply(model))


def decode(reader: ContainerReader) -> GaussianModel:
    """The model, all its SH bands active. Raises BitstreamError, also for any other .ply than `encode` writes."""
    n = reader.integer("num_gaussians", low=0, high=2**32 - 1)
    rest = (reader.integer("max_sh_degree", low=0, high=3) + 1) ** 2 - 1
    scales = stated_scales(reader)
    header, row = _header(n, rest, scales), 4 * (14 + scales + 3 * rest)
    with reader.decoding("ply") as data:
        if data[: len(header)] != header:
            raise BitstreamError(f"is no .ply of {n:,} Gaussians with {rest} higher SH coefficients")
        if len(data) != len(header) + n * row:
            raise BitstreamError(f"is {len(data):,} bytes, {n:,} Gaussians take {len(header) + n * row:,}")
        return from_ply(data, f"{reader.name}: ply")


def _header(n: int, rest: int, scales: int) -> bytes:
    """The text before the rows of n Gaussians with `rest` higher SH coefficients per channel, as `to_ply` has it."""
    tails = ((3,), (1, 3), (rest, 3), (), (scales,), (4,))
    none = gaussians_of(*(torch.zeros(0, *tail) for tail in tails))
    return to_ply(none).replace(b"element vertex 0\n", f"element vertex {n}\n".encode())
