"""The pure-torch rasterizer: the oracle that every kernel is held against, and the fallback where none can be built.

Values follow specs of 3DGS to the letter; gradients come from autograd, not from hand-derived formulas.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.api import (
    AccumOutput,
    Camera,
    GaussianInputs,
    GradBuffer,
    RasterizerInfo,
    RasterOptions,
    RasterStats,
    RenderResult,
)
from sw_reference import plugin
from sw_reference.compositing import Splats, composite, support_rectangles, tile_lists
from sw_reference.projection import CLASSIC_TILE, Projection, project, visible_radii
from sw_reference.scores import merge_scores, view_fisher, view_scores
from sw_reference.shading import background_image, splat_colors
from sw_reference.surfels import are_surfels, check_ellipsoids, draw_surfels, visible_surfel_radii


class ReferenceRasterizer:
    """3DGS and 2DGS (two scales a Gaussian) in pure torch: float32 and float64, CPU and CUDA, bounded memory, slow.

    classic_tiles   also cut each splat at the original's square of 16x16 tiles (3 sigma). The default draws the exact
                    support, alpha >= 1/255, wherever it reaches. Profile "dgr-exact" implies it, and takes over the
                    original's gradients through the alpha clamp and the Jacobian clamp.
    tile            side of the tiles that are blended together, pixels; changes speed only

    In both cases a Gaussian is culled where the original culls it (radii == 0).
    """

    info: RasterizerInfo = RasterizerInfo.declared(plugin.register_rasterizers, "reference")

    def __init__(self, *, classic_tiles: bool = False, tile: int = 8) -> None:
        self.classic_tiles = classic_tiles
        self.tile = tile

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view; see the protocol. Raises CapabilityError, ConfigError or ShapeError."""
        self.info.check_request(g, opt)
        opt.check_scores(cam)
        cam = cam.to(g.means.device, g.means.dtype)
        quirks = opt.profile == "dgr-exact"
        classic = self.classic_tiles or quirks
        if are_surfels(g):
            pass_clamp = quirks or opt.clamp_grad == "pass"
            return draw_surfels(g, cam, opt, tile=self.tile, classic=classic, pass_clamp=pass_clamp)
        check_ellipsoids(self.info.name, opt)
        p = project(g, cam, opt, dgr_gradient=quirks)
        order = torch.argsort(p.depth.detach(), stable=True)  # ties by index: rows ascend
        tile = CLASSIC_TILE if classic else self.tile
        rect = support_rectangles(p, cam.width, cam.height, tile, classic=classic)
        lists = tile_lists(rect[order], cam.width, cam.height, tile)

        u, grad2d, absgrad2d, probe = _watch_screen_gradient(p, g, cam, opt)
        colors = splat_colors(g, p.rows, cam, opt)
        depths = self._depth_channels(p, opt)
        channels = [colors, *depths.values()]
        if g.features is not None:
            channels.append(g.features[p.rows])
        packed = torch.cat([u, p.conic, p.opacity[:, None], probe, *channels], dim=1)[order]
        num_features = 0 if g.features is None else g.features.shape[1]
        splats = Splats(
            packed,
            num_channels=packed.shape[1] - 8,
            detached=num_features if opt.features_detach_geometry else 0,
            depth=p.depth[order] if "median" in opt.depth else None,
            pass_clamp=quirks or opt.clamp_grad == "pass",
            absgrad=opt.absgrad,
        )
        drawn = composite(splats, lists, cam.width, cam.height)

        num_colors = colors.shape[1]
        background = background_image(opt, num_colors, cam, g.means)
        alpha = 1 - drawn.T[None]
        depth = {name: drawn.channels[num_colors + i][None] for i, name in enumerate(depths)}
        if "expected" in opt.depth:
            depth["expected"] = depth["accumulated"] / alpha.clamp(min=1e-10)
        if drawn.median is not None:
            depth["median"] = drawn.median[None]
        scores = {}
        if opt.scores:
            per_splat = view_scores(opt.scores, splats, lists, num_colors, background)
            for spec in opt.scores:
                full = torch.zeros(len(g), dtype=torch.float64, device=g.means.device)
                full[p.rows[order]] = per_splat[spec.name]
                scores[spec.name] = full.to(spec.dtype)
        return RenderResult(
            image=drawn.channels[:num_colors] + drawn.T * background,
            radii=p.radii,
            inputs=g,
            alpha=alpha if opt.alpha else None,
            depth={name: depth[name] for name in sorted(opt.depth)},
            features=drawn.channels[-num_features:] if num_features else None,
            grad2d=grad2d,
            absgrad2d=absgrad2d,
            scores=scores,
            fisher=self._fisher(g, cam, opt).float() if opt.fisher else None,
            stats=RasterStats(
                n_visible=len(p.rows),
                n_pairs=len(lists.splats),
                n_evaluated=drawn.n_evaluated,
                n_blended=drawn.n_blended,
                n_pixels=cam.width * cam.height,
                n_invalid=p.n_invalid,
            ),
        )

    @torch.no_grad()
    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from means and covariances (opacities and colours are not looked at); 0 = culled."""
        self.info.check_geometry(g)
        cam = cam.to(g.means.device, g.means.dtype)
        return visible_surfel_radii(g, cam) if are_surfels(g) else visible_radii(g, cam, RasterOptions())

    @torch.no_grad()
    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """Sum scores and Fisher blocks over views ("blend_max": their maximum)."""
        self.info.check_request(g, opt)
        totals = {s.name: torch.zeros(len(g), dtype=s.dtype, device=g.means.device) for s in opt.scores}
        fisher = g.means.new_zeros(len(g), 21, dtype=torch.float64) if opt.fisher else None
        for cam in cams:
            if opt.scores:
                view = self.render(g, cam, replace(opt, fisher=False)).scores
                for spec in opt.scores:
                    totals[spec.name] = merge_scores(spec, totals[spec.name], view[spec.name])
            if fisher is not None:
                fisher += self._fisher(g, cam, opt)
        return AccumOutput(totals, None if fisher is None else fisher.float())

    def _fisher(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> Tensor:
        """[N,21] float64 of one view; a pass of autograd for every pixel and channel."""
        plain = replace(
            opt, fisher=False, scores=(), depth=frozenset(), alpha=False, grad2d=False, absgrad=False
        )  # fmt: skip
        return view_fisher(lambda inputs: self.render(inputs, cam, plain).image, g)

    @staticmethod
    def _depth_channels(p: Projection, opt: RasterOptions) -> dict[str, Tensor]:
        """Depth maps that are sums of one value per splat, [V,1] each."""
        channels = {}
        if opt.depth & {"accumulated", "expected"}:
            channels["accumulated"] = p.depth[:, None]
        if "inverse" in opt.depth:
            channels["inverse"] = 1 / p.depth[:, None]
        return channels


def _watch_screen_gradient(
    p: Projection, g: GaussianInputs, cam: Camera, opt: RasterOptions
) -> tuple[Tensor, GradBuffer | None, GradBuffer | None, Tensor]:
    """(u, buffer of dL/du, buffer of sum |dL/du|, probe [V,2]); the buffers are filled by hooks in NDC units."""
    u, probe = p.u, torch.zeros_like(p.u)
    to_ndc = u.new_tensor([cam.width / 2, cam.height / 2])

    def watch(x: Tensor) -> GradBuffer:
        buffer = GradBuffer()

        def store(gradient: Tensor) -> None:
            buffer.set(gradient.new_zeros(len(g), 2).index_copy(0, p.rows, gradient * to_ndc))

        x.register_hook(store)  # type: ignore[no-untyped-call]
        return buffer

    grad2d = absgrad2d = None
    if torch.is_grad_enabled():
        if opt.grad2d:
            if not u.requires_grad:
                u = u.detach().requires_grad_()
            grad2d = watch(u)
        if opt.absgrad:
            probe.requires_grad_()
            absgrad2d = watch(probe)
    return u, grad2d, absgrad2d, probe
