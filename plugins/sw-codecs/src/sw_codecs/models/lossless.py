"""A file of float32 as trained, packed without loss (`zstd-f32`): every bit comes back, in another order of Gaussians.

Rows follow the Morton curve through 2^21 cells an axis, so that successive Gaussians are neighbours. Positions are
stored as steps from row to row, and the bytes of equal weight of each column lie together for zstd at level 19.
The low mantissa bits of trained values are noise and stay so: the demo scene shrinks from 236 to 193 bytes per
Gaussian.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from sw_gaussians.surfels import gaussians_of, state_surfels, stated_scales

from sw_codecs.models.exchangeable import NamedParts, array_coder, codes_arrays, hold_part
from sw_codecs.positions.ordering import spatial_order

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel, PluginManager

PLANES = ("sh_dc", "opacity_logits", "log_scales", "quats", "sh_rest")
"""Parameters that are stored as byte planes; means are stored as steps."""


class LosslessSettings(NamedParts):
    """Settings of `gaussians-zstd`."""

    USUAL: ClassVar[dict[str, str]] = {"means": "float-delta", "arrays": "byte-planes"}

    means: str = Field("float-delta", description="coder of the positions: any that codes arrays of float32")
    arrays: str = Field("byte-planes", description="coder of all else: any that codes arrays of float32")

    def check(self, plugins: PluginManager) -> None:
        """Raise ConfigError for a part that is not installed, or does not do what the codec needs of it."""
        for part, name in self.named().items():
            hold_part(plugins.array_coders, name, f"codec.settings.{part}", partial(codes_arrays, dtypes=[np.float32]))


def encode(model: GaussianModel, writer: ContainerWriter, plugins: PluginManager, parts: LosslessSettings) -> None:
    """Sections means (`float-delta`), sh_dc, opacity_logits, log_scales, quats, sh_rest (`byte-planes`), as usual."""
    writer.raster["sh_degree"] = model.max_sh_degree
    writer.static["num_gaussians"] = model.num_rows
    writer.static["max_sh_degree"] = model.max_sh_degree
    writer.static["active_sh_degree"] = model.active_sh_degree
    state_surfels(model, writer)
    parts.state(writer)
    steps, planes = plugins.array_coders.load(parts.means)(), plugins.array_coders.load(parts.arrays)()
    means = _float32(model, "means")
    order = spatial_order(np.nan_to_num(means, nan=0.0, posinf=0.0, neginf=0.0))  # for the order alone
    writer.add("means", steps.encode(means[order]))
    for name in PLANES:
        writer.add(name, planes.encode(_float32(model, name)[order]))
    writer.allow(
        _bytes(model.num_rows, model.sh_rest.shape[1], model.NUM_SCALES), f"a model of {model.num_rows:,} Gaussians"
    )


def decode(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    """The model in the order of the file. Raises BitstreamError."""
    n = reader.integer("num_gaussians", low=0, high=2**32 - 1)
    degree = reader.integer("max_sh_degree", low=0, high=3)
    active = reader.integer("active_sh_degree", low=0, high=degree)
    rest, scales = (degree + 1) ** 2 - 1, stated_scales(reader)
    reader.allow(_bytes(n, rest, scales), f"a model of {n:,} Gaussians")
    steps, planes = (array_coder(reader, plugins, *part) for part in LosslessSettings.USUAL.items())
    with reader.decoding("means") as data:
        tensors = {"means": _tensor(steps.decode(data, np.float32, (n, 3)))}
    tails: dict[str, tuple[int, ...]] = {
        "sh_dc": (1, 3), "opacity_logits": (), "log_scales": (scales,), "quats": (4,), "sh_rest": (rest, 3),
    }  # fmt: skip
    for name in PLANES:
        with reader.decoding(name) as data:
            tensors[name] = _tensor(planes.decode(data, np.float32, (n, *tails[name])))
    return gaussians_of(**tensors, active_sh_degree=active)


def _float32(model: GaussianModel, name: str) -> NDArray[Any]:
    array: NDArray[Any] = getattr(model, name).detach().cpu().float().numpy()
    return array


def _tensor(array: NDArray[Any]) -> torch.Tensor:
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))  # a stranger's coder may give neither


def _bytes(n: int, rest: int, scales: int) -> int:
    return 4 * n * (11 + scales + 3 * rest)
