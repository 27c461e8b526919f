"""What a measurement is asked for beyond the file and the scene, and whether an earlier one already holds it.

An earlier one that holds more is kept: a run that was measured with weights, or five times over, does not lose that
because a later command does not ask for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from splatwizard_core.evaluation.metrics import MetricSettings, MetricSetup, metric_identities
from splatwizard_core.runs.session import Session


@dataclass(frozen=True)
class Asked:
    """What is to be in the measurement.

    repeats     of the speed
    metrics     name -> what its values would depend on now; None: it cannot be computed now
    """

    repeats: int
    metrics: Mapping[str, str | None] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """What a step remembers."""
        return asdict(self)

    def is_held_by(self, remembered: Any) -> bool:
        """Whether a measurement that was asked for `remembered` (of `as_dict`, or anything) holds all of this."""
        if not isinstance(remembered, Mapping) or not isinstance(remembered.get("metrics"), Mapping):
            return False
        repeats, metrics = remembered.get("repeats"), remembered["metrics"]
        if not isinstance(repeats, int) or repeats < self.repeats:
            return False
        return all(now is None or metrics.get(name) == now for name, now in self.metrics.items())


def what_is_asked(session: Session, *, repeats: int, metric_settings: MetricSettings) -> Asked:
    """What a run asks of its evaluation, with the packages and weights that are there now."""
    setup = MetricSetup(session.device, metric_settings)
    return Asked(repeats, metric_identities(session.plugins.metrics, setup))
