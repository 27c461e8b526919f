"""Named configurations, and the rate points: the paper's five values of lambda."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "quick": {},
}

RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": {"rate.weight": 0.004},
    "r2": {"rate.weight": 0.003},
    "r3": {"rate.weight": 0.002},
    "r4": {"rate.weight": 0.001},
    "r5": {"rate.weight": 0.0005},
}
