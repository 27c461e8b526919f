"""A file of float32 as trained, packed without loss (`zstd-f32`): every bit comes back, in another order of Gaussians.

Rows follow the Morton curve through 2^21 cells an axis, so that successive Gaussians are neighbours. Positions are
stored as steps from row to row, and the bytes of equal weight of each column lie together for zstd at level 19.
The low mantissa bits of trained values are noise and stay so: the demo scene shrinks from 236 to 193 bytes a Gaussian.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import GaussianModel
from sw_codecs.positions.ordering import spatial_order

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager

TAILS = {"sh_dc": (1, 3), "opacity_logits": (), "log_scales": (3,), "quats": (4,)}
"""Shape of one row of what is stored as byte planes, but for sh_rest [K-1,3]; means [3] are stored as steps."""


def encode(model: GaussianModel, writer: ContainerWriter, plugins: PluginManager) -> None:
    """Sections means (`float-delta`), sh_dc, opacity_logits, log_scales, quats, sh_rest (`byte-planes`)."""
    writer.raster["sh_degree"] = model.max_sh_degree
    writer.static["num_gaussians"] = model.num_rows
    writer.static["max_sh_degree"] = model.max_sh_degree
    writer.static["active_sh_degree"] = model.active_sh_degree
    steps, planes = plugins.array_coders.load("float-delta")(), plugins.array_coders.load("byte-planes")()
    means = _float32(model, "means")
    order = spatial_order(np.nan_to_num(means, nan=0.0, posinf=0.0, neginf=0.0))  # for the order alone
    writer.add("means", steps.encode(means[order]))
    for name in (*TAILS, "sh_rest"):
        writer.add(name, planes.encode(_float32(model, name)[order]))
    writer.allow(_bytes(model.num_rows, model.sh_rest.shape[1]), f"a model of {model.num_rows:,} Gaussians")


def decode(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    """The model in the order of the file. Raises BitstreamError."""
    n = reader.integer("num_gaussians", low=0, high=2**32 - 1)
    degree = reader.integer("max_sh_degree", low=0, high=3)
    active = reader.integer("active_sh_degree", low=0, high=degree)
    rest = (degree + 1) ** 2 - 1
    reader.allow(_bytes(n, rest), f"a model of {n:,} Gaussians")
    steps, planes = plugins.array_coders.load("float-delta")(), plugins.array_coders.load("byte-planes")()
    with reader.decoding("means") as data:
        tensors = {"means": torch.from_numpy(steps.decode(data, np.float32, (n, 3)))}
    for name, tail in {**TAILS, "sh_rest": (rest, 3)}.items():
        with reader.decoding(name) as data:
            tensors[name] = torch.from_numpy(planes.decode(data, np.float32, (n, *tail)))
    return GaussianModel(**tensors, active_sh_degree=active)


def _float32(model: GaussianModel, name: str) -> NDArray[Any]:
    array: NDArray[Any] = getattr(model, name).detach().cpu().float().numpy()
    return array


def _bytes(n: int, rest: int) -> int:
    return 4 * n * (14 + 3 * rest)
