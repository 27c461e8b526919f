"""Named configurations, and the rate points: how strongly Gaussians are taken out, and the smallest grid."""

from collections.abc import Mapping
from typing import Any

SYNTHETIC: Mapping[str, Any] = {
    "grid.log2_size": 16,
    "mask.weight": 4e-3,
    "mask.lr": 1e-3,
    "network.lr": 1e-3,
    "network.lr_steps": [25_000],
    # Ours: grids that were trained with a tenth of the step size hold smaller values, of which the authors' threshold
    # of 0.1 takes too many. Longer steps cost less for the same bytes (docs/methods/compact3dgs.md).
    "codec.settings.grid_threshold": 0.0,
    "codec.settings.grid_step": 0.06,
}

BY_DATASET: Mapping[str, Mapping[str, Any]] = {"nerf_synthetic": SYNTHETIC, "dtu": SYNTHETIC}

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The authors' values for real scenes (Mip-NeRF 360, Tanks and Temples, Deep Blending), plan of Splatwizard's paper.
    "paper": {},
    # Their strict comparison makes 600 the first densification.
    "inria": {"density.settings.start": 600},
    # The authors' values for Synthetic-NeRF and DTU; "paper" has them for scenes that are known to be of these.
    "synthetic": SYNTHETIC,
    # The plan scaled down for a CPU and the demo scene: a small grid, step sizes for few steps, codebooks of 4 stages.
    "quick": {
        "iterations": 1800,
        "lr.max_steps": 1800,
        "lr.position_init": 8e-4,
        "lr.position_final": 8e-6,
        "lr.scales": 1e-2,
        "lr.quats": 2e-3,
        "density.settings.start": 200,
        "density.settings.stop": 1000,
        "density.settings.grad_threshold": 4e-4,
        "mask.lr": 0.08,
        "mask.interval": 100,
        "grid.levels": 8,
        "grid.growth": 1.6,
        "grid.log2_size": 14,
        "network.lr_steps": [800, 1200, 1600],
        "rvq.start": 1700,
        "rvq.stages": 4,
        "codec.settings.grid_threshold": 0.05,
    },
}

# Of the weight of the preset: 5e-4 for real scenes, 4e-3 for synthetic ones.
RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"mask.factor": 8.0, "grid.halvings": 2, "codec.settings.grid_factor": 2.0},
    "r2": {"mask.factor": 4.0, "codec.settings.grid_factor": 2.0},
    "r3": {"mask.factor": 2.0, "codec.settings.grid_factor": 2.0},
    "r4": {"mask.factor": 1.0, "codec.settings.grid_factor": 2.0},  # the training of r5 in a smaller file
    "r5": {"mask.factor": 1.0},  # published, with post-processing
    "r6": {"mask.factor": 0.5},
    "r7": {"mask.factor": 1.0, "codec.settings.pp": False},  # published, without post-processing
}
