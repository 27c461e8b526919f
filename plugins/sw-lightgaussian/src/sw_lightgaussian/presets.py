"""Named configurations, and the rate points: how much is pruned."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # For a CPU and the demo scene: a tenth of the steps, and a smaller codebook that is trained for less.
    "quick": {
        "iterations": 500,
        "scale_schedule": True,
        "codec.codebook_size": 1024,
        "codec.vq_iterations": 200,
        "codec.vq_batch": 8192,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"prune.percent": 0.85},
    "r2": {"prune.percent": 0.75},
    "r3": {"prune.percent": 0.66},
    "r4": {"prune.percent": 0.60},
    "r5": {"prune.percent": 0.50},
}
