"""Named configurations, and the rate points: how much is removed."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The plan of the Splatwizard paper.
    "paper": {},
    # As the authors' code, which densifies from step 600 on.
    "inria": {"base.preset": "inria"},
    # 3DGS' plan for a CPU and the demo scene.
    "quick": {
        "base.preset": "quick",
        "iterations": 2000,
        "prune.start": 400,
        "prune.stop": 1_900,
        "prune.interval": 200,
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
