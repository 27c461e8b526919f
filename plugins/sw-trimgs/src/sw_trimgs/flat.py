"""Flat Gaussians: ellipsoids with one axis of next to no length, which is their normal.

Source: Trim 3D Gaussian Splatting (arXiv 2406.07499), code of the authors.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from sw_gaussians.density.splitting import rotate
from sw_gaussians.surfels import SURFEL_THICKNESS, as_ellipsoids

from splatwizard_core.api import GaussianInputs, GaussianModel

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera, Rasterizer

NORMAL_AXIS = 0
"""Column of the rotation that is the normal; surfels of 2DGS have theirs in column 2."""


class FlatGaussians(GaussianModel):
    """Gaussians whose first scale is 1e-8 world units; the first column of the rotation is the normal.

    That scale has no gradient.

    neighbors       [N,k] int32 buffer, rows of the nearest Gaussians; empty where nobody has looked for them
    draws_surface   depth and normal of each Gaussian are composited beside the colours
    """

    neighbors: Tensor

    def __init__(self, *tensors: Tensor, active_sh_degree: int | None = None) -> None:
        super().__init__(*tensors, active_sh_degree=active_sh_degree)
        self.log_scales.data[:, NORMAL_AXIS] = math.log(SURFEL_THICKNESS)
        self.register_buffer("neighbors", torch.zeros(0, 0, dtype=torch.int32, device=self.means.device))
        self.draws_surface = False

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N,3], world units; the first is SURFEL_THICKNESS, whatever the stored logarithm."""
        free = self.log_scales[:, 1:].exp()
        return torch.cat([free.new_full((len(free), 1), SURFEL_THICKNESS), free], dim=1)

    def normals(self, center: Tensor) -> Tensor:
        """[N,3] unit normals in the world, each on the side of `center` [3]; differentiable by the quaternions."""
        axis = torch.zeros_like(self.means)
        axis[:, NORMAL_AXIS] = 1
        normals = rotate(self.quats, axis)
        away = (normals.detach() * (center - self.means.detach())).sum(dim=1, keepdim=True) < 0
        return torch.where(away, -normals, normals)

    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians; with `draws_surface` also the features [N,4] depth (camera z) and normal (world)."""
        inputs = super().gaussians(camera, rasterizer)
        if self.draws_surface:
            depth = self.means @ camera.R[2] + camera.tau[2]
            inputs.features = torch.cat([depth[:, None], self.normals(camera.center)], dim=1)
        return inputs

    @torch.no_grad()
    def settle(self) -> None:
        """Reset the first scale to SURFEL_THICKNESS and drop the neighbour cache, as for a file or the next stage."""
        self.log_scales[:, NORMAL_AXIS] = math.log(SURFEL_THICKNESS)
        self.forget_neighbors()
        self.draws_surface = False

    def forget_neighbors(self) -> None:
        """Drop the list of neighbours, as rows came or went."""
        self.neighbors = self.neighbors.new_zeros(0, 0)


@torch.no_grad()
def flattened(model: GaussianModel) -> FlatGaussians:
    """Return copies of the Gaussians whose smallest axis became the first one, without its length.

    Axes change places cyclically and the rotation goes along, so that nothing turns over; surfels, of two scales, have
    their normal in the third column, which becomes the first.
    """
    if isinstance(model, FlatGaussians):
        return model
    model = as_ellipsoids(model)
    log_scales, quats = model.log_scales.detach(), model.quats.detach()
    smallest = log_scales.argmin(dim=1)  # [N]
    order = (smallest[:, None] + torch.arange(3, device=smallest.device)) % 3
    tensors = (model.means, model.sh_dc, model.sh_rest, model.opacity_logits, log_scales.gather(1, order))
    quats = times(quats, CYCLES.to(quats)[smallest])
    return FlatGaussians(*(t.detach().clone() for t in (*tensors, quats)), active_sh_degree=model.active_sh_degree)


CYCLES = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5]])
"""Rotations (w,x,y,z) that take axis 0 to axis a = 0, 1, 2, axis 1 to a + 1 and axis 2 to a + 2."""


def times(a: Tensor, b: Tensor) -> Tensor:
    """[N,4], the product of quaternions (w,x,y,z): first the rotation b, then a."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(dim=1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=1)
