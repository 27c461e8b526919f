"""Adam's moments as a training left them, for a stage that goes on where it ended instead of starting afresh."""

from __future__ import annotations

from typing import Any

from splatwizard_core.api import SplatModel, SplatOptimizer


class Moments:
    """Moments by parameter name, on the CPU: a trained scene may stay on a GPU for long. Copied models share them."""

    def __init__(self, optimizer: SplatOptimizer) -> None:
        self.by_name: dict[str, dict[str, Any]] = {
            name: {"step": state.step, **{key: state.tensors[key].cpu() for key in ("exp_avg", "exp_avg_sq")}}
            for name, state in optimizer.states.items()
        }

    def __deepcopy__(self, memo: dict[int, Any]) -> Moments:
        return self


def keep_moments(model: SplatModel, optimizer: SplatOptimizer) -> None:
    """Leave the moments of a finished training with its model; they are no part of its state or its file."""
    model.moments = Moments(optimizer)  # type: ignore[assignment]


def restore_moments(model: SplatModel, optimizer: SplatOptimizer) -> bool:
    """Go on with the moments that a training left with the model; False where it left none (a .ply, say).

    Raises ValueError if rows came or went since.
    """
    kept = getattr(model, "moments", None)
    if not isinstance(kept, Moments):
        return False
    optimizer.load_state_dict({**optimizer.state_dict(), "moments": kept.by_name})
    return True
