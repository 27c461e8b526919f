"""Variance of opacity gradients over fragments: high where pixels disagree about a Gaussian's opacity."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel, RenderResult, SplatModel
from sw_gaussians.fast import statistics as fast

BUFFER = "fragments"
"""Buffer [N,3] of a model: sum of g, sum of g^2, number of fragments, with g = o dL/do of one pixel of one view."""
MIN_TRANSPARENCY = 1e-6
"""Floor of 1 - opacity when converting d/d logit to d/d opacity."""


def add_buffer(model: GaussianModel) -> None:
    """Add the zero-filled buffer to the model; its rows follow the Gaussians and are saved in checkpoints."""
    if BUFFER not in model.ROWS:
        model.register_buffer(BUFFER, model.means.new_zeros(model.num_rows, 3))
        model.ROWS = (*model.ROWS, BUFFER)


def drop_buffer(model: SplatModel) -> None:
    """Remove the buffer from the model if it has one."""
    if BUFFER in model.ROWS:
        model.ROWS = tuple(name for name in model.ROWS if name != BUFFER)
        delattr(model, BUFFER)


@torch.no_grad()
def opacity_variance(fragments: Tensor) -> Tensor:
    """Score Gaussians by opacity^2 times the number of fragments times the variance of the opacity gradient.

    fragments   [N,3] as `BUFFER`

    Returns [N] float32 >= 0: n max(0, sum g^2 / (n + 1) - (sum g / (n + 1))^2) with g = o dL/do. A gradient that all
    fragments share moves the opacity; one that changes sign between them calls for another Gaussian.
    Source: LiteGS (arXiv 2503.01199), with squares of single fragments.
    """
    total, squares, count = fragments.double().unbind(1)
    mean = total / (count + 1)
    return (squares / (count + 1) - mean * mean).clamp_min_(0).mul_(count).float()


def collect_opacity_gradients(model: GaussianModel, result: RenderResult) -> None:
    """Schedule task: add this view's opacity gradients to `BUFFER`, which `add_buffer` has made.

    Raises ValueError for a stage that does not render them (`RasterOptions(fragment_grad=True)`). A step whose gradient
    of the opacities another task has taken is left out.
    """
    if result.fragment_grad is None or BUFFER not in model.ROWS:
        raise ValueError(
            "opacity gradients need a stage that renders them, with RasterOptions(fragment_grad=True), and a model "
            "with the buffer of sw_gaussians.density.fragments.add_buffer (of 3DGS: with density=budget)"
        )
    logits = model.opacity_logits
    if logits.grad is not None:
        accumulate_fragments(model.get_buffer(BUFFER), logits.grad, logits.detach(), result.fragment_grad.value)


def accumulate_fragments(sums: Tensor, gradients: Tensor, logits: Tensor, fragments: Tensor) -> None:
    """Add one view to `BUFFER`, in place.

    sums        [N,3] the buffer
    gradients   [N] derivative of the loss by the logits [N] of the opacities
    fragments   [N,2] sum of g^2, and number of fragments (RenderResult.fragment_grad)
    """
    if not fast.accumulate_fragments(sums, gradients, logits, fragments, least_clear=MIN_TRANSPARENCY):
        accumulate_fragments_in_torch(sums, gradients, logits, fragments)


def accumulate_fragments_in_torch(sums: Tensor, gradients: Tensor, logits: Tensor, fragments: Tensor) -> None:
    """Plain-torch version of `accumulate_fragments`."""
    clear = (1 - torch.sigmoid(logits)).clamp_min_(MIN_TRANSPARENCY)
    sums[:, 0].addcdiv_(gradients, clear)  # do/dlogit = o (1 - o)
    sums[:, 1:].add_(fragments)
