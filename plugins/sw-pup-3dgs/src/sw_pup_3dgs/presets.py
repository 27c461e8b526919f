"""Named configurations, and the rate points: what the two rounds remove."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # Step sizes of the Splatwizard paper's code: constant.
    "splatwizard": {"lr.position_init": 1.6e-6, "lr.decay": 1.0},
    # For a CPU and the demo scene: rounds of 500 steps that go on from the quick preset of 3dgs at its step sizes.
    "quick": {
        "iterations": 1000,
        "prune.steps": [1, 501],
        "lr.position_init": 8e-4,
        "lr.position_final": 8e-6,
        "lr.position_offset": 2000,
        "lr.max_steps": 2500,
        "lr.sh_dc": 1e-2,
        "lr.sh_rest": 1e-3,
        "lr.scales": 1e-2,
        "lr.quats": 2e-3,
        "lr.decay_interval": 40,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"prune.fractions": [0.8, 0.75]},  # 95 % in all
    "r2": {"prune.fractions": [0.8, 0.625]},  # 92.5 %
    "r3": {"prune.fractions": [0.8, 0.5]},  # 90 %, as published
    "r4": {"prune.fractions": [0.7, 0.5]},  # 85 %
    "r5": {"prune.fractions": [0.6, 0.5]},  # 80 %
    "r6": {"prune.fractions": [0.4, 1 / 3]},  # 60 %
}
