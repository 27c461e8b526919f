"""Named configurations, and the rate points."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The authors' settings for Mip-NeRF 360.
    "paper": {},
    "tandt": {"voxel_size": 0.01},
    "db": {"voxel_size": 0.005, "context.refine": True, "context.slices": [12, 12, 13, 13]},
    "bungee": {"voxel_size": 0.0, "growth.init_factor": 128, "rate.view_factor": 25.0, "lr.max_steps": 30_000},
    # The plan and the networks scaled down for a CPU and the demo scene: some 8,000 anchors, of whose file the
    # published networks would be most. Step sizes are larger, since there are few steps; base steps fit larger voxels.
    "quick": {
        "iterations": 2000,
        "voxel_size": 0.01,
        "feature_dim": 40,
        "num_offsets": 8,
        "hidden": 40,
        "lr.max_steps": 2000,
        "lr.features": 0.02,
        "lr.scales": 0.015,
        "lr.mlp_opacity_init": 0.006,
        "lr.mlp_cov_init": 0.01,
        "lr.mlp_cov_final": 0.001,
        "lr.mlp_color_init": 0.016,
        "growth.start": 100,
        "growth.pause_start": 400,
        "growth.pause_end": 450,
        "growth.stop": 900,
        "growth.start_stat": 20,
        "growth.interval": 50,
        "growth.success": 0.2,
        "growth.grad_threshold": 3e-4,
        "phases.quantize": 400,
        "phases.triplane": 550,
        "phases.warmup": 900,
        "phases.scene": 930,
        "phases.planes": 1000,
        "steps.scales": 0.004,
        "context.channels": 24,
        "context.hidden": 48,
        "context.slices": [4, 8, 12, 16],
        "context.slice_hidden": 32,
        "context.units": "steps",
        "rate.scale": 0.5,
        "rate.triplane_sample": 0.25,
        "codec.weights": "float16",
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    f"r{i}": {"rate.lambda_": value} for i, value in enumerate((0.04, 0.03, 0.015, 0.01, 0.004, 0.002), 1)
}
