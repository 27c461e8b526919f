"""Arguments of one drawing, besides the tensors to differentiate by."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, GradBuffer, RasterStats

INPUTS = (
    "means", "opacities", "scales", "quats", "cov3d", "sh", "sh_dc", "sh_rest", "colors", "features", "scale_factors",
)  # fmt: skip
"""Differentiable inputs."""

FORWARD_STAGES = ("project", "sort", "bin", "blend")
BACKWARD_STAGES = ("blend_backward", "project_backward")


class Flag(enum.IntFlag):
    """Flags of one call, as in csrc/flags.h."""

    ANTIALIAS = 1
    CLAMP_COLOR = 2
    TIGHT = 4
    PASS_CLAMP = 8
    INVERSE_DEPTH = 16
    ACCUMULATED_DEPTH = 32
    MEDIAN_DEPTH = 64
    DETACH_FEATURES = 128
    ABSGRAD = 256
    ALPHA_MAP = 512
    SAVE = 1024
    COUNT = 2048
    ORIGINAL_JACOBIAN = 4096
    FLASH = 8192  # CUDA only
    TENSOR_CORES = 16384
    BYTES = 32768
    FOR_SCORES = 65536  # with SAVE: nothing that only the backward pass needs
    ORDERED = 131072
    FRAGMENTS = 262144  # with ABSGRAD: other sums in its two columns
    SURFELS = 1 << 19
    WITH_MAPS = 1 << 20  # of surfels: depth, normals and distortion


@dataclass
class Call:
    """Non-differentiable arguments of one call, and buffers for its by-products.

    camera          18 numbers: R, tau, fx, fy, cx, cy, near, far
    geom_indices    [N] int64, rows of scales and quats, none outside: the kernels do not look
    seconds         stage -> seconds, filled by both passes; on CUDA only if the call counts
    counts          visible Gaussians, (splat, tile) pairs, evaluated and blended pixel-splat pairs (-1 unless counted),
                    inputs that are not finite
    """

    camera: list[float]
    width: int
    height: int
    sh_degree: int
    scale_modifier: float
    eps2d: float
    flags: Flag
    geom_indices: Tensor | None = None
    visible: Tensor | None = None
    background: Tensor | None = None
    grad2d: GradBuffer | None = None
    absgrad2d: GradBuffer | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    counts: list[int] = field(default_factory=list)

    def repeated(self, camera: list[float]) -> Call:
        """Return the same for another camera of the same size, with buffers of its own."""
        grad2d, absgrad2d = (None if buffer is None else GradBuffer() for buffer in (self.grad2d, self.absgrad2d))
        return Call(
            camera, self.width, self.height, self.sh_degree, self.scale_modifier, self.eps2d, self.flags,
            self.geom_indices, self.visible, self.background, grad2d, absgrad2d,
        )  # fmt: skip

    def stats(self) -> RasterStats:
        """Return what the forward pass told of itself."""
        visible, pairs, evaluated, blended, invalid = self.counts
        return RasterStats(
            n_visible=visible,
            n_pairs=pairs,
            n_evaluated=evaluated if evaluated >= 0 else None,
            n_blended=blended if blended >= 0 else None,
            n_pixels=self.width * self.height,
            n_invalid=invalid,
            stage_seconds=self.seconds,
        )


def camera_numbers(cam: Camera) -> list[float]:
    """Return the camera as [18] numbers: R row by row, tau, fx, fy, cx, cy, near, far."""
    return [*cam.pose, cam.fx, cam.fy, cam.cx, cam.cy, cam.near, cam.far]


def tensors_of(g: GaussianInputs, names: Sequence[str] = INPUTS) -> dict[str, Tensor | None]:
    """Return some of the inputs by the names that the kernels have for them."""
    sh = g.sh
    found = {
        "means": g.means,
        "opacities": g.opacities,
        "scales": g.scales,
        "quats": g.quats,
        "cov3d": g.cov3d,
        "sh": None if sh is None else sh.dense,
        "sh_dc": None if sh is None else sh.dc,
        "sh_rest": None if sh is None else sh.rest,
        "colors": g.colors,
        "features": g.features,
        "scale_factors": g.scale_factors,
    }
    return found if names is INPUTS else {name: found[name] for name in names}


def as_bytes(mask: Tensor | None) -> Tensor | None:
    """Return a mask as the kernels read it: uint8, 0 or 1."""
    return None if mask is None else mask.to(torch.bool).contiguous().view(torch.uint8)
