"""Presets (named configurations) and rate points of 3DGS."""

from collections.abc import Mapping
from typing import Any

from sw_gaussians.quick import QUICK as FROM_POINTS

from sw_codecs.models.rate_points import QUANTIZED_RATES

FAST: Mapping[str, Any] = {
    "iterations": 9_000,
    "scale_schedule": True,  # all plans below are in steps of 30,000
    "sh_interval": 3_000,
    "lr.opacity": 0.025,
    "density": "budget",
    "density.settings.start": 900,
    "density.settings.stop": 24_000,
    "density.settings.interval": 810,
    "density.settings.reset_interval": 6_000,
    "fast.average": 0.1,
    "density.settings.score": "gradient",  # better in equal seconds than the variance of opacity gradients
    "density.settings.growth": 2.0,
    "density.settings.opacity": "halve",
    "density.settings.morton": True,
    "fast.rates": "length",
}
"""Steps, growth and learning rates of fast training; `iterations` scales all of it.

Source: LiteGS (arXiv 2503.01199), with at most twice as many new Gaussians as plain density control would copy. On a
room (400x266, seed 0): 32.14 dB with 766,000 Gaussians, without the bound 32.18 dB with 1,000,000. The README of
sw-3dgs lists the effect of each part.
"""

FAST_CPU: Mapping[str, Any] = {
    **FAST,
    "iterations": 1_400,
    "lr.position_init": 2.4e-3,
    "lr.sh_dc": 3e-2,
    "lr.sh_rest": 3e-3,
    "lr.opacity": 0.05,
    "lr.scales": 3e-2,
    "lr.quats": 6e-3,
    "lr.beta2": 0.98,
    "density.settings.stop": 18_000,
    "density.settings.interval": 750,
    "density.settings.reset_interval": 30_000,  # never: a short run does not recover from what a long one gains by
    "density.settings.cap": 80_000,
    "density.settings.opacity": "reset",
    "pictures.schedule": "dash",
}
"""`fast` for two cores: few steps, the learning rates of `quick`, few Gaussians.

Two thirds of a step on a CPU are blending, which grows with pixels and Gaussians; hence small images at first
(DashGaussian, arXiv 2503.18402). docs/methods/3dgs.md lists the effect of each part.
"""

QUICK: Mapping[str, Any] = {
    **FROM_POINTS,
    "iterations": 1_100,
    "sh_interval": 80,
    "lr.max_steps": 1_100,
    "lr.position_init": 2.4e-3,
    "lr.position_final": 2.4e-5,
    "lr.sh_dc": 3e-2,
    "lr.scales": 3e-2,
    "lr.quats": 6e-3,
    "lr.beta2": 0.98,
    "density.settings.start": 110,
    "density.settings.stop": 660,
    "density.settings.interval": 55,
    "density.settings.grad_threshold": 3e-4,
    "fast.average": 0.1,
    "pictures.schedule": "dash",
}
"""The quick plan of methods that train from points, in little more than half of its steps.

Rates are larger, and Adam forgets squared gradients within fifty steps, not a thousand: of so short a run those of the
first steps would be in force to its end. docs/methods/3dgs.md lists the effect of each part.
"""

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The plan of the Splatwizard paper; hyper-parameters of the 3DGS authors' code of 2023.
    "paper": {},
    # Exactly the authors' code of 2023: its strict comparison makes 600 the first densification.
    "inria": {"density.settings.start": 600},
    # The authors' code after October 2024; its exposure compensation is off, as it is there by default.
    "inria2024": {"density.settings.start": 600, "lr.opacity": 0.025, "clamp_render": True},
    # AbsGS (arXiv 2404.10484) with the threshold that gsplat suggests.
    "absgrad": {"density.settings.absgrad": True, "density.settings.grad_threshold": 8e-4},
    # 3DGS-MCMC (arXiv 2404.09591): density control by relocation and noise up to `density.settings.cap` Gaussians.
    "mcmc": {"density": "mcmc"},
    # A third of the steps: density control by budget and score, opacities halved instead of reset.
    "fast": FAST,
    # The same with few, larger steps and a low cap: photographs on a CPU, in minutes.
    "fast-cpu": FAST_CPU,
    "quick": QUICK,
}

RATES = QUANTIZED_RATES
