"""Learning-rate decay of all parameter groups at the end of a training."""

from collections.abc import Mapping

from splatwizard_core.api import SplatOptimizer


class SettleLearningRates:
    """Decays learning rates log-linearly between two steps.

    rates   parameter group -> its rate until `first`; groups that the optimizer lacks are left out
    first   last step with full rates
    last    step from which the rates are `factor` times the full ones
    factor  > 0, at most 1; with 1 nothing changes

    Adam's step size equals its learning rate however small the gradient is. So with a constant rate the parameters keep
    oscillating around the optimum. Source: our own; plans of 3DGS lower the rate of the means alone.
    Raises ValueError for a factor outside its range, or last <= first.
    """

    def __init__(self, rates: Mapping[str, float], *, first: int, last: int, factor: float = 0.1) -> None:
        if not 0 < factor <= 1:
            raise ValueError(f"factor is {factor}: it must be above 0 and at most 1")
        if last <= first:
            raise ValueError(f"rates cannot fall between steps {first} and {last}: `last` must be the later one")
        self.rates, self.first, self.last, self.factor = dict(rates), first, last, factor

    def share(self, step: int) -> float:
        """Return the factor of the learning rates at a step."""
        passed = min(max((step - self.first) / (self.last - self.first), 0.0), 1.0)
        return float(self.factor**passed)

    def __call__(self, optimizer: SplatOptimizer, step: int) -> None:
        share = self.share(step)
        for name, rate in self.rates.items():
            if name in optimizer.groups:
                optimizer.set_lr(name, share * rate)
