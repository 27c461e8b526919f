"""Parameter averaging over the last training steps, which reduces the noise of single-view gradients."""

from splatwizard_core.api import SplatModel, SplatOptimizer

SAMPLE_EVERY = 10
"""Largest number of steps between two samples; reading the parameters costs about 1 % of a step."""
AVERAGE = "average"
"""Key in the optimizer state of a parameter: its running mean, same shape as the parameter."""


class AverageParameters:
    """Replaces the parameters by their mean over samples from the last steps, all weighted equally.

    first, last     steps of the first and the last sample; after the last the model is the mean
    every           steps between two samples

    The training goes on from the model itself, not from the mean, until the last step. Means are part of the
    optimizer's state: they follow rows that go or are put in another order, and are in checkpoints. Rows that come in
    between would be averaged with zeros, so `first` belongs after the last densification. Parameters without
    any update stay unchanged.
    Raises ValueError if `first` is not a whole number of samples before `last`.
    Source: stochastic weight averaging (arXiv 1803.05407).
    """

    def __init__(self, *, first: int, last: int, every: int = 10) -> None:
        if every < 1 or first > last or (last - first) % every:
            raise ValueError(f"steps {first} to {last} are no samples {every} steps apart")
        self.first, self.last, self.every = first, last, every

    @property
    def steps(self) -> range:
        """Steps at which it is to be called."""
        return range(self.first, self.last + 1, self.every)

    def __call__(self, model: SplatModel, optimizer: SplatOptimizer, step: int) -> None:
        samples = (step - self.first) // self.every + 1
        for name, param in model.named_parameters():
            state = optimizer.states.get(name)
            if state is None:
                continue
            value = param.detach()
            mean = state.tensors.get(AVERAGE)
            if mean is None:
                state.tensors[AVERAGE] = value.clone()
            else:
                mean.lerp_(value, 1 / samples)
            if step == self.last:
                value.copy_(state.tensors.pop(AVERAGE))


def average_of_the_end(share: float, *, first: int, last: int) -> AverageParameters | None:
    """Return the task that averages over the last share, 0..1, of `last` steps, but not before `first`; 0: None."""
    begin = max(first, round(last * (1 - share)))
    if begin >= last:
        return None
    every = min(SAMPLE_EVERY, last - begin)
    return AverageParameters(first=begin + (last - begin) % every, last=last, every=every)
