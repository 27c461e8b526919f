"""The presets `fast` and `fast-cpu` of methods that train Gaussians from points: one plan for all scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SHORT, LONG = 0.4, 0.8
"""Shares of the full plan up to which a run counts as short, and from which as long."""


def rate_factors(share: float) -> dict[str, float]:
    """Return by what two learning rates of the full plan are multiplied in a run of a share of its steps, > 0.

    A short run ends with larger steps of the means, for they have less time to arrive; up to a long one the factor is
    log-interpolated. SH bands 1 to 3 move twice as fast in all that is not long.

    Source: LiteGS (arXiv 2503.01199), whose values are those of a third of the plan and of the whole; between: our own.
    """
    q = min(max((share - SHORT) / (LONG - SHORT), 0.0), 1.0)
    return {"lr.position_final": 10.0 ** (1 - q), "lr.sh_rest": 2.0 if share < LONG else 1.0}


FAST: Mapping[str, Any] = {
    "iterations": 9_000,
    "scale_schedule": True,  # all plans below are in steps of 30,000
    "sh_interval": 3_000,
    "lr.opacity": 0.025,
    "densify.start": 900,
    "densify.stop": 24_000,
    "densify.interval": 810,
    "densify.reset_interval": 6_000,
    "fast.average": 0.1,
    "fast.densify": "budget",
    "fast.score": "gradient",  # better in equal seconds than the variance of opacity gradients
    "fast.growth": 2.0,
    "fast.opacity": "halve",
    "fast.morton": True,
    "fast.rates": "length",
}
"""Steps, growth and learning rates of fast training; `iterations` scales all of it.

Source: LiteGS (arXiv 2503.01199), with new Gaussians bounded by twice what plain density control would copy: on a room
(400x266, seed 0) 32.14 dB with 766,000 Gaussians, without the bound 32.18 dB with 1,000,000. What each part brings: the
README of sw-3dgs.
"""

FAST_CPU: Mapping[str, Any] = {
    **FAST,
    "iterations": 2_400,
    "lr.position_init": 8e-4,
    "lr.sh_dc": 1e-2,
    "lr.sh_rest": 1e-3,
    "lr.opacity": 0.05,
    "lr.scales": 1e-2,
    "lr.quats": 2e-3,
    "densify.stop": 18_000,
    "densify.interval": 750,
    "densify.reset_interval": 30_000,  # never: a short run does not recover from what a long one gains by
    "fast.cap": 80_000,
    "fast.opacity": "reset",
    "fast.resolution": "dash",
}
"""`fast` for two cores: few steps, as large as those of `quick`, and no more Gaussians than such a run can fit.

Two thirds of a step on a CPU are blending, which grows with pixels and Gaussians; hence small pictures at first
(DashGaussian, arXiv 2503.18402). What each part brings: docs/methods/3dgs.md.
"""
