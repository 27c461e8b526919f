"""The score: a Gaussian is as good as the better of its two ranks, by opacity and by mean screen-space gradient.

Cut at a level gamma it is the published rule: what goes lies below the gamma-quantile of opacity and below that of the
gradient (`doomed` below says why). A caller who removes a count gets the same order.

Source: Trimming the Fat (arXiv 2406.18214), code of the authors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer, SplatModel


class OpacityAndGradient:
    """Pruner `trimming-the-fat`. Looks at no view: what it knows of them is in the model's gradient statistics."""

    uses_statistics = True

    @torch.no_grad()
    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """[N] float64 in 0..1.

        Raises TypeError for a model that is not explicit Gaussians, ValueError if all gradients are equal: then nobody
        has collected any, and the rule would silently remove nothing.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'trimming-the-fat' scores a GaussianModel, not a {type(model).__name__}")
        gradients = mean_gradients(model)
        if model.num_rows > 1 and bool((gradients == gradients[0]).all()):
            raise ValueError(
                f"the mean gradients of all {model.num_rows:,} Gaussians are {float(gradients[0]):.3g}: the pruner "
                "'trimming-the-fat' reads gradient statistics, which must be collected in the steps before"
            )
        return worth(model.opacities, gradients)


def mean_gradients(model: GaussianModel) -> Tensor:
    """[N] norm of the gradient by the projected mean, NDC units, averaged over the steps in which it was visible.

    0 for a Gaussian that none of them showed.
    """
    return torch.where(model.denom > 0, model.grad_accum / model.denom.clamp_min(1), 0)


def worth(opacities: Tensor, gradients: Tensor) -> Tensor:
    """[N] float64 in 0..1: the higher of the two ranks, divided by N - 1. A single Gaussian is worth 1."""
    n = len(opacities)
    if n == 1:
        return torch.ones(1, dtype=torch.float64, device=opacities.device)
    better = torch.maximum(ranks(opacities), ranks(gradients)).double()
    # By a tensor: a GPU multiplies by the reciprocal of a Python number, whose last bit may differ from the quotient of
    # a CPU and put a Gaussian on the other side of a level.
    return better / torch.full_like(better, n - 1)


def ranks(values: Tensor) -> Tensor:
    """[N] int64: how many other `values` [N] are smaller or equal, so that equal ones share the highest rank."""
    return torch.searchsorted(values.sort().values, values, right=True) - 1


def doomed(scores: Tensor, level: float) -> Tensor:
    """[N] bool: what the rule removes at level gamma, 0..1.

    The quantile of sorted v at gamma interpolates between its neighbours at index h = gamma (N - 1). So v_i < quantile
    if and only if the highest rank among those equal to v_i is below h, and both together if the worth is below gamma.
    No quantile is formed: torch.quantile refuses more than 2^24 values.
    """
    return scores < level
