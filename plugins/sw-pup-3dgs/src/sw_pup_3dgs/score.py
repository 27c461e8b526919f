"""The score: how much the renders of the training views react to a Gaussian's mean and log scale.

theta = (x, y, z, ln s_x, ln s_y, ln s_z). For each view, pixel and colour channel, g = d image / d theta. The block
H = sum of g g^T is the Fisher information of theta (the Gauss-Newton Hessian of a squared error at a converged model);
U = log det H says how well the views pin the Gaussian down. Rotation, opacity and colour are left out, and so are the
blocks between Gaussians. No photograph is looked at. The sums are the rasterizer's (`RasterOptions.fisher`).

Source: PUP 3D-GS (arXiv 2406.10219), and the authors' code with its later fix: each channel's g is its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import torch
from pydantic import Field
from torch import Tensor

from splatwizard_core.api import ConfigError, GaussianModel, Params, RasterOptions

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer, SplatModel

RESOLUTIONS = (1, 2, 4, 8)
FLOOR = 1e-30
"""Eigenvalues below it count as it: a block seen from one side has rank 5, and rounding must not decide the order."""
AT_ONCE = 1 << 16
"""Blocks whose eigenvalues are computed together: 19 MB of float64."""


class FisherSettings(Params):
    """Settings of the pruner `pup-3dgs`."""

    resolution: Literal[1, 2, 4, 8] = Field(
        4,
        description="the score draws views at 1/resolution of their width and height; "
        "4 is for photographs of 1,000 pixels and more, 1 for small ones",
    )


class FisherScore:
    """Pruner `pup-3dgs`.

    resolution  views are drawn at 1/resolution of their width and height (rounded up), same field of view: each pixel
                of the small picture stands for a patch, as published
    """

    Settings = FisherSettings
    uses_statistics = False

    def __init__(self, resolution: int = 4) -> None:
        if resolution not in RESOLUTIONS:
            raise ConfigError(f"resolution is {resolution}, must be one of {', '.join(map(str, RESOLUTIONS))}")
        self.resolution = resolution

    @torch.no_grad()
    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """[N] float64; -inf for what no pixel of any view reacts to. A constant factor on the world shifts all alike.

        Raises TypeError for a model whose rows are not what is drawn, ValueError if a block is not finite.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'pup-3dgs' scores a GaussianModel, not a {type(model).__name__}")
        if not cameras:
            return model.means.new_full((model.num_rows,), -torch.inf, dtype=torch.float64)
        views = [reduced(camera, self.resolution).to(model.device) for camera in cameras]
        # "pass": as in the authors' kernel, alpha has a gradient also where it is clamped at 0.99.
        options = RasterOptions(background=background, fisher=True, clamp_grad="pass")
        blocks = rasterizer.accumulate(model.gaussians(views[0], rasterizer), views, options).fisher
        assert blocks is not None
        return log_determinants(blocks)


def reduced(camera: Camera, factor: int) -> Camera:
    """The view at 1/factor of its size, rounded up; the field of view stays."""
    return camera.resized(-(-camera.width // factor), -(-camera.height // factor))


def log_determinants(blocks: Tensor) -> Tensor:
    """[N] float64: sum of the logarithms of the eigenvalues, each at least FLOOR; -inf for a block of zeros.

    blocks  [N,21] upper triangles, row by row, of symmetric positive semidefinite 6x6 matrices

    Eigenvalues rather than a determinant, in double precision: they span many decades. On the CPU wherever the blocks
    are: half a second for 250,000, the same order on every machine, and the GPU's solver fails for so many.
    Raises ValueError if a value is not finite.
    """
    if not bool(torch.isfinite(blocks).all()):
        bad = int((~torch.isfinite(blocks)).any(dim=1).sum())
        raise ValueError(f"the Fisher blocks of {bad:,} Gaussians are not finite: the model has diverged")
    here = blocks.cpu()
    scores = torch.empty(len(here), dtype=torch.float64)
    for start in range(0, len(blocks), AT_ONCE):
        part = unpacked(here[start : start + AT_ONCE])
        scores[start : start + AT_ONCE] = torch.linalg.eigvalsh(part).clamp_min(FLOOR).log().sum(dim=1)
    return torch.where((here == 0).all(dim=1), -torch.inf, scores).to(blocks.device)


def unpacked(blocks: Tensor) -> Tensor:
    """[N,6,6] float64 symmetric matrices of [N,21]: (0,0), (0,1) ... (0,5), (1,1) ... (5,5)."""
    row, column = torch.triu_indices(6, 6, device=blocks.device)
    full = blocks.new_zeros(len(blocks), 6, 6, dtype=torch.float64)
    full[:, row, column] = blocks.double()
    full[:, column, row] = blocks.double()
    return full
