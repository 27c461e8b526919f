"""Named configurations, and the rate points."""

from collections.abc import Mapping
from typing import Any

from sw_anchors.params import RANDOM_START

AUTHORS_VALUES: Mapping[str, Mapping[str, Any]] = {
    "tandt": {"voxel_size": 0.01},
    "db": {"voxel_size": 0.005, "context.refine": True, "context.slices": [12, 12, 13, 13]},
    "bungee": {"voxel_size": 0.0, "growth.init_factor": 128, "rate_term.view_factor": 25.0, "lr.max_steps": 30_000},
}
"""Values of the authors' scripts by data set; the rest is Mip-NeRF 360's."""

BY_DATASET: Mapping[str, Mapping[str, Any]] = {
    **AUTHORS_VALUES,
    # The authors have no such scenes. Background and cells as HAC has them there; all weights of the rate a tenth, so
    # that lambda is that of HAC's rate points: an object fills a part of the picture, which lowers the distortion, too.
    "nerf_synthetic": {
        "growth.init_factor": 4,
        "background": "black",
        "rate_term.scale": 0.1,
        "rate_term.mask_floor": 1e-4,
        **RANDOM_START,
    },
    "blender": RANDOM_START,
}
"""Values of preset `paper` by data set."""

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The authors' settings for Mip-NeRF 360.
    "paper": {},
    **AUTHORS_VALUES,
    # The plan and the networks scaled down for a CPU and the demo scene: some 8,000 anchors, of whose file the
    # published networks would be most. Step sizes are larger, since there are few steps; base steps fit larger voxels.
    "quick": {
        "iterations": 3000,
        "voxel_size": 0.01,
        "feature_dim": 32,
        "num_offsets": 8,
        "hidden": 64,
        "lr.max_steps": 3000,
        "lr.features": 0.03,
        "lr.scales": 0.014,
        "lr.masks_final": 0.004,
        "lr.mlp_opacity_init": 0.004,
        "lr.mlp_opacity_final": 2e-4,
        "lr.mlp_cov_final": 5e-4,
        "lr.mlp_color_final": 5e-4,
        "context_lr.final": 5e-4,
        "growth.start": 150,
        "growth.pause_start": 700,
        "growth.pause_end": 700,
        "growth.stop": 700,
        "growth.start_stat": 50,
        "growth.interval": 50,
        "growth.grad_threshold": 4e-4,
        "phases.quantize": 600,
        "phases.triplane": 900,
        "phases.warmup": 1100,
        "phases.scene": 1130,
        "phases.planes": 1200,
        "steps.scales": 0.004,
        "context.channels": 24,
        "context.hidden": 48,
        "context.slices": [4, 6, 10, 12],
        "context.slice_hidden": 32,
        "context.units": "steps",
        "context.start": "statistics",
        "rate_term.scale": 0.25,
        "rate_term.triplane_sample": 0.125,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    f"r{i}": {"rate_term.lambda_": value} for i, value in enumerate((0.04, 0.03, 0.015, 0.01, 0.004, 0.002), 1)
}
