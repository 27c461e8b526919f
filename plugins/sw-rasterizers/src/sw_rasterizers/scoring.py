"""The rasterizers that also say how much each Gaussian matters: scores and Fisher blocks on compiled kernels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.api import (
    AccumOutput,
    Camera,
    CapabilityError,
    GaussianInputs,
    RasterizerInfo,
    RasterOptions,
    RenderResult,
    ScoreSpec,
    ShapeError,
)
from sw_rasterizers import plugin
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

KINDS = ("hits", "opacity", "opacity_T", "blend", "blend_max", "gamma", "dist", "grad_sq")
"""In the order of `enum ScoreKind` in csrc/scores.h."""
MAX_SCORES = 16
"""Of one call; `kMaxScores` there."""
FISHER = 21
"""Upper triangle of a 6x6 block, row by row."""


class _Totals:
    """Running sums over views in float64: scores [K,N], Fisher blocks [N,21] if asked for."""

    def __init__(self, g: GaussianInputs, opt: RasterOptions) -> None:
        like = g.means
        self.specs = opt.scores
        self.scores = like.new_zeros(len(opt.scores), len(g), dtype=torch.float64)
        self.fisher = like.new_zeros(len(g), FISHER, dtype=torch.float64) if opt.fisher else None

    def result(self) -> AccumOutput:
        """The sums in the dtypes of the contract: counts as int32, all else as float32."""
        limit = torch.iinfo(torch.int32).max
        scores = {
            spec.name: (row.clamp(max=limit) if spec.dtype == torch.int32 else row).to(spec.dtype)
            for spec, row in zip(self.specs, self.scores, strict=True)
        }
        return AccumOutput(scores, None if self.fisher is None else self.fisher.float())


class ScoreRasterizer(StandardRasterizer):
    """The standard rasterizer, with scores and Fisher blocks; a subclass for each name that is registered.

    Sums are formed per tile in the dtype of the Gaussians and across tiles and views in float64; on the CPU they are
    bit-equal for any number of threads, on CUDA each (Gaussian, pixel) counts once but the order of additions varies,
    unless torch is asked for deterministic algorithms: then a Gaussian's sum over the tiles of a view is float32, too.
    No score is differentiable, and none touches a gradient.
    """

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view; see the protocol. Raises CapabilityError, ConfigError or ShapeError."""
        self._check(g, opt)
        opt.check_scores(cam)
        result = super().render(g, cam, replace(opt, scores=(), fisher=False))
        if not opt.scores and not opt.fisher:
            return result
        totals = _Totals(g, opt)
        self._add(g, cam, opt, totals)
        found = totals.result()
        return replace(result, scores=found.scores, fisher=found.fisher)

    @torch.no_grad()
    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """Sum scores and Fisher blocks over views ("blend_max": their maximum); no image is kept."""
        self._check(g, opt)
        totals = _Totals(g, opt)
        for cam in cams:
            opt.check_scores(cam)
            self._add(g, cam, opt, totals)
        return totals.result()

    def _check(self, g: GaussianInputs, opt: RasterOptions) -> None:
        self.info.check_request(g, opt)
        if len(opt.scores) > MAX_SCORES:
            raise CapabilityError(
                f"rasterizer '{self.info.name}' forms at most {MAX_SCORES} scores at once, got {len(opt.scores)}",
                missing=(),
            )
        if g.colors is not None and g.colors.shape[1] == 0:
            raise ShapeError("GaussianInputs.colors has no channel: there is nothing to draw", actual=g.colors.shape)

    @torch.no_grad()
    def _add(self, g: GaussianInputs, cam: Camera, opt: RasterOptions, totals: _Totals) -> None:
        if not opt.scores and not opt.fisher:
            return
        MODULE.load()
        # Maps and features change no score: they are not asked for.
        call = self._call(
            g, cam, replace(opt, depth=frozenset(), alpha=False, absgrad=False, fragment_grad=False, grad2d=False)
        )
        sh = g.sh
        tensors = (
            g.means, g.opacities, g.scales, g.quats, g.cov3d, None if sh is None else sh.dense,
            None if sh is None else sh.dc, None if sh is None else sh.rest, g.colors,
        )  # fmt: skip
        weights, rows = _pixel_weights(opt.scores, g.means)
        torch.ops.sw_rasterizers.accumulate_scores(
            *(None if x is None else x.detach().contiguous() for x in tensors), call.visible, call.background,
            *call.settings(),
            [KINDS.index(s.kind) for s in opt.scores], [int(s.rule == "tested") for s in opt.scores],
            [float(s.gamma) for s in opt.scores], rows, weights, totals.scores, totals.fisher,
        )  # fmt: skip


def _pixel_weights(specs: tuple[ScoreSpec, ...], like: Tensor) -> tuple[Tensor | None, list[int]]:
    """The maps [M,H,W] and, for each score, which of them is its own; -1: none."""
    maps: list[Tensor] = []
    rows = []
    for spec in specs:
        rows.append(-1 if spec.pixel_weight is None else len(maps))
        if spec.pixel_weight is not None:
            maps.append(spec.pixel_weight.detach().to(like))
    return (torch.stack(maps).contiguous() if maps else None), rows


class CountRasterizer(ScoreRasterizer):
    """All sums of contributions (LightGaussian's are "hits" and "opacity_T"; also those of MesonGS and FastGS)."""

    info = RasterizerInfo.declared(plugin.register_rasterizers, "count")


class SpeedyRasterizer(ScoreRasterizer):
    """Squared derivatives of the image by a Gaussian's value: Speedy-Splat's score."""

    info = RasterizerInfo.declared(plugin.register_rasterizers, "speedy")


class PupRasterizer(ScoreRasterizer):
    """Fisher blocks of mean and log scale (PUP 3D-GS), and every other score."""

    info = RasterizerInfo.declared(plugin.register_rasterizers, "pup")


class MesonRasterizer(ScoreRasterizer):
    """MesonGS' importance: the sum of alpha T."""

    info = RasterizerInfo.declared(plugin.register_rasterizers, "mesongs")


class TrimRasterizer(ScoreRasterizer):
    """TrimGS' contribution, rule "tested", and its maps: features that leave the geometry alone, median depth."""

    info = RasterizerInfo.declared(plugin.register_rasterizers, "trimgs")
