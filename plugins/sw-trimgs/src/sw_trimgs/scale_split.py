"""Scale-driven densification: what is too large is split in three, whatever its gradient.

Source: Trim 3D Gaussian Splatting (arXiv 2406.07499), section on scale-driven densification.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import torch
from sw_gaussians.density.splitting import split_children
from sw_gaussians.statistics import GRADIENT_STATISTICS

from splatwizard_core.api import (
    CameraIterator,
    EmptyModel,
    GaussianModel,
    OptimizationParams,
    Scene,
    SplatOptimizer,
    TaskLog,
)

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import View

Box = Literal["own", "xx"]
CHILDREN = 3
THINNEST = 0.25
"""Least side of the box, of its longest side: a flat ring of cameras would leave no room."""


def camera_box(centers: Tensor, box: Box = "own") -> tuple[Tensor, Tensor]:
    """Return centre [3] and half sides [3] of the box around camera centres [V,3], world units.

    A full side is twice the span of the centres along its axis, and no less than a quarter of the longest side.

    box     own: each axis has its own span; xx: z has that of x, as in the authors' code
    """
    span = centers.amax(dim=0) - centers.amin(dim=0)
    if box == "xx":
        span = span[[0, 1, 0]]
    return centers.mean(dim=0), torch.maximum(span, THINNEST * span.max())


def too_large(
    model: GaussianModel, centers: Tensor, *, limit: float, size_px: float | None, box: Box = "own"
) -> Tensor:
    """[N] bool: larger than a limit, and inside the box around the cameras.

    centers     [V,3] camera centres, world units
    limit       of the largest scale, world units
    size_px     of the largest radius on screen since the statistics were cleared, px; None: the radius does not count
    """
    middle, half = camera_box(centers, box)
    large = model.scales.amax(dim=1) > limit
    if size_px is not None:
        large |= model.max_radii2d > size_px
    return large & ((model.means - middle).abs() <= half).all(dim=1)


@torch.no_grad()
def split_rows(model: GaussianModel, rows: SplatOptimizer, selected: Tensor) -> int:
    """Replace each of the rows `selected` [N] bool by three children; returns how many were replaced.

    Children are those of `split_children`, of scales divided by 2.4. Survivors keep their order, then come all first
    children, all second, all third. The statistics of density control start again at zero.
    """
    parents = selected.nonzero().squeeze(1)  # [P]
    for name in (*GRADIENT_STATISTICS, "max_radii2d"):
        getattr(model, name).zero_()
    if parents.numel() == 0:
        return 0
    rows.append_rows(model, split_children(model, parents, CHILDREN))
    keep = torch.cat([~selected, selected.new_ones(CHILDREN * parents.numel())])
    rows.keep_rows(model, keep)
    return parents.numel()


class ScaleSplit:
    """Schedule task: splits what is too large in three, then prunes what is faint.

    percent_dense   largest scale above it is split, times `factor` and the scene extent
    factor          k
    size_px         so is a larger radius on screen since the last densification, px; None: it does not count
    min_opacity     fainter Gaussians are pruned, 0..1
    world_prune     so are those with a larger scale, times the scene extent; None: none is
    box             see `camera_box`

    Radii are those that `collect-gradient-statistics` gathers. Curves: "scale_split", "pruned". It does nothing at the
    last step of a stage, which makes no update. Raises EmptyModel if nothing is left.
    """

    def __init__(
        self,
        *,
        percent_dense: float = 0.01,
        factor: float = 1.0,
        size_px: float | None = 100.0,
        min_opacity: float = 0.005,
        world_prune: float | None = None,
        box: Box = "own",
    ) -> None:
        self.percent_dense, self.factor, self.size_px = percent_dense, factor, size_px
        self.min_opacity, self.world_prune, self.box = min_opacity, world_prune, box

    def __call__(
        self,
        model: GaussianModel,
        optimizer: SplatOptimizer,
        cameras: CameraIterator,
        scene: Scene,
        opt: OptimizationParams,
        step: int,
        log: TaskLog,
    ) -> None:
        if step >= opt.iterations:
            return
        limit = self.percent_dense * self.factor * scene.extent
        centers = camera_centers(cameras, model)
        selected = too_large(model, centers, limit=limit, size_px=self.size_px, box=self.box)
        count = split_rows(model, optimizer, selected)
        doomed = model.opacities < self.min_opacity
        if self.world_prune is not None:
            doomed |= model.scales.amax(dim=1) > self.world_prune * scene.extent
        pruned = int(doomed.sum())
        if pruned == model.num_rows:
            raise EmptyModel(step)
        if pruned:
            optimizer.keep_rows(model, ~doomed)
        log.scalar("scale_split", count)
        log.scalar("pruned", pruned)


def camera_centers(views: Sequence[View], model: GaussianModel) -> Tensor:
    """[V,3] centres of the views' cameras, on the device of the model."""
    return torch.stack([view.camera.center for view in views]).to(model.means)
