"""Learning rates as functions of the step."""

import math


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
