"""Normals of depth maps and of Gaussians, and how far they disagree: the regularisation of Trim3DGS.

Source: Trim 3D Gaussian Splatting (arXiv 2406.07499), section on normal regularisation, and the authors' code.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.nn import functional

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera

SOBEL = ((-1.0, 0.0, 1.0), (-2.0, 0.0, 2.0), (-1.0, 0.0, 1.0))
"""Derivative along x, to be divided by 3; its transpose is that along y."""
SHORTEST = 1e-12
"""Length below which a vector has no direction; what the points of an empty background make."""


def world_points(depth: Tensor, camera: Camera) -> Tensor:
    """[3,H,W] world points at `depth` [1,H,W] (camera z) behind the pixel centres; differentiable."""
    height, width = depth.shape[-2:]
    x = (torch.arange(width, device=depth.device, dtype=depth.dtype) + 0.5 - camera.cx) / camera.fx  # [W]
    y = (torch.arange(height, device=depth.device, dtype=depth.dtype) + 0.5 - camera.cy) / camera.fy  # [H]
    rays = torch.stack([x.expand(height, width), y[:, None].expand(height, width), torch.ones_like(depth[0])])
    # R^T (P - tau), with the axes of R as rows.
    return torch.einsum("ki,khw->ihw", camera.R, depth * rays - camera.tau[:, None, None])


def normals_of_depth(depth: Tensor, camera: Camera, reach: int) -> Tensor:
    """[3,H,W] unit normals of the surface at `depth` [1,H,W], world frame, on the side of the camera; differentiable.

    reach   d >= 1, pixels: central differences over 2 d pixels, along the axes and along the diagonals; beyond the
            image the border's points are repeated

    0 where the points that are compared coincide.
    """
    points = world_points(depth, camera)
    height, width = depth.shape[-2:]
    padded = functional.pad(points[None], (reach,) * 4, mode="replicate")[0]

    def at(down: int, right: int) -> Tensor:
        top, left = reach * (1 + down), reach * (1 + right)
        return padded[:, top : top + height, left : left + width]

    diagonal = torch.linalg.cross(at(1, 1) - at(-1, -1), at(-1, 1) - at(1, -1), dim=0)
    straight = torch.linalg.cross(at(0, 1) - at(0, -1), at(-1, 0) - at(1, 0), dim=0)
    normals = unit(unit(diagonal) + unit(straight))
    away = (normals.detach() * (camera.center[:, None, None] - points.detach())).sum(dim=0, keepdim=True) < 0
    return torch.where(away, -normals, normals)


def unit(vectors: Tensor) -> Tensor:
    """`vectors` [3,...] divided by their lengths; 0, without a gradient, where the length is below SHORTEST."""
    length = vectors.norm(dim=0, keepdim=True)
    long = length > SHORTEST
    return torch.where(long, vectors / torch.where(long, length, 1), 0)


@torch.no_grad()
def smooth_pixels(depth: Tensor, threshold: float, erosion: int) -> Tensor:
    """[1,H,W], 1 where `depth` [1,H,W] has no edge near by and 0 elsewhere.

    threshold   of the length of the depth's derivative by x and y (Sobel over 3), world units a pixel; 0 or less: all 1
    erosion     k >= 0, pixels: an edge within k rows and columns counts
    """
    if threshold <= 0:
        return torch.ones_like(depth)
    along_x = depth.new_tensor(SOBEL) / 3
    kernels = torch.stack([along_x, along_x.T])[:, None]  # [2,1,3,3]
    slopes = functional.conv2d(functional.pad(depth[None], (1, 1, 1, 1), mode="replicate"), kernels)
    edges = (slopes.square().sum(dim=1).sqrt() >= threshold).to(depth)  # [1,H,W]
    return 1 - functional.max_pool2d(edges[None], 2 * erosion + 1, stride=1, padding=erosion)[0]


def normal_difference(drawn: Tensor, depth: Tensor, camera: Camera, mask: Tensor, reach: int) -> Tensor:
    """Scalar, how far the drawn normals are from those of the depth map, 0..1: the mean of |n - n'| / 2 under a mask.

    drawn   [3,H,W] composited normals, world frame, any length
    depth   [1,H,W] composited camera z, not divided by the coverage
    mask    [1,H,W] 0..1; the mean is over all pixels and the three components
    """
    return (mask * (unit(drawn) - normals_of_depth(depth, camera, reach)).abs()).mean() / 2


def roughness(normals: Tensor, neighbors: Tensor, chosen: Tensor) -> Tensor:
    """Scalar, how far normals are from the mean of their neighbours': the mean of |n - n'| / 2 over `chosen`.

    normals     [N,3] unit; a neighbour's is turned to the side of the Gaussian's own
    neighbors   [N,k] rows, the Gaussian itself among them
    chosen      [N] bool; none: 0
    """
    rows = chosen.nonzero().squeeze(1)  # [M]
    if rows.numel() == 0:
        return normals.sum() * 0
    own = normals[rows]  # [M,3]
    around = normals[neighbors[rows].long()]  # [M,k,3]
    side = torch.where((around.detach() * own.detach()[:, None]).sum(dim=2, keepdim=True) < 0, -1.0, 1.0)
    mean = functional.normalize((side * around).sum(dim=1), dim=1, eps=1e-12)
    return (own - mean).abs().mean() / 2


@torch.no_grad()
def near_surface(means: Tensor, depth: Tensor, camera: Camera, distance: float) -> Tensor:
    """[N] bool: in front of the camera, inside the image, and no further than `distance` from the depth map there.

    means       [N,3] world units
    depth       [1,H,W] camera z, read between pixel centres by bilinear interpolation
    distance    along z, world units
    """
    x, y, z = (means @ camera.R.T + camera.tau).unbind(dim=1)
    safe = torch.where(z > 0, z, 1)
    u = (camera.fx * x / safe + camera.cx) * (2 / camera.width) - 1
    v = (camera.fy * y / safe + camera.cy) * (2 / camera.height) - 1
    inside = (z > 0) & (u.abs() <= 1) & (v.abs() <= 1)
    grid = torch.stack([u, v], dim=1)[None, None]  # [1,1,N,2]
    surface = functional.grid_sample(depth[None], grid, align_corners=False, padding_mode="border")[0, 0, 0]
    return inside & ((z - surface).abs() < distance)
