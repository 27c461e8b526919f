"""Surface losses of 2DGS: depth distortion and normal consistency.

Source: 2D Gaussian Splatting (arXiv 2403.17888), section 5.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_core.api import Camera, LossPack, RenderResult
from sw_gaussians import cuda_face
from sw_gaussians.native import GAUSSIANS
from sw_gaussians.surface import camera_normals, depth_modes, surface_depth

NormalTerm = Literal["code", "paper"]
"""Form of the normal loss, see `normal_disagreement`."""


def maps_for(*, distortion: bool, normals: bool, depth_ratio: float) -> dict[str, Any]:
    """Return the fields of RasterOptions that request the maps these losses need.

    distortion, normals     which of the two losses has a weight
    depth_ratio             0..1, see `surface_depth`: only the depths that it blends are drawn
    """
    found: dict[str, Any] = {"distortion": True} if distortion else {}
    if normals:
        found |= {"normals": True, "alpha": True, "depth": depth_modes(depth_ratio)}
    return found


def distortion_loss(result: RenderResult) -> Tensor:
    """Return the mean depth distortion over all pixels, a scalar: penalises surfels spread along a ray.

    The map is not scale invariant (depths are compared between z = 0.2 and 100 world units), so neither is a weight.
    Raises ValueError if the distortion was not drawn.
    """
    if result.distortion is None:
        raise ValueError("the distortion loss needs RasterOptions(distortion=True)")
    return result.distortion.mean()


def normal_disagreement(result: RenderResult, camera: Camera, depth_ratio: float, term: NormalTerm = "code") -> Tensor:
    """Return [1,H,W], the disagreement of rendered normals and depth-map normals, 0 .. 2.

    n is the sum of the weighted normals of the surfels, n_surf that of the depth map, A the opacity of the pixel:

    code    1 - n . (A n_surf) without the gradient of A, as in the authors' code: 1 where nothing is shown, so that the
            loss falls as surfels cover an empty background, which costs nothing where their colour is that of it
    paper   A - n . n_surf, which is the sum of w (1 - n . n_surf) over the surfels of a ray: 0 where
            nothing is shown and wherever normals agree; A has its gradient. The border counts nothing

    depth_ratio     0..1, see `surface_depth`

    Raises ValueError if normals or opacity were not drawn, ConfigError for a depth that was not.
    """
    if result.normals is None or result.alpha is None:
        raise ValueError("the normal loss needs RasterOptions(normals=True, alpha=True) and the depths")
    depth, alpha, normals = surface_depth(result.depth, depth_ratio), result.alpha.detach(), result.normals
    if term == "paper":
        without = _disagreement(depth, normals, torch.ones_like(alpha), camera)  # 1 - n . n_surf; 1: there is no n_surf
        return torch.where(without == 1, 0.0, without - (1 - result.alpha))
    return _disagreement(depth, normals, alpha, camera)


def _disagreement(depth: Tensor, normals: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    if depth.is_cuda and depth.dtype == torch.float32 and GAUSSIANS.has_cuda():
        found: Tensor = _Disagreement.apply(depth, normals, alpha, camera)  # type: ignore[no-untyped-call]
        return found
    return disagreement_in_torch(depth, normals, alpha, camera)


def disagreement_in_torch(depth: Tensor, normals: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Return what `normal_disagreement` does of a depth [1,H,W], normals [3,H,W] of the camera's frame and alpha.

    An angle is the same in any frame: nothing is turned to the world's.
    """
    agreement = (normals * camera_normals(depth, camera) * alpha).sum(dim=0, keepdim=True)
    disagreement: Tensor = torch.ones_like(agreement) - agreement
    return disagreement


def add_surface_losses(
    loss: LossPack,
    result: RenderResult,
    camera: Camera,
    depth_ratio: float,
    *,
    distortion: float = 0.0,
    normals: float = 0.0,
    term: NormalTerm = "code",
    mask: Tensor | None = None,
) -> LossPack:
    """Return `loss` plus the weighted surface losses; `parts` gets the unweighted values.

    distortion, normals     weights; a loss of weight 0 is neither computed nor named
    term                    form of the normal loss
    mask                    [1,H,W] 0..1, factor of the normal loss of each pixel; None: all count. The mean is over all
    """
    total, terms = loss.total, {}
    if distortion > 0:
        terms["distortion"] = distortion_loss(result)
        total = total + distortion * terms["distortion"]
    if normals > 0:
        found = normal_disagreement(result, camera, depth_ratio, term)
        terms["normals"] = (found if mask is None else mask * found).mean()
        total = total + normals * terms["normals"]
    return LossPack(total, {name: part.detach() for name, part in {**loss.parts, **terms}.items()})


def disagreement_on_gpu(depth: Tensor, normals: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Return what `disagreement_in_torch` does, unknown to autograd; all contiguous."""
    found = torch.empty_like(depth)
    cuda_face.disagreement(depth=depth, normals=normals, alpha=alpha, found=found, **_lens(camera))
    return found


def disagreement_slopes(
    grad: Tensor, depth: Tensor, normals: Tensor, alpha: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Return the gradients of depth and normals from that of `disagreement_on_gpu`; all contiguous."""
    to_depth, to_normals = torch.empty_like(depth), torch.empty_like(normals)
    cuda_face.disagreement_backward(
        grad=grad, depth=depth, normals=normals, alpha=alpha, to_depth=to_depth, to_normals=to_normals, **_lens(camera)
    )
    return to_depth, to_normals


def _lens(camera: Camera) -> dict[str, float]:
    return {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}


class _Disagreement(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, depth: Tensor, normals: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
        given = depth.contiguous(), normals.contiguous(), alpha.contiguous()
        ctx.save_for_backward(*given)
        ctx.camera = camera
        return disagreement_on_gpu(*given, camera)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return *disagreement_slopes(grad.contiguous(), *ctx.saved_tensors, ctx.camera), None, None
