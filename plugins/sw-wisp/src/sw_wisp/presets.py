"""Named configurations of wisp, and its rate points."""

from collections.abc import Mapping
from typing import Any

GROWN: Mapping[str, Any] = {
    "pretrained.preset": "mcmc",
    "pretrained.iterations": 12_000,
    "pretrained.scale_schedule": True,
    "pretrained.density.settings.cap": "none",
}
"""The scene that it starts from: grown by MCMC to more splats than stay, since removal beats growth."""

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": GROWN,
    # Half the steps after a scene of preset `fast` of 3dgs.
    "fast": {"pretrained.preset": "fast", "iterations": 9_000, "scale_schedule": True},
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
    "r1": {"rate_term.lambda_": 4e-4, "budget.cap_factor": 0.5, "positions.eta": 0.8},
    "r2": {"rate_term.lambda_": 2e-4, "budget.cap_factor": 0.65, "positions.eta": 0.65},
    "r3": {"rate_term.lambda_": 1e-4, "budget.cap_factor": 0.8, "positions.eta": 0.5},
    "r4": {"rate_term.lambda_": 5e-5, "budget.cap_factor": 1.0, "positions.eta": 0.42},
    "r5": {"rate_term.lambda_": 2.5e-5, "budget.cap_factor": 1.25, "positions.eta": 0.35},
}
