"""Losses that draw surfels together into one surface: distortion, and normals that agree with the depth map.

Source: 2D Gaussian Splatting (arXiv 2403.17888), section 5.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from splatwizard_core.api import Camera, LossPack, RenderResult
from sw_gaussians.surface import depth_modes, depth_normals, surface_depth, world_normals

NormalTerm = Literal["code", "paper"]
"""Form of the normal loss, see `normal_disagreement`."""


def identity_before_terms(content: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration's identity without `surface.normal_term` where that is the code's.

    Runs and trained scenes of before the key existed stay what they are.
    """
    if content["surface"]["normal_term"] == "code":
        del content["surface"]["normal_term"]
    return content


def maps_for(*, distortion: bool, normals: bool, depth_ratio: float) -> dict[str, Any]:
    """Return the fields of RasterOptions whose maps the losses of this module read.

    distortion, normals     which of the two losses has a weight
    depth_ratio             0..1, see `surface_depth`: only the depths that it blends are drawn
    """
    found: dict[str, Any] = {"distortion": True} if distortion else {}
    if normals:
        found |= {"normals": True, "alpha": True, "depth": depth_modes(depth_ratio)}
    return found


def distortion_loss(result: RenderResult) -> Tensor:
    """Return the mean over all pixels of the distortion: pairs of surfels on a ray should be near or faint; scalar.

    The map is not scale invariant (depths are compared between z = 0.2 and 100 world units), so neither is a weight.
    Raises ValueError if the distortion was not drawn.
    """
    if result.distortion is None:
        raise ValueError("the distortion loss needs RasterOptions(distortion=True)")
    return result.distortion.mean()


def normal_disagreement(result: RenderResult, camera: Camera, depth_ratio: float, term: NormalTerm = "code") -> Tensor:
    """Return [1,H,W], how far drawn normals are from those of the depth map, 0 .. 2.

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
    surface = depth_normals(surface_depth(result.depth, depth_ratio), camera)
    drawn = world_normals(result.normals, camera)
    if term == "paper":
        known = (surface.detach().square().sum(dim=0, keepdim=True) > 0).to(surface)
        return known * (result.alpha - (drawn * surface).sum(dim=0, keepdim=True))
    agreement = (drawn * (surface * result.alpha.detach())).sum(dim=0, keepdim=True)
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
    """Return `loss` with the weighted losses of the surface, which stand unweighted among its parts.

    distortion, normals     weights; a loss of weight 0 is neither computed nor named
    term                    form of the normal loss
    mask                    [1,H,W] 0..1, factor of the normal loss of each pixel; None: all count. The mean is over all
    """
    total, terms = loss.total, {}
    if distortion > 0:
        terms["distortion"] = distortion_loss(result)
        total = total + distortion * terms["distortion"]
    if normals > 0:
        found = normal_disagreement(result, camera.to(result.image.device), depth_ratio, term)
        terms["normals"] = (found if mask is None else mask * found).mean()
        total = total + normals * terms["normals"]
    return LossPack(total, {name: part.detach() for name, part in {**loss.parts, **terms}.items()})
