"""Gradient accumulation over several views at the end of a training: less noise, fewer Adam updates."""

from splatwizard_core.api import SplatModel, SplatOptimizer

PENDING = "pending"
"""Key in the optimizer state: gradient sum since the last update, same shape as the parameter."""
LAST_PRIORITY = 100
"""Priority behind all tasks that read or change gradients."""


class SumViews:
    """Accumulates gradients and updates with their sum every `views` steps, from step `first` on; dense Adam only.

    last    step that updates with what there is by then, be it fewer views; None: what is left is lost

    A post task, to be registered with priority `LAST_PRIORITY`. The sums are part of the optimizer's state: they follow
    rows that come, go or are put in another order, and are in checkpoints. Adam does not see the factor between a sum
    and a mean, so learning rates stay as they are.
    Source: FastGS (arXiv 2511.04283). Raises ValueError for less than one view.
    """

    def __init__(self, *, views: int = 8, first: int = 8_000, last: int | None = None) -> None:
        if views < 1:
            raise ValueError(f"views is {views}: it must be at least 1")
        self.views, self.first, self.last = views, first, last

    def waits(self, step: int) -> bool:
        """Return whether a step only accumulates, without an update."""
        return step >= self.first and step != self.last and (step - self.first + 1) % self.views != 0

    def __call__(self, model: SplatModel, optimizer: SplatOptimizer, step: int) -> None:
        for name, param in model.named_parameters():
            if param.grad is None or not any(name == g or name.startswith(f"{g}.") for g in optimizer.groups):
                continue
            state = optimizer.states.get(name)
            kept = None if state is None else state.tensors.pop(PENDING, None)
            if kept is not None:
                param.grad = kept.add_(param.grad)
            if self.waits(step):
                state = state or optimizer.fresh_state(name, param)
                state.tensors[PENDING], param.grad = param.grad, None
