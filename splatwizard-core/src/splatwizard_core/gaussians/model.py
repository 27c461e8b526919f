"""Explicit 3D Gaussians: the model of 3DGS and of every method that prunes, quantizes or refines its Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.inputs import SH, GaussianInputs, check_shape
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.scene.camera import Camera
from splatwizard_core.streams import stream

if TYPE_CHECKING:
    from splatwizard_core.rendering.rasterizer import Rasterizer


Origin = tuple[float, float, float]
WORLD_ORIGIN = "world_origin"
"""Key of a model's `origin`, and of a file's header: where the origin of its coordinates lies in the world."""


def as_origin(value: Any) -> Origin | None:
    """Three finite numbers of a file as an origin; None for anything else."""
    numbers = isinstance(value, Sequence) and len(value) == 3 and all(type(x) in (int, float) for x in value)
    if not numbers or not all(math.isfinite(x) for x in value):
        return None
    x, y, z = value
    return (float(x), float(y), float(z))


class GaussianModel(SplatModel):
    """N Gaussians with raw (pre-activation) parameters, K = (max_sh_degree + 1)^2.

    means           [N,3] world units
    sh_dc           [N,1,3] SH band 0
    sh_rest         [N,K-1,3] SH bands 1 .. max_sh_degree
    opacity_logits  [N]; opacity = sigmoid
    log_scales      [N,3]; standard deviation in world units = exp
    quats           [N,4] (w,x,y,z), any norm; normalised where they are used
    grad_accum, denom, max_radii2d
                    [N] buffers, the statistics of adaptive density control (density.py)

    active_sh_degree    bands above it are neither drawn nor trained
    """

    NUM_SCALES: int = 3
    """Columns of `log_scales`; a subclass of flat Gaussians (surfels) has 2."""
    RAW: tuple[str, ...] = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")
    """The raw parameters of any GaussianModel, in the order of the constructor."""
    ROWS: tuple[str, ...] = (*RAW, "grad_accum", "denom", "max_radii2d")

    means: nn.Parameter
    sh_dc: nn.Parameter
    sh_rest: nn.Parameter
    opacity_logits: nn.Parameter
    log_scales: nn.Parameter
    quats: nn.Parameter
    grad_accum: Tensor
    denom: Tensor
    max_radii2d: Tensor

    def __init__(
        self,
        means: Tensor,
        sh_dc: Tensor,
        sh_rest: Tensor,
        opacity_logits: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        *,
        active_sh_degree: int | None = None,
    ) -> None:
        super().__init__()
        n = means.shape[0]
        tails: dict[str, tuple[Tensor, tuple[int | str, ...]]] = {
            "means": (means, (3,)),
            "sh_dc": (sh_dc, (1, 3)),
            "sh_rest": (sh_rest, ("K-1", 3)),
            "opacity_logits": (opacity_logits, ()),
            "log_scales": (log_scales, (self.NUM_SCALES,)),
            "quats": (quats, (4,)),
        }
        for name, (tensor, tail) in tails.items():
            check_shape(f"GaussianModel.{name}", tensor.shape, (n, *tail))
            self.register_parameter(name, nn.Parameter(tensor.detach()))
        degree = self.max_sh_degree
        if (degree + 1) ** 2 != sh_rest.shape[1] + 1 or degree > 3:
            raise ShapeError(
                f"GaussianModel.sh_rest has {sh_rest.shape[1]} coefficients per channel; 0, 3, 8 or 15 are possible"
            )
        self.active_sh_degree = degree if active_sh_degree is None else active_sh_degree
        if not 0 <= self.active_sh_degree <= degree:
            raise ShapeError(f"active SH degree {active_sh_degree} is outside 0 .. {degree}")
        for name in ("grad_accum", "denom", "max_radii2d"):
            self.register_buffer(name, torch.zeros(n, dtype=means.dtype, device=means.device))
        self.split_seed = 0
        self._splits = 0

    @classmethod
    def from_tensors(cls, *raw: Tensor, active_sh_degree: int | None = None, **named: Tensor) -> GaussianModel:
        """A model of copies of the tensors of RAW, in that order or by name. active_sh_degree None: the full degree."""
        given = {**dict(zip(cls.RAW, raw, strict=False)), **named}
        copies = {name: tensor.detach().clone().contiguous() for name, tensor in given.items()}
        return cls(**copies, active_sh_degree=active_sh_degree)

    @property
    def world_origin(self) -> Origin | None:
        """Place (x, y, z) of the origin of the coordinates in the world, as the file says; None: it does not say."""
        return as_origin(self.origin.get(WORLD_ORIGIN))

    @property
    def world_shift(self) -> Origin | None:
        """Shift (x, y, z) that an exporter adds to the coordinates, if those of the world are asked for; else None."""
        return self.world_origin if self.origin.get("as_world") else None

    @property
    def max_sh_degree(self) -> int:
        """The highest SH band that is stored; K = (max_sh_degree + 1)^2."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    @property
    def opacities(self) -> Tensor:
        """[N] in 0..1."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def scales(self) -> Tensor:
        """[N,3] (surfels: [N,2]) standard deviations, world units."""
        return torch.exp(self.log_scales)

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians, whatever the camera; colours stay in two tensors, so nothing is concatenated."""
        rest = self.sh_rest if self.max_sh_degree > 0 else None
        sh = SH(dc=self.sh_dc, rest=rest, active_degree=self.active_sh_degree)
        return GaussianInputs(self.means, self.opacities, self.scales, self.quats, sh=sh)

    def next_split_generator(self) -> torch.Generator:
        """The random stream of the next split: a function of `split_seed` and of how many splits there were.

        Lives on the CPU, so that a model splits alike on every device; its whole state is two integers of
        `state_dict_extra`, so that a resumed run draws what the uninterrupted one would have drawn.
        """
        generator = stream(self.split_seed, f"split/{self._splits}")
        self._splits += 1
        return generator

    def state_dict_extra(self) -> dict[str, Any]:
        """Active SH degree, seed and number of the splits."""
        return {"active_sh_degree": self.active_sh_degree, "split_seed": self.split_seed, "splits": self._splits}

    def load_state_dict_extra(self, extra: dict[str, Any]) -> None:
        """Inverse of `state_dict_extra`."""
        self.active_sh_degree = int(extra["active_sh_degree"])
        self.split_seed = int(extra["split_seed"])
        self._splits = int(extra["splits"])
