"""Named configurations, and the rate points of the file."""

from collections.abc import Mapping
from typing import Any

from sw_gaussians.fast import FAST, FAST_CPU
from sw_gaussians.quick import QUICK

from sw_codecs.models.rate_points import QUANTIZED_RATES

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The plan of the Splatwizard paper; hyper-parameters of the 3DGS authors' code of 2023.
    "paper": {},
    # Exactly the authors' code of 2023: its strict comparison makes 600 the first densification.
    "inria": {"densify.start": 600},
    # The authors' code after October 2024; its exposure compensation is off, as it is there by default.
    "inria2024": {"densify.start": 600, "lr.opacity": 0.025, "clamp_render": True},
    # AbsGS (arXiv 2404.10484) with the threshold that gsplat suggests.
    "absgrad": {"densify.absgrad": True, "densify.grad_threshold": 8e-4},
    # 3DGS-MCMC (arXiv 2404.09591): density control by relocation and noise up to `mcmc.cap` Gaussians.
    "mcmc": {"mcmc.enabled": True},
    # A third of the steps: density control by budget and score, opacities halved instead of reset.
    "fast": FAST,
    # The same with few, larger steps and a low cap: photographs on a CPU, in minutes.
    "fast-cpu": FAST_CPU,
    "quick": QUICK,
}

RATES = QUANTIZED_RATES
