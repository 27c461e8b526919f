"""Named configurations, and the rate points."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The authors' settings for Mip-NeRF 360.
    "paper": {},
    "tandt": {"voxel_size": 0.01},
    "db": {"voxel_size": 0.005, "context.refine": True, "context.slices": [12, 12, 13, 13]},
    "bungee": {"voxel_size": 0.0, "growth.init_factor": 128, "rate.view_factor": 25.0, "lr.max_steps": 30_000},
    # The plan and the networks scaled down for a CPU and the demo scene, where 5,000 to 10,000 anchors suffice and
    # the published networks would be most of a file.
    "quick": {
        "iterations": 1500,
        "voxel_size": 0.01,
        "feature_dim": 32,
        "num_offsets": 6,
        "hidden": 32,
        "lr.max_steps": 1500,
        "growth.start": 100,
        "growth.pause_start": 200,
        "growth.pause_end": 250,
        "growth.stop": 700,
        "growth.start_stat": 20,
        "growth.interval": 50,
        "growth.success": 0.2,
        "phases.quantize": 200,
        "phases.triplane": 400,
        "phases.warmup": 700,
        "phases.scene": 730,
        "phases.planes": 800,
        "context.channels": 24,
        "context.hidden": 48,
        "context.slices": [4, 6, 10, 12],
        "context.slice_hidden": 32,
        "rate.triplane_sample": 0.25,
        "codec.weights": "float16",
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    f"r{i}": {"rate.lambda_": value} for i, value in enumerate((0.04, 0.03, 0.015, 0.01, 0.004, 0.002), 1)
}
