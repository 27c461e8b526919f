"""Preset `quick` of HAC and HAC++ as far as both share it: the plan scaled down for a CPU and the demo scene.

A tenth of the steps takes larger updates, a prediction that starts where the values are, and base steps for scales of a
twentieth; networks and grids of the published size would be most of so small a file.
"""

from collections.abc import Mapping
from typing import Any

QUICK: Mapping[str, Any] = {
    "iterations": 3000,
    "num_offsets": 8,
    "feature_dim": 24,
    "hidden": 64,
    "grid.hidden": 48,
    "grid.space": [18, 33, 59, 108],
    "grid.planes": [34, 66, 130],
    "grid.log2_space": 11,
    "grid.log2_planes": 11,
    "growth.start": 150,
    "growth.pause_start": 700,
    "growth.pause_end": 700,
    "growth.stop": 700,
    "growth.start_stat": 50,
    "growth.interval": 50,
    "growth.grad_threshold": 0.0004,
    "phases.quantized": 600,
    "phases.rebound": 899,
    "phases.entropy": 900,
    "rate_term.start": "statistics",
    "rate_term.units": "steps",
    "steps.features": 0.5,
    "steps.scales": 0.004,
    "lr.max_steps": 3000,
    "lr.features": 0.02,
    "lr.scales": 0.014,
    "lr.masks_final": 0.004,
    "lr.mlp_opacity_init": 0.004,
    "lr.mlp_opacity_final": 0.0004,
    "lr.mlp_color_final": 0.001,
    "lr.mlp_cov_final": 0.0005,
    "lr.grid_init": 0.02,
    "lr.grid_final": 0.001,
    "lr.mlp_grid_init": 0.01,
    "lr.mlp_grid_final": 0.0005,
    "codec.settings.weights": "float16",
}
