"""A training step of anchors with drawing and photometric loss outside of autograd."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.fast.whole_step import WholeStep

from sw_anchors.fast.loss import product_and_slopes

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera, LossPack, RasterOptions, RenderResult, TrainingState, View

Step = tuple["RenderResult", "LossPack"]
Weighted = tuple[float, "Tensor"]
"""A weight and the scalar that it multiplies."""


class WholeAnchorStep(WholeStep):
    """Takes the whole step of an AnchorStage whose loss is that class's."""

    def __init__(self) -> None:
        super().__init__()
        self._kept: RasterOptions | None = None  # options of the last step, which are nearly always those of the next

    def of(self, stage: Any, state: TrainingState, view: View, camera: Camera, background: Tensor) -> Step:
        """Return the result and the loss, gradients made; in parts where nothing else can."""
        model, step = state.model, state.step
        inputs = model.gaussians(camera, state.rasterizer)
        options = self._kept = _the_same(self._kept, stage.raster_options(step, background))
        settings = stage.opt.loss

        def terms(result: RenderResult, by: dict[str, Tensor]) -> dict[str, Weighted]:
            assert result.inputs.scales is not None
            count = stage.counted(result)
            with torch.no_grad():
                volume, others = product_and_slopes(result.inputs.scales, count)
                if isinstance(count, int):
                    by["scales"].add_(others, alpha=settings.volume / count)
                else:
                    by["scales"].addcmul_(others, settings.volume / count)
            return {"volume": (settings.volume, volume), **all_weighted(stage.extra_loss(model, result, step))}

        found = self.through(inputs, options, settings.lambda_dssim, state, view, camera, background, terms)
        if found is not None:
            return found
        # From what has been decoded: noise is drawn once.
        result = state.rasterizer.render(inputs, camera, options)
        loss = stage.loss(model, view, result, background, step)
        loss.total.backward()  # type: ignore[no-untyped-call]
        return result, loss


def all_weighted(terms: Mapping[str, Weighted | Tensor]) -> dict[str, Weighted]:
    """Return terms of which each has a weight, if none then 1."""
    return {name: term if isinstance(term, tuple) else (1.0, term) for name, term in terms.items()}


def _the_same(last: RasterOptions | None, now: RasterOptions) -> RasterOptions:
    """Return the last options if they say what those of now do: what is known of them is looked up by the object."""
    if last is not None and last.background is now.background and _said(last) == _said(now):
        return last
    return now


def _said(options: RasterOptions) -> list[Any]:
    return [value for name, value in vars(options).items() if name not in ("background", "_asked")]
