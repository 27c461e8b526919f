"""Named configurations, and the rate points: how much goes, and how much view dependence stays."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    # The student densifies as the authors' code does, from step 600 on.
    "inria": {"student.preset": "inria"},
    # For a CPU and the demo scene: Speedy-Splat's preset `quick` with one hard removal fewer, since the scene is small;
    # a short distillation with larger step sizes that decay; and a file for few Gaussians, to which a codebook adds
    # more bytes than it saves: nearly all keep their own vectors, on lattices as fine as their float16 needs to be.
    "quick": {
        "iterations": 1500,
        "student.preset": "quick",
        "train.stop": 1140,
        "distill.iterations": 600,
        "distill.beta2": 0.98,
        "distill.lr.position_init": 3e-4,
        "distill.lr.position_final": 6e-6,
        "distill.lr.max_steps": 600,
        "distill.lr.sh_dc": 1.5e-2,
        "distill.lr.sh_rest": 4e-3,
        "distill.lr.scales": 1.5e-2,
        "distill.lr.decay": 0.8,
        "distill.lr.decay_interval": 60,
        "codec.sh2.ratio": 0.1,
        "codec.sh3.ratio": 0.1,
        "codec.settings.size": 1024,
        "codec.settings.training": "kmeans",
        "codec.settings.iterations": 20,
        "steps.colors": 1 / 32,
        "steps.opacity": 1 / 8,
        "steps.scales": 1 / 16,
        "steps.quats": 1 / 64,
        "xyz": "uniform16",
    },
}


def _point(soft: float, hard: float, mask_weight: float) -> dict[str, float]:
    return {"train.soft": soft, "train.hard": hard, "mask.weight": mask_weight}


RATES: Mapping[str, Mapping[str, Any]] = {
    "r1": _point(0.80, 0.40, 2e-2),
    "r2": _point(0.80, 0.30, 1e-2),
    "r3": _point(0.70, 0.20, 1e-2),
    "r4": _point(0.50, 0.10, 5e-3),
}
