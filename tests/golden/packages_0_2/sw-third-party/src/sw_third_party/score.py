"""The one new idea, as a function on tensors that can be tested alone."""

from torch import Tensor


def worth(opacities: Tensor) -> Tensor:
    """Score each Gaussian by its opacity: the lowest go.

    opacities   [N] 0..1

    Returns [N], higher is more important.
    """
    return opacities.detach()
