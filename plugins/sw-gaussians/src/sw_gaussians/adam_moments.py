"""Adam's moments of a finished stage, kept with the model so that a later stage can continue from them."""

from __future__ import annotations

from typing import Any

from splatwizard_core.api import SplatModel, SplatOptimizer


class Moments:
    """Adam's moments by parameter name, on the CPU to free GPU memory. Copies of a model share them."""

    def __init__(self, optimizer: SplatOptimizer) -> None:
        self.by_name: dict[str, dict[str, Any]] = {
            name: {"step": state.step, **{key: state.tensors[key].cpu() for key in ("exp_avg", "exp_avg_sq")}}
            for name, state in optimizer.states.items()
        }

    def __deepcopy__(self, memo: dict[int, Any]) -> Moments:
        return self


def keep_moments(model: SplatModel, optimizer: SplatOptimizer) -> None:
    """Attach the optimizer's moments to the model; they are not saved in its state or its file."""
    model.moments = Moments(optimizer)  # type: ignore[assignment]


def restore_moments(model: SplatModel, optimizer: SplatOptimizer) -> bool:
    """Load the moments attached to the model into the optimizer; return False if there are none (e.g. from a .ply).

    Raises ValueError if rows came or went since.
    """
    kept = getattr(model, "moments", None)
    if not isinstance(kept, Moments):
        return False
    optimizer.load_state_dict({**optimizer.state_dict(), "moments": kept.by_name})
    return True
