"""Rate points of a method whose file is written by `gaussians-quantized`; equal steps make methods comparable."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


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


QUANTIZED_RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": _quantized(13, 0.2, 0.2, 0.6, 0.3, 0.07),
    "r2": _quantized(14, 0.12, 0.1, 0.4, 0.18, 0.04),
    "r3": _quantized(15, 0.07, 0.055, 0.25, 0.1, 0.022),
    "r4": _quantized(16, 0.04, 0.028, 0.15, 0.06, 0.012),
    "r5": _quantized(18, 0.02, 0.012, 0.08, 0.03, 0.007),
    "r6": {"codec.name": "gaussians-exact"},
}
"""Settings by name, smallest file first; steps of the parameters as they are trained, the last one without loss."""
