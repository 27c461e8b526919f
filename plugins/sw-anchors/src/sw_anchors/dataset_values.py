"""Values that the authors of HAC and HAC++ set by data set, keys of the scene included; the rest is Mip-NeRF 360's.

Source: HAC (arXiv 2403.14530) and HAC++ (arXiv 2501.12255), the scripts of both. The split of BungeeNeRF that goes with
them is that of its family (sw-datasets).
"""

from collections.abc import Mapping
from typing import Any

BY_DATASET: Mapping[str, Mapping[str, Any]] = {
    "tandt": {"voxel_size": 0.01},
    "db": {"voxel_size": 0.005},
    "bungee": {"voxel_size": 0.0, "growth.init_factor": 128},
    "nerf_synthetic": {"growth.init_factor": 4, "background": "black", "init_points": 10_000},
}
