"""Named configurations, one a family of data sets, and the rate points: the configurations of the authors."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The values of a scene are found by its name in any family.
    "paper": {},
    "nerf_synthetic": {"authors.family": "nerf_synthetic"},
    "mipnerf360": {"authors.family": "mipnerf360"},
    "tandt": {"authors.family": "tandt"},
    "db": {"authors.family": "db"},
    # For a CPU and the demo scene: fewer and larger steps, since the scene itself was trained for 2,000 only; a smaller
    # codebook by k-means; coarser positions.
    "quick": {
        "iterations": 600,
        "scale_schedule": True,
        "lr.factor": 1.0,
        "lr.final": 0.1,
        "codec.settings.depth": 14,
        "codec.settings.vq_training": "kmeans",
        "codec.settings.vq_steps": 20,
        "codec.settings.rows_per_code": 16,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"authors.point": "tk-c1"},
    "r2": {"authors.point": "c3"},
    "r3": {"authors.point": "c2"},
    "r4": {"authors.point": "c1"},
}
