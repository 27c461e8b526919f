"""Named configurations, and the rate points: how much is pruned."""

from collections.abc import Mapping
from typing import Any


def _quick_rates(stage: str, **rates: float) -> dict[str, float]:
    return {f"{stage}.lr.{name}": rate for name, rate in rates.items()}


PRESETS: Mapping[str, Mapping[str, Any]] = {
    # About what the authors' counters come to: sums over all pixels, which those were meant to be, let large Gaussians
    # push out the small ones that recovery needs (docs/methods/lightgaussian.md).
    "paper": {"prune.settings.kind": "v_tile_score", "score.settings.kind": "v_tile_score"},
    # For a CPU and the demo scene: a fifth of the steps with larger rates, since the scene itself was trained for 2,000
    # only and has not settled; and a codebook of at most 1,024 entries by k-means in place of 8,192 by batches.
    "quick": {
        "iterations": 1000,
        "scale_schedule": True,
        **_quick_rates(
            "prune", position_init=4e-4, position_final=8e-6, position_offset=0, max_steps=5000,
            sh_dc=1e-2, sh_rest=1e-3, scales=1e-2, quats=2e-3,
        ),
        **_quick_rates(
            "distill", position_init=2e-4, position_final=8e-6, position_offset=0, max_steps=5000,
            sh_dc=1e-2, sh_rest=6e-3, scales=1e-2, quats=2e-3,
        ),
        "codec.settings.size": 1024,
        "codec.settings.training": "kmeans",
        "codec.settings.iterations": 20,
    },
}  # fmt: skip

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"prune.percent": 0.85},
    "r2": {"prune.percent": 0.75},
    "r3": {"prune.percent": 0.66},
    "r4": {"prune.percent": 0.60},
    "r5": {"prune.percent": 0.50},
}
