"""gsplat's `rasterization` as a rasterizer of ours: inputs, conventions and statistics are translated, no more.

Where its pictures differ from the other rasterizers' (version 1.5): alpha is clamped at 0.999 instead of 0.99, a pixel
stops at T <= 1e-4 instead of < 1e-4. Its gradients stop at the clamp of alpha, as ours do.
Source: gsplat (arXiv 2409.06765), its public documentation.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import (
    AccumOutput,
    Camera,
    CapabilityError,
    ConfigError,
    Feature,
    GaussianInputs,
    GradBuffer,
    RasterizerInfo,
    RasterOptions,
    RenderResult,
)
from sw_gsplat import plugin


class GsplatRasterizer:
    """Standard 3DGS through gsplat, float32 on CUDA. The first use compiles gsplat's kernels (minutes)."""

    info: RasterizerInfo = RasterizerInfo.declared(plugin.register_rasterizers, "gsplat")

    def __init__(self) -> None:
        try:
            from gsplat import rasterization
        except ImportError as error:
            raise CapabilityError(
                f"rasterizer 'gsplat' needs the package gsplat ({error}): pip install 'sw-gsplat[gsplat]'"
            ) from error
        self._rasterization = rasterization

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view; see the protocol. Raises CapabilityError, ConfigError or ShapeError."""
        self.info.check_request(g, opt)
        if opt.clamp_grad != "exact":
            raise ConfigError("rasterizer 'gsplat' stops gradients at the clamp of alpha: clamp_grad cannot be 'pass'")
        drawn, alphas, meta = self._rasterization(
            **self._gaussians(g, opt), **_camera(cam, g.means), packed=False, eps2d=opt.eps2d, absgrad=opt.absgrad,
            rasterize_mode="antialiased" if opt.antialias else "classic",
            render_mode="RGB+D" if opt.depth else "RGB",
        )  # fmt: skip
        drawn, alpha = drawn[0].permute(2, 0, 1), alphas[0].permute(2, 0, 1)
        channels = 3 if g.colors is None else g.colors.shape[1]
        image = drawn[:channels]
        background = opt.background_of(channels, cam, g.means)
        if background is not None:
            image = image + (1 - alpha) * background.reshape(channels, *(background.shape[1:] or (1, 1)))
        depth = {}
        if "accumulated" in opt.depth:
            depth["accumulated"] = drawn[channels:]
        if "expected" in opt.depth:
            depth["expected"] = drawn[channels:] / alpha.clamp(min=1e-10)
        grad2d, absgrad2d = _watch(meta["means2d"], cam, opt)
        return RenderResult(
            image=image,
            radii=_classic_radii(meta["radii"][0], meta["conics"][0]),
            inputs=g,
            alpha=alpha if opt.alpha else None,
            depth=depth,
            grad2d=grad2d,
            absgrad2d=absgrad2d,
        )

    @torch.no_grad()
    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Not declared: gsplat has no pass that looks at geometry alone. Raises CapabilityError."""
        self.info.check_offered(Feature.VISIBLE_FILTER)
        raise AssertionError("not declared")

    @torch.no_grad()
    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """No score is declared: raises CapabilityError for any that is asked for."""
        self.info.check_offered(Feature.asked_by(replace(opt, grad2d=False)))
        return AccumOutput({})

    def _gaussians(self, g: GaussianInputs, opt: RasterOptions) -> dict[str, Any]:
        # An opacity below 1/255 is culled: that is how gsplat is told to leave a Gaussian out.
        opacities = g.opacities if g.visible is None else g.opacities * g.visible
        given: dict[str, Any] = {"means": g.means, "opacities": opacities, "quats": g.quats, "scales": g.scales}
        if g.cov3d is not None:
            given["covars"] = g.cov3d[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        elif opt.scale_modifier != 1.0:
            assert g.scales is not None
            given["scales"] = g.scales * opt.scale_modifier
        if g.colors is not None:
            return given | {"colors": g.colors}
        assert g.sh is not None
        return given | {"colors": g.sh.to_dense(), "sh_degree": g.sh.active_degree}


def _camera(cam: Camera, like: Tensor) -> dict[str, Any]:
    """One camera as gsplat takes it: viewmats and Ks [1,4,4] and [1,3,3], pixel centres at +0.5."""
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = cam.R.cpu(), cam.tau.cpu()
    K = torch.tensor([[cam.fx, 0, cam.cx], [0, cam.fy, cam.cy], [0, 0, 1]])
    return {
        "viewmats": viewmat[None].to(like),
        "Ks": K[None].to(like),
        "width": cam.width,
        "height": cam.height,
        "near_plane": cam.near,
        "far_plane": cam.far,
    }


def _watch(means2d: Tensor, cam: Camera, opt: RasterOptions) -> tuple[GradBuffer | None, GradBuffer | None]:
    """Buffers that the backward pass fills with gsplat's pixel gradients [1,N,2], in NDC units."""
    if not (means2d.requires_grad and (opt.grad2d or opt.absgrad)):
        return None, None
    half = means2d.new_tensor([cam.width / 2, cam.height / 2])
    grad2d = GradBuffer() if opt.grad2d else None
    absgrad2d = GradBuffer() if opt.absgrad else None

    def keep(gradient: Tensor) -> None:
        if grad2d is not None:
            grad2d.set(gradient[0] * half)
        if absgrad2d is not None:
            absgrad2d.set(means2d.absgrad[0] * half)  # type: ignore[attr-defined]

    means2d.register_hook(keep)
    return grad2d, absgrad2d


def _classic_radii(radii: Tensor, conics: Tensor) -> Tensor:
    """[N] int32, the classic radius ceil(3 sqrt(largest eigenvalue)) of what gsplat drew, 0 elsewhere.

    radii   [N,2] gsplat's own extents, 0 where it culled
    conics  [N,3] inverse 2-D covariances xx, xy, yy
    """
    a, b, c = conics.detach().unbind(1)
    det = (a * c - b * b).clamp(min=1e-30)  # of the inverse: the covariance is (c, -b, a) / det
    middle = 0.5 * (a + c) / det
    largest = middle + (middle * middle - 1 / det).clamp(min=0.1).sqrt()
    seen = (radii > 0).all(dim=1)
    return torch.where(seen, (3 * largest.sqrt()).ceil(), torch.zeros_like(largest)).to(torch.int32)
