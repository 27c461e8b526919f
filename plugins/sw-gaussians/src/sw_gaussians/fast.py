"""The presets `fast` and `fast-cpu` of methods that train Gaussians from points: one plan for all scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FAST: Mapping[str, Any] = {
    "iterations": 10_000,
    "scale_schedule": True,  # all plans below are in steps of 30,000
    "sh_interval": 3_000,
    "lr.position_final": 1.6e-5,
    "lr.sh_rest": 2.5e-4,
    "lr.opacity": 0.025,
    "densify.start": 900,
    "densify.stop": 24_000,
    "densify.interval": 750,
    "densify.reset_interval": 6_000,
    "fast.densify": "budget",
    "fast.growth": 2.0,
    "fast.opacity": "halve",
    "fast.morton": True,
}
"""Steps, growth and learning rates of fast training; `iterations` scales all of it.

Source: LiteGS (arXiv 2503.01199), with new Gaussians bounded by twice what plain density control would copy: on a room
(400x266, seed 0) a bound of once gives 31.54 dB with 526,000 Gaussians, twice 31.94 dB with 823,000, none 31.66 dB with
1,000,000 (benchmarks/time_to_quality.py).
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
    "densify.reset_interval": 30_000,  # never: a short run does not recover from what a long one gains by
    "fast.cap": 80_000,
    "fast.opacity": "reset",
    "fast.resolution": "dash",
}
"""`fast` for two cores: few steps, as large as those of `quick`, and no more Gaussians than such a run can fit.

Two thirds of a step on a CPU are blending, which grows with pixels and Gaussians; hence small pictures at first
(DashGaussian, arXiv 2503.18402). What each part brings: docs/methods/3dgs.md.
"""
