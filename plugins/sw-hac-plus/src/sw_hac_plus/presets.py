"""Named configurations, the authors' values by data set, and the rate points: the authors' five values of lambda."""

from collections.abc import Mapping
from typing import Any

from sw_hac.presets import BY_DATASET as HAC_VALUES
from sw_hac.presets import QUICK

_OWN: Mapping[str, Mapping[str, Any]] = {
    "tandt": {"lr.masks_by_rate": 0.1},
    "db": {"lr.masks_by_rate": 0.08},
    "bungee": {"lr.masks_by_rate": 0.1},
    # The opacity network has its full rate at once, as published, where there are points enough for it: HAC's tenth
    # costs 0.2 dB (docs/methods/hac.md).
    "nerf_synthetic": {"lr.masks_by_rate": 0.08, "channel.kind": "tiny", "lr.mlp_opacity_early": "none"},
}

BY_DATASET: Mapping[str, Mapping[str, Any]] = {
    name: {**values, **_OWN.get(name, {})} for name, values in HAC_VALUES.items()
}

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # Voxels are finer, since anchors lie on their lattice.
    "quick": {
        **QUICK,
        "voxel_size": 0.01,
        "channel.slices": [8, 8, 8],
        "channel.hidden": 24,
        "lr.channel_init": 0.01,
    },
}

RATES: Mapping[str, Mapping[str, Any]] = {
    f"r{i}": {"rate_term.weight": weight} for i, weight in enumerate((0.004, 0.003, 0.002, 0.001, 0.0005), 1)
}
