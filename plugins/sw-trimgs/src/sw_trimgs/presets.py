"""Named configurations of the methods on ellipsoids, and the rate points of all of this package."""

from collections.abc import Mapping
from typing import Any

from sw_gaussians.quick import QUICK

from sw_codecs.models.rate_points import QUANTIZED_RATES

FLAT_PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "quick": QUICK,
}

# A tenth of the plan for a CPU and the demo scene, with smaller steps of the means, larger ones else, and no reset.
# The last 200 steps let it settle.
QUICK_TUNE: Mapping[str, Any] = {
    "iterations": 700,
    "scale_schedule": True,
    "densify.reset_interval": 0,
    "densify.stop": 5000,
    "lr.position_init": 4e-5,
    "lr.position_final": 8e-6,
    "lr.sh_dc": 1e-2,
    "lr.sh_rest": 1e-3,
    "lr.scales": 1e-2,
    "lr.quats": 2e-3,
}

# The background of the demo scene is black and empty. The published normal loss falls as black surfels cover it, which
# no picture forbids: a skirt of them grows around the stage. A pixel is 0.014 wide at the distance of the cameras,
# so that 0.03 a pixel would leave out three quarters of the true surface as edges.
_DEMO_NORMALS: Mapping[str, Any] = {"surface.normal_term": "paper", "surface.edge_threshold": 0.2}

_MIPNERF360: Mapping[str, Any] = {
    "lr.position_init": 1.6e-6,
    "densify.interval": 1000,
    "densify.reset_interval": 0,
    "trim.after": 0,
    "trim.interval": 1000,
}

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # The authors' scripts, by data set. Scenes of DTU with values of their own: docs/methods/trim-3dgs.md.
    "dtu": {
        "densify.mode": "mix",
        "densify.factor": 2.0,
        "normals.weight": 0.05,
        "normals.after": 5000,
        "normals.reach": 3,
    },
    "mipnerf360-outdoor": {**_MIPNERF360, "normals.weight": 0.1},
    "mipnerf360-indoor": {**_MIPNERF360, "normals.weight": 0.01},
    "quick": QUICK_TUNE,
}

SURFEL_PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # The authors' scripts, by data set; scan63 of DTU starts the means at 1.6e-6.
    "dtu": {
        "densify.mode": "mix",
        "trim.interval": 100,
        "surface.lambda_dist": 1000.0,
        "surface.depth_ratio": 1.0,
        "drop_masked": True,
    },
    "mipnerf360": {"densify.size_px": 100},
    "tnt": {
        "lr.position_init": 1.6e-6,
        "densify.reset_interval": 0,
        "trim.interval": 300,
        "surface.edge_threshold": 0.0,
        "surface.depth_ratio": 1.0,
    },
    "tnt-large": {
        "lr.position_init": 1.6e-6,
        "densify.reset_interval": 0,
        "trim.interval": 300,
        "surface.edge_threshold": 0.0,
        "surface.depth_ratio": 1.0,
        "surface.lambda_dist": 10.0,
    },
    # Surfels of 2,000 steps are larger than the published limits expect, which would split nearly all of them at once:
    # with those the scene doubles before it is trimmed, and its surface gets less complete.
    "quick": {**QUICK_TUNE, "densify.factor": 4.0, "densify.size_px": 40, **_DEMO_NORMALS},
}

SCRATCH_PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "dtu": {"trim.interval": 100, "surface.lambda_dist": 1000.0},
    # The quick plan of 2dgs, which ends its densification at step 1,200 of 2,000.
    "quick": {
        "base.preset": "quick",
        "iterations": 2000,
        "densify.interval": 100,
        "densify.start": 200,
        "densify.stop": 1200,
        "densify.factor": 2.0,
        "trim.after": 200,
        "trim.interval": 100,
        "trim.stop": 1200,
        "surface.normal_after": 500,
        **_DEMO_NORMALS,
    },
}

# The steps are those of 3dgs.
RATES = QUANTIZED_RATES
