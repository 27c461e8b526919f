"""Named configurations, and the rate points of the file."""

from collections.abc import Mapping
from typing import Any

from sw_codecs.models.rate_points import QUANTIZED_RATES

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

# The steps of 3DGS' rate points, so that the two can be compared.
RATES = QUANTIZED_RATES
