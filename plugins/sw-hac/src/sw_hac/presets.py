"""Named configurations, the authors' values by data set, and the rate points: the paper's five values of lambda."""

from collections.abc import Mapping
from typing import Any

from sw_anchors.params import RANDOM_START

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
}
"""Preset `quick` as far as HAC++ shares it: the plan scaled down for a CPU and the demo scene.

A tenth of the steps takes larger updates, a prediction that starts where the values are, and base steps for scales of a
twentieth; networks and grids of the published size would be most of so small a file.
"""

_RATE_START: Mapping[str, Any] = {"rate_term.start": "statistics", "rate_term.scale_floor": 0.05}
"""A rate that every number learns: as published, one whose deviation starts negative stays at 20 bits for good."""

BY_DATASET: Mapping[str, Mapping[str, Any]] = {
    "tandt": {"voxel_size": 0.01},
    "db": {"voxel_size": 0.005},
    "bungee": {"voxel_size": 0.0, "growth.init_factor": 128},
    "nerf_synthetic": {"growth.init_factor": 4, "background": "black", **RANDOM_START, **_RATE_START},
    "blender": {**RANDOM_START, **_RATE_START},
}
"""Values that the authors of HAC and HAC++ set by data set, keys of the scene included; the rest is Mip-NeRF 360's.

Source: HAC (arXiv 2403.14530) and HAC++ (arXiv 2501.12255), the scripts of both; `RANDOM_START` is ours. The split of
BungeeNeRF that goes with them is that of its family (sw-datasets).
"""

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "quick": {
        **QUICK,
        "voxel_size": 0.08,
        "growth.init_factor": 2,
        "growth.subvoxel": True,
        "rate_term.masks": 0.002,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"rate_term.weight": 0.004},
    "r2": {"rate_term.weight": 0.003},
    "r3": {"rate_term.weight": 0.002},
    "r4": {"rate_term.weight": 0.001},
    "r5": {"rate_term.weight": 0.0005},
}
