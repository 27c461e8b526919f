"""Named configurations, and the rate points of the file."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The authors' code; the weights of the surface follow the data set.
    "paper": {},
    # The plan scaled down for a CPU and the demo scene, with no opacity reset and larger steps, as 3DGS' `quick`.
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
        "surface.dist_after": 200,
        "surface.normal_after": 500,
    },
}


def _quantized(bits: int, dc: float, rest: float, opacity: float, scale: float, quat: float) -> dict[str, Any]:
    return {
        "codec.name": "gaussians-quantized",
        "codec.settings.position_bits": bits,
        "codec.settings.dc_step": dc,
        "codec.settings.rest_step": rest,
        "codec.settings.opacity_step": opacity,
        "codec.settings.scale_step": scale,
        "codec.settings.quat_step": quat,
    }


# The steps of 3DGS' rate points, so that the two can be compared.
RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": _quantized(13, 0.2, 0.2, 0.6, 0.3, 0.07),
    "r2": _quantized(14, 0.12, 0.1, 0.4, 0.18, 0.04),
    "r3": _quantized(15, 0.07, 0.055, 0.25, 0.1, 0.022),
    "r4": _quantized(16, 0.04, 0.028, 0.15, 0.06, 0.012),
    "r5": _quantized(18, 0.02, 0.012, 0.08, 0.03, 0.007),
    "r6": {"codec.name": "gaussians-exact"},
}
