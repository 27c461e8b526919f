"""PUP 3D-GS: Principled Uncertainty Pruning for 3D Gaussian Splatting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod

from sw_pup_3dgs.config import Pup3DGSConfig
from sw_pup_3dgs.presets import PRESETS, RATES
from sw_pup_3dgs.stage import PupStage

if TYPE_CHECKING:
    from splatwizard_core.api import Stage


class Pup3DGS(GaussianMethod):
    """Hanson, Tu, Singla, Jayawardhana, Zwicker, Goldstein: PUP 3D-GS, CVPR 2025 (arXiv 2406.10219).

    1. SCORE    every Gaussian of a trained 3DGS scene by the log determinant of its Fisher block: how much the training
                views would change with its mean and its log scales; no photograph is looked at
    2. PRUNE    the lowest 80 %
    3. TRAIN    the others, as in 3DGS without densification
    4. AGAIN    once, with 50 %: a tenth is left

    Nothing is quantised or coded by the method itself.
    """

    name: ClassVar[str] = "pup-3dgs"
    version: ClassVar[int] = 1
    Config = Pup3DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r3"

    def stages(self) -> Sequence[Stage]:
        return [PupStage(self.config, self.plugins)]
