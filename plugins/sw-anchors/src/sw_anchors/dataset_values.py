"""Values that the authors of HAC and HAC++ set by data set, keys of the scene included; the rest is Mip-NeRF 360's.

Source: HAC (arXiv 2403.14530) and HAC++ (arXiv 2501.12255), the scripts of both; `RANDOM_START` is ours. The split of
BungeeNeRF that goes with them is that of its family (sw-datasets).
"""

from collections.abc import Mapping
from typing import Any

RANDOM_START: Mapping[str, Any] = {
    "init_points": 100_000,
    "paired_offsets": True,
    "random_background_until": 1_500,
    "lr.mlp_opacity_early": 0.1,
}
"""Start of scenes in the Blender layout, which as a rule come without points (docs/methods/hac.md).

The authors' code draws 10,000 points where the folder holds none of an earlier 3DGS training, and takes its 100,000
where it does; their figures are those of the latter.
"""

BY_DATASET: Mapping[str, Mapping[str, Any]] = {
    "tandt": {"voxel_size": 0.01},
    "db": {"voxel_size": 0.005},
    "bungee": {"voxel_size": 0.0, "growth.init_factor": 128},
    "nerf_synthetic": {"growth.init_factor": 4, "background": "black", **RANDOM_START},
    "blender": RANDOM_START,
}
