"""Named configurations, and the rate points: how sensitive a colour or shape must be to keep an entry of its own."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # For a CPU and the demo scene, whose Gaussians are a hundredth as many as those of the published scenes and each a
    # hundred times as sensitive: thresholds to match; small codebooks by passes over all; a tenth of the steps with
    # larger rates, since the scene itself was trained for 2,000 only and has not settled.
    "quick": {
        "iterations": 500,
        "color.threshold": 0.6e-4,
        "shape.threshold": 0.3e-3,
        **{f"{codebook}.{key}": value for codebook in ("color", "shape") for key, value in
           (("size", 1024), ("training", "kmeans"), ("iterations", 15))},
        "lr.position_init": 1e-4,
        "lr.position_final": 4e-6,
        "lr.max_steps": 500,
        "lr.sh_rest": 1e-3,
    },
}  # fmt: skip

# Neither the paper nor the authors' code has a list: factors on the published thresholds, r4.
RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"factors.thresholds": 16, "factors.sizes": 0.5},
    "r2": {"factors.thresholds": 16},
    "r3": {"factors.thresholds": 4},
    "r4": {"factors.thresholds": 1},
    "r5": {"factors.thresholds": 0.25},
}
