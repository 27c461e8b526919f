"""Named configurations, the authors' values by data set, and the rate points: the authors' five values of lambda."""

from collections.abc import Mapping
from typing import Any

from sw_anchors.dataset_values import BY_DATASET as HAC_VALUES

_OWN: Mapping[str, Mapping[str, Any]] = {
    "tandt": {"lr.masks_by_rate": 0.1},
    "db": {"lr.masks_by_rate": 0.08},
    "bungee": {"lr.masks_by_rate": 0.1},
    "nerf_synthetic": {"lr.masks_by_rate": 0.08, "channel.kind": "tiny"},
}

BY_DATASET: Mapping[str, Mapping[str, Any]] = {name: {**values, **_OWN[name]} for name, values in HAC_VALUES.items()}

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # The plan of HAC's preset of this name; voxels are finer, since anchors lie on their lattice.
    "quick": {
        "iterations": 3000,
        "voxel_size": 0.01,
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
        "growth.grad_threshold": 4e-4,
        "phases.quantized": 600,
        "phases.rebound": 899,
        "phases.entropy": 900,
        "rate_term.start": "statistics",
        "rate_term.units": "steps",
        "steps.features": 0.5,
        "steps.scales": 0.004,
        "channel.slices": [8, 8, 8],
        "channel.hidden": 24,
        "lr.max_steps": 3000,
        "lr.features": 0.02,
        "lr.scales": 0.014,
        "lr.masks_final": 0.004,
        "lr.mlp_opacity_init": 0.004,
        "lr.mlp_opacity_final": 4e-4,
        "lr.mlp_color_final": 1e-3,
        "lr.mlp_cov_final": 5e-4,
        "lr.grid_init": 0.02,
        "lr.grid_final": 1e-3,
        "lr.mlp_grid_init": 0.01,
        "lr.mlp_grid_final": 5e-4,
        "lr.channel_init": 0.01,
        "codec.settings.weights": "float16",
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    f"r{i}": {"rate_term.weight": weight} for i, weight in enumerate((0.004, 0.003, 0.002, 0.001, 0.0005), 1)
}
