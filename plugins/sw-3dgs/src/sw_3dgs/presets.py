"""Named configurations, and the rate points of the file."""

from collections.abc import Mapping
from typing import Any

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
    # The plan scaled down for a CPU and the demo scene, with no opacity reset and larger steps, since there are few:
    # 34.3 dB there with 25,000 Gaussians, against 31.6 dB at the paper's rates (2,000 and 1,500 steps).
    "quick": {
        "iterations": 2000,
        "sh_interval": 150,
        "lr.max_steps": 2000,
        "lr.position_init": 8e-4,
        "lr.position_final": 8e-6,
        "lr.sh_dc": 1e-2,
        "lr.sh_rest": 1e-3,
        "lr.scales": 1e-2,
        "lr.quats": 2e-3,
        "densify.start": 200,
        "densify.stop": 1200,
        "densify.grad_threshold": 4e-4,
    },
}

RATES = QUANTIZED_RATES
