"""Named configurations, and the rate points: how much goes, and how much view dependence stays."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # The student densifies as the authors' code does, from step 600 on.
    "inria": {"student.preset": "inria"},
    # For a CPU and the demo scene.
    "quick": {
        "iterations": 2500,
        "student.preset": "quick",
        "distill.iterations": 1000,
        "vq.size": 1024,
        "vq.training": "kmeans",
        "vq.iterations": 20,
        "xyz": "uniform16",
    },
}


def _point(soft: float, hard: float, mask_weight: float) -> dict[str, float]:
    return {"train.soft": soft, "train.hard": hard, "mask.weight": mask_weight}


RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": _point(0.80, 0.40, 2e-2),
    "r2": _point(0.80, 0.30, 1e-2),
    "r3": _point(0.70, 0.20, 1e-2),
    "r4": _point(0.50, 0.10, 5e-3),
}
