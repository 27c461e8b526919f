"""The file in mode `exact`: all six tensors as float32, bit for bit.

236 bytes per Gaussian at SH degree 3, 232 per surfel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_gaussians.surfels import gaussians_of, state_surfels, stated_scales

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel

TAILS = {"means": (3,), "sh_dc": (1, 3), "opacity_logits": (), "log_scales": (3,), "quats": (4,)}
"""Shape of one row of each tensor, but for sh_rest [K-1,3]; the log scales of surfels are two."""


def encode(model: GaussianModel, writer: ContainerWriter) -> None:
    """One section a tensor."""
    writer.raster["sh_degree"] = model.max_sh_degree
    writer.static["num_gaussians"] = model.num_rows
    writer.static["max_sh_degree"] = model.max_sh_degree
    writer.static["active_sh_degree"] = model.active_sh_degree
    state_surfels(model, writer)
    for name in (*TAILS, "sh_rest"):
        writer.add_array(name, getattr(model, name).detach().cpu().float().numpy())


def decode(reader: ContainerReader) -> GaussianModel:
    """The inverse of `encode`. Raises BitstreamError."""
    n = reader.integer("num_gaussians", low=0, high=2**32 - 1)
    degree = reader.integer("max_sh_degree", low=0, high=3)
    active = reader.integer("active_sh_degree", low=0, high=degree)
    rest = (degree + 1) ** 2 - 1
    shapes = {name: (n, *tail) for name, tail in TAILS.items()} | {"sh_rest": (n, rest, 3)}
    shapes["log_scales"] = (n, stated_scales(reader))
    tensors = {
        name: torch.from_numpy(reader.array(name, dtype="float32", shape=shape)) for name, shape in shapes.items()
    }
    return gaussians_of(**tensors, active_sh_degree=active)
