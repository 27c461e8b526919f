"""Named configurations, and the rate points: the paper's five values of lambda."""

from collections.abc import Mapping
from typing import Any

from sw_anchors.grid_quick import QUICK

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "quick": {
        **QUICK,
        "voxel_size": 0.08,
        "growth.init_factor": 2,
        "growth.subvoxel": True,
        "rate_term.masks": 0.002,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"rate_term.weight": 0.004},
    "r2": {"rate_term.weight": 0.003},
    "r3": {"rate_term.weight": 0.002},
    "r4": {"rate_term.weight": 0.001},
    "r5": {"rate_term.weight": 0.0005},
}
