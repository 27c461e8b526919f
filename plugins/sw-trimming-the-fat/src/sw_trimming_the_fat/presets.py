"""Named configurations, and the rate points: the level below which Gaussians go."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The plan of the Splatwizard paper.
    "paper": {},
    # As the authors' code but for one step: its length, its removals, and the gradients that 3DGS has left.
    "official": {"iterations": 10_000, "prune.start": 1, "prune.statistics": "checkpoint"},
    # For a CPU and the demo scene: one pass over its 60 views before the first of the ten removals, step sizes of the
    # quick preset of 3dgs where that ends.
    "quick": {
        "iterations": 1500,
        "prune.window": 60,
        "prune.start": 61,
        "prune.stop": 561,
        "prune.interval": 50,
        "lr.position_init": 8e-6,
        "lr.position_final": 8e-6,
        "lr.sh_dc": 1e-2,
        "lr.sh_rest": 1e-3,
        "lr.scales": 1e-2,
        "lr.quats": 2e-3,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"prune.level": 0.60},
    "r2": {"prune.level": 0.50},
    "r3": {"prune.level": 0.425},  # published default of the Splatwizard paper
    "r4": {"prune.level": 0.35},
    "r5": {"prune.level": 0.30},
    "r6": {"prune.level": 0.225},
}
