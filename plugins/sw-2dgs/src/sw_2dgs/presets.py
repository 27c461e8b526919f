"""Named configurations, and the rate points of the file."""

from collections.abc import Mapping
from typing import Any

from sw_gaussians.quick import QUICK

from sw_codecs.models.rate_points import QUANTIZED_RATES

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The authors' code; the weights of the surface follow the data set.
    "paper": {},
    "quick": {**QUICK, "surface.dist_after": 200, "surface.normal_after": 500},
}

# The steps of 3DGS' rate points, so that the two can be compared.
RATES = QUANTIZED_RATES
