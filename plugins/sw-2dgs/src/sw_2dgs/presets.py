"""Named configurations, and the rate points of the file."""

from collections.abc import Mapping
from typing import Any

from sw_gaussians.quick import QUICK

from sw_codecs.models.rate_points import QUANTIZED_RATES

PRESETS: Mapping[str, Mapping[str, Any]] = {
    # The authors' code; the weights of the surface follow the data set.
    "paper": {},
    # The demo's background is black and empty: the code's form of the normal loss would reward black surfels over it.
    "quick": {**QUICK, "surface.dist_after": 200, "surface.normal_after": 500, "surface.normal_term": "paper"},
}

# The steps of 3DGS' rate points, so that the two can be compared.
RATES = QUANTIZED_RATES
