"""Learning rates as functions of the step, and of the length of a run."""

import math

from splatwizard_core.api import Scene, SplatOptimizer


def exponential_lr(
    step: float,
    *,
    init: float,
    final: float,
    max_steps: int,
    delay_steps: int = 0,
    delay_mult: float = 1.0,
) -> float:
    """Return a rate that falls from `init` to `final`, log-linearly over `max_steps`, and stays there.

    It is 0 for step < 0 or init = 0.

    delay_steps     with more than 0 the rate is damped at first: by `delay_mult` at step 0, rising as a sine
    delay_mult      without effect while delay_steps is 0, as in the authors' configuration of 3DGS

    Source: 3DGS (arXiv 2308.04079), code of the authors; first in JAXNeRF.
    """
    if step < 0 or init == 0:
        return 0.0
    damping = 1.0
    if delay_steps > 0:
        damping = delay_mult + (1 - delay_mult) * math.sin(0.5 * math.pi * min(step / delay_steps, 1.0))
    tau = min(step / max(max_steps, 1), 1.0)
    return damping * math.exp((1 - tau) * math.log(init) + tau * math.log(final))


class UpdateLearningRate:
    """Sets the step size of the means: exponential decay, times the scene extent."""

    def __init__(
        self,
        *,
        init: float = 1.6e-4,
        final: float = 1.6e-6,
        max_steps: int = 30_000,
        delay_steps: int = 0,
        delay_mult: float = 0.01,
    ) -> None:
        self.init, self.final, self.max_steps = init, final, max_steps
        self.delay_steps, self.delay_mult = delay_steps, delay_mult

    def rate(self, step: int, extent: float) -> float:
        """Return the learning rate of the means at `step`, world units."""
        return extent * exponential_lr(
            step,
            init=self.init,
            final=self.final,
            max_steps=self.max_steps,
            delay_steps=self.delay_steps,
            delay_mult=self.delay_mult,
        )

    def __call__(self, optimizer: SplatOptimizer, scene: Scene, step: int) -> None:
        optimizer.set_lr("means", self.rate(step, scene.extent))


SHORT, LONG = 0.4, 0.8
"""Bounds, as shares of the full schedule: shorter runs count as short, longer ones as long."""


def rate_factors(share: float) -> dict[str, float]:
    """Return the factors of two learning rates in a run of a given share, > 0, of the full schedule.

    A short run ends with larger steps of the means, for they have less time to arrive; up to a long one the factor is
    log-interpolated. SH bands 1 to 3 move twice as fast in all that is not long.

    Source: LiteGS (arXiv 2503.01199), whose values are those of a third of the plan and of the whole; between: our own.
    """
    q = min(max((share - SHORT) / (LONG - SHORT), 0.0), 1.0)
    return {"lr.position_final": 10.0 ** (1 - q), "lr.sh_rest": 2.0 if share < LONG else 1.0}
