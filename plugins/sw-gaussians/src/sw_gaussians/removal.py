"""The exact cost of removing a Gaussian: by how much the squared error of the views grows without it.

A render is affine in the alpha of each Gaussian at each pixel, so that one pass over a view gives, for every Gaussian
at once, the error of the picture without it: nothing is estimated, and no gradient is formed. Costs are those of single
removals: where several Gaussians overlap, they do not add up. How strongly renders depend on all other
parameters is estimated by random signs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, GaussianModel, Rasterizer, RasterOptions, ScoreSpec, View


@dataclass(frozen=True)
class RemovalCosts:
    """Changes of some views by the removal of each Gaussian alone, sums over their pixels and colours.

    cost            [N] float64: squared error without the Gaussian, less `squared_error`; below 0: better without it
    change          [N] float64: squared change of the renders; S(m) of a factor m on the opacity. 0: hidden, or unseen
    squared_error   of the renders as they are; 0 without pictures
    values          how many squares a sum is of: 3 per pixel
    scores          further sums, by score kind, [N] float64
    """

    cost: Tensor
    change: Tensor
    squared_error: float
    values: int
    scores: dict[str, Tensor]


@torch.no_grad()
def removal_costs(
    draw: Callable[[Camera], GaussianInputs],
    views: Iterable[View | Camera],
    rasterizer: Rasterizer,
    background: Tensor | None = None,
    *,
    also: Sequence[str] = (),
) -> RemovalCosts:
    """Return what the removal of each Gaussian costs, in one sweep over the views.

    draw    camera -> the Gaussians to draw, the same rows each time; of a model: `model.gaussians(camera, rasterizer)`
    views   a Camera stands for a view whose picture is the render itself: then `cost` is `change`. Any subset misses
            Gaussians that only the others show; wrap it in `track` to show progress
    background  [3], 0..1; None: black
    also    score kinds to sum in the same sweep, such as "hits", "blend_sq", "blend_max", "shown"

    Exact but for pixels that are opaque (T < 1e-4) only with the Gaussian. Renders are compared unclamped. Works where
    the rasterizer offers SCORE_REMOVAL. Raises ValueError without views.
    """
    cost = change = None
    sums: dict[str, Tensor] = {}
    squared_error, values = 0.0, 0
    for view in views:
        camera = view if isinstance(view, Camera) else view.camera
        inputs = draw(camera)
        device = inputs.means.device
        camera = camera.to(device)
        specs = [ScoreSpec("change", "removal"), *(ScoreSpec(kind, kind) for kind in also)]
        if not isinstance(view, Camera):
            image = rasterizer.render(inputs, camera, RasterOptions(background=background)).image
            residual = image - view.image(background, device)
            squared_error += float(residual.double().square().sum())
            specs.append(ScoreSpec("cost", "removal", residual=residual))
        options = RasterOptions(background=background, scores=tuple(specs))
        found = rasterizer.accumulate(inputs, [camera], options).scores
        values += 3 * camera.width * camera.height
        if cost is None or change is None:
            cost, change = (torch.zeros_like(found["change"], dtype=torch.float64) for _ in range(2))
            sums = {kind: torch.zeros_like(change) for kind in also}
        change += found["change"]
        cost += found.get("cost", found["change"])
        for kind in also:
            sums[kind] = torch.maximum(sums[kind], found[kind]) if kind == "blend_max" else sums[kind].add_(found[kind])
    if cost is None or change is None:
        raise ValueError("costs of removal need at least one view")
    return RemovalCosts(cost, change, squared_error, values, sums)


def sensitivities(
    draw: Callable[[Camera], GaussianInputs],
    parameters: Mapping[str, Tensor],
    cameras: Iterable[Camera],
    rasterizer: Rasterizer,
    generator: torch.Generator,
    background: Tensor | None = None,
    *,
    draws: int = 2,
) -> dict[str, Tensor]:
    """Estimate S(z) = sum over views, pixels and colours of (d image / d z)^2 of every number z of the parameters.

    draw        camera -> the Gaussians to draw, differentiable with respect to the parameters
    parameters  name -> leaf
    generator   draws the signs, on any device
    draws       sign patterns per view, whose estimates are averaged

    Returns name -> S in the shape of the parameter, float32. Each pattern gives the square of the derivative of a sum
    with signs +-1, which is S on average: the relative error is about sqrt(2 / n), n the patterns that see the
    parameter. Enough for weights; a decision on one Gaussian needs `removal_costs`. Gradients in `.grad` stay as they
    are. Squared gradients of the loss would not do: they vanish with the residual.
    """
    found = {name: torch.zeros_like(value, dtype=torch.float32) for name, value in parameters.items()}
    leaves = list(parameters.values())
    options = RasterOptions(background=background)
    for camera in cameras:
        for _ in range(draws):
            with torch.enable_grad():
                inputs = draw(camera)
                image = rasterizer.render(inputs, camera.to(inputs.means.device), options).image
                if not image.requires_grad:  # nothing is seen
                    break
                signs = torch.randint(2, image.shape, generator=generator, device=generator.device).to(image) * 2 - 1
                gradients = torch.autograd.grad((image * signs).sum(), leaves, allow_unused=True)
            for name, gradient in zip(found, gradients, strict=True):
                if gradient is not None:
                    found[name] += gradient.square() / draws
    return found


class Removal:
    """Pruner `removal`: the squared error that the views gain by removing a Gaussian, sums over all of them."""

    uses_statistics = False

    def score(
        self, model: GaussianModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """Return the squared change of the renders, [N] float64; -inf for what no camera sees.

        For want of pictures; `score_views` is what `sw_gaussians.finetune.pruning` asks for. Raises TypeError for a
        model whose rows are not what is drawn.
        """
        return self._scores(model, cameras, rasterizer, background)

    def score_views(
        self, model: GaussianModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """Return the cost of removal, [N] float64, also below 0; -inf for what no view shows. Raises TypeError."""
        return self._scores(model, views, rasterizer, background)

    def _scores(
        self,
        model: GaussianModel,
        views: Sequence[View | Camera],
        rasterizer: Rasterizer,
        background: Tensor | None,
    ) -> Tensor:
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'removal' scores a GaussianModel, not a {type(model).__name__}")
        if not views:
            return torch.full((model.num_rows,), -torch.inf, dtype=torch.float64, device=model.device)
        costs = removal_costs(
            lambda camera: model.gaussians(camera.to(model.device), rasterizer),
            views, rasterizer, background, also=("hits",),
        )  # fmt: skip
        return torch.where(costs.scores["hits"] > 0, costs.cost, -torch.inf)
