"""Preset `quick` of methods that train from points: a short schedule for a CPU and the demo scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

QUICK: Mapping[str, Any] = {
    "iterations": 2000,
    "sh_interval": 150,
    "lr.max_steps": 2000,
    "lr.position_init": 8e-4,
    "lr.position_final": 8e-6,
    "lr.sh_dc": 1e-2,
    "lr.sh_rest": 1e-3,
    "lr.scales": 1e-2,
    "lr.quats": 2e-3,
    "density.settings.start": 200,
    "density.settings.stop": 1200,
    "density.settings.grad_threshold": 4e-4,
}
"""No opacity reset; larger learning rates, since there are few steps.

3DGS reaches 34.3 dB with it on `demo` with 25,000 Gaussians, against 31.6 dB at the paper's learning rates
(2,000 and 1,500 steps).
"""

LONGER: Mapping[str, Any] = {
    **{key: value for key, value in QUICK.items() if key != "iterations"},
    "lr.beta2": 0.999,
    "density.settings.interval": 100,
    "fast.average": 0,
    "pictures.schedule": "none",
}
"""Preset `quick` of 3dgs but for its length, as it was when run directories that go on now only named it."""
