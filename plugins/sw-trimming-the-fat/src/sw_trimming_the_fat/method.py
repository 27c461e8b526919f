"""Trimming the Fat: Efficient Compression of 3D Gaussian Splats through Pruning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod

from sw_trimming_the_fat.config import TrimmingTheFatConfig
from sw_trimming_the_fat.presets import PRESETS, RATES
from sw_trimming_the_fat.stage import TrimmingStage

if TYPE_CHECKING:
    from splatwizard_core.api import Stage


class TrimmingTheFat(GaussianMethod):
    """Ali, Qamar, Bae, Tartaglione: Trimming the Fat, BMVC 2024 (arXiv 2406.18214).

    1. MEASURE  how much the projected mean of each Gaussian of a trained 3DGS scene is pulled at, over some steps
    2. PRUNE    what lies below a quantile of opacity and below the same quantile of that gradient, in ten small events
    3. TRAIN    between the events and long after them, as in 3DGS without densification

    Nothing is quantised or coded by the method itself.
    """

    name: ClassVar[str] = "trimming-the-fat"
    version: ClassVar[int] = 1
    Config = TrimmingTheFatConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r3"

    def stages(self) -> Sequence[Stage]:
        return [TrimmingStage(self.config, self.plugins)]
