"""Named configurations, and the rate points: how much is removed."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The plan of the Splatwizard paper.
    "paper": {},
    # As the authors' code, which densifies from step 600 on.
    "inria": {"base.preset": "inria"},
    # For a CPU and the demo scene: the plan of 3DGS' preset `quick`, drawn out by half and with more densification,
    # since what a soft removal takes must grow back in a few hundred steps.
    "quick": {
        "iterations": 1500,
        "prune.start": 300,
        "prune.stop": 1440,
        "prune.interval": 300,
        "base.preset": "quick",
        "base.sh_interval": 90,
        "base.lr.max_steps": 1500,
        "base.lr.sh_rest": 1.5e-3,
        "base.density.settings.start": 120,
        "base.density.settings.stop": 900,
        "base.density.settings.interval": 60,
        "base.density.settings.grad_threshold": 2.3e-4,
    },
}


def _removing(soft: float, hard: float) -> dict[str, float]:
    return {"prune.soft": soft, "prune.hard": hard}


RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": _removing(0.85, 0.50),
    "r2": _removing(0.80, 0.40),
    "r3": _removing(0.80, 0.30),  # published
    "r4": _removing(0.70, 0.25),
    "r5": _removing(0.60, 0.20),
    "r6": _removing(0.50, 0.10),
}
