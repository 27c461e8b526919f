"""Named configurations of wisp, and its rate points."""

from collections.abc import Mapping
from typing import Any

PHOTOGRAPHS: Mapping[str, Any] = {"pretrained.preset": "fast", "budget.density": 6e-3}
"""Photographs: few splats per training pixel, since more of them fit what other views do not show."""

GROWN: Mapping[str, Any] = {
    "pretrained.preset": "mcmc",
    "pretrained.iterations": 12_000,
    "pretrained.scale_schedule": True,
    "pretrained.density.settings.cap": "none",
    "budget.density": 1.0,
}
"""A scene that MCMC grows to more splats than stay, since removal beats growth: for scenes without noise."""

BY_DATASET: Mapping[str, Mapping[str, Any]] = dict.fromkeys(("nerf_synthetic", "blender", "demo"), GROWN)
"""Rendered scenes. Of photographs MCMC's splats fit the training views and hang in the air before the others."""

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": PHOTOGRAPHS,
    # Half the steps.
    "fast": {**PHOTOGRAPHS, "iterations": 9_000, "scale_schedule": True},
    # A CPU and the demo scene: a fifteenth of the steps, three removals; larger step sizes, since there are few steps,
    # and small networks, since there are few splats.
    "quick": {
        "iterations": 1_200,
        "scale_schedule": True,
        "prune.every": 4_000,
        "context.networks": "small",
        "context.rebuild": 600,
        "context.fit": 400,
        "lr.means.first": 8e-5,
        "lr.means.last": 8e-6,
        "lr.shape.first": 8e-3,
        "lr.colour.first": 8e-3,
        "lr.latents.first": 1e-2,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"rate_term.lambda_": 8e-4, "budget.cap_factor": 0.4, "positions.eta": 0.95},
    "r2": {"rate_term.lambda_": 3e-4, "budget.cap_factor": 0.57, "positions.eta": 0.7},
    "r3": {"rate_term.lambda_": 1e-4, "budget.cap_factor": 0.8, "positions.eta": 0.5},
    "r4": {"rate_term.lambda_": 5e-5, "budget.cap_factor": 1.0, "positions.eta": 0.42},
    "r5": {"rate_term.lambda_": 2.5e-5, "budget.cap_factor": 1.25, "positions.eta": 0.35},
}
