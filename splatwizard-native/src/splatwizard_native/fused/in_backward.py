"""Adam within a backward pass: an update that waits at a parameter for whoever finds its gradient.

A rasterizer whose kernel has the gradient of a parameter in registers may do Adam's step there, so that the gradient
is neither written nor read again. An optimizer offers the update before the drawing; the backward pass takes it, and
then hands out no gradient for this parameter; what nobody has taken is done as always. Right only where one drawing
makes the whole gradient, and where nobody looks at it before the optimizer's turn: the offerer's to know.
"""

from typing import Any

from torch import Tensor

from splatwizard_native.fused.adam import AdamUpdate


def offer_update(param: Tensor, update: AdamUpdate) -> None:
    """Let the next backward pass that has the gradient of `param` do this update; its `grad` is not looked at.

    Whoever does it counts up the version of `param`, as every change in place does.
    """
    holder: Any = param
    holder.update_in_backward = update, param._version


def offered_update(param: Tensor) -> AdamUpdate | None:
    """The update that waits at a parameter; None: none does."""
    offer: tuple[AdamUpdate, int] | None = getattr(param, "update_in_backward", None)
    return offer[0] if offer is not None and offer[1] == param._version else None


def end_offer(param: Tensor) -> bool:
    """Withdraw what was offered, or say that it is done; returns whether it still waited."""
    waits = offered_update(param) is not None
    holder: Any = param
    holder.update_in_backward = None
    return waits
